"""Pictures of shapes: the silhouettes to scale, with what the robot is to find out about them."""
# matplotlib annotates its methods but for their **kwargs, which makes every call "partially unknown"
# pyright: reportUnknownMemberType=false

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from PIL import Image
from shapely.geometry import Polygon
from shapely.geometry.polygon import orient

from lab.base.errors import RequestError
from projector.shape import Shape, Silhouette, polygons_of

SILHOUETTE_COLOUR = "#1f3b57"
_MARGIN_CM = 4.0
_CAPTION_INCH = 0.55
_PALETTE = 32  # colours: the ink, the greys of the captions, and the shades of their edges
_TITLE_LETTERS = 30
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
    centre = (left + shift + width / 2) / total_width
    figure.text(centre, 1 - 0.32 / total_height, shape.title, ha="center", va="center", fontsize=13)
    figure.text(
        centre,
        1 - 0.62 / total_height,
        f"A = {shape.area_cm2:,.1f} cm²   P = {shape.perimeter_cm:,.1f} cm   {_counts(shape)}",
        ha="center",
        va="center",
        fontsize=9.5,
        color="0.3",
    )
    if path is not None:
        figure.savefig(path)
    return figure


def draw_gallery(shapes: Sequence[Shape], path: Path | str | None = None) -> Figure:
    """Draw many shapes in one picture, all to one scale; title, area, perimeter, pieces and holes under each.

    With ``path`` the figure is saved there (.png, .pdf or .svg). Raises RequestError for no shape at all.
    """
    if not shapes:
        raise RequestError("a gallery needs at least one shape")
    widest, tallest = (max(sizes) for sizes in zip(*(shape.size_cm for shape in shapes), strict=True))
    # a picture of about 4:3; the captions need their own room
    cell_width, picture_height = 1.9, 1.9 * min(max(tallest / widest, 0.35), 1.6)
    cell_height = picture_height + _CAPTION_INCH
    columns = min(len(shapes), max(1, round(np.sqrt(len(shapes) * 4 / 3 * cell_height / cell_width))))
    rows = -(-len(shapes) // columns)
    figure = Figure(figsize=(columns * cell_width, rows * cell_height), dpi=120)
    FigureCanvasAgg(figure)
    cm_per_inch = max(widest / (0.88 * cell_width), tallest / (0.92 * picture_height))
    for number, shape in enumerate(shapes):
        row, column = divmod(number, columns)
        bottom = 1 - (row * cell_height + picture_height) / (rows * cell_height)
        axes = figure.add_axes((column / columns, bottom, 1 / columns, picture_height / (rows * cell_height)))
        x_low, y_low, x_high, y_high = shape.geometry.bounds
        middle = np.array([x_low + x_high, y_low + y_high]) / 2
        half = np.array([cell_width, picture_height]) * cm_per_inch / 2
        axes.set_xlim(middle[0] - half[0], middle[0] + half[0])
        axes.set_ylim(middle[1] - half[1], middle[1] + half[1])
        axes.set_axis_off()
        axes.add_patch(PathPatch(outline_path(shape.geometry), facecolor=SILHOUETTE_COLOUR, edgecolor="none"))
        # a text would read the same twice, with its font beside it
        title = shape.name if shape.font is not None else shape.title
        words = (
            (0.10, title[:_TITLE_LETTERS], 7.5, "black"),
            (0.25, f"A {shape.area_cm2:,.0f} cm²  P {shape.perimeter_cm:,.0f} cm", 6.0, "0.35"),
            (0.37, _counts(shape), 6.0, "0.35"),
        )
        for below, text, size, colour in words:
            y = bottom - below / (rows * cell_height)
            figure.text((column + 0.5) / columns, y, text, ha="center", va="center", fontsize=size, color=colour)
    if path is not None:
        _save_small(figure, Path(path))
    return figure


def _save_small(figure: Figure, path: Path) -> None:
    """Save, a PNG with a palette: a gallery has one ink, and takes a quarter of the room so."""
    if path.suffix.lower() != ".png":
        figure.savefig(path)
        return
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    image.quantize(_PALETTE, dither=Image.Dither.NONE).save(path, optimize=True)


def _counts(shape: Shape) -> str:
    holes, pieces = shape.holes, shape.pieces
    return f"{pieces} piece{'s' * (pieces != 1)}, {holes} hole{'s' * (holes != 1)}"
