"""The paper's panels, one function each, drawn from the workbench and written to a folder."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from analysis.figures.paper.explored import blinks_panel, chords_panel, evolution_panel, way_panel
from analysis.figures.paper.needed import crowd_panel, letters_panel, needed_panel, words_panel
from analysis.figures.paper.panel import PANELS, PaperPanel, write_panel
from analysis.figures.paper.plane import domains_panel, window_of
from analysis.figures.paper.precision import complexity_panel, scatter_panel
from analysis.figures.paper.word import global_panel, letters_plane_panel, local_panel, whole_plane_panel
from analysis.tablestore import Mapper
from lab.base.errors import ChordlabError, RequestError
from lab.base.files import write_aside
from lab.figures.robots import NO_SESSIONS, Stored
from lab.figures.workbench import COSTS, ELLIPSES_AT, WORD, Scale, Workbench
from lab.settings.settings import Settings
from projector.shape import Font
from projector.text import TEXT_PREFIX

Progress = Callable[[int, int], None]
Maker = Callable[[Workbench, str], PaperPanel]

SHEET = "index.html"
FEW, MANY, LETTERS_AT, WORDS_AT = 200, 1000, 30_000, 30_000  # lines in 2G and H, 2I and J, 3A, 3C
FIT_FROM = 30
_CROWD = ("chichen_itza", "eiffel", "liberty")
_DRAWING = 12  # tenths of a second for a panel's files


@dataclass(frozen=True, slots=True)
class Drawn:
    """What was written: the panels, every file, and the sessions that were left out with the reason."""

    panels: tuple[PaperPanel, ...]
    files: tuple[Path, ...]
    left_out: tuple[tuple[str, str], ...]


def _blinks(shape: str, *, growing: bool = False) -> Maker:
    def make(bench: Workbench, name: str) -> PaperPanel:
        seen = bench.seen[shape]
        counts = [n for n in bench.scale.blinks if n < seen.lines] if growing else []
        if seen.track is None:
            raise ChordlabError(f"{seen.source} was not seen by a camera; leave it out")
        return blinks_panel(name, seen, seen.track, [*counts, None])

    return make


def _tower_chords(bench: Workbench, name: str) -> PaperPanel:
    return chords_panel(name, [bench.robots["eiffel"]], bench.exact)


def _other_chords(bench: Workbench, name: str) -> PaperPanel:
    return chords_panel(name, [robot for shape, robot in bench.robots.items() if shape != "eiffel"], bench.exact)


def _way(bench: Workbench, name: str) -> PaperPanel:
    return way_panel(name, list(bench.robots.values()), bench.simulated, bench.exact, n=ELLIPSES_AT)


def _evolution(column: str) -> Maker:
    return lambda bench, name: evolution_panel(
        name, list(bench.robots.values()), bench.simulated, bench.exact, column=column
    )


def _scatter(column: str) -> Maker:
    return lambda bench, name: scatter_panel(
        name, bench.titles, bench.simulated, bench.exact, bench.fits[column], column=column, first=FIT_FROM
    )


def _domains(n: int) -> Maker:
    return lambda bench, name: domains_panel(name, bench.six, window_of(bench.six, FEW, points=bench.scale.grid), n=n)


def _needed(bench: Workbench, name: str) -> PaperPanel:
    return needed_panel(name, bench.six, window_of(bench.six, FEW, points=bench.scale.grid), n=FEW)


def _crowd(bench: Workbench, name: str) -> PaperPanel:
    return crowd_panel(
        name, bench.six, window_of(bench.six, MANY, names=_CROWD, room=0.3, points=bench.scale.grid), n=MANY
    )


def _letters(bench: Workbench, name: str) -> PaperPanel:
    window = window_of(bench.letters, LETTERS_AT, room=0.05, points=bench.scale.grid)
    return domains_panel(
        name, bench.letters, window, n=LETTERS_AT, size_in=(7.2, 5.4), kind="capitals", grid_table=False
    )


def _words(bench: Workbench, name: str) -> PaperPanel:
    window = window_of(bench.words, WORDS_AT, log=True, room=0.05, points=bench.scale.grid)
    return domains_panel(name, bench.words, window, n=WORDS_AT, size_in=(7.2, 6.4), kind="words", grid_table=False)


def _word_in_letters(bench: Workbench, name: str) -> PaperPanel:
    spelt = [f"{TEXT_PREFIX}{letter}" for letter in WORD]
    return letters_plane_panel(name, bench.alphabet, bench.read, spelt, font=bench.font.name, points=bench.scale.grid)


MAKERS: Mapping[str, tuple[Maker, tuple[str, ...]]] = {
    "1B": (_blinks("eiffel", growing=True), ("robots",)),
    "1C": (_blinks("triangle"), ("robots",)),
    "1D": (_blinks("chichen_itza"), ("robots",)),
    "1E": (_blinks("liberty"), ("robots",)),
    "1F": (_tower_chords, ("robots", "exact")),
    "1G": (_way, ("robots", "exact", "simulated")),
    "2A": (_other_chords, ("robots", "exact")),
    "2B": (_evolution("area_cm2"), ("robots", "exact", "simulated")),
    "2C": (_evolution("perimeter_cm"), ("robots", "exact", "simulated")),
    "2D": (_scatter("area_cm2"), ("exact", "simulated", "fits")),
    "2E": (_scatter("perimeter_cm"), ("exact", "simulated", "fits")),
    "2F": (lambda bench, name: complexity_panel(name, bench.complexity), ("exact", "simulated", "fits", "complexity")),
    "2G": (_domains(FEW), ("exact", "shapes")),
    "2H": (_needed, ("exact", "shapes")),
    "2I": (_domains(MANY), ("exact", "shapes")),
    "2J": (_crowd, ("exact", "shapes")),
    "3A": (_letters, ("letters",)),
    "3B": (lambda bench, name: letters_panel(name, bench.letters, font=bench.font.name), ("letters",)),
    "3C": (_words, ("words",)),
    "3D": (
        lambda bench, name: words_panel(name, bench.words, bench.letters.lines_needed()),
        ("letters", "words"),
    ),
    "3E": (_word_in_letters, ("alphabet", "read")),
    "3F": (
        lambda bench, name: whole_plane_panel(
            name, bench.words, bench.read, f"{TEXT_PREFIX}{WORD}", points=bench.scale.grid
        ),
        ("words", "alphabet", "read"),
    ),
    "3G": (lambda bench, name: local_panel(name, bench.read), ("alphabet", "read")),
    "3H": (
        lambda bench, name: global_panel(name, bench.read, bench.strategies),
        ("words", "alphabet", "read", "strategies"),
    ),
}


def draw_figures(
    names: Sequence[str],
    out: Path,
    *,
    seed: int = 1,
    settings: Settings | None = None,
    scale: Scale | None = None,
    font: Font | None = None,
    stored: Stored = NO_SESSIONS,
    progress: Progress = lambda _done, _total: None,
    mapper: Mapper | None = None,
) -> Drawn:
    """Draw the panels ``names`` (`analysis.figures.paper.panel.chosen_panels`) and a contact sheet into ``out``.

    The same seed, scale and sessions give the same tables, whichever panels are asked for. ``progress`` is called with
    (spent, in all), in tenths of a second or so. ``mapper`` spreads the work and does not change it: see `Workbench`.

    Raises:
        RequestError: ``out`` cannot be written.
    """
    total = sum(COSTS[product] for product in {need for name in names for need in MAKERS[name][1]})
    total += _DRAWING * len(names)
    done = 0.0

    def spent(cost: float) -> None:
        nonlocal done
        done += cost
        progress(min(round(done), total), total)

    bench = Workbench(
        settings or Settings(),
        seed=seed,
        scale=scale or Scale(),
        font=font,
        stored=stored,
        spent=spent,
        mapper=mapper,
    )
    panels: list[PaperPanel] = []
    files: list[Path] = []
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name in names:
            panel = MAKERS[name][0](bench, name)
            files += write_panel(panel, out)
            panel.figure.clear()
            panels.append(panel)
            spent(_DRAWING)
        write_aside(out / SHEET, _sheet(panels, seed).encode())
    except OSError as error:
        raise RequestError(f"{out}: cannot be written ({error.strerror or error}); choose another --out") from error
    progress(total, total)
    return Drawn(tuple(panels), (*files, out / SHEET), stored.left_out)


_STYLE = (
    "body{font:15px/1.5 sans-serif;max-width:62em;margin:2em auto;padding:0 1em;color:#1b1f24;background:#fff}"
    "figure{margin:0 0 3em}img{max-width:100%;height:auto}figcaption{max-width:48em}h2{font-size:1.05em;margin:0}"
)


def _sheet(panels: Sequence[PaperPanel], seed: int) -> str:
    """A page with every panel, its caption and its files."""
    parts: list[str] = []
    for panel in panels:
        tables = ", ".join(
            f'<a href="{panel.name}{"-" if part else ""}{part}.csv">{part or "data"}</a>' for part in panel.tables
        )
        parts.append(
            f'<figure id="{panel.name}"><h2>{panel.name}. {html.escape(panel.title)}</h2>'
            f'<img src="{panel.name}.png" alt="{html.escape(panel.title)}" width="864">'
            f'<figcaption>{html.escape(panel.caption)} <a href="{panel.name}.svg">svg</a>, {tables}</figcaption>'
            "</figure>"
        )
    first = f"Panels {', '.join(panel.name for panel in panels)}; random lines from seed {seed}."
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>The figures of the paper</title>'
        f"<style>{_STYLE}</style></head><body><h1>The figures of the paper</h1><p>{first}</p>\n"
        + "\n".join(parts)
        + "\n</body></html>\n"
    )


def as_found(drawn: Drawn) -> dict[str, object]:
    """The figures behind the captions, by panel."""
    return {
        panel.name: {"title": PANELS[panel.name], "caption": panel.caption, **panel.found} for panel in drawn.panels
    }
