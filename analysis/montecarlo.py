"""Uniform isotropic random lines across a shape, many millions a second.

Lines are thrown at the shape's circumscribed circle (θ uniform in [0, π), p uniform across the circle: the measure
dG = dp dθ) and those that miss the shape are not counted, as the robot does not count them. Work is cut into blocks
of lines that each own a random stream spawned from the caller's generator, so that the result depends on the seed
alone and not on the number of threads.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from time import perf_counter
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.boundary import Boundary, Geometry
from analysis.invariants import area_cm2, perimeter_cm
from analysis.kernels import available_cores, ragged_invariants, trace_lines
from lab.base.errors import RequestError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Progress = Callable[[int, int], None]
_Reduced = TypeVar("_Reduced")

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
    _trace(boundary, 1, np.random.default_rng(0))  # compiles, or loads what was compiled
    start = perf_counter()
    sums = _segment_sums(boundary, np.full(runs, lines, dtype=np.int64), rng, progress, threads)
    elapsed_s = perf_counter() - start
    k, l1, l3 = (sums / lines).T
    return Simulation(lines, area_cm2(l1, l3), perimeter_cm(k, l1, l3), lines * runs / elapsed_s)


def simulate_lines(
    geometry: Geometry, lines: int, rng: np.random.Generator, *, threads: int | None = None
) -> tuple[Ints, Floats, Floats]:
    """Give (k, 𝓛_1 in cm, 𝓛_3 in cm³), each (lines,), of random crossing lines."""
    _at_least_one(lines=lines)
    parts = list(_blocks(Boundary.of(geometry), lines, rng, Lines.invariants, threads=threads))
    return (
        np.concatenate([k for k, _, _ in parts]),
        np.concatenate([l1_cm for _, l1_cm, _ in parts]),
        np.concatenate([l3_cm3 for _, _, l3_cm3 in parts]),
    )


def simulate_crossings(
    geometry: Geometry, lines: int, rng: np.random.Generator, *, threads: int | None = None
) -> Lines:
    """Give random crossing lines with all their crossings."""
    _at_least_one(lines=lines)
    parts = list(_blocks(Boundary.of(geometry), lines, rng, lambda block: block, threads=threads))
    return Lines(np.concatenate([part.s_cm for part in parts]), np.concatenate([part.counts for part in parts]))


def simulate_chords(geometry: Geometry, lines: int, rng: np.random.Generator, *, threads: int | None = None) -> Floats:
    """Give the lengths in cm of all chords of ``lines`` random crossing lines."""
    return simulate_crossings(geometry, lines, rng, threads=threads).chords_cm


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
    k, l1, l3 = np.moveaxis(np.cumsum(sums, axis=1) / n[:, None], 2, 0)
    area, perimeter = area_cm2(l1, l3), perimeter_cm(k, l1, l3)
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
    first = 0

    def invariants(block: Lines) -> Floats:
        return np.column_stack([np.asarray(column, dtype=float) for column in block.invariants()])

    for values in _blocks(boundary, int(ends[-1]), rng, invariants, threads=threads, progress=progress):
        last = first + len(values)
        # Segments that this block touches, and where each begins inside the block.
        low, high = np.searchsorted(ends, first, side="right"), np.searchsorted(ends, last, side="left")
        begins = np.concatenate([[0], ends[low:high] - first])
        sums[low : high + 1] += np.add.reduceat(values, begins, axis=0)
        first = last
    return sums


def _blocks(
    boundary: Boundary,
    lines: int,
    rng: np.random.Generator,
    reduce: Callable[[Lines], _Reduced],
    *,
    threads: int | None,
    progress: Progress | None = None,
) -> Iterator[_Reduced]:
    """Yield ``reduce(block)`` for consecutive blocks, in order, with a bounded number in flight."""
    workers = threads or available_cores()
    sizes = [BLOCK_LINES] * (lines // BLOCK_LINES) + ([lines % BLOCK_LINES] if lines % BLOCK_LINES else [])
    done = 0

    def work(size: int, stream: np.random.Generator) -> _Reduced:
        return reduce(_trace(boundary, size, stream))

    if len(sizes) == 1:  # a thread pool costs more than a small block
        yield work(sizes[0], rng.spawn(1)[0])
        if progress is not None:
            progress(lines, lines)
        return
    waiting: deque[tuple[int, Future[_Reduced]]] = deque()
    with ThreadPoolExecutor(workers, thread_name_prefix="montecarlo") as pool:
        for size in [*sizes, *[0] * (2 * workers)]:
            if size:
                waiting.append((size, pool.submit(work, size, rng.spawn(1)[0])))
            if waiting and (len(waiting) >= 2 * workers or not size):
                finished, future = waiting.popleft()
                yield future.result()
                done += finished
                if progress is not None:
                    progress(done, lines)


def _trace(boundary: Boundary, quota: int, rng: np.random.Generator) -> Lines:
    """Throw lines until ``quota`` of them have crossed the shape."""
    likely_hit = boundary.hull_perimeter_cm / (2 * np.pi * boundary.radius_cm)
    positions: list[Floats] = []
    counts: list[Ints] = []
    uniforms = np.empty((0, 2))
    left = quota
    while left:
        if not len(uniforms):
            uniforms = rng.random((int(1.05 * left / likely_hit) + 32, 2))
        # Room for the longest single line always, for the typical block at once.
        s_cm = np.empty(boundary.x_cm.size + 3 * left)
        count = np.empty(left, dtype=np.int64)
        hits, used, filled = trace_lines(
            uniforms,
            left,
            boundary.radius_cm,
            (boundary.x_cm, boundary.y_cm, boundary.chunks, boundary.discs),
            (s_cm, count),
        )
        positions.append(s_cm[:filled])
        counts.append(count[:hits])
        uniforms = uniforms[used:]
        left -= hits
    return Lines(np.concatenate(positions), np.concatenate(counts))


def _at_least_one(**numbers: int) -> None:
    for name, number in numbers.items():
        if number < 1:
            raise RequestError(f"`{name}` must be at least 1, got {number}")
