"""A shape's boundary as plain arrays for the kernels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon

from analysis.linekernels import Outline, outline_of
from lab.base.errors import RequestError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Geometry = Polygon | MultiPolygon

_CHUNK_EDGES = 8  # measured: 4 to 16 differ by under 10 %


class BoundaryError(RequestError):
    """The geometry has no inside to measure: mend or union it first.

    Attributes:
        reason: what shapely says is wrong.
    """

    def __init__(self, reason: str) -> None:
        super().__init__(f"this shape cannot be measured: {reason}; union its parts, or run shapely.make_valid on it")
        self.reason = reason


@dataclass(frozen=True, slots=True, eq=False)
class Boundary:
    """The rings of a shape, relative to the centre of its circumscribed circle.

    Attributes:
        x_cm: (v + rings,) vertices of all rings end to end, every ring closed by its first vertex.
        y_cm: the same.
        rings: (rings, 2) first and last index of each ring in ``x_cm``; both are the same point.
        chunks: (c, 2) first and last vertex of stretches of consecutive edges.
        discs: (c, 3) x, y, r in cm of a circle round each stretch.
        centre_cm: the centre that was taken off.
        radius_cm: radius of the circumscribed circle.
        hull_perimeter_cm: perimeter of the convex hull.
        outline: the vertices as `analysis.linekernels` wants them.
    """

    x_cm: Floats
    y_cm: Floats
    rings: Ints
    chunks: Ints
    discs: Floats
    centre_cm: tuple[float, float]
    radius_cm: float
    hull_perimeter_cm: float
    outline: Outline

    @classmethod
    def of(cls, geometry: Geometry) -> Boundary:
        """Take a Polygon or MultiPolygon in cm apart. Raises BoundaryError if it is empty or invalid."""
        checked: Any = geometry
        if not isinstance(checked, (Polygon, MultiPolygon)):
            raise BoundaryError(f"a Polygon or MultiPolygon is needed, not {type(checked).__name__}")
        if geometry.is_empty or not geometry.area > 0:
            raise BoundaryError("it is empty")
        if not geometry.is_valid:
            raise BoundaryError(shapely.is_valid_reason(geometry))
        centre = shapely.minimum_bounding_circle(geometry).centroid
        origin = np.array([centre.x, centre.y])
        parts = [geometry] if isinstance(geometry, Polygon) else list(geometry.geoms)
        points: list[Floats] = []
        rings: list[tuple[int, int]] = []
        chunks: list[tuple[int, int]] = []
        size = 0
        for part in parts:
            for ring in (part.exterior, *part.interiors):
                closed = np.asarray(shapely.get_coordinates(ring), dtype=float) - origin
                moved = np.ones(len(closed), dtype=bool)
                moved[1:] = (np.diff(closed, axis=0) != 0).any(axis=1)
                closed = closed[moved]
                last = size + len(closed) - 1
                rings.append((size, last))
                chunks += [(start, min(start + _CHUNK_EDGES, last)) for start in range(size, last, _CHUNK_EDGES)]
                points.append(closed)
                size = last + 1
        xy = np.concatenate(points)
        discs = np.empty((len(chunks), 3))
        for row, (first, last) in enumerate(chunks):
            stretch = xy[first : last + 1]
            middle = (stretch.min(axis=0) + stretch.max(axis=0)) / 2
            # A hair more than needed: a crossing exactly on the circle must not be lost to rounding.
            discs[row] = *middle, np.hypot(*(stretch - middle).T).max() * (1 + 1e-12) + 1e-12
        x_cm, y_cm = np.ascontiguousarray(xy[:, 0]), np.ascontiguousarray(xy[:, 1])
        ends = np.array(rings, dtype=np.int64)
        return cls(
            x_cm=x_cm,
            y_cm=y_cm,
            rings=ends,
            chunks=np.array(chunks, dtype=np.int64),
            discs=discs,
            centre_cm=(float(centre.x), float(centre.y)),
            radius_cm=float(np.hypot(xy[:, 0], xy[:, 1]).max()),
            hull_perimeter_cm=float(geometry.convex_hull.length),
            outline=outline_of(x_cm, y_cm, ends),
        )

    @property
    def edges(self) -> int:
        """Number of edges; no line can have more crossings."""
        return len(self.x_cm) - len(self.rings)

    def open_rings(self) -> tuple[Floats, Floats, Ints, Ints]:
        """Give (x_cm, y_cm, previous, following): each vertex once, and its neighbours' indices in its ring."""
        keep = np.ones(len(self.x_cm), dtype=bool)
        keep[self.rings[:, 1]] = False
        previous = np.empty(self.edges, dtype=np.int64)
        following = np.empty(self.edges, dtype=np.int64)
        first = 0
        for row in range(len(self.rings)):
            size = int(self.rings[row, 1] - self.rings[row, 0])
            ring = np.arange(first, first + size)
            previous[ring] = np.roll(ring, 1)
            following[ring] = np.roll(ring, -1)
            first += size
        return self.x_cm[keep], self.y_cm[keep], previous, following
