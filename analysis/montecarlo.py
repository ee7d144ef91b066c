"""Uniform isotropic random lines across a shape, a hundred million a second on two cores.

Lines are thrown at the shape's circumscribed circle (θ uniform in [0, π), p uniform across the circle: the measure
dG = dp dθ) and those that miss the shape are not counted, as the robot does not count them. At least 55 of 100 hit a
shape in one piece. Work is cut into blocks of lines that each own a random stream spawned from the caller's
generator (`analysis.blocks`), so that the result depends on the seed alone and not on the number of threads. Time
grows with the number of edges, and no crossing is dropped however many there are.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.blocks import Progress, run_blocks
from analysis.boundary import Boundary, Geometry
from analysis.invariants import sizes
from analysis.kernels import available_cores, ragged_invariants, ragged_moments
from analysis.lanes import LANES, seeded
from analysis.linekernels import cross_given, fill_crossings, fill_lines, sum_lines, work_for
from lab.base.errors import RequestError

__all__ = [
    "Bands",
    "Lines",
    "Simulation",
    "available_cores",
    "cross_lines",
    "running_bands",
    "simulate",
    "simulate_chords",
    "simulate_crossings",
    "simulate_lines",
]

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

BLOCK_LINES = 1 << 15
DEFAULT_QUANTILES = (0.025, 0.16, 0.5, 0.84, 0.975)


@dataclass(frozen=True, slots=True, eq=False)
class Lines:
    """Lines that crossed a shape, with all their crossings.

    Attributes:
        s_cm: (crossings,) positions along the lines, line after line, sorted within each.
        counts: (lines,) crossings of each line, even and ≥ 2.
    """

    s_cm: Floats
    counts: Ints

    @property
    def chords_cm(self) -> Floats:
        """Lengths of all chords, line after line."""
        return self.s_cm[1::2] - self.s_cm[::2]

    def invariants(self) -> tuple[Ints, Floats, Floats]:
        """Give (k, 𝓛_1 in cm, 𝓛_3 in cm³) of every line."""
        k = np.empty(self.counts.size, dtype=np.int64)
        l1_cm, l3_cm3 = np.empty(self.counts.size), np.empty(self.counts.size)
        ragged_invariants(self.s_cm, self.counts, k, l1_cm, l3_cm3)
        return k, l1_cm, l3_cm3

    def moments(self) -> Floats:
        """Give (k, 𝓛_1, 𝓛_3, 𝓛_4, 𝓛_5), in powers of cm, of every line: (lines, 5)."""
        found = np.empty((self.counts.size, 5))
        ragged_moments(self.s_cm, self.counts, found)
        return found


@dataclass(frozen=True, slots=True, eq=False)
class Simulation:
    """Independent simulated explorations of a shape.

    Attributes:
        lines: crossing lines in each run.
        area_cm2: (runs,) Eq. 1 for each run.
        perimeter_cm: (runs,).
        lines_per_second: crossing lines thrown per second, compilation not counted.
    """

    lines: int
    area_cm2: Floats
    perimeter_cm: Floats
    lines_per_second: float

    @property
    def covariance(self) -> Floats:
        """Covariance (2, 2) of (area_cm2, perimeter_cm) over the runs; NaN for a single run."""
        if self.area_cm2.size < 2:
            return np.full((2, 2), np.nan)
        return np.asarray(np.cov(self.area_cm2, self.perimeter_cm), dtype=float)


@dataclass(frozen=True, slots=True, eq=False)
class Bands:
    """How estimates spread as lines accumulate, over simulated runs.

    Attributes:
        n: (checkpoints,) numbers of crossing lines.
        quantile_levels: (q,).
        area_mean_cm2: (checkpoints,).
        area_std_cm2: (checkpoints,).
        area_quantiles_cm2: (q, checkpoints).
        perimeter_mean_cm: (checkpoints,).
        perimeter_std_cm: (checkpoints,).
        perimeter_quantiles_cm: (q, checkpoints).
        area_runs_cm2: (runs, checkpoints) every single run.
        perimeter_runs_cm: (runs, checkpoints).
    """

    n: Ints
    quantile_levels: Floats
    area_mean_cm2: Floats
    area_std_cm2: Floats
    area_quantiles_cm2: Floats
    perimeter_mean_cm: Floats
    perimeter_std_cm: Floats
    perimeter_quantiles_cm: Floats
    area_runs_cm2: Floats
    perimeter_runs_cm: Floats


def simulate(
    geometry: Geometry,
    *,
    lines: int,
    runs: int,
    rng: np.random.Generator,
    progress: Progress | None = None,
    threads: int | None = None,
) -> Simulation:
    """Simulate ``runs`` explorations of ``lines`` crossing lines each.

    ``progress`` is called in this thread with (lines done, lines in all). ``threads`` does not change the
    result.

    Raises:
        RequestError: ``lines`` or ``runs`` below 1.
        analysis.boundary.BoundaryError: the geometry is empty or invalid.
    """
    _at_least_one(lines=lines, runs=runs)
    boundary = Boundary.of(geometry)
    _sums(boundary, np.ones(1, dtype=np.int64), np.random.default_rng(0))  # compiles, or loads what was compiled
    start = perf_counter()
    sums = _segment_sums(boundary, np.full(runs, lines, dtype=np.int64), rng, progress, threads)
    elapsed_s = perf_counter() - start
    area, perimeter = sizes(sums / lines).T
    return Simulation(lines, area, perimeter, lines * runs / elapsed_s)


def simulate_lines(
    geometry: Geometry,
    lines: int,
    rng: np.random.Generator,
    *,
    progress: Progress | None = None,
    threads: int | None = None,
) -> tuple[Ints, Floats, Floats]:
    """Give (k, 𝓛_1 in cm, 𝓛_3 in cm³), each (lines,), of random crossing lines."""
    _at_least_one(lines=lines)
    boundary = Boundary.of(geometry)
    outline = boundary.outline
    k, l1_cm, l3_cm3 = np.empty(lines, dtype=np.int64), np.empty(lines), np.empty(lines)

    def work(first: int, last: int, stream: np.random.Generator) -> None:
        columns = k[first:last], l1_cm[first:last], l3_cm3[first:last]
        fill_lines(seeded(stream), boundary.radius_cm, outline, work_for(outline), columns)

    for _ in run_blocks(work, lines, BLOCK_LINES, rng, threads=threads, progress=progress):
        pass
    return k, l1_cm, l3_cm3


def simulate_crossings(
    geometry: Geometry,
    lines: int,
    rng: np.random.Generator,
    *,
    progress: Progress | None = None,
    threads: int | None = None,
) -> Lines:
    """Give random crossing lines with all their crossings."""
    _at_least_one(lines=lines)
    boundary = Boundary.of(geometry)

    def work(first: int, last: int, stream: np.random.Generator) -> list[Lines]:
        return _crossings(boundary, last - first, stream)

    blocks = run_blocks(work, lines, BLOCK_LINES, rng, threads=threads, progress=progress)
    parts = [part for block in blocks for part in block]
    return Lines(np.concatenate([part.s_cm for part in parts]), np.concatenate([part.counts for part in parts]))


def simulate_chords(geometry: Geometry, lines: int, rng: np.random.Generator, *, threads: int | None = None) -> Floats:
    """Give the lengths in cm of all chords of ``lines`` random crossing lines."""
    return simulate_crossings(geometry, lines, rng, threads=threads).chords_cm


def cross_lines(boundary: Boundary, theta_rad: ArrayLike, p_cm: ArrayLike) -> tuple[Ints, Floats, Floats]:
    """Give (k, 𝓛_1 in cm, 𝓛_3 in cm³), each (lines,), of given lines x cos θ + y sin θ = p; 0 for those that miss."""
    theta, p = (np.asarray(values, dtype=float).ravel() for values in (theta_rad, p_cm))
    if theta.size != p.size:
        raise RequestError("a line needs both an angle and a distance: theta_rad and p_cm differ in length")
    cos, sin = np.cos(theta), np.sin(theta)
    columns = np.empty(p.size, dtype=np.int64), np.empty(p.size), np.empty(p.size)
    x_cm, y_cm = boundary.centre_cm
    cross_given(cos, sin, p - x_cm * cos - y_cm * sin, boundary.outline, work_for(boundary.outline), columns)
    return columns


def running_bands(
    geometry: Geometry,
    checkpoints: ArrayLike,
    runs: int,
    rng: np.random.Generator,
    *,
    quantiles: ArrayLike = DEFAULT_QUANTILES,
    progress: Progress | None = None,
    threads: int | None = None,
) -> Bands:
    """Follow A(N) and P(N) over ``runs`` simulated explorations at the ``checkpoints`` N.

    ``checkpoints`` are distinct numbers of lines ≥ 1 in rising order.
    """
    n = np.asarray(checkpoints, dtype=np.int64).ravel()
    if n.size == 0 or n[0] < 1 or (np.diff(n) <= 0).any():
        raise RequestError("checkpoints are numbers of lines from 1 up, in rising order")
    _at_least_one(runs=runs)
    segments = np.tile(np.diff(n, prepend=0), runs)
    sums = _segment_sums(Boundary.of(geometry), segments, rng, progress, threads).reshape(runs, n.size, 3)
    area, perimeter = np.ascontiguousarray(np.moveaxis(sizes(np.cumsum(sums, axis=1) / n[:, None]), 2, 0))
    levels = np.asarray(quantiles, dtype=float).ravel()
    spread = 1 if runs > 1 else 0
    return Bands(
        n=n,
        quantile_levels=levels,
        area_mean_cm2=area.mean(axis=0),
        area_std_cm2=area.std(axis=0, ddof=spread),
        area_quantiles_cm2=np.asarray(np.quantile(area, levels, axis=0), dtype=float),
        perimeter_mean_cm=perimeter.mean(axis=0),
        perimeter_std_cm=perimeter.std(axis=0, ddof=spread),
        perimeter_quantiles_cm=np.asarray(np.quantile(perimeter, levels, axis=0), dtype=float),
        area_runs_cm2=area,
        perimeter_runs_cm=perimeter,
    )


def _segment_sums(
    boundary: Boundary, segments: Ints, rng: np.random.Generator, progress: Progress | None, threads: int | None
) -> Floats:
    """Sum (k, 𝓛_1, 𝓛_3) over consecutive stretches of ``segments[i]`` lines: (segments, 3)."""
    ends = np.cumsum(segments)
    sums = np.zeros((segments.size, 3))

    def work(first: int, last: int, stream: np.random.Generator) -> tuple[slice, Floats]:
        # The stretches that this block touches; the outer two may reach beyond it.
        low, high = np.searchsorted(ends, first, side="right"), np.searchsorted(ends, last, side="left") + 1
        return slice(low, high), _sums(boundary, np.minimum(ends[low:high], last) - first, stream)

    for touched, found in run_blocks(work, int(ends[-1]), BLOCK_LINES, rng, threads=threads, progress=progress):
        sums[touched] += found
    return sums


def _sums(boundary: Boundary, ends: Ints, stream: np.random.Generator) -> Floats:
    """Sum (k, 𝓛_1, 𝓛_3) over stretches of lines that end at numbers ``ends``: (stretches, 3)."""
    found = np.zeros((ends.size, 3))
    sum_lines(seeded(stream), ends, boundary.radius_cm, boundary.outline, work_for(boundary.outline), found)
    return found


def _crossings(boundary: Boundary, lines: int, stream: np.random.Generator) -> list[Lines]:
    """Throw lines until so many have crossed the shape; in pieces that each fill the room set aside."""
    state, work = seeded(stream), work_for(boundary.outline)
    parts: list[Lines] = []
    left = lines
    while left:
        # Room for 64 lines that cross everything always, for the typical block at once.
        s_cm = np.empty(LANES * boundary.outline.x_cm.size + 3 * left)
        counts = np.empty(left, dtype=np.int64)
        hits, filled = fill_crossings(state, boundary.radius_cm, boundary.outline, work, (s_cm, counts))
        parts.append(Lines(s_cm[:filled].copy(), counts[:hits].copy()))
        left -= hits
    return parts


def _at_least_one(**numbers: int) -> None:
    for name, number in numbers.items():
        if number < 1:
            raise RequestError(f"`{name}` must be at least 1, got {number}")
