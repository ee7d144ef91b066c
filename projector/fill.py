"""From closed outlines to a filled silhouette: which regions are inside, by winding number.

Fonts and drawings overlap outlines freely. Taking every hole's outline out of every outer one goes wrong
for islands in holes and for outlines that overlap; so the outlines are noded into faces, and each face
is kept or left by how often the outlines wind about it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, MultiPolygon, Polygon

from projector.shape import Silhouette

Floats = NDArray[np.float64]
FillRule = Literal["nonzero", "evenodd"]


def fill(rings: Sequence[Floats], rule: FillRule = "nonzero") -> Silhouette:
    """Fill closed outlines (n, 2), each with or without its first point repeated.

    ``nonzero`` keeps the faces about which the outlines wind at least once in sum, ``evenodd`` those
    with an odd sum. The result is valid, and empty where nothing is enclosed.

    >>> ccw = np.array([[0, 0], [4, 0], [4, 4], [0, 4.0]])
    >>> hole = np.array([[1, 1], [1, 2], [2, 2], [2, 1.0]])
    >>> fill([ccw, hole]).area, fill([ccw, hole[::-1]]).area, fill([ccw, hole[::-1]], "evenodd").area
    (15.0, 16.0, 15.0)
    """
    closed = [np.vstack([ring, ring[:1]]) for ring in rings if len(np.unique(ring, axis=0)) >= 3]
    if not closed:
        return MultiPolygon()
    noded = shapely.union_all([LineString(ring) for ring in closed])
    faces = [face for face in shapely.polygonize([noded]).geoms if isinstance(face, Polygon)]
    kept: list[Polygon] = []
    for face in faces:
        point = face.representative_point()
        turns = sum(_winding(ring, point.x, point.y) for ring in closed)
        if (turns if rule == "nonzero" else turns % 2) != 0:
            kept.append(face)
    joined = shapely.union_all(kept)
    return joined if isinstance(joined, Polygon | MultiPolygon) else MultiPolygon()


def _winding(ring: Floats, x: float, y: float) -> int:
    """How often ``ring`` turns counter-clockwise about (x, y), by its crossings of the ray to the right."""
    low, high = ring.min(axis=0), ring.max(axis=0)
    if not (low[0] <= x <= high[0] and low[1] <= y <= high[1]):
        return 0
    start, end = ring[:-1], ring[1:]
    up = (start[:, 1] <= y) & (end[:, 1] > y)
    down = (start[:, 1] > y) & (end[:, 1] <= y)
    # > 0: the point lies left of the edge
    side = (end[:, 0] - start[:, 0]) * (y - start[:, 1]) - (x - start[:, 0]) * (end[:, 1] - start[:, 1])
    return int(np.count_nonzero(up & (side > 0)) - np.count_nonzero(down & (side < 0)))
