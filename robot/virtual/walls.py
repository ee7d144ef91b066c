"""The walls around a convex polygon, met exactly: a step is cut where it first crosses an edge."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from shapely.geometry import Polygon
from shapely.geometry.polygon import orient

from lab.base.errors import RequestError

# Nearer than this to an edge's line counts as standing against it.
_TOUCH_CM = 1e-6


@dataclass(frozen=True, slots=True)
class Hit:
    """Where a step meets a wall: after ``distance_cm``; ``normal_rad`` is the arena angle of the inward normal."""

    distance_cm: float
    normal_rad: float


class Walls:
    """The edges of a convex polygon as half planes n·p <= d, n the outward unit normals.

    Args:
        reachable: The polygon, arena cm.

    Raises:
        RequestError: It is empty, has holes or is not convex.
    """

    def __init__(self, reachable: Polygon) -> None:
        if reachable.is_empty or not reachable.is_valid or reachable.area <= 0:
            raise RequestError("arena: the robot has no room to roll; make the arena larger than the robot")
        if reachable.interiors or reachable.convex_hull.area > reachable.area * (1 + 1e-9):
            raise RequestError("arena: it must be convex and without holes, or lines would end inside it")
        ring = np.asarray(orient(reachable).exterior.coords, dtype=float)[:, :2]
        edges = np.diff(ring, axis=0)
        lengths = np.hypot(edges[:, 0], edges[:, 1])
        edges, ring = edges[lengths > 0], ring[:-1][lengths > 0]
        lengths = lengths[lengths > 0]
        # Counter-clockwise ring: the outside is to the right of each edge.
        self._normal_x = edges[:, 1] / lengths
        self._normal_y = -edges[:, 0] / lengths
        self._offset_cm = self._normal_x * ring[:, 0] + self._normal_y * ring[:, 1]
        self._low = ring.min(axis=0)
        self._high = ring.max(axis=0)
        # Around this point no wall is nearer than this: a step that ends within meets none.
        self._clear_x_cm, self._clear_y_cm, self._clear_cm = 0.0, 0.0, -1.0

    def contains(self, x_cm: float, y_cm: float) -> bool:
        """Whether the point is inside or on the walls."""
        gap = self._offset_cm - self._normal_x * x_cm - self._normal_y * y_cm
        return bool(gap.min() >= -_TOUCH_CM)

    def draw(self, rng: Generator) -> tuple[float, float]:
        """A point drawn evenly over the inside."""
        while True:
            x_cm, y_cm = np.asarray(rng.uniform(self._low, self._high), dtype=float).tolist()
            if self.contains(x_cm, y_cm):
                return x_cm, y_cm

    def blocks(self, x_cm: float, y_cm: float, along_x: float, along_y: float) -> bool:
        """Whether a ball that stands here is held by a wall when it pushes along the unit vector."""
        gap = self._offset_cm - self._normal_x * x_cm - self._normal_y * y_cm
        towards = self._normal_x * along_x + self._normal_y * along_y
        return bool(np.any((gap < _TOUCH_CM) & (towards > 0)))

    def hit(self, x_cm: float, y_cm: float, along_x: float, along_y: float, way_cm: float) -> Hit | None:
        """The first wall on a straight step of ``way_cm`` from an inner point along the unit vector, or None."""
        end_x, end_y = x_cm + way_cm * along_x - self._clear_x_cm, y_cm + way_cm * along_y - self._clear_y_cm
        if self._clear_cm > 0 and end_x * end_x + end_y * end_y < self._clear_cm * self._clear_cm:
            return None
        gap = self._offset_cm - self._normal_x * x_cm - self._normal_y * y_cm
        towards = self._normal_x * along_x + self._normal_y * along_y
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            reach = np.where(towards > 1e-15, np.maximum(gap, 0.0) / towards, np.inf)
        first = int(reach.argmin())
        distance_cm = float(reach[first])
        if distance_cm > way_cm:
            self._clear_x_cm, self._clear_y_cm, self._clear_cm = x_cm, y_cm, float(gap.min())
            return None
        inward_rad = math.atan2(-float(self._normal_y[first]), -float(self._normal_x[first]))
        return Hit(distance_cm, inward_rad)
