"""Several balls in one arena: they are moved on together and run into each other.

No ball may pass through another, and where they meet must not depend on how often they are asked. So
the crowd steps by bounds that no contact can beat. Far apart, from the speeds and the rate at which they
may rise alone: two balls with the gap g meet no sooner than the root of g = (v1 + v2) t + (a1 + a2) t²/2.
Near each other, from the motion itself: with n the unit vector between the centres, the distance after
the time t is at least its part along n,

    d(t) >= d + n·w t + (n·a - b) t²/2,

w and a the relative velocity and acceleration and b what bent paths may add. Steps to the root of that
bound are Newton's on a convex function: they come up to the contact from one side, quadratically.

Contact is dead: no push is handed on. A ball that moves into the other stops, one that moves away or
along rolls on, and both feel it. A ball told to roll into one that it touches is held, as at a wall; whether
the way has become free it feels at fixed instants.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

from numpy.random import Generator
from shapely.geometry import Polygon

from lab.base.errors import RequestError
from robot.virtual.body import Body
from robot.virtual.walls import Walls

BOLT_RADIUS_CM = 3.65
# Nearer than this is touching, as at a wall.
_TOUCH_CM = 1e-6
# Slower than this is not closing; touching balls that pass side by side are let this near.
_STILL_CM_S = 1e-9
_GRAZE_CM = 1e-4
# Where speeds alone allow less than this, the motion itself is looked at.
_COARSE_S = 0.02
# Every step takes this long at least; two fast balls come 1e-5 cm nearer in it.
_LEAST_S = 5e-8
# A held ball feels at whole multiples of this whether its way is free.
_FEEL_S = 0.01
_SAME = 1e-5
_DRAWS = 10_000


class Crowd:
    """Balls that share an arena; from now on ``advance`` of any of them moves all.

    A crowd of one does what the ball alone does.

    Args:
        bodies: The balls, all at the same instant or not yet started, none nearer to another than two radii.
        radius_cm: Radius of each.

    Raises:
        RequestError: The radius is not above 0, balls overlap, their clocks differ, or one is in a crowd already.
    """

    def __init__(self, bodies: Sequence[Body], radius_cm: float = BOLT_RADIUS_CM) -> None:
        _check_radius(radius_cm)
        self.bodies = tuple(bodies)
        self.radius_cm = radius_cm
        if len({id(body) for body in self.bodies}) < len(self.bodies) or any(body.crowd for body in self.bodies):
            raise RequestError("crowd: a robot is in a crowd already; make one crowd of all that share an arena")
        clocks = [body.t_s for body in self.bodies if body.started]
        if clocks and (len(clocks) < len(self.bodies) or max(clocks) > min(clocks)):
            raise RequestError("crowd: the robots' clocks differ; advance all to one instant first")
        self._t_s: float | None = clocks[0] if clocks else None
        self._pairs = tuple(combinations(range(len(self.bodies)), 2))
        for i, j in self._pairs:
            if self.gap_cm(i, j) < -_TOUCH_CM:
                one, two = self.bodies[i], self.bodies[j]
                raise RequestError(
                    f"crowd: robots {i} and {j} overlap at ({one.x_cm:g}, {one.y_cm:g}) and ({two.x_cm:g}, "
                    f"{two.y_cm:g}) cm; place them {2 * radius_cm:g} cm apart or more"
                )
        for body in self.bodies:
            body.crowd = self
        self._touching: frozenset[tuple[int, int]] = frozenset()
        self._busy = False
        self._meet()

    def gap_cm(self, i: int, j: int) -> float:
        """Free way between the balls ``i`` and ``j``; below 0 they overlap."""
        one, two = self.bodies[i], self.bodies[j]
        return math.hypot(one.x_cm - two.x_cm, one.y_cm - two.y_cm) - 2.0 * self.radius_cm

    @property
    def touching(self) -> frozenset[tuple[int, int]]:
        """The pairs (i, j), i < j, that stand against each other."""
        return self._touching

    def advance(self, t_s: float) -> None:
        """Move all on to the instant ``t_s``; the first call sets the clock.

        An instant already passed changes nothing, nor does a call from within ``on_bump``.
        """
        if self._busy:
            return
        self._busy = True
        try:
            now_s = self._t_s
            if now_s is None or not self._pairs:
                self._move(t_s)
                return
            while now_s < t_s:
                left_s = t_s - now_s
                far_s = left_s
                if any(body.speed_cm_s > 0 for body in self.bodies):
                    far_s = min(left_s, self._until_felt_s(now_s))
                step_s = self._far_s(far_s)
                if step_s < min(_COARSE_S, far_s):
                    step_s = self._near_s(now_s, far_s)
                now_s = t_s if step_s >= left_s else min(t_s, now_s + max(step_s, _LEAST_S))
                self._move(now_s)
                self._meet()
        finally:
            self._busy = False

    def _move(self, t_s: float) -> None:
        for body in self.bodies:
            body.advance_alone(t_s)
        self._t_s = t_s

    def _until_felt_s(self, t_s: float) -> float:
        """Time to the next instant at which held balls feel whether their way is free, if any touch."""
        return (math.floor(t_s / _FEEL_S + _SAME) + 1) * _FEEL_S - t_s if self._touching else math.inf

    def _far_s(self, most_s: float) -> float:
        """A time in which nobody can reach another, whatever they are told meanwhile."""
        rises = [body.settings.acceleration_cm_s2 if body.moving else 0.0 for body in self.bodies]
        for i, j in self._pairs:
            speed, rise = self.bodies[i].speed_cm_s + self.bodies[j].speed_cm_s, rises[i] + rises[j]
            if speed > 0 or rise > 0:
                gap_cm = max(0.0, self.gap_cm(i, j) - _TOUCH_CM)
                root = math.sqrt(speed * speed + 2.0 * rise * gap_cm)
                most_s = min(most_s, 2.0 * gap_cm / (speed + root) if speed + root > 0 else 0.0)
        return most_s

    def _near_s(self, t_s: float, most_s: float) -> float:
        """A time from ``t_s`` in which all move smoothly and nobody comes nearer to another than touching."""
        outlooks = [body.outlook(most_s) for body in self.bodies]
        most_s = min(most_s, *(outlook[0] for outlook in outlooks))
        if any(outlook[1] > 0 for outlook in outlooks):
            most_s = min(most_s, self._until_felt_s(t_s))
        for i, j in self._pairs:
            one, two = self.bodies[i], self.bodies[j]
            n_x, n_y = self._from(i, j)
            opening_cm_s = self._opening_cm_s(i, j, n_x, n_y)
            # Twice the bend, for the chords that stand for the arcs.
            rise = -2.0 * (outlooks[i][2] + outlooks[j][2])
            rise += outlooks[i][1] * _along(one, n_x, n_y) - outlooks[j][1] * _along(two, n_x, n_y)
            free_cm = self.gap_cm(i, j)
            if free_cm <= _TOUCH_CM and opening_cm_s >= -_STILL_CM_S:
                # Side by side: a bend that is only feared must not make the steps endless.
                free_cm = _GRAZE_CM
            most_s = min(most_s, _least_root(free_cm - _TOUCH_CM / 2.0, opening_cm_s, rise))
        return most_s

    def _from(self, i: int, j: int) -> tuple[float, float]:
        """Unit vector from ball ``j`` to ball ``i``."""
        x_cm, y_cm = self.bodies[i].x_cm - self.bodies[j].x_cm, self.bodies[i].y_cm - self.bodies[j].y_cm
        distance_cm = math.hypot(x_cm, y_cm)
        return x_cm / distance_cm, y_cm / distance_cm

    def _meet(self) -> None:
        """Let those that have come to touch feel it, and those held feel whether their way is free."""
        near = frozenset(pair for pair in self._pairs if self.gap_cm(*pair) <= _TOUCH_CM)
        if not near and not self._touching:
            return
        moment = (self._t_s or 0.0) / _FEEL_S
        self._touching = near if abs(moment - round(moment)) < _SAME else self._touching | near
        beside: list[list[tuple[float, float]]] = [[] for _ in self.bodies]
        impacts: list[tuple[int, int, float, float]] = []
        for i, j in sorted(self._touching):
            n_x, n_y = self._from(i, j)
            beside[i].append((n_x, n_y))
            beside[j].append((-n_x, -n_y))
            closing_cm_s = -self._opening_cm_s(i, j, n_x, n_y)
            if (i, j) in near and closing_cm_s > _STILL_CM_S:
                impacts.append((i, j, math.atan2(n_y, n_x), closing_cm_s))
        for body, normals in zip(self.bodies, beside, strict=True):
            body.beside = tuple(normals)
        for i, j, normal_rad, closing_cm_s in impacts:
            self.bodies[i].touch(normal_rad, closing_cm_s)
            self.bodies[j].touch(normal_rad + math.pi, closing_cm_s)

    def _opening_cm_s(self, i: int, j: int, n_x: float, n_y: float) -> float:
        """Speed at which the ball ``i`` leaves ``j``, the unit vector from ``j`` to ``i`` given."""
        one, two = self.bodies[i], self.bodies[j]
        return one.speed_cm_s * _along(one, n_x, n_y) - two.speed_cm_s * _along(two, n_x, n_y)


def draw_places(
    reachable: Polygon, count: int, rng: Generator, radius_cm: float = BOLT_RADIUS_CM
) -> list[tuple[float, float]]:
    """Draw where ``count`` balls start: every arrangement without overlap is equally likely.

    Args:
        reachable: Convex polygon that the balls' centres move in, arena cm.
        count: Number of balls.
        rng: Source of the draws.
        radius_cm: Radius of each ball.

    Returns:
        The centres (x, y), cm.

    Raises:
        RequestError: ``reachable`` or the radius will not do, or there is no room for so many.
    """
    _check_radius(radius_cm)
    walls = Walls(reachable)
    for _ in range(_DRAWS):
        places: list[tuple[float, float]] = []
        while len(places) < count:
            place = walls.draw(rng)
            if any(math.dist(place, other) < 2.0 * radius_cm for other in places):
                break
            places.append(place)
        else:
            return places
    raise RequestError(f"crowd: no room for {count} robots of {radius_cm:g} cm radius; take fewer or a larger arena")


def _check_radius(radius_cm: float) -> None:
    if not (math.isfinite(radius_cm) and radius_cm > 0):
        raise RequestError(f"crowd: the balls' radius must be above 0 cm, got {radius_cm:g}")


def _along(body: Body, n_x: float, n_y: float) -> float:
    """Part along the unit vector of a way of 1 cm straight on."""
    facing_rad = body.facing_rad
    return n_x * math.cos(facing_rad) + n_y * math.sin(facing_rad)


def _least_root(gap: float, slope: float, rise: float) -> float:
    """The first time t at which gap + slope t + rise t²/2 is 0; infinite if it never is."""
    if gap <= 0:
        return 0.0
    square = slope * slope - 2.0 * rise * gap
    if square < 0 or (slope >= 0 and rise >= 0):
        return math.inf
    if slope < 0:
        return 2.0 * gap / (math.sqrt(square) - slope)
    return (slope + math.sqrt(square)) / -rise
