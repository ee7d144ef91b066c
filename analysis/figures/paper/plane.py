# pyright: reportUnknownMemberType=false
# (matplotlib's stubs leave the **kwargs of set_xscale untyped)
"""Figs. 2G–J, 3A–D: where in the plane an entry is named with 95 %, and after how many lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.path import Path as MplPath
from numpy.typing import NDArray

from analysis.estimate import ellipse
from analysis.figures import fields, pen
from analysis.figures.paper.known import Known
from analysis.figures.paper.panel import PaperPanel
from analysis.figures.style import colour_of
from analysis.landscape import Domains, domains, lines_to_be_sure, lines_to_confidence

Floats = NDArray[np.float64]

LEVEL = 0.95
_RADIUS2 = -2 * np.log1p(-LEVEL)
GRID = 600, 420  # points across and up
_EVERY = 4  # grid point that goes into a table
_NEVER = 1e7  # where a bar ends that has no end
_SPAN = (10.0, 1e4)
_RIMS = (30.0, 100.0, 300.0)


@dataclass(frozen=True, slots=True)
class Window:
    """A part of the plane with a grid over it, on linear or logarithmic axes."""

    perimeter_cm: tuple[float, float]
    area_cm2: tuple[float, float]
    points: tuple[int, int] = GRID
    log: bool = False

    def grid(self) -> tuple[Floats, Floats]:
        """Perimeters (columns,) and areas (rows,)."""
        space = np.geomspace if self.log else np.linspace
        return space(*self.perimeter_cm, self.points[0]), space(*self.area_cm2, self.points[1])

    def fit(self, axes: Axes) -> None:
        """Give axes this part of the plane."""
        if self.log:
            axes.set_xscale("log")
            axes.set_yscale("log")
            fields.plain_log_ticks(axes.xaxis, *self.perimeter_cm)
            fields.plain_log_ticks(axes.yaxis, *self.area_cm2)
        axes.set_xlim(*self.perimeter_cm)
        axes.set_ylim(*self.area_cm2)


def window_of(
    known: Known,
    n: float,
    *,
    names: Sequence[str] = (),
    log: bool = False,
    room: float = 0.12,
    points: tuple[int, int] = GRID,
) -> Window:
    """The window that shows the 95 % ellipses of some entries after ``n`` lines, or of all, with some room."""
    corners = np.concatenate([_contour(known, name, n) for name in names or known.names])
    corners = corners[(corners > 0).all(axis=1)]
    low, high = corners.min(axis=0), corners.max(axis=0)
    if log:
        free = np.maximum((high / low) ** (room / 2), 1.02)
        low, high = low / free, high * free
    else:
        free = room * (high - low)
        low, high = np.maximum(low - free, 0.02 * high), high + free
    return Window((float(low[0]), float(high[0])), (float(low[1]), float(high[1])), points, log)


def domains_panel(
    name: str,
    known: Known,
    window: Window,
    *,
    n: int,
    size_in: tuple[float, float] = (7.2, 4.8),
    kind: str = "shapes",
    grid_table: bool = True,
) -> PaperPanel:
    """Draw where estimates from ``n`` lines name an entry with more than 95 % (2G, 2I, 3A, 3C)."""
    figure = pen.new_figure(*size_in)
    axes = figure.add_subplot(1, 1, 1)
    found = draw_domains(axes, known, window, n=n)
    pen.line(axes, [], [], pen.INK, width=1.2, label=f"95 % of estimates after {n} lines")
    pen.line(axes, [], [], pen.MUTED, width=7, alpha=0.35, label="one entry has more than 95 %")
    pen.legend_below(figure, axes, columns=2)
    written = label_entries(axes, known, n)
    table = known.table(n)
    right = np.asarray(table["right"], dtype=float)
    sure = int(np.count_nonzero(right >= LEVEL))
    unnamed = len(known.names) - len(written)
    never = list(known.twins)
    words = [
        f"Pale: where an estimate from N = {n} lines gives one of the {len(known.names)} {kind} a posterior above 95 "
        f"%, in "
        "its colour; strong: the part of it where 95 % of its own estimates fall (ellipse). White: undecided. "
        f"{sure} of {len(right)} are named rightly in at least 95 % of runs after N = {n} lines"
    ]
    if sure < len(right):
        weakest = table.sort_values("right").head(4)
        told = ", ".join(
            f"{known.titles[str(row['entry'])]} {100 * float(row['right']):.0f} %" for _, row in weakest.iterrows()
        )
        words.append(f"; least: {told}")
    words.append(".")
    if unnamed:
        words.append(f" {unnamed} names found no room.")
    if never:
        words.append(
            f" Twins, one class each: {'; '.join('/'.join(known.titles[m] for m in twins) for twins in never)}."
        )
    tables = {"": table}
    if grid_table:
        tables = {"": _grid_table(found, known), "entries": table}
    return PaperPanel(name, figure, "".join(words), tables, {"n": n, "sure": sure, "entries": len(right)})


def draw_domains(axes: Axes, known: Known, window: Window, *, n: int, ellipses: Sequence[str] | None = None) -> Domains:
    """Paint the domains, and the 95 % ellipses of ``ellipses`` (all without it)."""
    pen.dress(axes, x="perimeter P (cm)", y="area A (cm²)", grid=False)
    window.fit(axes)
    perimeter, area = window.grid()
    found = domains(known.recogniser, perimeter, area, n)
    colours = [colour_of(name) for name in known.names]
    p, a = np.meshgrid(perimeter, area)
    size = np.array([[m.area_cm2, m.perimeter_cm] for m in known.moments.values()])[found.leader]
    inverse = np.linalg.inv(np.array([m.covariance_at(n) for m in known.moments.values()]))[found.leader]
    off = np.stack([a, p], axis=-1) - size
    own = np.einsum("rci,rcij,rcj->rc", off, inverse, off) <= _RADIUS2
    sure = (found.posterior > LEVEL) & ~_seams(found.leader)
    fields.paint(axes, perimeter, area, found.leader, np.where(sure, np.where(own, 0.62, 0.17), 0.0), colours)
    for name in known.names if ellipses is None else ellipses:
        path = MplPath(_contour(known, name, n), closed=True)
        pen.outline(axes, path, pen.INK, width=0.6, alpha=0.8, above=2.0, gid=f"{name} ellipse")
    return found


def _seams(leader: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Grid points next to another leader's, so that a seam finer than the grid is drawn whole and not as dots."""
    seams = np.zeros(leader.shape, dtype=bool)
    seams[:, 1:] |= leader[:, 1:] != leader[:, :-1]
    seams[1:] |= leader[1:] != leader[:-1]
    return seams


