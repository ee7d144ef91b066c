"""Geometry on axes: the silhouette of the shape and the arena's outline, in cm."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.path import Path as MplPath
from shapely import Polygon, get_parts
from shapely.geometry.base import BaseGeometry

from analysis.figures import pen


def outline(geometry: BaseGeometry) -> MplPath:
    """Turn polygons, holes included, into one matplotlib path."""
    rings = [
        MplPath(np.asarray(ring.coords)[:, :2], closed=True)
        for part in get_parts(geometry).tolist()
        if isinstance(part, Polygon)
        for ring in (part.exterior, *part.interiors)
    ]
    return MplPath.make_compound_path(*rings)


def draw_silhouette(axes: Axes, geometry: BaseGeometry, colour: str, *, fill: float = 0.16) -> None:
    """Draw the projected shape: a faint fill and a fine contour."""
    pen.outline(axes, outline(geometry), colour, fill=fill, width=0.7)


def draw_arena(axes: Axes, arena: BaseGeometry) -> None:
    """Draw the arena's wall."""
    pen.outline(axes, outline(arena), pen.MUTED, width=0.9, above=0.4)


def draw_scale(axes: Axes, view: tuple[float, float, float, float]) -> None:
    """Draw a scale bar of a round length (cm), at most a third of the view's width, in its lower left corner.

    ``view`` is (west, south, east, north) in cm.
    """
    west, south, east, north = view
    across = east - west
    decade = 10 ** np.floor(np.log10(across / 3))
    length = decade * max(step for step in (1, 2, 5) if step * decade <= across / 3)
    x, y = west + 0.02 * across, south + 0.03 * (north - south)
    pen.line(axes, [x, x + length], [y, y], pen.MUTED, width=2.0, gid="scale")
    pen.text(axes, (x + length, y), f"{length:g} cm", shift=(5, 0), colour=pen.MUTED)
