# pyright: reportUnknownMemberType=false
# (matplotlib's stubs leave every **kwargs untyped; this module is the one place that meets them)
"""The strokes that the figures are made of: typed, in the house's look, on matplotlib's axes.

``gid`` names a stroke, so that a test or a reader of the SVG can find it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as MplPath
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter, NullLocator
from numpy.typing import ArrayLike, NDArray
from shapely import Polygon
from shapely.geometry import box

Floats = NDArray[np.float64]
Sides = Literal["left", "center", "right"]
Heights = Literal["top", "center", "bottom"]

INK = "#1b1f24"  # these four are stand-ins: the report turns them into the page's own colours, light or dark
MUTED = "#68717d"
GRID = "#d9dde3"
PAPER = "#fefefe"

LABEL_SIZE = 9.5
SMALL_SIZE = 8.5


def new_figure(width_in: float = 7.2, height_in: float = 3.6) -> Figure:
    """Make an empty figure whose parts make room for one another. 7.2 in are 691 px in the report."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    figure.set_facecolor("none")
    return figure


def dress(axes: Axes, *, x: str = "", y: str = "", title: str = "", grid: bool = True) -> None:
    """Give axes the common look, with labels (units included) and a title."""
    axes.set_facecolor("none")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(MUTED)
    axes.tick_params(which="both", colors=MUTED, labelcolor=INK, labelsize=SMALL_SIZE)
    axes.set_xlabel(x, color=INK, fontsize=LABEL_SIZE)
    axes.set_ylabel(y, color=INK, fontsize=LABEL_SIZE)
    if title:
        axes.set_title(title, color=INK, fontsize=LABEL_SIZE, loc="left")
    if grid:
        axes.grid(visible=True, color=GRID, linewidth=0.6)
        axes.set_axisbelow(True)


def dress_map(axes: Axes, *, title: str = "") -> None:
    """Give axes the look of a map to scale: nothing but the content and a title."""
    axes.set_facecolor("none")
    axes.set_aspect("equal")
    axes.set_axis_off()
    if title:
        axes.set_title(title, color=INK, fontsize=LABEL_SIZE)


def square_with_margins(figure: Figure) -> tuple[Axes, Axes, Axes]:
    """Lay out a square with a low axes over it and a narrow one beside it, sharing its scales."""
    grid = figure.add_gridspec(2, 2, width_ratios=(4, 1), height_ratios=(1, 4))
    square = figure.add_subplot(grid[1, 0])
    over = figure.add_subplot(grid[0, 0], sharex=square)
    beside = figure.add_subplot(grid[1, 1], sharey=square)
    over.tick_params(labelbottom=False)
    beside.tick_params(labelleft=False)
    return square, over, beside


def name_rows(axes: Axes, beside: Axes, names: Sequence[str]) -> None:
    """Make y of both axes rows 0, 1, … from the top, with their names to the left of the first."""
    for part in (axes, beside):
        part.set_yticks(range(len(names)), names)
        part.set_ylim(len(names) - 0.4, -0.6)
        part.grid(visible=False, axis="y")
    beside.tick_params(labelleft=False)