def label_entries(axes: Axes, known: Known, n: float, names: Sequence[str] | None = None) -> list[str]:
    """Name the entries beside their ellipses as far as there is room; gives the names written."""
    chosen = list(known.names if names is None else names)
    contours = [np.maximum(_contour(known, name, n), 1e-3) for name in chosen]
    return pen.spread_labels(axes, contours, [known.titles[name] for name in chosen], [pen.INK] * len(chosen))


def needed_panel(name: str, known: Known, window: Window, *, n: int) -> PaperPanel:
    """Draw the lines to 95 % across the plane (2H)."""
    figure = pen.new_figure(7.2, 4.8)
    axes = figure.add_subplot(1, 1, 1)
    table = _draw_needed(figure, axes, known, window, n=n)
    pen.line(axes, [], [], pen.INK, width=1.0, label=f"95 % of estimates after {n} lines")
    pen.legend_below(figure, axes, columns=2)
    label_entries(axes, known, n)
    own = {key: int(lines_at(known, key)) for key in known.names}
    told = ", ".join(f"{known.titles[key]} {lines}" for key, lines in own.items())
    return PaperPanel(
        name,
        figure,
        "Lines after which an estimate that stays at this place names one entry with 95 %, all other entries taken "
        "into "
        f"account (at least 10 are asked for; contours at 30, 100 and 300; "
        f"beyond {_SPAN[1]:.0f} grey). Ridges run half way between entries. At the "
        f"entries' own places: {told}.",
        {"": table},
        {"lines_at_own_place": own},
    )


