"""The page itself: one layout for a running session and for a stored one, on a phone, a desk and a projector."""

from __future__ import annotations

import html
import math
import time
from typing import Any

from fastapi import Response
from nicegui import Client, app, ui

from lab.live import words
from lab.live.folder import StoryFolder
from lab.live.page.buttons import Buttons, Slider
from lab.live.page.figures import TITLES, arena_says, draw_light
from lab.live.page.parts import Figure, Looks, heading, panel, say
from lab.live.page.source import Source
from lab.live.page.style import FAREWELL_SCRIPT, STYLE
from lab.live.story import Moment

_DRAW_EVERY_S = 0.4
_FIGURES_EVERY_S = 1.0  # of a running session; they are most of what is sent
_MOST_REMARKS = 6


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


def is_looked_at() -> bool:
    """Whether any page is open in a browser."""
    return any(client.has_socket_connection for client in Client.instances.values())


class View:
    """One open page.

    Args:
        source: what is shown, the same for all pages.
        large: whether letters are to be read from afar.
    """

    def __init__(self, source: Source, *, large: bool) -> None:
        self._source = source
        self._large = large
        self._slider = None if source.is_live else Slider(source, self._draw)
        self._buttons = Buttons(source) if source.is_live else None
        self._drawn: tuple[Any, ...] | None = None
        self._figured: tuple[Any, ...] | None = None
        self._next_figures_s = -math.inf
        self._figures: dict[str, Figure] = {}
        self._facts: dict[str, ui.label] = {}
        self._parted = False

    def lay_out(self) -> None:
        """Make the page's elements, empty."""
        ui.colors(primary="#0b5f96", secondary="#55616d", negative="#a32020")
        ui.add_head_html(f"<style>{STYLE}</style>")
        with ui.element("main").classes("page") as main:
            self._looks = Looks(main, large=self._large, changed=self._draw)
            with ui.element("header").classes("head"):
                self._title = heading("h1", "chordlab")
                self._state = ui.label("").classes("state").props("role=status aria-live=polite")
                self._headline = ui.label("").classes("headline").props("role=status aria-live=polite")
                self._after = ui.label("").classes("after").props("role=status aria-live=polite")
            with ui.element("div").classes("controls").props('role=group aria-label="Controls"') as self._controls:
                for part in (self._buttons, self._slider, self._looks):
                    if part is not None:
                        part.lay_out()
            with ui.element("dl").classes("facts"):
                for name in ("Lines", "Area", "Perimeter", "Time", "Time left", "Battery", "Link"):
                    with ui.element("div"):
                        heading("dt", name)
                        self._facts[name] = heading("dd", "–")
            with ui.element("div").classes("panels"):
                self._lay_out_panels()

    async def begin(self) -> None:
        """Start to draw, once the browser is there and has said whether its system is dark."""
        await self._looks.begin()
        ui.timer(_DRAW_EVERY_S, self._draw)
        if self._slider is not None:
            self._slider.begin()

    def _lay_out_panels(self) -> None:
        with panel("Camera") as self._camera:
            self._picture = ui.element("img").props('alt="The camera\'s picture with the LED marked"').classes("camera")
        with panel("Arena and blinks"):
            self._arena = ui.html("", sanitize=False)
            self._arena_says = ui.label("").classes("says")
        for name, title in TITLES.items():
            if name != "light" or self._source.is_live:
                self._figures[name] = Figure(title)
        with panel("What happened"):
            self._remarks = ui.html("", sanitize=False)

    def _draw(self) -> None:
        """Bring the page up to date, where there is something new."""
        source, ink = self._source, self._looks.ink
        t_s = math.inf if self._slider is None else self._slider.t_s
        gone = source.session_gone.is_set()
        state = (source.version, t_s, ink, gone)
        if state == self._drawn and self._figured == (source.log_version, t_s, ink):
            return
        self._drawn = state
        moment, folder = source.moment(t_s), source.folder
        if moment is None or folder is None:
            say(self._state, source.trouble or "Getting ready")
            say(self._headline, str(source.news("said", "")))
        else:
            self._tell(moment, folder)
            self._show_figures(t_s, at_once=gone)
            self._show_picture(moment, folder)
            if "light" in self._figures:
                lit = {name: bool(robot.get("lit")) for name, robot in source.news("robots", {}).items()}
                light = {name: list(samples) for name, samples in sorted(source.light.items())}
                self._figures["light"].show(draw_light(light, lit, ink))
        if gone and not self._parted:  # nothing more will come, and nobody is there to ask: the page stays as it is
            self._parted = True
            self._controls.set_visibility(False)
            ui.run_javascript(FAREWELL_SCRIPT)

    def _show_figures(self, t_s: float, *, at_once: bool) -> None:
        source, ink = self._source, self._looks.ink
        wanted, now_s = (source.log_version, t_s, ink), time.monotonic()
        hurry = at_once or self._figured is None or wanted[1:] != self._figured[1:]
        if not hurry and now_s < self._next_figures_s:
            return
        self._next_figures_s = now_s + _FIGURES_EVERY_S
        drawings = source.drawings(t_s, ink)
        if drawings is None:
            return
        self._figured = wanted
        for name, drawing in drawings.figures.items():
            self._figures[name].show(drawing)
        if self._arena.content != drawings.arena_svg:
            self._arena.set_content(drawings.arena_svg)

    def _show_picture(self, moment: Moment, folder: StoryFolder) -> None:
        self._camera.set_visibility(folder.has_camera)
        if folder.has_camera:
            stamp = f"new={self._source.picture_number}" if self._source.is_live else f"at={moment.t_s:.2f}"
            self._picture.props(f'src="/picture.jpg?{stamp}"')

    def _tell(self, moment: Moment, folder: StoryFolder) -> None:
        """The words of a moment."""
        source = self._source
        say(self._title, folder.shape.title)
        say(self._state, self._state_words(moment, folder))
        say(self._headline, words.headline(moment.last))
        say(self._after, self._words_after(folder))
        say(self._arena_says, arena_says(folder))
        speed = source.news("speed") if source.is_live else None
        link = folder.link_quality(moment.runs)
        for name, text in words.facts(moment, folder.story.lines, link, source.batteries(moment), speed).items():
            say(self._facts[name], text)
        remarks = "".join(
            f"<li><span class=when>{words.duration(remark.t_s - folder.story.t_begin_s)}</span> "
            f"{html.escape(remark.text)}</li>"
            for remark in reversed(moment.remarks[-_MOST_REMARKS:])
        )
        listing = f"<ul class=remarks>{remarks}</ul>" if remarks else "<p>Nothing besides the lines.</p>"
        if self._remarks.content != listing:
            self._remarks.set_content(listing)
        if self._slider is not None:
            self._slider.tell(moment)
        if self._buttons is not None:
            self._buttons.update(ended=folder.story.has_ended)

    def _state_words(self, moment: Moment, folder: StoryFolder) -> str:
        source = self._source
        if source.trouble:
            return source.trouble
        if source.is_live and not folder.story.has_ended:
            if source.session_gone.is_set():
                return "Cut off"
            if source.news("stopping"):
                return "Stopping"
            if source.news("paused") and moment.state == "rolling":
                return "Pauses after this run"
        return words.state_words(moment.state)

    def _words_after(self, folder: StoryFolder) -> str:
        """What is said once the rolling is over."""
        if not self._source.is_live or not (folder.story.has_ended or self._source.session_gone.is_set()):
            return ""
        if not self._source.session_gone.is_set():
            return "The report is being written" if folder.report is None else f"Report: {folder.report}"
        told = f"Report: {folder.report}" if folder.report is not None else "No report was written"
        return f"{told}\nLook again: chordlab watch {folder.session.folder}"
