"""The page itself: one layout for a running session and for a stored one, on a phone, a desk and a projector."""

from __future__ import annotations

import contextlib
import html
import math
from dataclasses import dataclass, replace
from typing import Any, cast

from fastapi import Response
from nicegui import Client, app, ui
from nicegui.events import GenericEventArguments, ValueChangeEventArguments

from lab.live import charts, words
from lab.live.map import arena_svg
from lab.live.page.source import Source
from lab.live.page.style import SCHEME_SCRIPT, STYLE
from lab.live.story import Moment

_DRAW_EVERY_S = 0.4
_PLAY_EVERY_S = 0.25
_SPEEDS = (1, 5, 20, 50)
_LARGE_PX = 20
_MOST_REMARKS = 6
Options = dict[str, Any]


def build(source: Source) -> None:
    """Register the page and its pictures with NiceGUI."""

    @app.get("/picture.jpg")
    def picture(at: float = math.inf) -> Response:  # pyright: ignore[reportUnusedFunction]
        found = source.picture(at)
        if found is None:
            return Response(status_code=404)
        return Response(found, media_type="image/jpeg", headers={"Cache-Control": "no-store"})

    @ui.page("/", title="chordlab", dark=None)
    async def page(client: Client, large: bool = False) -> None:  # pyright: ignore[reportUnusedFunction]
        view = View(source, large=large)
        view.lay_out()
        await client.connected(timeout=60)
        await view.begin()


@dataclass(slots=True)
class _Figure:
    """A chart and the sentence that stands for it."""

    chart: ui.echart
    text: ui.element


