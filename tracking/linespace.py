"""The space of lines that meet a convex region, and the lines a robot should roll in it.

A line is (theta, p): theta in [0, pi) the direction of its normal, p its signed distance from the
origin. The measure that motions leave alone is dp dtheta, so of the lines that meet a convex region the
direction has the density w(theta)/perimeter, w the support width, and p given theta is uniform over the
support interval (Santalo, Integral Geometry and Geometric Probability, ch. 3). Directions are thus
uniform in a disc alone. The map (theta, p) -> (U, V) = (F_w(theta), place of p in its interval) makes
isotropic, homogeneous lines uniform on the unit square, whatever the region.

Turning the normal round (theta + pi, -p) is the same line: U = 1 joins U = 0 with V upside down, so the
square closes into a Moebius strip.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from shapely import Polygon

from lab.base.errors import RequestError

Floats = NDArray[np.float64]


class RegionError(RequestError):
    """The region given for the ball's centre is no convex polygon; hand in the arena shrunk by the ball's radius."""


def corners(region: Polygon) -> Floats:
    """The corners (m, 2) of a convex polygon, counter-clockwise, first not repeated, cm.

    Raises RegionError where the region is empty, has a hole or is not convex.
    """
    hull = region.convex_hull
    if region.is_empty or region.area <= 0 or len(region.interiors) or hull.area > region.area * (1 + 1e-9):
        raise RegionError(
            "the region the robot can reach must be one convex polygon without holes; "
            "give the arena shrunk by the ball's radius, not the shape"
        )
    ring = np.asarray(shapely.get_coordinates(shapely.normalize(hull)), dtype=float)[:-1]
    x, y = ring.T
    turns_left = float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) > 0
    return ring if turns_left else ring[::-1].copy()


def support(theta_rad: ArrayLike, region: Polygon) -> Floats:
    """The support function h(theta) = max of x cos(theta) + y sin(theta) over the region, cm.

    The lines of direction theta that meet the region are those with -h(theta + pi) <= p <= h(theta).
    ``theta_rad`` may have any shape.

    >>> from shapely import box
    >>> float(support(0.0, box(-3, -1, 3, 1)))
    3.0
    """
    theta = np.asarray(theta_rad, dtype=float)
    points = corners(region)
    along = np.cos(theta)[..., None] * points[:, 0] + np.sin(theta)[..., None] * points[:, 1]
    return np.asarray(along.max(axis=-1), dtype=float)


@dataclass(frozen=True, slots=True, eq=False)
class LineSpace:
    """The lines that meet one convex region, ready for many look-ups.

    Between two neighbouring ``breaks_rad`` (normals of the edges, modulo pi) the same corner lies lowest
    and the same highest, so the width is one sinusoid, ``span . (cos, sin)``, and its integral is closed.
    """

    breaks_rad: Floats
    lowest_cm: Floats
    span_cm: Floats
    integral_cm: Floats

    @classmethod
    def of(cls, region: Polygon) -> LineSpace:
        """Build it for a convex polygon; raises RegionError for anything else."""
        points = corners(region)
        edges = np.roll(points, -1, axis=0) - points
        normals = np.mod(np.arctan2(edges[:, 1], edges[:, 0]) + np.pi / 2, np.pi)
        breaks = np.unique(np.concatenate([[0.0], normals[normals > 1e-12], [np.pi]]))
        middle = (breaks[1:] + breaks[:-1]) / 2
        along = np.cos(middle)[:, None] * points[:, 0] + np.sin(middle)[:, None] * points[:, 1]
        lowest = points[along.argmin(axis=1)]
        span = points[along.argmax(axis=1)] - lowest
        sine, cosine = np.diff(np.sin(breaks)), np.diff(np.cos(breaks))
        pieces = span[:, 0] * sine - span[:, 1] * cosine
        return cls(breaks, lowest, span, np.concatenate([[0.0], np.cumsum(pieces)]))

    @property
    def perimeter_cm(self) -> float:
        """The integral of the width over [0, pi): the region's perimeter (Cauchy)."""
        return float(self.integral_cm[-1])

    def uniforms(self, theta_rad: ArrayLike, p_cm: ArrayLike) -> tuple[Floats, Floats]:
        """Map lines to (U, V), each of the broadcast shape. V leaves [0, 1] for a line that misses the region."""
        theta_in, p_in = np.broadcast_arrays(np.asarray(theta_rad, dtype=float), np.asarray(p_cm, dtype=float))
        turns = np.floor(theta_in / np.pi)
        theta = theta_in - turns * np.pi
        p = np.where(turns % 2 == 0, p_in, -p_in)
        piece = np.clip(np.searchsorted(self.breaks_rad, theta, side="right") - 1, 0, len(self.span_cm) - 1)
        cosine, sine = np.cos(theta), np.sin(theta)
        begin = self.breaks_rad[piece]
        span_x, span_y = self.span_cm[piece, 0], self.span_cm[piece, 1]
        covered = self.integral_cm[piece] + span_x * (sine - np.sin(begin)) - span_y * (cosine - np.cos(begin))
        lowest = self.lowest_cm[piece, 0] * cosine + self.lowest_cm[piece, 1] * sine
        return covered / self.perimeter_cm, (p - lowest) / (span_x * cosine + span_y * sine)

    def direction(self, u: float) -> float:
        """The inverse of U: the normal's direction theta in [0, pi) below which the share ``u`` of the lines lies."""
        piece = int(np.clip(np.searchsorted(self.integral_cm, u * self.perimeter_cm) - 1, 0, len(self.span_cm) - 1))
        begin, end = float(self.breaks_rad[piece]), float(self.breaks_rad[piece + 1])
        grid = np.asarray(np.linspace(begin, end, 257), dtype=float)
        # theta = pi belongs to the next turn of the strip, so look its share up as the one just below
        share, _ = self.uniforms(np.minimum(grid, np.nextafter(np.pi, 0.0)), 0.0)
        return float(np.interp(u, share, grid))


