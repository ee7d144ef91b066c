"""A shape's picture: the silhouette to scale, with what the robot is to find out about it."""
# matplotlib annotates its methods but for their **kwargs, which makes every call "partially unknown"
# pyright: reportUnknownMemberType=false

from __future__ import annotations

from pathlib import Path

import numpy as np
import shapely
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from shapely.geometry import Polygon
from shapely.geometry.polygon import orient

from projector.shape import Shape, Silhouette, polygons_of

SILHOUETTE_COLOUR = "#1f3b57"
_MARGIN_CM = 4.0
_WIDEST_INCH, _TALLEST_INCH = 9.0, 7.0


def outline_path(geometry: Silhouette) -> Outline:
    """The silhouette as one matplotlib path, outer rings and holes wound against each other."""
    vertices: list[np.ndarray[tuple[int, ...], np.dtype[np.float64]]] = []
    codes: list[np.ndarray[tuple[int, ...], np.dtype[np.uint8]]] = []
    for piece in polygons_of(geometry):
        turned = orient(piece)
        for ring in (turned.exterior, *turned.interiors):
            xy = shapely.get_coordinates(ring)
            code = np.full(len(xy), Outline.LINETO, dtype=np.uint8)
            code[0], code[-1] = Outline.MOVETO, Outline.CLOSEPOLY
            vertices.append(xy)
            codes.append(code)
    return Outline(np.concatenate(vertices), np.concatenate(codes))


def draw_shape(shape: Shape, path: Path | str | None = None, *, arena: Polygon | None = None) -> Figure:
    """Draw ``shape`` filled and to scale, axes in cm; title, area, perimeter, pieces and holes above it.

    With ``arena`` its edge is drawn too. With ``path`` the figure is saved there (.png, .pdf or .svg).
    """
    bounds = np.array(shape.geometry.bounds if arena is None else shapely.union(shape.geometry, arena).bounds)
    low, high = bounds[:2] - _MARGIN_CM, bounds[2:] + _MARGIN_CM
    span = high - low
    # the axes' box in inches: to scale, as large as allowed; around it room for title and labels
    inch_per_cm = min(_WIDEST_INCH / span[0], _TALLEST_INCH / span[1])
    width, height = span * inch_per_cm
    left, right, below, above = 0.75, 0.3, 0.65, 0.85
    total_width, total_height = max(width + left + right, 5.2), height + below + above
    figure = Figure(figsize=(total_width, total_height), dpi=120)
    FigureCanvasAgg(figure)
    shift = (total_width - left - right - width) / 2
    axes = figure.add_axes(
        ((left + shift) / total_width, below / total_height, width / total_width, height / total_height)
    )
    if arena is not None:
        axes.add_patch(PathPatch(outline_path(arena), facecolor="none", edgecolor="0.6", linewidth=1.0))
    axes.add_patch(PathPatch(outline_path(shape.geometry), facecolor=SILHOUETTE_COLOUR, edgecolor="none"))
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_xlabel("x (cm)")
    axes.set_ylabel("y (cm)")
    axes.grid(visible=True, color="0.92", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    holes, pieces = shape.holes, shape.pieces
    counts = f"{pieces} piece{'s' * (pieces != 1)}, {holes} hole{'s' * (holes != 1)}"
    centre = (left + shift + width / 2) / total_width
    figure.text(centre, 1 - 0.32 / total_height, shape.title, ha="center", va="center", fontsize=13)
    figure.text(
        centre,
        1 - 0.62 / total_height,
        f"A = {shape.area_cm2:,.1f} cm²   P = {shape.perimeter_cm:,.1f} cm   {counts}",
        ha="center",
        va="center",
        fontsize=9.5,
        color="0.3",
    )
    if path is not None:
        figure.savefig(path)
    return figure
