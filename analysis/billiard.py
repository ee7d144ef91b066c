"""Simulated robots that roll from edge to edge of a convex arena, turning by a given law.

The outgoing angle φ from the edge's inward normal has a density ∝ cos^m φ: m = 1 is Lambert's law, whose lines are
uniform and isotropic (Evans, Ann. Appl. Probab. 11 (2001) 419), m = 0 the uniform angle. With t = sin φ the density
is ∝ (1 − t²)^((m−1)/2), so that (t + 1)/2 is Beta((m+1)/2, (m+1)/2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon
from shapely.geometry.polygon import orient

from analysis.kernels import kernel
from lab.base.errors import RequestError

Floats = NDArray[np.float64]

# Runs until the places of the ends forget where the first one was.
_WARM_UP = 20


class ArenaError(RequestError):
    """The region given for the ball's centre is not one convex polygon; hand in the arena less the ball's radius."""


@dataclass(frozen=True, slots=True, eq=False)
class Rolls:
    """Runs of simulated robots, each array (robots, runs), in the order rolled.

    A run lies on the line x cos θ + y sin θ = p; θ is not reduced to one turn.
    """

    theta_rad: Floats
    p_cm: Floats
    length_cm: Floats


def corners(reachable: Polygon) -> Floats:
    """The corners (m, 2) in cm of a convex polygon, counter-clockwise, the first not repeated.

    Raises:
        ArenaError: it is empty, has holes or is not convex.
    """
    if (
        reachable.is_empty
        or not reachable.area > 0
        or len(reachable.interiors)
        or reachable.convex_hull.area > reachable.area * (1 + 1e-9)
    ):
        raise ArenaError(
            "the region that the robot's centre can reach must be one convex polygon without holes: "
            "give the arena less the ball's radius"
        )
    ring = np.asarray(shapely.get_coordinates(orient(reachable).exterior), dtype=float)[:-1]
    moved = np.any(ring != np.roll(ring, 1, axis=0), axis=1)
    return np.ascontiguousarray(ring[moved])


def check_exponent(exponent: float) -> None:
    """Raise RequestError unless cos^m has a finite integral."""
    if not (np.isfinite(exponent) and exponent > -1):
        raise RequestError(f"the angle's density is ∝ cos^m with m above −1, not {exponent}: Lambert's law is 1")


def roll(reachable: Polygon, robots: int, runs: int, rng: np.random.Generator, *, exponent: float = 1.0) -> Rolls:
    """Roll ``robots`` for ``runs`` successive runs each, from edge to edge, with a density ∝ cos^m of the angle.

    They start evenly along the edge (which Lambert's law keeps so) and, for another law, have already rolled
    until its own distribution is reached.

    Raises:
        ArenaError: ``reachable`` (cm) is not convex.
        RequestError: the exponent m is not above −1.
    """
    check_exponent(exponent)
    ring = corners(reachable)
    before = 0 if exponent == 1.0 else _WARM_UP
    shape = (robots, runs + before)
    half = (exponent + 1) / 2
    sines = 2 * (rng.random(shape) if exponent == 1.0 else rng.beta(half, half, shape)) - 1
    found = (np.empty(shape), np.empty(shape), np.empty(shape))
    _from_edge_to_edge(ring[:, 0].copy(), ring[:, 1].copy(), rng.random(robots), sines, found)
    return Rolls(*(np.ascontiguousarray(values[:, before:]) for values in found))


def hit_and_run(reachable: Polygon, robots: int, runs: int, rng: np.random.Generator) -> Rolls:
    """The chords of robots that stop at uniform points of them and turn anywhere (Smith, Oper. Res. 32 (1984) 1296).

    Their lines are isotropic, with a density ∝ the chord's length.
    """
    ring = corners(reachable)
    shape = (robots, runs + _WARM_UP)
    found = (np.empty(shape), np.empty(shape), np.empty(shape))
    centre = reachable.centroid
    draws = (2 * np.pi * rng.random(shape), rng.random(shape))
    _from_stop_to_stop(ring[:, 0].copy(), ring[:, 1].copy(), (centre.x, centre.y), draws, found)
    return Rolls(*(np.ascontiguousarray(values[:, _WARM_UP:]) for values in found))


@kernel
def _from_edge_to_edge(
    x_cm: Floats, y_cm: Floats, starts: Floats, sines: Floats, found: tuple[Floats, Floats, Floats]
) -> None:
    """Fill (θ, p, length) of every run. ``starts`` (robots,) in [0, 1) are places along the edge, as shares of it."""
    theta, p, length = found
    count = x_cm.size
    side = np.empty(count)
    total = 0.0
    for i in range(count):
        side[i] = np.hypot(x_cm[(i + 1) % count] - x_cm[i], y_cm[(i + 1) % count] - y_cm[i])
        total += side[i]
    for robot in range(sines.shape[0]):
        left = starts[robot] * total
        wall = 0
        while wall < count - 1 and left > side[wall]:
            left -= side[wall]
            wall += 1
        share = min(left / side[wall], 1.0)
        x = x_cm[wall] + share * (x_cm[(wall + 1) % count] - x_cm[wall])
        y = y_cm[wall] + share * (y_cm[(wall + 1) % count] - y_cm[wall])
        for run in range(sines.shape[1]):
            along_x = (x_cm[(wall + 1) % count] - x_cm[wall]) / side[wall]
            along_y = (y_cm[(wall + 1) % count] - y_cm[wall]) / side[wall]
            sine = sines[robot, run]
            cosine = np.sqrt(max(0.0, 1.0 - sine * sine))
            dx = sine * along_x - cosine * along_y
            dy = sine * along_y + cosine * along_x
            # Counter-clockwise from the wall just left, corners lie right of the heading up to the wall that is
            # met and left of it from there on: bisection.
            low, high = 1, count - 1
            while low < high:
                middle = (low + high + 1) // 2
                corner = (wall + middle) % count
                if dx * (y_cm[corner] - y) - dy * (x_cm[corner] - x) <= 0:
                    low = middle
                else:
                    high = middle - 1
            wall = (wall + low) % count
            wall_x = (x_cm[(wall + 1) % count] - x_cm[wall]) / side[wall]
            wall_y = (y_cm[(wall + 1) % count] - y_cm[wall]) / side[wall]
            gap = wall_x * (y - y_cm[wall]) - wall_y * (x - x_cm[wall])
            closing = dy * wall_x - dx * wall_y
            reach = max(gap, 0.0) / max(-closing, 1e-12)
            theta[robot, run] = np.arctan2(dx, -dy)
            p[robot, run] = y * dx - x * dy
            length[robot, run] = reach
            x += reach * dx
            y += reach * dy


@kernel
def _from_stop_to_stop(
    x_cm: Floats,
    y_cm: Floats,
    start_cm: tuple[float, float],
    draws: tuple[Floats, Floats],
    found: tuple[Floats, Floats, Floats],
) -> None:
    """Fill (θ, p, length) of every chord. ``draws`` (robots, runs): headings, and shares of the chord to stop at."""
    theta, p, length = found
    heading, share = draws
    count = x_cm.size
    for robot in range(heading.shape[0]):
        x, y = start_cm
        for run in range(heading.shape[1]):
            dx = np.cos(heading[robot, run])
            dy = np.sin(heading[robot, run])
            back, ahead = -np.inf, np.inf
            for i in range(count):
                wall_x = x_cm[(i + 1) % count] - x_cm[i]
                wall_y = y_cm[(i + 1) % count] - y_cm[i]
                closing = dy * wall_x - dx * wall_y
                gap = wall_x * (y - y_cm[i]) - wall_y * (x - x_cm[i])
                if closing < 0:
                    ahead = min(ahead, -gap / closing)
                elif closing > 0:
                    back = max(back, -gap / closing)
            theta[robot, run] = np.arctan2(dx, -dy)
            p[robot, run] = y * dx - x * dy
            length[robot, run] = max(ahead - back, 0.0)
            stop = back + share[robot, run] * (ahead - back)
            x += stop * dx
            y += stop * dy