def lines_at(known: Known, name: str) -> float:
    """Lines to 95 % for an estimate that stays at the entry's own place."""
    m = known.moments[name]
    return float(lines_to_confidence(known.recogniser, np.array([m.perimeter_cm]), np.array([m.area_cm2]))[0, 0])


def _draw_needed(figure: Figure, axes: Axes, known: Known, window: Window, *, n: int) -> pd.DataFrame:
    pen.dress(axes, x="perimeter P (cm)", y="area A (cm²)", grid=False)
    window.fit(axes)
    perimeter, area = window.grid()
    lines = lines_to_confidence(known.recogniser, perimeter, area, confidence=LEVEL, most=_SPAN[1])
    fields.heat(figure, axes, (perimeter, area, lines), span=_SPAN, levels=_RIMS, label="lines to 95 %")
    for name, m in known.moments.items():
        path = MplPath(_contour(known, name, n), closed=True)
        pen.outline(axes, path, pen.INK, width=1.0, above=2.0, gid=f"{name} ellipse")
        pen.dots(axes, [m.perimeter_cm], [m.area_cm2], colour_of(name), size=34, edge=pen.PAPER, above=3, gid=name)
    p, a = np.meshgrid(perimeter[::_EVERY], area[::_EVERY])
    return pd.DataFrame(
        {"perimeter_cm": p.ravel(), "area_cm2": a.ravel(), "lines_to_95_percent": lines[::_EVERY, ::_EVERY].ravel()}
    )


def crowd_panel(name: str, known: Known, window: Window, *, n: int) -> PaperPanel:
    """Draw the lines to 95 % where entries crowd, and for each entry (2J)."""
    figure = pen.new_figure(7.2, 6.4)
    axes = figure.add_subplot(2, 1, 1)
    below = figure.add_subplot(2, 1, 2)
    grid = _draw_needed(figure, axes, known, window, n=n)
    likeliest = known.lines_needed()
    sure = {
        entry: lines_to_be_sure(known.recogniser, row, known.moments[entry].covariance_at(1), _centre(known, entry))
        for row, entry in enumerate(known.names)
    }
    nearest = {entry: known.nearest(entry) for entry in known.names}
    pen.dress(below, x="lines N")
    below.set_xscale("log")
    titles = [known.titles[entry] for entry in known.names]
    rows = np.arange(len(titles))
    fields.bars(below, titles, [_end(likeliest[e]) for e in known.names], [colour_of(e) for e in known.names], size=8.5)
    pen.dots(
        below,
        [_end(sure[e]) for e in known.names],
        rows,
        pen.INK,
        marker="D",
        size=26,
        above=3,
        label="posterior ≥ 95 % in 95 % of runs",
    )
    most = max(_end(sure[entry]) for entry in known.names)
    below.set_xlim(1, max(2000.0, 3 * most))
    fields.decades(below.xaxis)
    for row, entry in enumerate(known.names):
        pen.text(
            below,
            (_end(sure[entry]), row),
            f"{_told(likeliest[entry])} / {_told(sure[entry])}",
            shift=(7, 0),
            halo=True,
        )
    for paper in (100, 1000):
        pen.upright(below, paper, pen.MUTED, width=0.8, style=":", gid=f"paper {paper}")
    pen.line(below, [], [], pen.MUTED, width=6, alpha=0.75, label="likeliest in 95 % of runs")
    pen.line(below, [], [], pen.MUTED, width=0.8, style=":", label="the paper's 10² (circle) and 10³ (others)")
    pen.legend_below(figure, below, columns=2)
    label_entries(axes, known, n)
    table = pd.DataFrame(
        {
            "entry": list(known.names),
            "lines_likeliest_in_95_percent": [likeliest[e] for e in known.names],
            "lines_posterior_95_in_95_percent": [sure[e] for e in known.names],
            "nearest": [nearest[e][0] for e in known.names],
            "distance_one_line_sigmas": [nearest[e][1] for e in known.names],
        }
    ).astype({"lines_likeliest_in_95_percent": "Int64", "lines_posterior_95_in_95_percent": "Int64"})
    return PaperPanel(
        name,
        figure,
        _why(known, likeliest, sure, nearest),
        {"": grid, "entries": table},
        {"lines_likeliest": likeliest, "lines_sure": sure, "nearest": {e: list(nearest[e]) for e in known.names}},
    )


