"""What people press: the buttons of a running session, or the slider of a stored one."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from nicegui import ui
from nicegui.events import GenericEventArguments, ValueChangeEventArguments

from lab.live.page.parts import say
from lab.live.page.source import Source
from lab.live.story import Moment

_PLAY_EVERY_S = 0.25
_SPEEDS = (1, 5, 20, 50)
_USUAL_SPEED = 20


class Buttons:
    """Pause, resume, stop, next shape and notes.

    Args:
        source: whose session they lead.
    """

    def __init__(self, source: Source) -> None:
        self._source = source

    def lay_out(self) -> None:
        """Make the buttons."""
        self._pause = ui.button("Pause", on_click=self._press_pause).props("no-caps unelevated")
        self._next = ui.button("Next shape", on_click=lambda: self._press("next")).props("no-caps outline")
        with ui.dialog().props('aria-label="Stop the session?"') as sure, ui.card():
            ui.label("Stop the session? What is rolled is kept.")
            with ui.row():
                ui.button("Stop it", on_click=lambda: (sure.close(), self._press("stop"))).props(
                    "no-caps unelevated color=negative"
                )
                ui.button("Go on", on_click=sure.close).props("no-caps outline")
        self._stop = ui.button("Stop", on_click=sure.open).props("no-caps unelevated color=negative")
        self._note = (
            ui.input(label="Note for the log").props('dense outlined maxlength=500 aria-label="Note for the log"')
        ).classes("note")
        self._note.on("keydown.enter", self._keep_note)
        self._keep = ui.button("Keep note", on_click=self._keep_note).props("no-caps outline")

    def update(self, *, ended: bool) -> None:
        """Bring them up to date; after the end none can be pressed."""
        source = self._source
        gone = source.session_gone.is_set()
        ended = ended or gone
        say_on(self._pause, "Resume" if source.news("paused") else "Pause")
        self._pause.set_enabled(bool(source.news("can_pause", True)) and not ended)
        next_shape = str(source.news("next_shape", ""))
        self._next.set_visibility(bool(next_shape))
        say_on(self._next, f"Next shape: {next_shape}")
        self._next.set_enabled(not ended)
        self._stop.set_enabled(not ended)
        for part in (self._note, self._keep):
            part.set_enabled(not gone)

    def _press(self, what: str, **more: str) -> None:
        if not self._source.command({"do": what, **more}):
            ui.notify("The session is gone", type="warning")

    def _press_pause(self) -> None:
        self._press("resume" if self._source.news("paused") else "pause")

    def _keep_note(self) -> None:
        text = str(self._note.value or "").strip()
        if text:
            self._press("note", text=text)
            self._note.set_value("")


class Slider:
    """The time of a stored session, moved by hand or playing by itself.

    Args:
        source: of the session.
        moved: called when another time is chosen by hand.
    """

    def __init__(self, source: Source, moved: Callable[[], None]) -> None:
        self._source = source
        self._moved = moved
        self._at_s = -math.inf
        self._playing = False
        self._speed = _USUAL_SPEED

    def lay_out(self) -> None:
        """Make the slider and what is about it."""
        self._play = ui.button("Play", on_click=self._press_play).props("no-caps unelevated")
        ui.select(
            {speed: f"{speed}×" for speed in _SPEEDS}, value=self._speed, label="Speed", on_change=self._choose_speed
        ).props('dense outlined options-dense aria-label="Speed of replay"')
        self._slider = (
            ui.element("input")
            .props('type=range min=0 max=1000 step=0.1 value=1000 aria-label="Time of the session"')
            .classes("time")
        )
        self._slider.on("input", self._slide, js_handler="(event) => emit(event.target.value)", throttle=0.1)
        self._clock = ui.label("").classes("clock")

    def begin(self) -> None:
        """Let it play when it is asked to."""
        ui.timer(_PLAY_EVERY_S, self._play_on)

    @property
    def t_s(self) -> float:
        """The time that is chosen, s of the session's clock; the end at first."""
        folder = self._source.folder
        if folder is None:
            return math.inf
        if self._at_s == -math.inf:
            self._at_s = folder.story.t_end_s
            span_s = max(1.0, folder.story.t_end_s - folder.story.t_begin_s)
            self._slider.props(f"max={span_s:.1f} value={span_s:.1f}")
        return self._at_s

    def tell(self, moment: Moment) -> None:
        """Say what time it is."""
        if (folder := self._source.folder) is not None:
            begin_s = folder.story.t_begin_s
            say(self._clock, f"{moment.t_s - begin_s:.0f} of {folder.story.t_end_s - begin_s:.0f} s")

    def _slide(self, event: GenericEventArguments) -> None:
        folder = self._source.folder
        if folder is not None:
            self._at_s = folder.story.t_begin_s + float(event.args)
            self._slider.props(f"value={float(event.args):.1f}")  # or the next drawing would put it back
            self._moved()

    def _press_play(self) -> None:
        folder = self._source.folder
        self._playing = not self._playing
        if self._playing and folder is not None and self._at_s >= folder.story.t_end_s:
            self._at_s = folder.story.t_begin_s
        self._play.set_text("Halt" if self._playing else "Play")

    def _play_on(self) -> None:
        folder = self._source.folder
        if not self._playing or folder is None:
            return
        self._at_s = min(folder.story.t_end_s, self._at_s + _PLAY_EVERY_S * self._speed)
        self._slider.props(f"value={self._at_s - folder.story.t_begin_s:.1f}")
        if self._at_s >= folder.story.t_end_s:
            self._press_play()

    def _choose_speed(self, change: ValueChangeEventArguments[Any]) -> None:
        self._speed = int(change.value)


def say_on(button: ui.button, text: str) -> None:
    """Letter a button, if it is lettered otherwise."""
    if button.text != text:
        button.set_text(text)