class View:
    """One open page.

    Args:
        source: what is shown, the same for all pages.
        large: whether letters are to be read from afar.
    """

    def __init__(self, source: Source, *, large: bool) -> None:
        self._source = source
        self._large = large
        self._dark = False
        self._chosen = False  # light or dark, by hand
        self._drawn: tuple[Any, ...] | None = None
        self._at_s = math.inf if source.is_live else -math.inf
        self._playing = False
        self._speed = _SPEEDS[2]
        self._said: dict[str, str] = {}
        self._figures: dict[str, _Figure] = {}
        self._facts: dict[str, ui.label] = {}

    def lay_out(self) -> None:
        """Make the page's elements, empty."""
        ui.colors(primary="#0b5f96", secondary="#55616d", negative="#a32020")
        ui.add_head_html(f"<style>{STYLE}</style>")
        self._mode = ui.dark_mode(None)
        with ui.element("main").classes("page") as self._page:
            with ui.element("header").classes("head"):
                self._title = _heading("h1", "chordlab")
                self._state = ui.label("").classes("state").props("role=status aria-live=polite")
                self._headline = ui.label("").classes("headline").props("role=status aria-live=polite")
            with ui.element("div").classes("controls").props('role=group aria-label="Controls"'):
                if self._source.is_live:
                    self._lay_out_buttons()
                else:
                    self._lay_out_slider()
                self._lay_out_looks()
            with ui.element("dl").classes("facts"):
                for name in ("Lines", "Area", "Perimeter", "Time", "Time left", "Battery", "Link"):
                    with ui.element("div"):
                        ui.element("dt").props(f'innerHTML="{name}"')
                        self._facts[name] = _labelled("dd")
            with ui.element("div").classes("panels"):
                self._lay_out_panels()
        self._resize()

    async def begin(self) -> None:
        """Start to draw, once the browser is there and has said whether its system is dark."""
        ui.on("scheme", self._scheme_changed)
        with contextlib.suppress(TimeoutError):
            dark = cast("object", await ui.run_javascript(SCHEME_SCRIPT, timeout=5))
            self._scheme_is(dark is True)
        ui.timer(_DRAW_EVERY_S, self._draw)
        if not self._source.is_live:
            ui.timer(_PLAY_EVERY_S, self._play_on)

    def _lay_out_buttons(self) -> None:
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
        ui.button("Keep note", on_click=self._keep_note).props("no-caps outline")

    def _lay_out_slider(self) -> None:
        self._play = ui.button("Play", on_click=self._press_play).props("no-caps unelevated")
        self._fast = ui.select(
            {speed: f"{speed}×" for speed in _SPEEDS},
            value=self._speed,
            label="Speed",
            on_change=self._choose_speed,
        ).props('dense outlined options-dense aria-label="Speed of replay"')
        self._slider = (
            ui.element("input")
            .props('type=range min=0 max=1000 step=0.1 value=1000 aria-label="Time of the session"')
            .classes("time")
        )
        self._slider.on("input", self._slide, js_handler="(event) => emit(event.target.value)", throttle=0.1)
        self._clock = ui.label("").classes("clock")

    def _lay_out_looks(self) -> None:
        self._dark_switch = ui.switch("Dark", on_change=self._choose_dark).props('aria-label="Dark page"')
        ui.switch("Large text", value=self._large, on_change=self._choose_large).props('aria-label="Large text"')

    def _lay_out_panels(self) -> None:
        with _panel("Camera") as self._camera:
            self._picture = ui.element("img").props('alt="The camera\'s picture with the LED marked"').classes("camera")
        with _panel("Arena and blinks"):
            self._arena = ui.html("", sanitize=False)
            self._arena_says = ui.label("").classes("says")
        for name, title in (
            ("plane", "Area against perimeter"),
            ("names", "Which shape is it?"),
            ("area", "Area A(N)"),
            ("perimeter", "Perimeter P(N)"),
            ("runs", "Blinks along the last runs"),
            ("light", "Light sensor now"),
        ):
            if name == "light" and not self._source.is_live:
                continue
            with _panel(title):
                chart = ui.echart({}, renderer="canvas").classes("chart").props("role=img")
                self._figures[name] = _Figure(chart, _text(""))
        with _panel("What happened"):
            self._remarks = ui.html("", sanitize=False)

    def _draw(self) -> None:
        """Bring the page up to date, where there is something new."""
        source = self._source
        t_s = self._now_s()
        state = (source.version, t_s, self._dark, self._large, source.is_live)
        if state == self._drawn:
            return
        self._drawn = state
        moment, folder = source.moment(t_s), source.folder
        if moment is None or folder is None:
            self._tell_preparing()
            return
        self._tell(moment)
        ink = charts.DARK if self._dark else charts.LIGHT
        ink = replace(ink, text_px=_LARGE_PX) if self._large else ink
        truth, last = folder.truth, moment.last
        standings = moment.standings
        self._show(
            "plane", charts.plane(standings, (truth.area_cm2, truth.perimeter_cm), ink), self._plane_says(moment)
        )
        self._show("names", charts.names(last, ink), _names_say(moment))
        for name, which, true, unit in (
            ("area", "area_cm2", truth.area_cm2, "cm²"),
            ("perimeter", "perimeter_cm", truth.perimeter_cm, "cm"),
        ):
            says = "No line has crossed the shape yet."
            if last is not None:
                value = words.with_error(getattr(last, which), getattr(last, f"sigma_{which}"), unit)
                says = f"{value} after {last.n} lines; the projected shape has {true:.0f} {unit}."
            self._show(name, charts.convergence(standings, which, true, unit, ink), says)
        lit = sum(len(run.lit_cm) for run in moment.runs)
        self._show(
            "runs", charts.runs(moment.runs, ink), f"{lit} blinks in {len(moment.runs)} runs; the newest at the bottom."
        )
        if "light" in self._figures:
            light = list(source.light)
            says = f"{light[-1][1]:.0f} lux; the LED is {'lit' if self._is_lit() else 'dark'}." if light else ""
            self._show("light", charts.light_strip(light, ink), says)
        seen = source.sightings(t_s)
        self._camera.set_visibility(folder.has_camera)
        places = "where the camera saw the LED: lit spots are large, dark ones small"
        places = places if folder.has_camera else "without a camera nobody sees where the robot blinks"
        self._say(self._arena_says, "arena", f"The shape; {places}.")
        drawing = arena_svg(
            folder.settings.arena.polygon,
            folder.outline_cm(),
            seen,
            label=html.escape(f"The arena with {folder.shape.title}; {int(seen.lit.sum())} lit sightings"),
        )
        if self._arena.content != drawing:
            self._arena.set_content(drawing)
        if folder.has_camera:
            stamp = f"at={moment.t_s:.2f}" if not source.is_live else f"new={source.version}"
            self._picture.props(f'src="/picture.jpg?{stamp}"')

    def _tell_preparing(self) -> None:
        self._say(self._title, "title", "chordlab")
        self._say(self._state, "state", self._source.trouble or "Getting ready")
        self._say(self._headline, "headline", str(self._source.news("said", "")))

    def _tell(self, moment: Moment) -> None:
        """The words of a moment."""
        source, folder = self._source, self._source.folder
        if folder is None:
            return
        state = words.state_words(moment.state)
        if source.is_live:
            stopping, paused = bool(source.news("stopping")), bool(source.news("paused"))
            ended = folder.story.has_ended
            if stopping and not ended:
                state = "Stopping"
            elif paused and moment.state == "rolling":
                state = "Pauses after this run"
            self._pause.set_text("Resume" if paused else "Pause")
            self._pause.set_enabled(bool(source.news("can_pause", True)) and not ended)
            next_shape = str(source.news("next_shape", ""))
            self._next.set_visibility(bool(next_shape))
            self._next.set_text(f"Next shape: {next_shape}")
            self._next.set_enabled(not ended)
            self._stop.set_enabled(not ended)
        elif source.session_gone.is_set():
            state = f"{state}. The session has left; look again: chordlab watch {folder.session.folder}"
            for button in (self._pause, self._next, self._stop):
                button.set_enabled(False)
        if source.trouble:
            state = source.trouble
        self._say(self._title, "title", folder.shape.title)
        self._say(self._state, "state", state)
        self._say(self._headline, "headline", words.headline(moment.last))
        speed = source.news("speed") if source.is_live else None
        link = folder.link_quality(moment.runs)
        for name, text in words.facts(moment, folder.story.lines, link, source.batteries(moment), speed).items():
            self._say(self._facts[name], name, text)
        remarks = "".join(
            f"<li><span class=when>{words.duration(remark.t_s - folder.story.t_begin_s)}</span> "
            f"{html.escape(remark.text)}</li>"
            for remark in reversed(moment.remarks[-_MOST_REMARKS:])
        )
        listing = f"<ul class=remarks>{remarks}</ul>" if remarks else "<p>Nothing besides the lines.</p>"
        if self._remarks.content != listing:
            self._remarks.set_content(listing)
        if not source.is_live and hasattr(self, "_clock"):
            begin_s = folder.story.t_begin_s
            self._say(self._clock, "clock", f"{moment.t_s - begin_s:.0f} of {folder.story.t_end_s - begin_s:.0f} s")

    def _say(self, label: ui.label, name: str, text: str) -> None:
        """Set a text, only if it is another: a screen reader reads what changes."""
        if self._said.get(name) != text:
            self._said[name] = text
            label.set_text(text)

    def _show(self, name: str, options: Options, says: str) -> None:
        figure = self._figures[name]
        held = cast("Options", figure.chart.options)  # pyright: ignore[reportUnknownMemberType]
        held.clear()
        held.update(options)
        figure.chart.update()
        if self._said.get(f"figure {name}") != says:
            self._said[f"figure {name}"] = says
            figure.chart.props(f'aria-label="{html.escape(says) or name}"')
            figure.text.props(f'innerHTML="{html.escape(says)}"')

    def _plane_says(self, moment: Moment) -> str:
        last = moment.last
        if last is None:
            return "No line has crossed the shape yet."
        return (
            f"A {words.with_error(last.area_cm2, last.sigma_area_cm2, 'cm²')}, "
            f"P {words.with_error(last.perimeter_cm, last.sigma_perimeter_cm, 'cm')}. "
            "The 95 % ellipses shrink onto the true shape, the diamond."
        )

    def _is_lit(self) -> bool:
        return any(robot.get("lit") for robot in self._source.news("robots", {}).values())

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

    def _now_s(self) -> float:
        """The time that is shown, s of the session's clock."""
        folder = self._source.folder
        if self._source.is_live or folder is None or self._source.session_gone.is_set():
            return math.inf
        if self._at_s == -math.inf:
            self._at_s = folder.story.t_end_s
            span_s = max(1.0, folder.story.t_end_s - folder.story.t_begin_s)
            self._slider.props(f"max={span_s:.1f} value={span_s:.1f}")
        return self._at_s

    def _slide(self, event: GenericEventArguments) -> None:
        folder = self._source.folder
        if folder is not None:
            self._at_s = folder.story.t_begin_s + float(event.args)
            self._slider.props(f"value={float(event.args):.1f}")  # or the next drawing would put it back
            self._draw()

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

    def _scheme_changed(self, event: GenericEventArguments) -> None:
        self._scheme_is(bool(event.args))

    def _scheme_is(self, dark: bool) -> None:
        """The system's scheme, at first and whenever it changes; a choice by hand goes before."""
        if not self._chosen:
            self._dark = dark
            self._dark_switch.set_value(dark)
            self._mode.set_value(dark)

    def _choose_speed(self, change: ValueChangeEventArguments[Any]) -> None:
        self._speed = int(change.value)

    def _choose_dark(self, change: ValueChangeEventArguments[Any]) -> None:
        if bool(change.value) != self._dark:
            self._chosen = True
            self._dark = bool(change.value)
            self._mode.set_value(self._dark)

    def _choose_large(self, change: ValueChangeEventArguments[Any]) -> None:
        self._large = bool(change.value)
        self._resize()

    def _resize(self) -> None:
        self._page.classes(add="large") if self._large else self._page.classes(remove="large")


def _heading(tag: str, text: str) -> ui.label:
    label = ui.label(text)
    label.tag = tag
    return label


def _labelled(tag: str) -> ui.label:
    return _heading(tag, "–")


def _panel(title: str) -> ui.element:
    """A part of the page with its heading; use as a context manager to fill it."""
    panel = ui.element("section").classes("panel").props(f'aria-label="{title}"')
    with panel:
        _heading("h2", title)
    return panel


def _text(text: str) -> ui.element:
    return ui.element("p").classes("says").props(f'innerHTML="{html.escape(text)}"')


def _names_say(moment: Moment) -> str:
    if moment.last is None:
        return "No line has crossed the shape yet."
    return (
        ", ".join(f"{name} {words.percent(share)}" for name, share in moment.last.names[:3])
        + ", if it is in the dictionary."
    )