def uniforms(theta_rad: ArrayLike, p_cm: ArrayLike, reachable: Polygon) -> tuple[Floats, Floats]:
    """Map lines to (U, V), uniform on the unit square if and only if they are isotropic and homogeneous.

    Args:
        theta_rad: direction of each line's normal; any branch, (theta + pi, -p) is the same line.
        p_cm: signed distance of each line from the origin, same shape.
        reachable: convex polygon in which the ball's centre moves.

    Returns:
        U = F_w(theta), with F_w the distribution of directions under dp dtheta, and V, the place of p in
        the support interval at theta: 0 lowest, 1 highest, outside [0, 1] for a line that misses the region.

    Raises:
        RegionError: the polygon is not convex, or empty.

    >>> from shapely import box
    >>> u, v = uniforms([0.0, 1.5707963267948966], [0.0, 1.0], box(-3, -1, 3, 1))
    >>> [float(round(value, 6)) for value in u], [float(round(value, 6)) for value in v]
    ([0.0, 0.5], [0.5, 1.0])
    """
    return LineSpace.of(reachable).uniforms(theta_rad, p_cm)


@dataclass(frozen=True, slots=True, eq=False)
class Wall:
    """The boundary of a convex region: places on it are counted in cm along it, counter-clockwise."""

    points: Floats
    tangents: Floats
    inward: Floats
    begins_cm: Floats
    perimeter_cm: float

    @classmethod
    def of(cls, region: Polygon) -> Wall:
        """The boundary of a convex polygon; raises RegionError for anything else."""
        points = corners(region)
        edges = np.roll(points, -1, axis=0) - points
        lengths: Floats = np.asarray(np.hypot(edges[:, 0], edges[:, 1]), dtype=float)
        tangents = edges / lengths[:, None]
        begins = np.concatenate([[0.0], np.cumsum(lengths)])
        inward = np.column_stack([-tangents[:, 1], tangents[:, 0]])
        return cls(points, tangents, inward, begins[:-1], float(begins[-1]))

    def at(self, place_cm: Floats) -> tuple[Floats, NDArray[np.intp]]:
        """The points (n, 2) at places (n,) along the wall, and the edges they lie on."""
        edge = np.clip(np.searchsorted(self.begins_cm, place_cm, side="right") - 1, 0, len(self.points) - 1)
        return self.points[edge] + (place_cm - self.begins_cm[edge])[:, None] * self.tangents[edge], edge

    def place_cm(self, position: Floats, edge: NDArray[np.intp]) -> Floats:
        """The places (n,) of points (n, 2) on these edges."""
        along = np.einsum("ij,ij->i", position - self.points[edge], self.tangents[edge])
        return np.asarray(self.begins_cm[edge] + along, dtype=float)

    def heading(self, edge: NDArray[np.intp], sine: Floats) -> Floats:
        """Unit vectors (n, 2) that leave these edges at the inward angle arcsin(sine) to their normals."""
        cosine = np.sqrt(1.0 - sine * sine)
        return cosine[:, None] * self.inward[edge] + sine[:, None] * self.tangents[edge]

    def next_edge(self, position: Floats, heading: Floats, edge: NDArray[np.intp]) -> NDArray[np.intp]:
        """The edge each robot meets next, by bisection.

        Counter-clockwise from the edge just left the corners lie right of the heading up to the edge it meets
        and left of it from there on.
        """
        count = len(self.points)
        low, high = np.ones_like(edge), np.full_like(edge, count)
        for _ in range(int(np.ceil(np.log2(count))) + 1):
            middle = (low + high) // 2
            towards = self.points[(edge + middle) % count] - position
            right = heading[:, 0] * towards[:, 1] - heading[:, 1] * towards[:, 0] <= 0
            low = np.where(right, middle, low)
            high = np.where(right, high, np.maximum(middle, low + 1))
        return (edge + low) % count

    def ends_cm(self, theta_rad: Floats, p_cm: Floats) -> Floats:
        """The places (n, 2) where lines leave the region; a line that misses it is moved to its nearest corner."""
        normal = np.column_stack([np.cos(theta_rad), np.sin(theta_rad)])
        height = normal @ self.points.T
        low, high = height.min(axis=1), height.max(axis=1)
        slack = 1e-9 * (high - low)
        above = height > np.clip(p_cm, low + slack, high - slack)[:, None]
        rising = np.argmax(~above & np.roll(above, -1, axis=1), axis=1)
        falling = np.argmax(above & ~np.roll(above, -1, axis=1), axis=1)
        places: list[Floats] = []
        for edge in (rising, falling):
            here = np.take_along_axis(height, edge[:, None], axis=1)[:, 0]
            climb = np.einsum("ij,ij->i", normal, self.tangents[edge])
            span = np.diff(np.append(self.begins_cm, self.perimeter_cm))[edge]
            places.append(self.begins_cm[edge] + np.clip((p_cm - here) / climb, 0.0, span))
        return np.stack(places, axis=1)


