"""Simulated robots in an arena: successive runs from edge to edge, turning as the robot does, light sensor included.

`analysis.montecarlo` draws independent lines. A robot's runs follow one upon another, miss the shape now and then and
are uniform and isotropic only if it turns by Lambert's law; with another law A and P are biased, and weights mend
that or not. This simulates whole sessions, many at once.
"""

from __future__ import annotations

from time import perf_counter

import numpy as np
from numpy.typing import NDArray
from shapely.geometry import Point, Polygon, box

from analysis.billiard import Rolls, hit_and_run, roll
from analysis.blocks import Progress, run_blocks
from analysis.boundary import Boundary, Geometry
from analysis.invariants import area_cm2, perimeter_cm
from analysis.montecarlo import Simulation, cross_lines
from analysis.sensor import SensorModel
from analysis.turning import Turning
from lab.base.errors import RequestError

Floats = NDArray[np.float64]

_LINES_AT_ONCE = 1 << 17  # bounds the memory
_SHORTEST_CM = 0.5  # a run below it meets nothing; bounds the weight 1/length
_OUTSIDE = 1e-9  # of the shape's area
_CIRCLE_SIDES = 1024
_MOST_RUNS = 10_000  # rolled for one crossing line before the shape counts as out of reach


def disc_arena(radius_cm: float) -> Polygon:
    """A disc about the origin, by a polygon of 1024 sides with the same area."""
    if not (np.isfinite(radius_cm) and radius_cm > 0):
        raise RequestError(f"an arena's radius is above 0 cm, not {radius_cm}")
    slice_rad = 2 * np.pi / _CIRCLE_SIDES
    outer = radius_cm * np.sqrt(slice_rad / np.sin(slice_rad))
    return Point(0, 0).buffer(outer, quad_segs=_CIRCLE_SIDES // 4)


def rectangle_arena(width_cm: float, height_cm: float) -> Polygon:
    """A rectangle about the origin."""
    if not (np.isfinite([width_cm, height_cm]).all() and min(width_cm, height_cm) > 0):
        raise RequestError(f"an arena's sides are above 0 cm, not {width_cm} and {height_cm}")
    return box(-width_cm / 2, -height_cm / 2, width_cm / 2, height_cm / 2)


def explore(
    geometry: Geometry,
    reachable: Polygon,
    *,
    lines: int,
    runs: int,
    rng: np.random.Generator,
    turning: Turning | float = Turning.LAMBERT,
    sensor: SensorModel | None = None,
    progress: Progress | None = None,
    threads: int | None = None,
) -> Simulation:
    """Simulate ``runs`` sessions of robots that each go on until ``lines`` lines have crossed the shape.

    Args:
        geometry: the shape where it lies in the arena, cm.
        reachable: convex polygon in which the robot's centre moves, cm (`disc_arena`, `rectangle_arena`).
        lines: crossing lines in each session.
        runs: sessions.
        rng: source of it all; the result does not depend on ``threads``.
        turning: the robot's policy, or m of an outgoing angle with density ∝ cos^m.
        sensor: its light sensor; a perfect one when not given. Lines on which it sees nothing do not count.
        progress: called with (sessions done, in all).
        threads: default: the cores.

    Raises:
        RequestError: a number below 1, a shape that reaches out of the arena or is never met, or an arena or exponent
            that does not serve.
    """
    for name, number in (("lines", lines), ("runs", runs)):
        if number < 1:
            raise RequestError(f"`{name}` must be at least 1, got {number}")
    start = perf_counter()
    sums = follow_sessions(
        geometry,
        reachable,
        np.array([lines]),
        runs,
        rng,
        turning=turning,
        sensor=sensor,
        progress=progress,
        threads=threads,
    )
    elapsed_s = perf_counter() - start
    k, l1, l3 = sums[:, 0].T
    return Simulation(lines, area_cm2(l1, l3), perimeter_cm(k, l1, l3), lines * runs / elapsed_s)


def follow_sessions(
    geometry: Geometry,
    reachable: Polygon,
    checkpoints: NDArray[np.int64],
    runs: int,
    rng: np.random.Generator,
    *,
    turning: Turning | float = Turning.LAMBERT,
    sensor: SensorModel | None = None,
    progress: Progress | None = None,
    threads: int | None = None,
) -> Floats:
    """Follow the weighted sums (runs, checkpoints, 3) of (k, 𝓛_1, 𝓛_3) after so many crossing lines each.

    ``checkpoints`` rise from 1 up. The other arguments, and what is raised, as for `explore`.
    """
    boundary = Boundary.of(geometry)
    if geometry.difference(reachable).area > _OUTSIDE * geometry.area:
        raise RequestError("the shape reaches out of what the robot can reach: move it, shrink it or cut it off there")

    def work(first: int, last: int, stream: np.random.Generator) -> Floats:
        return _sessions(boundary, reachable, checkpoints, last - first, stream, turning, sensor)

    size = max(1, _LINES_AT_ONCE // (4 * int(checkpoints[-1])))
    return np.concatenate(list(run_blocks(work, runs, size, rng, threads=threads, progress=progress)))


def _sessions(
    boundary: Boundary,
    reachable: Polygon,
    checkpoints: NDArray[np.int64],
    sessions: int,
    rng: np.random.Generator,
    turning: Turning | float,
    sensor: SensorModel | None,
) -> Floats:
    """Weighted sums (sessions, checkpoints, 3) of (k, 𝓛_1, 𝓛_3) over the first crossing lines of each.

    Sessions of one block are rolled side by side in stretches, each long enough for what most of them still need.
    Between two stretches a robot is put down anew on the edge, as one that has lost its way is.
    """
    lines, points = int(checkpoints[-1]), checkpoints.size
    sums = np.zeros((sessions * points, 3))
    met = np.zeros(sessions, dtype=np.int64)
    # Uniform lines meet the shape in this share; other laws differ, and then go round again.
    share = min(1.0, boundary.hull_perimeter_cm / reachable.length)
    rolled = 0
    while (left := lines - int(met.min())) > 0:
        if rolled > _MOST_RUNS * lines:
            raise RequestError("the sensor hardly ever sees this shape: take readings closer together")
        stretch = int(1.1 * left / share + 4 * np.sqrt(left / share)) + 16
        stretch = min(stretch, max(64, 8 * _LINES_AT_ONCE // sessions))
        rolls = _rolls(reachable, sessions, stretch, rng, turning)
        rolled += stretch
        theta, p = rolls.theta_rad.ravel(), rolls.p_cm.ravel()
        found = cross_lines(boundary, theta, p) if sensor is None else sensor.along(boundary, theta, p, rng)
        columns = np.stack([np.asarray(column, dtype=float).reshape(sessions, stretch) for column in found])
        crossed = columns[0] > 0
        number = met[:, None] + np.cumsum(crossed, axis=1)
        counted = crossed & (number <= lines)
        weights = _weights(rolls.length_cm, turning)[counted]
        # each crossing line belongs to the first checkpoint that it is not beyond
        stretch_of = np.nonzero(counted)[0] * points + np.searchsorted(checkpoints, number[counted])
        for column in range(3):
            sums[:, column] += np.bincount(stretch_of, columns[column][counted] * weights, sums.shape[0])
        met += counted.sum(axis=1)
    return np.cumsum(sums.reshape(sessions, points, 3), axis=1)


def _rolls(reachable: Polygon, robots: int, runs: int, rng: np.random.Generator, turning: Turning | float) -> Rolls:
    if turning == Turning.INTERIOR:
        return hit_and_run(reachable, robots, runs, rng)
    exponents = {Turning.LAMBERT: 1.0, Turning.UNIFORM: 0.0, Turning.UNIFORM_WEIGHTED: 0.0}
    exponent = exponents[turning] if isinstance(turning, Turning) else float(turning)
    return roll(reachable, robots, runs, rng, exponent=exponent)


def _weights(length_cm: Floats, turning: Turning | float) -> Floats:
    if turning == Turning.INTERIOR:
        return 1 / np.maximum(length_cm, _SHORTEST_CM)
    return length_cm if turning == Turning.UNIFORM_WEIGHTED else np.ones_like(length_cm)
