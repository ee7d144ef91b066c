"""A report as a single HTML file that needs nothing else: figures, style and text are inside."""

from __future__ import annotations

import base64
import itertools
import re
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup

from analysis.figures import pen
from analysis.figures.style import png_bytes, svg_text
from analysis.report.panels import Panel, panels_of
from analysis.report.result import SessionResult
from analysis.report.tables import history_table, provenance_of, tables_of
from analysis.report.verdict import verdict_of
from analysis.report.words import typographic
from lab.base.errors import RequestError
from lab.base.files import write_aside

SVG_LIMIT = 300_000  # characters; a larger figure is smaller, and faster to show, as an image
_SCREEN_DPI = 96
_PAGE_COLOURS = {pen.INK: "var(--ink)", pen.MUTED: "var(--muted)", pen.GRID: "var(--grid)", pen.PAPER: "var(--paper)"}


@dataclass(frozen=True, slots=True)
class Shown:
    """A panel as the template takes it."""

    name: str
    title: str
    alt: str
    caption: str
    picture: Markup


class ReportFileError(RequestError):
    """The report could not be written. Attribute: ``path``."""

    def __init__(self, path: Path, reason: str) -> None:
        self.path = path
        super().__init__(f"cannot write the report to {path} ({reason}): give a place that can be written to")


def write_report(result: SessionResult, path: Path) -> Path:
    """Write the report of ``result`` to ``path`` (.html) and return it; a reader never sees half a file.

    Raises:
        ReportFileError: The file cannot be written.
    """
    return keep_page(render_report(result), path)


def keep_page(page: str, path: Path) -> Path:
    """Write a page whole or not at all, and return its path. Raises ReportFileError."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_aside(path, page.encode())
    except OSError as error:
        raise ReportFileError(path, error.strerror or type(error).__name__) from error
    return path


def render_report(result: SessionResult) -> str:
    """Give the report of ``result`` as HTML text. The same result gives the same text."""
    panels, left_out = panels_of(result)
    return page_of("template.html.j2").render(
        result=result,
        verdict=verdict_of(result),
        panels=[shown(panel) for panel in panels],
        left_out=left_out,
        tables=tables_of(result),
        history=history_table(result),
        provenance=provenance_of(result),
    )


def page_of(template: str) -> Template:
    """Give a template of this folder, which escapes all that is put into it."""
    environment = Environment(
        loader=PackageLoader("analysis", "report"), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    environment.filters["typeset"] = _typeset
    return environment.get_template(template)


def _typeset(text: str) -> Markup:
    """Keep units on the line of their numbers, and set what stands between backticks as code."""
    return Markup("").join(
        _code(part) if index % 2 else _with_units(typographic(part)) for index, part in enumerate(text.split("`"))
    )


def _code(text: str) -> Markup:
    """A command or a setting: lines are broken between its words only."""
    words = Markup(" ").join(Markup("<span>{}</span>").format(word) for word in text.split())
    return Markup("<code>{}</code>").format(words)


def _with_units(text: str) -> str:
    return re.sub(r"(?<=[\d)]) (?=(?:%|cm|σ))|(?<=[pmNAP]) (?=[=<] )|(?<== )(?=$)|(?<=[\d%]) (?=± )", "\u202f", text)


def shown(panel: Panel) -> Shown:
    """Make a figure ready for the page: inline SVG, or an image where that is smaller."""
    svg = svg_text(panel.figure)
    picture = _image(panel) if len(svg) > SVG_LIMIT else _inline(svg, panel)
    return Shown(panel.name, panel.title, panel.alt, panel.caption, picture)


def _image(panel: Panel) -> Markup:
    data = base64.b64encode(png_bytes(panel.figure)).decode("ascii")
    width_px, height_px = (round(inches * _SCREEN_DPI) for inches in panel.figure.get_size_inches().tolist())
    return Markup('<img class="card" src="data:image/png;base64,{}" alt="{}" width="{}" height="{}">').format(
        data, panel.alt, width_px, height_px
    )


def _inline(svg: str, panel: Panel) -> Markup:
    """Fit an <svg> into the page: the page's colours, ids of its own, a name for who cannot see it."""
    svg = re.sub(r"#[0-9a-f]{6}\b", lambda match: _PAGE_COLOURS.get(match.group(), match.group()), svg)
    svg = _own_ids(svg, panel.name)
    width_px = round(float(panel.figure.get_size_inches()[0]) * _SCREEN_DPI)
    head = Markup('<svg role="img" aria-label="{}" style="max-width:{}px"').format(panel.alt, width_px)
    opening, rest = svg.split(">", 1)
    opening = re.sub(r'\s(?:width|height|version)="[^"]*"', "", opening).removeprefix("<svg")
    return Markup(f"{head}{opening}>{rest}")


def _own_ids(svg: str, prefix: str) -> str:
    """Number the ids behind ``prefix``: matplotlib's repeat, in a figure and between figures, or are random."""
    first: dict[str, str] = {}
    numbers = itertools.count()

    def renamed(match: re.Match[str]) -> str:
        new = f"{prefix}-{next(numbers)}"
        first.setdefault(match.group(1), new)
        return f'id="{new}"'

    svg = re.sub(r'\bid="([^"]+)"', renamed, svg)
    return re.sub(r'(href="#|url\(#)([^")]+)', lambda match: match.group(1) + first[match.group(2)], svg)
