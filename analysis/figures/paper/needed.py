# pyright: reportUnknownMemberType=false
# (matplotlib's stubs leave the **kwargs of set_xscale untyped)
"""Figs. 2H, 2J, 3B, 3D: after how many lines an entry is named with 95 %, across the plane and one by one."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.path import Path as MplPath

from analysis.figures import fields, pen
from analysis.figures.paper.known import Known
from analysis.figures.paper.panel import PaperPanel
from analysis.figures.paper.plane import EVERY, LEVEL, Window, centre, contour, label_entries
from analysis.figures.style import colour_of
from analysis.landscape import lines_to_be_sure, lines_to_confidence

_NEVER = 1e7  # where a bar ends that has no end
_SPAN = (10.0, 1e4)
_RIMS = (30.0, 100.0, 300.0)


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
        path = MplPath(contour(known, name, n), closed=True)
        pen.outline(axes, path, pen.INK, width=1.0, above=2.0, gid=f"{name} ellipse")
        pen.dots(axes, [m.perimeter_cm], [m.area_cm2], colour_of(name), size=34, edge=pen.PAPER, above=3, gid=name)
    p, a = np.meshgrid(perimeter[::EVERY], area[::EVERY])
    return pd.DataFrame(
        {"perimeter_cm": p.ravel(), "area_cm2": a.ravel(), "lines_to_95_percent": lines[::EVERY, ::EVERY].ravel()}
    )


def crowd_panel(name: str, known: Known, window: Window, *, n: int) -> PaperPanel:
    """Draw the lines to 95 % where entries crowd, and for each entry (2J)."""
    figure = pen.new_figure(7.2, 6.4)
    axes = figure.add_subplot(2, 1, 1)
    below = figure.add_subplot(2, 1, 2)
    grid = _draw_needed(figure, axes, known, window, n=n)
    likeliest = known.lines_needed()
    sure = {
        entry: lines_to_be_sure(known.recogniser, row, known.moments[entry].covariance_at(1), centre(known, entry))
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


def _end(lines: int | None) -> float:
    return _NEVER if lines is None else float(lines)


def _told(lines: int | None) -> str:
    return "never" if lines is None else str(lines)
