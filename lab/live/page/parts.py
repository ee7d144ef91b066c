"""What the page is made of: headings, panels, figures, and what visitors choose of its looks."""

from __future__ import annotations

import contextlib
import html
from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

from nicegui import ui
from nicegui.events import GenericEventArguments, ValueChangeEventArguments

from lab.live import charts
from lab.live.page.figures import Drawing, Options
from lab.live.page.style import SCHEME_SCRIPT

_LARGE_PX = 20


def heading(tag: str, text: str) -> ui.label:
    """A text in an HTML element of its own kind."""
    label = ui.label(text)
    label.tag = tag
    return label


def panel(title: str) -> ui.element:
    """A part of the page with its heading; use as a context manager to fill it."""
    made = ui.element("section").classes("panel").props(f'aria-label="{title}"')
    with made:
        heading("h2", title)
    return made


def say(label: ui.label, text: str) -> None:
    """Set a text, only if it is another: a screen reader reads what changes."""
    if label.text != text:
        label.set_text(text)


class Figure:
    """A chart and the sentence that stands for it."""

    def __init__(self, title: str) -> None:
        with panel(title):
            self._chart = ui.echart({}, renderer="canvas").classes("chart").props("role=img")
            self._text = heading("p", "").classes("says")
        self._title = title
        self._shown: Drawing | None = None

    def show(self, drawing: Drawing) -> None:
        """Show it, unless it is shown already."""
        if drawing is self._shown:
            return
        self._shown = drawing
        held = cast("Options", self._chart.options)  # pyright: ignore[reportUnknownMemberType]
        held.clear()
        held.update(drawing.options)
        self._chart.update()
        if self._text.text != drawing.says:
            self._chart.props(f'aria-label="{html.escape(drawing.says) or self._title}"')
            self._text.set_text(drawing.says)


class Looks:
    """Light or dark, as the system is until somebody chooses; and how large the letters are.

    Args:
        page: the element whose letters grow.
        large: whether they are to be read from afar.
        changed: called when anything was chosen.
    """

    def __init__(self, page: ui.element, *, large: bool, changed: Callable[[], None]) -> None:
        self._page = page
        self._large = large
        self._dark = False
        self._chosen = False
        self._changed = changed
        self._mode = ui.dark_mode(None)

    def lay_out(self) -> None:
        """Make the two switches."""
        self._switch = ui.switch("Dark", on_change=self._choose_dark).props('aria-label="Dark page"')
        ui.switch("Large text", value=self._large, on_change=self._choose_large).props('aria-label="Large text"')
        self._resize()

    async def begin(self) -> None:
        """Ask the browser, and be told whenever its system changes."""
        ui.on("scheme", self._scheme_changed)
        with contextlib.suppress(TimeoutError):
            dark = cast("object", await ui.run_javascript(SCHEME_SCRIPT, timeout=5))
            self._scheme_is(dark is True)

    @property
    def ink(self) -> charts.Ink:
        """What charts are drawn with."""
        ink = charts.DARK if self._dark else charts.LIGHT
        return replace(ink, text_px=_LARGE_PX) if self._large else ink

    def _scheme_changed(self, event: GenericEventArguments) -> None:
        self._scheme_is(bool(event.args))

    def _scheme_is(self, dark: bool) -> None:
        """The system's scheme, at first and whenever it changes; a choice by hand goes before."""
        if not self._chosen:
            self._dark = dark
            self._switch.set_value(dark)
            self._mode.set_value(dark)
            self._changed()

    def _choose_dark(self, change: ValueChangeEventArguments[Any]) -> None:
        if bool(change.value) != self._dark:
            self._chosen = True
            self._dark = bool(change.value)
            self._mode.set_value(self._dark)
            self._changed()

    def _choose_large(self, change: ValueChangeEventArguments[Any]) -> None:
        self._large = bool(change.value)
        self._resize()
        self._changed()

    def _resize(self) -> None:
        self._page.classes(add="large") if self._large else self._page.classes(remove="large")