def _why(
    known: Known,
    likeliest: Mapping[str, int | None],
    sure: Mapping[str, int | None],
    nearest: Mapping[str, tuple[str, float]],
) -> str:
    """Why our entries need the lines that they do, in words; all figures computed."""
    fewest, most = min(_end(v) for v in likeliest.values()), max(_end(v) for v in sure.values())
    told = "; ".join(
        f"{known.titles[entry]} to {known.titles[other]} {far:.2f}" for entry, (other, far) in nearest.items()
    )
    # two entries of like scatter that lie d one-line sigmas apart: the midpoint is d√N/2 = 1.645 sigmas away
    apart = 2 * 1.645 / np.sqrt(1000)
    scatter = [m.sigma_perimeter_rel for m in known.moments.values()]
    return (
        "Above: lines to 95 % among the entries that lie closest. Below, for each entry: bars, lines after which it "
        "is the "
        "likeliest in 95 % of runs; diamonds, lines after which it has a posterior of 95 % in 95 % of runs. "
        f"In our dictionary that takes {fewest:.0f} to {most:.0f} lines, fewer than the paper's 10² (circle) and 10³ "
        "(others). The number falls as the square of the distance to the nearest entry, which here, in standard "
        "deviations "
        f"of one line, is: {told}. To need 10³ lines two entries of like scatter would have to lie within "
        f"{apart:.2f} of one line's σ, that is within {100 * apart * min(scatter):.0f} to "
        f"{100 * apart * max(scatter):.0f} % "
        "in P at equal A: the paper's entries lie closer than ours, or it asks for more."
    )


def letters_panel(name: str, known: Known, *, font: str) -> PaperPanel:
    """Draw the lines to 95 % for each letter (3B)."""
    needed = known.lines_needed()
    figure = pen.new_figure(7.2, 3.9)
    axes = figure.add_subplot(1, 1, 1)
    pen.dress(axes, y="lines to 95 % right")
    axes.set_yscale("log")
    titles = [known.titles[entry] for entry in known.names]
    fields.columns(axes, titles, [_end(needed[e]) for e in known.names], [colour_of(e) for e in known.names])
    top = max(_end(value) for value in needed.values())
    axes.set_ylim(3, 2.5 * top)
    fields.decades(axes.yaxis)
    pen.line(axes, [], [], pen.MUTED, width=6, alpha=0.75, label="by (P, A)")
    if known.by_line:
        pen.dots(
            axes,
            range(len(titles)),
            [_end(known.by_line[e]) for e in known.names],
            pen.INK,
            marker="D",
            size=16,
            above=3,
            label="line by line",
        )
    pen.legend_below(figure, axes, columns=2)
    table = _needed_table(known, needed)
    values = np.array([_end(value) for value in needed.values()])
    by_line = np.array([_end(value) for value in known.by_line.values()]) if known.by_line else np.empty(0)
    worst = max(needed, key=lambda entry: _end(needed[entry]))
    also = (
        f" Diamonds: line by line, as a session reads, it takes {by_line.min():.0f} to {by_line.max():.0f}."
        if by_line.size
        else ""
    )
    return PaperPanel(
        name,
        figure,
        f"Lines after which each capital ({font}, 40 cm high) is the likeliest of the {len(values)} in 95 % of runs, "
        f"by "
        f"area and perimeter: median {np.median(values):.0f}, most {_told(needed[worst])} "
        f"({known.titles[worst]}, taken for {known.titles[known.rival(worst, min(_end(needed[worst]), 1e4))]}).{also}",
        {"": table},
        {"lines": needed, "by_line": dict(known.by_line), "median": float(np.median(values))},
    )


