"""Runs of unnamed shapes in the (P, A) plane, coloured by the class that they were sorted into."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.path import Path as MplPath
from numpy.typing import NDArray

from analysis.estimate import ellipse
from analysis.figures import pen

Floats = NDArray[np.float64]

# Okabe and Ito's colours for colour-blind readers, darkened to 3:1 on white; classes have no shape to take one from.
_COLOURS = ("#0b7bc1", "#d97a00", "#009e73", "#c05a9c", "#a0622d", "#6a5acd", "#808080", "#8a7d00")
_MARKERS = ("o", "s", "^", "D", "v", "P")
LEVEL = 0.95


@dataclass(frozen=True, slots=True, eq=False)
class ClassPoint:
    """One run: its class from 0, its size, and the covariance (2, 2) of the errors of (log A, log P)."""

    name: str
    label: int
    lines: int
    area_cm2: float
    perimeter_cm: float
    log_covariance: Floats


def classes_figure(points: Sequence[ClassPoint]) -> Figure:
    """Draw perimeter against area: each run with the region that holds its truth in 95 cases of 100."""
    figure = pen.new_figure(7.2, 4.9)
    axes = figure.add_subplot(1, 1, 1)
    pen.dress(axes, x="perimeter P (cm)", y="area A (cm²)")
    contours: list[Floats] = []
    for label in sorted({point.label for point in points}):
        own = [point for point in points if point.label == label]
        colour = _COLOURS[label % len(_COLOURS)]
        for point in own:
            log_area, log_perimeter = ellipse(
                np.log([point.area_cm2, point.perimeter_cm]), point.log_covariance, LEVEL, points=91
            )
            outline = np.exp(np.column_stack([log_perimeter, log_area]))
            contours.append(outline)
            pen.outline(axes, MplPath(outline, closed=True), colour, fill=0.1, width=0.8, alpha=0.7, gid=point.name)
        pen.dots(
            axes,
            [point.perimeter_cm for point in own],
            [point.area_cm2 for point in own],
            colour,
            size=30,
            marker=_MARKERS[label // len(_COLOURS) % len(_MARKERS)],
            edge=pen.INK,
            above=4,
            label=f"class {label + 1}: {len(own)} run{'s' if len(own) > 1 else ''}",
            gid=f"class {label + 1}",
        )
    corners = np.concatenate(contours)
    free = 0.05 * (corners.max(axis=0) - corners.min(axis=0))
    (west, south), (east, north) = np.maximum(corners.min(axis=0) - free, 0.0), corners.max(axis=0) + free
    axes.set_xlim(float(west), float(east))
    axes.set_ylim(float(south), float(north))
    pen.legend_below(figure, axes, columns=4)
    return figure
