"""Figs. 1F and 2A: how long the chords are, with the mean chord and the root of the area marked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from analysis.figures import pen
from analysis.figures.style import colour_of

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Chords:
    """One shape's chords: lengths (n,) in cm and the area estimated from the same lines.

    ``exact_area_cm2`` and ``exact_perimeter_cm`` add where the marks lie for the projected shape.
    """

    name: str
    title: str
    lengths_cm: Floats
    area_cm2: float
    exact_area_cm2: float | None = None
    exact_perimeter_cm: float | None = None

    @property
    def longest_cm(self) -> float:
        """The longest measured chord, by which the paper normalises."""
        return float(self.lengths_cm.max())

    @property
    def mean_cm(self) -> float:
        """The mean chord ⟨ℓ⟩ over chords."""
        return float(self.lengths_cm.mean())


def chords_figure(shapes: Sequence[Chords]) -> Figure:
    """Draw the histogram of one shape (Fig. 1F), or of several side by side (Fig. 2A)."""
    columns = min(len(shapes), 2)
    rows = -(-len(shapes) // columns)
    figure = pen.new_figure(7.2, 3.3 if rows == 1 else 2.6 * rows)
    for place, shape in enumerate(shapes):
        axes = figure.add_subplot(rows, columns, place + 1)
        _histogram(axes, shape, title=shape.title if len(shapes) > 1 else "", labelled=place % columns == 0)
    pen.legend_below(figure, figure.axes[0], columns=3)
    return figure


def _histogram(axes: Axes, shape: Chords, *, title: str, labelled: bool) -> None:
    longest = shape.longest_cm
    pen.dress(
        axes,
        x=f"chord length / longest chord ({longest:.1f} cm)",
        y="probability density" if labelled else "",
        title=title,
    )
    bins = int(np.clip(np.sqrt(shape.lengths_cm.size), 10, 50))
    pen.histogram(axes, shape.lengths_cm / longest, colour_of(shape.name), bins=bins, within=(0.0, 1.0))
    axes.set_xlim(0, 1.02)
    axes.set_ylim(top=axes.get_ylim()[1] * 1.28)  # room for the marks' names
    if shape.exact_area_cm2 is not None and shape.exact_perimeter_cm is not None:
        root_cm = float(np.sqrt(shape.exact_area_cm2))
        mean_cm = np.pi * shape.exact_area_cm2 / shape.exact_perimeter_cm  # Cauchy
        pen.upright(axes, mean_cm / longest, pen.MUTED, width=1.0, style=":", top=0.8, gid="exact mean")
        pen.upright(axes, root_cm / longest, pen.MUTED, width=1.0, style=":", top=0.8, gid="exact root")
        pen.line(axes, [], [], pen.MUTED, width=1.0, style=":", label="the projected shape's")
    root_cm = float(np.sqrt(shape.area_cm2))
    marks = [
        (shape.mean_cm / longest, f"⟨ℓ⟩ = {shape.mean_cm:.1f} cm", "mean"),
        (root_cm / longest, f"√A = {root_cm:.1f} cm", "root"),
    ]
    # Names go to the side with room; the mark that is written across the other stands higher, over its end.
    leftwards = max(place for place, _, _ in marks) > 0.75
    for row, (place, words, gid) in zip((0.97, 0.87), sorted(marks, reverse=leftwards), strict=True):
        pen.upright(axes, place, pen.INK, style="-" if gid == "mean" else "--", top=row, gid=gid)
        pen.text(
            axes,
            (place, row),
            words,
            shift=(-5 if leftwards else 5, 0),
            side="right" if leftwards else "left",
            height="top",
            frame="x data, y axes",
            size=pen.LABEL_SIZE,
            halo=True,
        )
    pen.line(axes, [], [], pen.INK, width=1.2, label="⟨ℓ⟩ measured")
    pen.line(axes, [], [], pen.INK, width=1.2, style="--", label="√A measured")
