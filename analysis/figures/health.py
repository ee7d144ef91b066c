# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# (matplotlib's stubs leave every **kwargs untyped)
"""What is followed from session to session, in strips one above the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure
from numpy.typing import NDArray

from analysis.figures import pen
from analysis.figures.style import AREA, MANY_DOTS, PERIMETER, fitting

Floats = NDArray[np.float64]

_WIDTH_IN = 7.2


@dataclass(frozen=True, slots=True, eq=False)
class Strip:
    """One thing followed over the sessions: ``values`` (n,), and the ``names`` of those that stand out, by index."""

    title: str
    values: Floats
    names: Mapping[int, str]


def health_figure(strips: Sequence[Strip], started: NDArray[np.datetime64] | None) -> Figure:
    """Draw one strip for each thing over the time of the sessions' beginning, or over their order without times."""
    figure = pen.new_figure(_WIDTH_IN, 0.5 + 1.25 * len(strips))
    first: Axes | None = None
    for index, strip in enumerate(strips):
        axes = figure.add_subplot(len(strips), 1, index + 1, sharex=first)
        first = first or axes
        last = index == len(strips) - 1
        pen.dress(axes, x=("begun" if started is not None else "session, in order") if last else "", title=strip.title)
        x = np.arange(strip.values.size, dtype=np.float64) if started is None else _days(started)
        known = np.isfinite(strip.values) & np.isfinite(x)
        out = np.zeros(strip.values.size, dtype=np.bool_)
        out[list(strip.names)] = True
        plain, odd = known & ~out, known & out
        pixels = int(plain.sum()) > MANY_DOTS
        pen.dots(axes, x[plain], strip.values[plain], AREA, size=9, alpha=0.7, pixels=pixels, gid=strip.title)
        pen.dots(axes, x[odd], strip.values[odd], PERIMETER, size=26, marker="D", edge=pen.INK, above=4)
        if known.any():
            _room(axes, strip.values[known])
            pen.level(axes, float(np.median(strip.values[known])), pen.MUTED, width=0.8)
        _label(axes, x, strip)
        if not last:
            axes.tick_params(labelbottom=False)
    if started is not None and first is not None:
        locator = AutoDateLocator(minticks=3, maxticks=8)
        first.xaxis.set_major_locator(locator)
        first.xaxis.set_major_formatter(ConciseDateFormatter(locator))
    return figure


def _days(started: NDArray[np.datetime64]) -> Floats:
    """Matplotlib's days since 1970; NaN for what is no time."""
    seconds = started.astype("datetime64[ms]").astype(float) / 1000
    return np.where(np.isnat(started), np.nan, seconds / 86400)


def _room(axes: Axes, values: Floats) -> None:
    low, high = float(values.min()), float(values.max())
    free = 0.12 * max(high - low, 0.02 * abs(high), 1e-9)
    axes.set_ylim(low - free, high + free)


def _label(axes: Axes, x: Floats, strip: Strip) -> None:
    """Name the outliers, towards the side with more room."""
    known = x[np.isfinite(x)]
    middle = float((known.min() + known.max()) / 2) if known.size else 0.0
    for index, name in strip.names.items():
        if np.isfinite(x[index]):
            left = bool(x[index] <= middle)
            place = (float(x[index]), float(strip.values[index]))
            pen.text(
                axes,
                place,
                fitting(name, 34),
                shift=(7 if left else -7, 0),
                side="left" if left else "right",
                halo=True,
            )