def line_of(position: Floats, heading: Floats) -> tuple[Floats, Floats]:
    """(theta, p) of the lines through points (n, 2) along unit vectors (n, 2), theta in [0, pi)."""
    theta = np.arctan2(heading[:, 0], -heading[:, 1])
    p = position[:, 1] * heading[:, 0] - position[:, 0] * heading[:, 1]
    flip = np.floor(theta / np.pi)
    return np.asarray(theta - flip * np.pi, dtype=float), np.where(flip % 2 != 0, -p, p)


@dataclass(frozen=True, slots=True, eq=False)
class Rolls:
    """Runs of simulated robots, every array (chains, runs); start and end are places along the wall."""

    theta_rad: Floats
    p_cm: Floats
    length_cm: Floats
    start_cm: Floats
    end_cm: Floats


def roll(
    reachable: Polygon,
    chains: int,
    runs: int,
    rng: np.random.Generator,
    *,
    successive: bool = True,
    begins: NDArray[np.bool_] | None = None,
    shortest_cm: float = 0.0,
) -> Rolls:
    """Roll ``chains`` robots for ``runs`` straight runs each, leaving every wall by Lambert's cosine law.

    The inward angle phi to the wall's normal has the density cos(phi)/2, phi = arcsin(2u - 1). A start
    that is uniform along the wall then stays so, and every line is isotropic and homogeneous
    (Evans, Ann. Appl. Probab. 11 (2001) 419), while lines that follow each other share an end and are
    dependent.

    Args:
        reachable: convex polygon in which the ball's centre moves.
        chains: robots.
        runs: runs of each that are kept.
        rng: source of starts and angles.
        successive: False draws a fresh start for each run: independent lines of the same law.
        begins: (runs,), true for the runs that start afresh where others follow the run before.
        shortest_cm: shorter runs are rolled but not kept.

    Raises:
        RegionError: the region is not convex.
        RequestError: runs of ``shortest_cm`` hardly occur.
    """
    wall = Wall.of(reachable)
    offsets = np.einsum("ij,ij->i", wall.inward, wall.points)
    afresh = np.full(runs, not successive) if begins is None else np.array(begins, dtype=bool)
    afresh[:1] = True
    kept = {name: np.empty((chains, runs)) for name in Rolls.__slots__}
    count, everyone = np.zeros(chains, dtype=np.intp), np.arange(chains)
    place = np.zeros(chains)
    position, edge = wall.at(place)
    steps = 0
    while int(count.min()) < runs:
        steps += 1
        if steps > 20 * (runs + 50):
            raise RequestError(
                f"runs of at least {shortest_cm:g} cm hardly occur in this region; lower shortest_cm below its diameter"
            )
        fresh = afresh[np.minimum(count, runs - 1)]
        if fresh.any():
            place = np.where(fresh, rng.random(chains) * wall.perimeter_cm, place)
            begun, begun_edge = wall.at(place)
            position, edge = np.where(fresh[:, None], begun, position), np.where(fresh, begun_edge, edge)
        heading = wall.heading(edge, 2.0 * rng.random(chains) - 1.0)
        theta, p = line_of(position, heading)
        edge = wall.next_edge(position, heading, edge)
        closing = np.maximum(-np.einsum("ij,ij->i", heading, wall.inward[edge]), 1e-12)
        length = np.maximum((np.einsum("ij,ij->i", position, wall.inward[edge]) - offsets[edge]) / closing, 0.0)
        position = position + length[:, None] * heading
        reached = wall.place_cm(position, edge)
        stored = (length >= shortest_cm) & (count < runs)
        row = everyone[stored]
        for name, values in zip(Rolls.__slots__, (theta, p, length, place, reached), strict=True):
            kept[name][row, count[stored]] = values[stored]
        count += stored
        place = reached
    return Rolls(**kept)
