# pyright: reportUnknownMemberType=false
# (matplotlib's stubs leave the **kwargs of set_xscale untyped)
"""A dictionary in the (P, A) plane: how far each entry's estimates scatter, and which entries they blur into one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.path import Path as MplPath
from numpy.typing import NDArray

from analysis.estimate import ellipse
from analysis.figures import pen
from analysis.figures.fields import plain_log_ticks
from analysis.figures.style import colour_of
from analysis.figures.values import Entry

Floats = NDArray[np.float64]


def separability_figure(
    entries: Mapping[str, Entry],
    *,
    n: int,
    level: float = 0.95,
    apart: Sequence[str] = (),
) -> Figure:
    """Draw perimeter against area, both logarithmic, with each entry's ellipse and as many names as find room.

    Args:
        entries: The dictionary.
        n: Crossing lines for which the ellipses are drawn.
        level: Probability inside an ellipse.
        apart: Names that stand clear of all others after ``n`` lines; the rest is drawn in grey, as one heap.
    """
    figure = pen.new_figure(9.6, 7.2)
    axes = figure.add_subplot(1, 1, 1)
    pen.dress(axes, x="perimeter P (cm)", y="area A (cm²)")
    clear = set(apart)
    contours: list[Floats] = []
    for entry in entries.values():
        area, perimeter = ellipse((entry.area_cm2, entry.perimeter_cm), entry.covariance_at(n), level)
        # after a few lines the ellipse of an intricate shape reaches below zero, which a log scale does not show
        floor = 0.2 * np.array([entry.perimeter_cm, entry.area_cm2])
        contours.append(np.maximum(np.column_stack([perimeter, area]), floor))
    points = np.array([[entry.perimeter_cm, entry.area_cm2] for entry in entries.values()])
    axes.set_xscale("log")
    axes.set_yscale("log")
    corners = np.concatenate(contours)
    for axis, low, high, limit in (
        (axes.xaxis, *_span(corners[:, 0]), axes.set_xlim),
        (axes.yaxis, *_span(corners[:, 1]), axes.set_ylim),
    ):
        limit(low, high)
        plain_log_ticks(axis, low, high)
    colours = [colour_of(name) if name in clear else pen.MUTED for name in entries]
    for name, contour, colour in zip(entries, contours, colours, strict=True):
        pen.outline(
            axes, MplPath(contour, closed=True), colour, fill=0.16 if name in clear else 0.07, width=0.8, gid=name
        )
    pen.dots(axes, points[:, 0], points[:, 1], pen.INK, size=4.0, above=3)
    pen.line(axes, [], [], pen.INK, width=1.2, label=f"{100 * level:g} % of estimates after {n} lines")
    pen.line(axes, [], [], pen.MUTED, width=1.2, label="grey: overlaps with another entry")
    pen.legend_below(figure, axes, columns=2)
    # a name may lie over another's ellipse in a crowd, but over no point and no other name
    spots = [_spot(point) for point in points]
    pen.spread_labels(axes, spots, [entry.title for entry in entries.values()], colours)
    return figure


def _span(values: Floats) -> tuple[float, float]:
    """The limits of a logarithmic axis with some room for names."""
    low, high = float(values.min()), float(values.max())
    room = max((high / low) ** 0.06, 1.02)
    return low / room, high * room


def _spot(point: Floats) -> Floats:
    """A small closed contour about a point, of a thousandth in both directions."""
    phase = np.linspace(0, 2 * np.pi, 9)
    return point * (1 + 1e-3 * np.column_stack([np.cos(phase), np.sin(phase)]))
