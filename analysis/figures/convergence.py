"""Fig. 2B, C: A(N) and P(N) of the robot against simulation; and how sure the recognition is as N grows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from analysis.figures import pen
from analysis.figures.style import colour_of
from analysis.figures.values import Band, Entry

Floats = NDArray[np.float64]

_SCALE_FROM = 5, 0.03  # N, share of all: the first estimates say little and would set the scale


@dataclass(frozen=True, slots=True, eq=False)
class Convergence:
    """One shape's way to its values: the robot's ``estimates``, the ``exact`` values, and the simulated ``band``."""

    name: str
    title: str
    estimates: pd.DataFrame
    exact: Entry
    band: Band | None = None


def convergence_figure(shapes: Sequence[Convergence]) -> Figure:
    """Draw A(N) and P(N), thick for the robot, thin for single simulated runs, shaded where these spread."""
    figure = pen.new_figure(7.2, 3.7)
    area = figure.add_subplot(1, 2, 1)
    perimeter = figure.add_subplot(1, 2, 2)
    pen.dress(area, x="crossing lines N", y="area A (cm²)")
    pen.dress(perimeter, x="crossing lines N", y="perimeter P (cm)")
    reached = max((int(shape.estimates["n"].max()) for shape in shapes if len(shape.estimates)), default=2)
    for axes in (area, perimeter):
        pen.count_axis(axes, reached)
    for shape in shapes:
        many, tag = len(shapes) > 1, shape.title
        _curves(area, shape, "area_cm2", shape.exact.area_cm2, label=tag if many else None)
        _curves(perimeter, shape, "perimeter_cm", shape.exact.perimeter_cm, label=tag if many else None)
    for axes, column in ((area, "area_cm2"), (perimeter, "perimeter_cm")):
        _scale(axes, shapes, column)
    if len(shapes) == 1:
        shape = shapes[0]
        pen.line(area, [], [], colour_of(shape.name), width=2.2, label="robot")
        if shape.band is not None:
            if len(shape.band.area_runs_cm2):
                pen.line(area, [], [], colour_of(shape.name), width=0.6, alpha=0.6, label="simulated runs")
            share = f"{100 * (shape.band.levels[-1] - shape.band.levels[0]):.0f} %"
            pen.band(area, [], [], [], colour_of(shape.name), alpha=0.2, label=f"{share} of simulations")
    pen.line(area, [], [], pen.INK, width=1.0, style="--", label="exact")
    pen.legend_below(figure, area, columns=4)
    return figure


def _curves(axes: Axes, shape: Convergence, column: str, exact: float, *, label: str | None) -> None:
    colour = colour_of(shape.name)
    if shape.band is not None:
        _draw_band(axes, shape.band, column, colour)
    pen.level(axes, exact, pen.INK, gid=f"{shape.name} exact")
    estimates = shape.estimates.sort_values("n")
    pen.line(
        axes, estimates["n"], estimates[column], colour, width=2.2, above=3, label=label, gid=f"{shape.name} robot"
    )


def _draw_band(axes: Axes, band: Band, column: str, colour: str) -> None:
    quantiles, runs = (
        (band.area_cm2, band.area_runs_cm2) if column == "area_cm2" else (band.perimeter_cm, band.perimeter_runs_cm)
    )
    for inner in range(len(band.levels) // 2):
        pen.band(axes, band.n, quantiles[inner], quantiles[-1 - inner], colour, alpha=0.14)
    for run in runs:
        pen.line(axes, band.n, run, colour, width=0.6, alpha=0.5, gid="simulated")


def _scale(axes: Axes, shapes: Sequence[Convergence], column: str) -> None:
    """Scale y to what happens once the first estimates have calmed, at least 5 % around the exact value."""
    seen: list[Floats] = []
    last = max((int(shape.estimates["n"].max()) for shape in shapes if len(shape.estimates)), default=0)
    first = max(_SCALE_FROM[0], _SCALE_FROM[1] * last)
    for shape in shapes:
        late = shape.estimates[shape.estimates["n"] >= first]
        seen.append(np.asarray(late[column], dtype=float))
        exact = shape.exact.area_cm2 if column == "area_cm2" else shape.exact.perimeter_cm
        seen.append(np.array([0.95 * exact, 1.05 * exact]))
        if shape.band is not None:
            quantiles = shape.band.area_cm2 if column == "area_cm2" else shape.band.perimeter_cm
            seen.append(quantiles[:, shape.band.n >= first].ravel())
    values = np.concatenate(seen)
    values = values[np.isfinite(values)]
    free = 0.06 * float(np.ptp(values))
    axes.set_ylim(max(0.0, float(values.min()) - free), float(values.max()) + free)


def posterior_figure(
    estimates: pd.DataFrame,
    *,
    titles: Mapping[str, str],
    posteriors: pd.DataFrame | None = None,
    stop_at: float = 0.95,
    most: int = 6,
) -> Figure:
    """Draw the posterior against N: of each entry where ``posteriors`` is given, else of the leading one.

    Args:
        estimates: Columns n, leading, posterior.
        titles: How the entries are written.
        posteriors: Column ``n`` and one for each entry; the ``most`` that ever came first or highest are named.
        stop_at: Where the session was to stop.
        most: Entries drawn in colour; the others share one grey.
    """
    figure = pen.new_figure(7.2, 3.1)
    axes = figure.add_subplot(1, 1, 1)
    pen.dress(axes, x="crossing lines N", y="posterior")
    pen.count_axis(axes, float(estimates["n"].max()) if len(estimates) else 2)
    axes.set_ylim(-0.02, 1.04)
    pen.level(axes, stop_at, pen.INK, gid="stop")
    pen.text(
        axes,
        (0.99, stop_at),
        f"stop at {stop_at:g}",
        shift=(0, -7),
        frame="x axes, y data",
        colour=pen.MUTED,
        side="right",
    )
    if posteriors is not None:
        _every_entry(axes, posteriors, titles, most)
    else:
        _leader(axes, estimates, titles)
    pen.legend_below(figure, axes, columns=4)
    return figure


def _every_entry(axes: Axes, posteriors: pd.DataFrame, titles: Mapping[str, str], most: int) -> None:
    ordered = posteriors.sort_values("n")
    entries = ordered.drop(columns=["n"])
    highest = entries.max().sort_values(ascending=False)
    named = set(highest.index[:most].astype(str))
    for name in map(str, entries.columns):
        chosen = name in named
        pen.line(
            axes,
            ordered["n"],
            entries[name],
            colour_of(name) if chosen else pen.GRID,
            width=1.8 if chosen else 0.8,
            above=3 if chosen else 1.5,
            label=titles.get(name, name) if chosen else None,
            gid=f"posterior {name}",
        )


def _leader(axes: Axes, estimates: pd.DataFrame, titles: Mapping[str, str]) -> None:
    known = estimates.dropna(subset=["leading", "posterior"]).sort_values("n")
    n = np.asarray(known["n"], dtype=float)
    posterior = np.asarray(known["posterior"], dtype=float)
    leading = [str(name) for name in known["leading"]]
    pen.line(axes, n, posterior, pen.MUTED, width=0.8, gid="posterior")
    for name in dict.fromkeys(leading):
        ahead = np.array([other == name for other in leading])
        pen.dots(
            axes,
            n[ahead],
            posterior[ahead],
            colour_of(name),
            size=9,
            pixels=len(n) > 500,
            label=f"{titles.get(name, name)} leads",
        )
