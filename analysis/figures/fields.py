# pyright: reportUnknownMemberType=false
# (matplotlib's stubs leave every **kwargs untyped)
"""The strokes that maps of the plane and bars are made of, beside those of `analysis.figures.pen`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import LogNorm, to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullLocator
from numpy.typing import ArrayLike, NDArray

from analysis.figures import pen

Floats = NDArray[np.float64]

_FEW_TICKS = 4
_TICKS = tuple(step * 10.0**decade for decade in range(-1, 7) for step in (1, 2, 5))
_SCALE = "viridis_r"  # few lines light, many dark; read alike by all eyes, and in grey


def plain_log_ticks(axis: Axis, low: float, high: float) -> None:
    """Write the ticks of a logarithmic axis out as numbers; where decades are too few, evenly spaced ones."""
    ticks = [tick for tick in _TICKS if low <= tick <= high]
    if len(ticks) < _FEW_TICKS:
        rough = (high - low) / 6
        step = min((tick for tick in _TICKS if tick >= rough), default=rough)
        ticks = list(np.arange(np.ceil(low / step) * step, high, step))
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_major_formatter(FuncFormatter(_plain))
    axis.set_minor_locator(NullLocator())


def decades(axis: Axis, *, short: bool = False) -> None:
    """Write the ticks of a logarithmic axis of counts out, decade by decade; ``short``: every other one, as a power."""
    axis.set_major_locator(LogLocator(base=100 if short else 10, numticks=12))
    axis.set_major_formatter(FuncFormatter(_power if short else _count))
    axis.set_minor_locator(NullLocator())


def _plain(value: float, _position: int | None) -> str:
    return f"{value:g}"


def _count(value: float, _position: int | None) -> str:
    return f"{value:,.0f}".replace(",", "\u202f") if value >= 1 else f"{value:g}"


def _power(value: float, _position: int | None) -> str:
    return f"$10^{{{round(float(np.log10(value)))}}}$"


def paint(axes: Axes, x: Floats, y: Floats, which: NDArray[np.int64], opacity: Floats, colours: Sequence[str]) -> None:
    """Colour a grid (rows, columns) by ``colours[which]`` with ``opacity``; as pixels, since it is one."""
    rgba = np.empty((*which.shape, 4))
    rgba[..., :3] = np.array([to_rgb(colour) for colour in colours])[which]
    rgba[..., 3] = opacity
    axes.pcolormesh(x, y, rgba, shading="nearest", rasterized=True, zorder=0.5, edgecolors="none", linewidth=0)


def heat(
    figure: Figure,
    axes: Axes,
    grid: tuple[Floats, Floats, Floats],
    *,
    span: tuple[float, float],
    levels: Sequence[float],
    label: str,
) -> None:
    """Draw counts (rows, columns) over (x, y) on a logarithmic colour scale with contours; NaN is left grey."""
    x, y, values = grid
    axes.set_facecolor(pen.GRID)
    norm = LogNorm(*span)
    known = np.ma.masked_invalid(values)
    mesh = axes.pcolormesh(x, y, known, norm=norm, cmap=_SCALE, shading="nearest", rasterized=True, zorder=0.5)
    # what no number of lines settles counts as very many, so that the contours close round it
    filled = np.where(np.isfinite(values), values, 10 * span[1])
    rims = axes.contour(x, y, filled, levels=levels, colors=[pen.PAPER], linewidths=0.8, zorder=1.0)
    bar = figure.colorbar(mesh, ax=axes, pad=0.02, aspect=28, extend="max")
    bar.add_lines(rims)
    bar.set_label(label, color=pen.INK, fontsize=pen.LABEL_SIZE)
    bar.ax.tick_params(which="both", colors=pen.MUTED, labelcolor=pen.INK, labelsize=pen.SMALL_SIZE)
    bar.ax.yaxis.set_major_formatter(FuncFormatter(_count))
    bar.outline.set_visible(False)


def bars(axes: Axes, names: Sequence[str], lengths: ArrayLike, colours: Sequence[str], *, size: float) -> None:
    """Draw one bar across for each name, the first on top; the names stand to the left, in points ``size``."""
    rows = np.arange(len(names))
    axes.barh(rows, np.asarray(lengths, dtype=float), height=0.72, color=list(colours), alpha=0.75, zorder=1.5)
    axes.set_yticks(rows, list(names))
    axes.tick_params(axis="y", labelsize=size, length=0)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")


def columns(axes: Axes, names: Sequence[str], heights: ArrayLike, colours: Sequence[str]) -> None:
    """Draw one upright bar for each name."""
    places = np.arange(len(names))
    axes.bar(places, np.asarray(heights, dtype=float), width=0.72, color=list(colours), alpha=0.75, zorder=1.5)
    axes.set_xticks(places, list(names))
    axes.tick_params(axis="x", length=0)
    axes.set_xlim(-0.7, len(names) - 0.3)
    axes.grid(visible=False, axis="x")


def error_bars(
    axes: Axes, x: ArrayLike, y: ArrayLike, sigma: ArrayLike, colour: str, *, label: str | None = None
) -> None:
    """Draw points with their standard errors."""
    axes.errorbar(
        np.asarray(x, dtype=float),
        np.asarray(y, dtype=float),
        yerr=np.asarray(sigma, dtype=float),
        fmt="o",
        color=colour,
        markersize=4,
        elinewidth=1.2,
        capsize=2.5,
        label=label,
        zorder=3,
    )
