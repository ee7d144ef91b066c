"""Fig. 1G: the (P, A) plane, with the way of the estimates and how far each entry's estimates scatter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.path import Path as MplPath
from numpy.typing import NDArray

from analysis.estimate import Estimate, ellipse
from analysis.figures import pen
from analysis.figures.style import colour_of
from analysis.figures.values import Entry

Floats = NDArray[np.float64]

LEVELS = (0.75, 0.95, 0.99)
_MOST_CONTOURS = 40  # entries; beyond, only the 95 % ellipse of each is drawn


def plane_figure(
    entries: Mapping[str, Entry],
    trajectories: Mapping[str, pd.DataFrame],
    *,
    n: int,
    camera: Estimate | None = None,
    levels: Sequence[float] = LEVELS,
) -> Figure:
    """Draw perimeter against area.

    Args:
        entries: The dictionary; each entry gets the ellipses that hold ``levels`` of its estimates after ``n`` lines.
        trajectories: By entry name, estimates tables; the contrast grows with N.
        n: Crossing lines for which the ellipses are drawn.
        camera: The camera's own estimate, drawn as a cross.
        levels: Probabilities inside the ellipses, the contrast growing as they shrink.
    """
    figure = pen.new_figure(7.2, 4.9)
    axes = figure.add_subplot(1, 1, 1)
    pen.dress(axes, x="perimeter P (cm)", y="area A (cm²)")
    drawn = tuple(levels) if len(entries) <= _MOST_CONTOURS else (0.95,)
    corners: list[Floats] = []
    outermost: list[Floats] = []
    for name, entry in entries.items():
        for rank, level in enumerate(sorted(drawn, reverse=True)):
            area, perimeter = ellipse((entry.area_cm2, entry.perimeter_cm), entry.covariance_at(n), level)
            points = np.column_stack([perimeter, area])
            corners.append(points)
            if rank == 0:
                outermost.append(points)
            pen.outline(
                axes,
                MplPath(points, closed=True),
                colour_of(name),
                fill=0.14,
                width=0.7 + 0.3 * rank,
                alpha=0.45 + 0.25 * rank,
                gid=f"{name} {level:g}",
            )
    for name, estimates in trajectories.items():
        _trajectory(axes, estimates, colour_of(name))
        corners.append(_late(estimates))
    if camera is not None:
        place = np.array([[camera.perimeter_cm, camera.area_cm2]])
        corners.append(place)
        pen.dots(axes, place[:, 0], place[:, 1], pen.INK, marker="x", size=70, label="camera", above=5)
    _limits(axes, np.concatenate(corners) if corners else np.empty((0, 2)))
    pen.line(axes, [], [], pen.MUTED, width=1.6, label="robot, as N grows")
    pen.dots(axes, [], [], pen.PAPER, edge=pen.INK, size=38, label="robot, last")
    inside = ", ".join(f"{100 * level:g}" for level in drawn)
    pen.line(axes, [], [], pen.MUTED, width=0.8, label=f"{inside} % of estimates at N = {n}")
    pen.legend_below(figure, axes, columns=4)
    pen.spread_labels(
        axes, outermost, [entry.title for entry in entries.values()], [colour_of(name) for name in entries]
    )
    return figure


def _trajectory(axes: Axes, estimates: pd.DataFrame, colour: str) -> None:
    ordered = estimates.sort_values("n")
    points = np.asarray(ordered[["perimeter_cm", "area_cm2"]], dtype=float)
    if not len(points):
        return
    if len(points) > 1:
        pieces = np.stack([points[:-1], points[1:]], axis=1)
        log_n = np.log(np.asarray(ordered["n"], dtype=float)[1:])
        contrast = 0.06 + 0.94 * (log_n / max(float(log_n.max()), 1e-9)) ** 3
        pen.segments(axes, pieces, colour, width=1.5, alpha=contrast, gid="trajectory")
    pen.dots(axes, points[-1:, 0], points[-1:, 1], colour, edge=pen.INK, size=46, above=4, gid="last estimate")


def _late(estimates: pd.DataFrame) -> Floats:
    """The part of a trajectory (m, 2) that the limits must show: where the scatter is within five times the last."""
    n = np.asarray(estimates["n"], dtype=float)
    points = np.asarray(estimates[["perimeter_cm", "area_cm2"]], dtype=float)
    return points[n >= 0.04 * n.max()] if len(n) else points


def _limits(axes: Axes, points: Floats) -> None:
    """Show all points, but nothing below zero: the ellipses of few lines reach there, areas do not."""
    finite = points[np.isfinite(points).all(axis=1)]
    if not len(finite):
        return
    low, high = finite.min(axis=0), finite.max(axis=0)
    free = 0.05 * np.maximum(high - low, 0.05 * np.abs(high) + 1e-9)
    (west, south), (east, north) = np.maximum(low - free, 0.0), high + free
    axes.set_xlim(west, east)
    axes.set_ylim(south, north)