def words_panel(name: str, known: Known, letters: Mapping[str, int | None], *, columns: int = 4) -> PaperPanel:
    """Draw the lines to 95 % for each word, divided by its letters (3D). ``letters``: those of single letters."""
    needed = known.lines_needed()
    count = {entry: len(known.titles[entry]) for entry in known.names}
    per_letter = {entry: _end(needed[entry]) / count[entry] for entry in known.names}
    order = sorted(known.names, key=lambda entry: (per_letter[entry], entry))
    by_letters = float(np.median([_end(value) for value in letters.values()]))
    rows = -(-len(order) // columns)
    figure = pen.new_figure(7.2, 0.9 + 0.148 * rows)
    finite = [per_letter[entry] for entry in order if needed[entry] is not None]
    low, high = 0.5 * min(finite), 3 * max(finite)
    for column in range(columns):
        part = order[column * rows : (column + 1) * rows]
        if not part:
            continue
        axes = figure.add_subplot(1, columns, column + 1)
        pen.dress(axes, x="lines / letter")
        axes.set_xscale("log")
        lengths = [min(per_letter[entry], high) for entry in part]
        fields.bars(axes, [known.titles[e] for e in part], lengths, [colour_of(e) for e in part], size=5.8)
        axes.set_ylim(rows - 0.4, -0.6)
        axes.set_xlim(low, high)
        axes.tick_params(axis="x", labelsize=6.5)
        fields.decades(axes.xaxis, short=True)
        pen.upright(axes, by_letters, pen.INK, width=0.8, style="--", gid="letters")
        for row, entry in enumerate(part):
            if needed[entry] is None:
                pen.text(axes, (high, row), "never", shift=(-3, 0), side="right", size=5.8, halo=True)
    axes = figure.axes[0]
    pen.line(axes, [], [], pen.INK, width=0.8, style="--", label="median of the single letters (3B)")
    pen.legend_below(figure, axes, columns=1)
    table = _needed_table(known, needed)
    table["letters"] = [count[entry] for entry in known.names]
    table["lines_per_letter"] = np.where(
        table["lines_to_95_percent"].isna(), np.nan, [per_letter[entry] for entry in known.names]
    )
    never = [known.titles[entry] for entry in order if needed[entry] is None]
    told = f" {', '.join(never)} are of the same letters and never told apart by (P, A)." if never else ""
    middle = float(np.median([per_letter[entry] for entry in order]))
    return PaperPanel(
        name,
        figure,
        f"Lines after which each word, as one shape, is the likeliest of the {len(order)} in 95 % of runs, divided by "
        f"its "
        f"letters: median {middle:.0f}, against {by_letters:.0f} for a single letter (dashed).{told}",
        {"": table},
        {"median_per_letter": middle, "letters_median": by_letters, "never": never},
    )


def _needed_table(known: Known, needed: Mapping[str, int | None]) -> pd.DataFrame:
    table = pd.DataFrame({"entry": list(known.names), "lines_to_95_percent": [needed[e] for e in known.names]})
    table["lines_to_95_percent"] = table["lines_to_95_percent"].astype("Int64")
    table["most_often_taken_for"] = [known.rival(e, min(_end(needed[e]), 1e4)) for e in known.names]
    if known.by_line:
        table["lines_to_95_percent_line_by_line"] = [known.by_line[e] for e in known.names]
    return table


def _grid_table(found: Domains, known: Known) -> pd.DataFrame:
    p, a = np.meshgrid(found.perimeter_cm[::_EVERY], found.area_cm2[::_EVERY])
    leader = found.leader[::_EVERY, ::_EVERY].ravel()
    return pd.DataFrame(
        {
            "perimeter_cm": p.ravel(),
            "area_cm2": a.ravel(),
            "leading": np.array(known.names)[leader],
            "posterior": found.posterior[::_EVERY, ::_EVERY].ravel(),
        }
    )


def _contour(known: Known, name: str, n: float) -> Floats:
    area, perimeter = ellipse(_centre(known, name), known.moments[name].covariance_at(n), LEVEL)
    return np.column_stack([perimeter, area])


def _centre(known: Known, name: str) -> tuple[float, float]:
    return known.moments[name].area_cm2, known.moments[name].perimeter_cm


def _end(lines: int | None) -> float:
    return _NEVER if lines is None else float(lines)


def _told(lines: int | None) -> str:
    return "never" if lines is None else str(lines)