def legend_below(figure: Figure, axes: Axes, *, columns: int) -> None:
    """Add a legend of what ``axes`` show under the whole figure."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize=SMALL_SIZE, labelcolor=INK
    )


def count_axis(axes: Axes, last: float) -> None:
    """Make x a logarithmic axis of counts 1 … ``last``, ticks written out as numbers."""
    axes.set_xscale("log")
    last = max(last, 2.0)
    axes.set_xlim(1, last)
    decades = range(int(np.floor(np.log10(last))) + 1)
    steps = (1,) if last >= 1e4 else (1, 3)
    ticks = [step * 10.0**decade for decade in decades for step in steps if step * 10.0**decade <= last]
    axes.xaxis.set_major_locator(FixedLocator(ticks))
    axes.xaxis.set_major_formatter(FuncFormatter(_whole))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_minor_formatter(NullFormatter())


def _whole(value: float, _position: int | None) -> str:
    return f"{value:,.0f}".replace(",", "\u202f")


def line(
    axes: Axes,
    x: ArrayLike,
    y: ArrayLike,
    colour: str,
    *,
    width: float = 1.4,
    style: str = "-",
    alpha: float = 1.0,
    above: float = 2.0,
    label: str | None = None,
    gid: str | None = None,
    steps: bool = False,
) -> None:
    """Draw a curve; ``above`` orders the strokes, ``steps`` holds each value until the next point."""
    axes.plot(
        np.asarray(x, dtype=float),
        np.asarray(y, dtype=float),
        color=colour,
        linewidth=width,
        linestyle=style,
        alpha=alpha,
        zorder=above,
        label=label,
        gid=gid,
        drawstyle="steps-post" if steps else "default",
        solid_capstyle="round",
        solid_joinstyle="round",
    )


def segments(
    axes: Axes, pieces: Floats, colour: str, *, width: float = 0.6, alpha: ArrayLike = 1.0, gid: str | None = None
) -> None:
    """Draw separate straight pieces (n, 2, 2); ``alpha`` may differ between them."""
    opacity = np.broadcast_to(np.asarray(alpha, dtype=float), len(pieces))
    collection = LineCollection(list(pieces), colors=colour, linewidths=width, alpha=opacity, zorder=2)
    collection.set_gid(gid)
    collection.set_capstyle("round")
    axes.add_collection(collection)


def web(axes: Axes, pieces: Floats, colour: str, *, width: float, alpha: float, gid: str | None = None) -> None:
    """Draw very many straight pieces (n, 2, 2), bundled into at most 60 strokes that add up where they cross.

    One stroke for each piece would make an SVG several times as large, and an image of fine lines larger still.
    """
    bundles = min(len(pieces), 60)
    paths = [
        MplPath(pieces[first::bundles].reshape(-1, 2), _hops(len(pieces[first::bundles]))) for first in range(bundles)
    ]
    collection = PathCollection(
        paths, facecolors="none", edgecolors=colour, linewidths=width, alpha=alpha, zorder=2, offset_transform=None
    )
    collection.set_gid(gid)
    axes.add_collection(collection)


def _hops(pieces: int) -> NDArray[np.uint8]:
    return np.tile(np.array([MplPath.MOVETO, MplPath.LINETO], dtype=np.uint8), pieces)


def dots(
    axes: Axes,
    x: ArrayLike,
    y: ArrayLike,
    colour: str,
    *,
    size: float = 6.0,
    alpha: float = 1.0,
    marker: str = "o",
    edge: str | None = None,
    above: float = 2.5,
    label: str | None = None,
    gid: str | None = None,
    pixels: bool = False,
) -> None:
    """Draw points of ``size`` points²; ``pixels``: as an image in an SVG, for many."""
    bare = marker in {"x", "+"}  # strokes without a face, which matplotlib colours as faces
    axes.scatter(
        np.asarray(x, dtype=float),
        np.asarray(y, dtype=float),
        s=size,
        c=colour,
        alpha=alpha,
        marker=marker,
        linewidths=1.6 if bare else 0.9 if edge else 0.0,
        edgecolors=None if bare else edge or "none",
        zorder=above,
        label=label,
        gid=gid,
        rasterized=pixels,
    )


def band(
    axes: Axes, x: ArrayLike, low: ArrayLike, high: ArrayLike, colour: str, *, alpha: float, label: str | None = None
) -> None:
    """Fill between two curves."""
    axes.fill_between(
        np.asarray(x, dtype=float),
        np.asarray(low, dtype=float),
        np.asarray(high, dtype=float),
        color=colour,
        alpha=alpha,
        linewidth=0,
        label=label,
        zorder=1,
    )


def band_sideways(axes: Axes, y: ArrayLike, low: ArrayLike, high: ArrayLike, colour: str, *, alpha: float) -> None:
    """Fill between two curves x = low(y) and x = high(y)."""
    axes.fill_betweenx(
        np.asarray(y, dtype=float),
        np.asarray(low, dtype=float),
        np.asarray(high, dtype=float),
        color=colour,
        alpha=alpha,
        linewidth=0,
        zorder=1,
    )


def histogram(
    axes: Axes,
    values: ArrayLike,
    colour: str,
    *,
    bins: int,
    within: tuple[float, float],
    density: bool = True,
    sideways: bool = False,
) -> None:
    """Draw a histogram of ``values`` over the range ``within``."""
    axes.hist(
        np.asarray(values, dtype=float),
        bins=bins,
        range=within,
        density=density,
        color=colour,
        alpha=0.55,
        edgecolor=colour,
        linewidth=0.6,
        orientation="horizontal" if sideways else "vertical",
    )


def upright(
    axes: Axes,
    x: float,
    colour: str,
    *,
    width: float = 1.2,
    style: str = "-",
    top: float = 1.0,
    gid: str | None = None,
) -> None:
    """Draw a vertical line from the bottom to the share ``top`` of the height."""
    axes.axvline(x, ymax=top, color=colour, linewidth=width, linestyle=style, gid=gid)


def level(
    axes: Axes,
    y: float,
    colour: str,
    *,
    width: float = 1.0,
    style: str = "--",
    label: str | None = None,
    gid: str | None = None,
) -> None:
    """Draw a horizontal line over the whole width."""
    axes.axhline(y, color=colour, linewidth=width, linestyle=style, label=label, gid=gid)


def outline(
    axes: Axes,
    path: MplPath,
    colour: str,
    *,
    fill: float = 0.0,
    width: float = 0.8,
    alpha: float = 1.0,
    above: float = 1.0,
    gid: str | None = None,
) -> None:
    """Draw a closed path, filled with opacity ``fill``."""
    if fill > 0:
        axes.add_patch(PathPatch(path, facecolor=colour, alpha=fill, edgecolor="none", zorder=above))
    axes.add_patch(
        PathPatch(path, facecolor="none", edgecolor=colour, linewidth=width, alpha=alpha, zorder=above + 0.1, gid=gid)
    )


def text(
    axes: Axes,
    place: tuple[float, float],
    words: str,
    *,
    shift: tuple[float, float] = (0.0, 0.0),
    colour: str = INK,
    size: float = SMALL_SIZE,
    halo: bool = False,
    side: Sides = "left",
    height: Heights = "center",
    frame: Literal["data", "axes", "x data, y axes", "x axes, y data"] = "data",
) -> None:
    """Write beside ``place``, moved by ``shift`` points; ``side`` and ``height``: which edge of the text sits there.

    ``halo`` keeps the words readable over strokes.
    """
    systems = {
        "data": "data",
        "axes": "axes fraction",
        "x data, y axes": ("data", "axes fraction"),
        "x axes, y data": ("axes fraction", "data"),
    }
    note = axes.annotate(
        words,
        place,
        xycoords=systems[frame],
        xytext=shift,
        textcoords="offset points",
        ha=side,
        va=height,
        color=colour,
        fontsize=size,
        zorder=6,
        annotation_clip=True,
    )
    note.set_in_layout(False)
    if halo:
        note.set_path_effects([withStroke(linewidth=2.5, foreground=PAPER)])


def spread_labels(axes: Axes, contours: Sequence[Floats], words: Sequence[str], colours: Sequence[str]) -> list[str]:
    """Name regions that are given by their convex contours (m, 2) in data units.

    Each label goes beside its region's outermost point in the first of eight directions, those that lead away from
    the other regions first, near or a little further off, where it covers no label, no region and no edge. Labels that
    find no such place are left out: an unreadable heap names nothing. Returns the words written.
    """
    figure = axes.get_figure(root=True)
    if figure is None:
        return []
    figure.draw_without_rendering()  # settles the layout, so that data coordinates have their final pixels
    regions = [Polygon(np.asarray(axes.transData.transform(contour), dtype=float)) for contour in contours]
    point = figure.dpi / 72
    edge = axes.get_window_extent()
    page = box(edge.x0, edge.y0, edge.x1, edge.y1)
    middle = np.mean([region.centroid.coords[0] for region in regions], axis=0) if regions else np.zeros(2)
    labels: list[Polygon] = []
    written: list[str] = []
    for index, word in enumerate(words):
        corners = np.asarray(regions[index].exterior.coords)
        half = np.array([0.29 * len(word) + 0.2, 0.62]) * SMALL_SIZE * point
        outwards: Floats = corners.mean(axis=0) - middle
        away = [float(outwards @ np.array(way)) / float(np.hypot(*way)) for way in _WAYS]
        ranked = sorted((-round(share, 6), rank) for rank, share in enumerate(away))
        ways = [np.array(_WAYS[rank], dtype=float) for _, rank in ranked]
        for gap, way in ((gap, way) for gap in (3, 10) for way in ways):
            outermost = int(np.argmax(corners @ way))
            centre = corners[outermost] + (half + gap * point) * way
            (west, south), (east, north) = (centre - half).tolist(), (centre + half).tolist()
            label = box(west, south, east, north)
            if label.within(page) and not any(label.intersects(other) for other in (*labels, *regions)):
                x, y = contours[index][outermost].tolist()
                shift = ((half / point + gap) * way).tolist()
                text(axes, (x, y), word, shift=(shift[0], shift[1]), side="center", colour=colours[index], halo=True)
                labels.append(label)
                written.append(word)
                break
    return written


_WAYS = ((0, 1), (1, 0), (-1, 0), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))
