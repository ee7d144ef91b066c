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

from projector.shape import ShapeError, Silhouette
from projector.winding import count_turns

Floats = NDArray[np.float64]
FillRule = Literal["nonzero", "evenodd"]

MAX_NEAR = 5_000_000  # pairs of edges whose boxes overlap: a second or two of looking
MAX_MEETINGS = 100_000  # pairs of edges that meet, both ways: some seconds of noding
MAX_TESTS = 10_000_000_000  # of a face against an edge: some seconds


def fill(rings: Sequence[Floats], rule: FillRule = "nonzero", *, subject: str = "outline") -> Silhouette:
    """Fill closed outlines (n, 2), each with or without its first point repeated.

    ``nonzero`` keeps the faces about which the outlines wind at least once in sum, ``evenodd`` those
    with an odd sum. The result is valid, and empty where nothing is enclosed. Raises ShapeError, with
    ``subject`` in it, for a tangle that would take minutes.

    >>> ccw = np.array([[0, 0], [4, 0], [4, 4], [0, 4.0]])
    >>> hole = np.array([[1, 1], [1, 2], [2, 2], [2, 1.0]])
    >>> fill([ccw, hole]).area, fill([ccw, hole[::-1]]).area, fill([ccw, hole[::-1]], "evenodd").area
    (15.0, 16.0, 15.0)
    """
    closed = [np.vstack([ring, ring[:1]]) for ring in rings if len(np.unique(ring, axis=0)) >= 3]
    if not closed:
        return MultiPolygon()
    if len(closed) == 1 and (simple := Polygon(closed[0])).is_valid and not simple.is_empty:
        return simple
    check_tangle(closed, subject)
    noded = shapely.union_all([LineString(ring) for ring in closed])
    faces = np.array([face for face in shapely.polygonize([noded]).geoms if isinstance(face, Polygon)])
    points = shapely.get_coordinates(shapely.point_on_surface(faces))
    vertices = np.concatenate(closed)
    if len(points) * len(vertices) > MAX_TESTS:
        raise _tangled(subject)
    turns = np.zeros(len(points), dtype=np.int64)
    starts = np.cumsum([0, *(len(ring) for ring in closed)], dtype=np.int64)
    count_turns(vertices, starts, points, turns)
    joined = shapely.union_all(faces[(turns if rule == "nonzero" else turns % 2) != 0])
    return joined if isinstance(joined, Polygon | MultiPolygon) else MultiPolygon()


def mend(polygon: Polygon, subject: str = "outline") -> Silhouette:
    """Untangle a polygon that crosses itself: what each ring winds about, the holes taken out.

    Both lobes of an eight are kept. Raises ShapeError as ``fill`` does.
    """
    mended: shapely.Geometry = fill([shapely.get_coordinates(polygon.exterior)], subject=subject)
    for hole in polygon.interiors:
        mended = shapely.difference(mended, fill([shapely.get_coordinates(hole)], subject=subject))
    return mended if isinstance(mended, Polygon | MultiPolygon) else MultiPolygon()


def check_tangle(rings: Sequence[Floats], subject: str) -> None:
    """Raise ShapeError where the edges of closed ``rings`` (n, 2) meet each other too often to be sorted out."""
    ends = np.concatenate([np.stack([ring[:-1], ring[1:]], axis=1) for ring in rings])
    edges = np.asarray(shapely.linestrings(ends), dtype=object)
    tree = shapely.STRtree(edges)
    # each edge meets itself and its two neighbours; tests come in growing portions, so that the worst stays small
    own = 3 * len(edges)
    near, meetings, first, portion = -own, -own, 0, 16
    while first < len(edges):
        asked = edges[first : first + portion]
        near += tree.query(asked).shape[1]
        if near <= MAX_NEAR:
            meetings += tree.query(asked, predicate="intersects").shape[1]
        if near > MAX_NEAR or meetings > MAX_MEETINGS:
            raise _tangled(subject)
        first, portion = first + portion, min(2 * portion, 1024)


def _tangled(subject: str) -> ShapeError:
    return ShapeError(subject, "its outlines cross each other too many times; draw the silhouette alone")
