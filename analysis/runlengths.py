"""Does the robot turn as it should? Told from its own run lengths and crossings, without a camera.

Three questions of a session's edge-to-edge runs:

- `examine_runs`: are their lengths those of uniform isotropic lines, whose mean is Cauchy's πA/P of the arena? And
  if the outgoing angle had a density ∝ cos^m φ, which m fits (1 is Lambert's law, 0 the uniform angle)?
- `expected_bias`: how far off do area and perimeter of a given shape come out under such a law?
- `arena_consistency`: does the known arena give the same area and perimeter as Eq. 1?

Successive runs share an end and are dependent, so no p-value here takes them for independent.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import t as student
from shapely.geometry import Polygon

from analysis.billiard import check_exponent, hit_and_run, roll
from analysis.boundary import Boundary, Geometry
from analysis.invariants import sizes
from analysis.montecarlo import cross_lines
from analysis.turninglaw import Exponent, LawTable, as_measured, tabulate_law
from lab.base.errors import RequestError
from lab.base.jackknife import jackknife_sigma

Floats = NDArray[np.float64]

FEWEST_RUNS = 10
_LEVEL = 0.05
_MOST_ROLLED = 20_000_000  # runs simulated for one table
_ROLLED_AT_ONCE = 1_000_000  # bounds the memory
_BLOCKS = 25  # of the jackknife
_COVERED = 1e-9


@dataclass(frozen=True, slots=True)
class RunLengths:
    """What the run lengths say.

    Attributes:
        runs: how many.
        mean_cm: their mean.
        expected_cm: mean of uniform isotropic lines, πA/P (if length-weighted, that of lines drawn ∝ length).
        mean_p: p-value of the mean.
        distribution_p: p-value of the distribution (Cramér–von Mises).
        law_p: p-value of the fitted exponent, the keenest on wrong turns; NaN if length-weighted.
        p_value: of all together: a right session falls below 0.05 once in twenty.
        exponent: m of the fitted density ∝ cos^m φ of the outgoing angle; NaN if length-weighted.
        exponent_low, exponent_high: its 95 % interval.
        passed: no fault found at 5 %.
        verdict: in words.
    """

    runs: int
    mean_cm: float
    expected_cm: float
    mean_p: float
    distribution_p: float
    law_p: float
    p_value: float
    exponent: float
    exponent_low: float
    exponent_high: float
    passed: bool
    verdict: str


@dataclass(frozen=True, slots=True, eq=False)
class RunTable:
    """What sessions of ``runs`` runs look like in one arena.

    Attributes:
        reachable: the polygon, cm.
        runs: runs in each session.
        length_weighted: the lines are drawn with a density ∝ their length.
        expected_cm: mean length.
        lengths_cm: sorted lengths of right runs: their distribution.
        null: (tests, sessions) statistics of right sessions, each test's sorted: deviation of the mean in cm,
            Cramér–von Mises distance, deviation of log(1 + m); large speaks against them.
        least_p: (sessions,) sorted, the smallest of each right session's p-values.
        law: for the fit of the exponent; None if length-weighted.
    """

    reachable: Polygon
    runs: int
    length_weighted: bool
    expected_cm: float
    lengths_cm: Floats
    null: Floats
    least_p: Floats
    law: LawTable | None


@dataclass(frozen=True, slots=True)
class ExpectedBias:
    """Bias of area and perimeter under a turning law, relative to the truth, with its standard errors.

    ``exponent`` is m of the law's density ∝ cos^m φ; ``verdict`` says it in words.
    """

    exponent: float
    area_rel: float
    perimeter_rel: float
    sigma_area_rel: float
    sigma_perimeter_rel: float
    verdict: str


@dataclass(frozen=True, slots=True)
class ArenaConsistency:
    """The size by the known arena over the size by Eq. 1, with standard errors and p-values of their being 1.

    ``area_cm2`` and ``perimeter_cm`` are those by the arena, A_arena ΣT_lit/ΣT and P_arena chords/runs.
    ``passed``: neither deviates at 5 %, after Holm's correction; ``verdict`` says it in words.
    """

    runs: int
    area_cm2: float
    perimeter_cm: float
    area_ratio: float
    sigma_area_ratio: float
    area_p: float
    perimeter_ratio: float
    sigma_perimeter_ratio: float
    perimeter_p: float
    passed: bool
    verdict: str


def tabulate_runs(
    reachable: Polygon,
    runs: int,
    rng: np.random.Generator,
    *,
    length_weighted: bool = False,
    sessions: int = 1999,
) -> RunTable:
    """Simulate sessions of ``runs`` runs by Lambert's law in the arena, and by the laws around it for the fit.

    Their lengths are those of robots whose scale is known to 1 % (`analysis.turninglaw.as_measured`).

    Args:
        reachable: convex polygon in which the robot's centre moves, cm.
        runs: edge-to-edge runs in each session.
        rng: source of the simulated sessions.
        length_weighted: the robot makes random interior stops instead (`analysis.billiard.hit_and_run`).
        sessions: how many (fewer when they are very long); p-values come in steps of 1/(sessions + 1).

    Raises:
        RequestError: fewer than 10 runs, or the polygon is not convex.
    """
    if runs < FEWEST_RUNS:
        raise RequestError(f"{runs} edge-to-edge runs are too few to examine; roll at least {FEWEST_RUNS}")
    sessions = int(np.clip(_MOST_ROLLED // runs, 199, sessions))
    at_once = max(1, _ROLLED_AT_ONCE // runs)
    throw = hit_and_run if length_weighted else roll
    parts = [
        as_measured(throw(reachable, min(at_once, sessions - begun), runs, rng).length_cm, rng)
        for begun in range(0, sessions, at_once)
    ]
    pool = np.sort(np.concatenate([part.ravel() for part in parts]))
    expected_cm = float(pool.mean()) if length_weighted else np.pi * reachable.area / reachable.length
    law = None if length_weighted else tabulate_law(reachable, runs, pool, rng)
    statistics = np.concatenate([_statistics(part, expected_cm, pool, law) for part in parts], axis=1)
    null: Floats = np.sort(statistics, axis=1)
    # Among themselves: each session's p-value is the share of all, itself included, that are as extreme.
    least = np.min([_shares_beyond(row, seen) for row, seen in zip(null, statistics, strict=True)], axis=0)
    return RunTable(reachable, runs, length_weighted, expected_cm, pool, null, np.sort(least), law)


def examine_runs(
    lengths_cm: ArrayLike,
    reachable: Polygon,
    rng: np.random.Generator,
    *,
    length_weighted: bool = False,
    table: RunTable | None = None,
) -> RunLengths:
    """Compare the lengths of edge-to-edge runs with those of uniform isotropic lines in the same arena.

    Args:
        lengths_cm: (n,) of the runs that measure, in the order rolled; NaNs are left out.
        reachable: convex polygon in which the robot's centre moves, cm.
        rng: source of the simulated sessions.
        length_weighted: the robot made random interior stops, whose lines come ∝ their length.
        table: from `tabulate_runs`, to be shared between sessions of equal length.

    Raises:
        RequestError: fewer than 10 runs, a polygon that is not convex, or a table for something else.
    """
    lengths = np.asarray(lengths_cm, dtype=float).ravel()
    lengths = lengths[np.isfinite(lengths)]
    if table is None:
        table = tabulate_runs(reachable, len(lengths), rng, length_weighted=length_weighted)
    if table.runs != len(lengths) or table.length_weighted != length_weighted or not table.reachable.equals(reachable):
        raise RequestError(
            f"the table is for {table.runs} runs and the session has {len(lengths)}, or it is for another arena or "
            "policy; tabulate again"
        )
    mean_cm = float(lengths.mean())
    seen = _statistics(lengths[None, :], table.expected_cm, table.lengths_cm, table.law)[:, 0]
    sessions = len(table.least_p)
    # (1 + #)/(1 + sessions), # the right sessions at least as extreme.
    p_values = [
        (1 + sessions * float(_shares_beyond(row, value))) / (1 + sessions)
        for row, value in zip(table.null, seen, strict=True)
    ]
    p_value = float((1 + np.searchsorted(table.least_p, min(p_values), side="right")) / (1 + sessions))
    mean_p, distribution_p, law_p = p_values if table.law is not None else (*p_values, np.nan)
    exponent = Exponent(np.nan, np.nan, np.nan) if table.law is None else table.law.fit(lengths)
    passed = p_value >= _LEVEL
    verdict = (
        f"{'No fault found' if passed else 'These are not the runs of uniform isotropic lines'} (p = {p_value:.2g}): "
        f"{len(lengths)} runs are {mean_cm:.1f} cm long on average, {table.expected_cm:.1f} cm are expected."
    )
    if not length_weighted:
        verdict += (
            f" Their lengths fit outgoing angles of density ∝ cosᵐ φ with m = {exponent.value:.2f} "
            f"({exponent.low:.2f} to {exponent.high:.2f} at 95 %), where 1 is Lambert's law and 0 a uniform angle."
        )
    if not passed:
        turns = law_p < _LEVEL and not exponent.low <= 1 <= exponent.high
        verdict += (
            " It seems not to turn by Lambert's law: area and perimeter will be biased."
            if turns
            else " Are runs cut short, is the path's scale off, or is the arena not the one that was rolled in?"
        )
    return RunLengths(
        runs=len(lengths),
        mean_cm=mean_cm,
        expected_cm=table.expected_cm,
        mean_p=mean_p,
        distribution_p=distribution_p,
        law_p=law_p,
        p_value=p_value,
        exponent=exponent.value,
        exponent_low=exponent.low,
        exponent_high=exponent.high,
        passed=passed,
        verdict=verdict,
    )


def expected_bias(
    geometry: Geometry, reachable: Polygon, exponent: float, rng: np.random.Generator, *, runs: int = 400_000
) -> ExpectedBias:
    """Simulate the law ∝ cos^m φ in this arena over this shape: the bias of Eq. 1's area and perimeter.

    Args:
        geometry: the shape where it lies in the arena, cm.
        reachable: convex polygon in which the robot's centre moves, cm.
        exponent: m.
        rng: source of the runs.
        runs: how many; the errors fall as 1/√runs.

    Raises:
        RequestError: the shape reaches out of the arena, or the polygon or the exponent does not serve.
    """
    check_exponent(exponent)
    boundary = Boundary.of(geometry)
    if geometry.difference(reachable).area > _COVERED * geometry.area:
        raise RequestError("the shape reaches out of what the robot can reach: move it, shrink it or cut it off there")
    sums = np.empty((2 * _BLOCKS, 3))
    for row in range(len(sums)):
        rolls = roll(reachable, 16, max(1, runs // (16 * len(sums))), rng, exponent=exponent)
        sums[row] = _shape_sums(boundary, rolls.theta_rad.ravel(), rolls.p_cm.ravel())
    if not sums[:, 0].all():
        raise RequestError(f"{runs} runs meet this shape too seldom: ask for more, or for a larger shape")
    size, sigma = _jackknifed(sums, sizes)
    truth = np.array([geometry.area, geometry.length])
    bias, error = (size / truth - 1).tolist(), (sigma / truth).tolist()
    verdict = (
        f"Outgoing angles of density ∝ cosᵐ φ, m = {exponent:.2f}, in this arena bias this shape's area by "
        f"{100 * bias[0]:+.1f} ± {100 * error[0]:.1f} % and its perimeter by "
        f"{100 * bias[1]:+.1f} ± {100 * error[1]:.1f} %."
    )
    return ExpectedBias(exponent, bias[0], bias[1], error[0], error[1], verdict)


def arena_consistency(
    k: ArrayLike,
    l1_cm: ArrayLike,
    l3_cm3: ArrayLike,
    length_cm: ArrayLike,
    reachable: Polygon,
    *,
    weights: ArrayLike | None = None,
) -> ArenaConsistency:
    """Compare the size by the known arena with that by Eq. 1: A_arena ΣT_lit/ΣT and P_arena chords/runs.

    Both hold for uniform isotropic lines; a robot that turns otherwise, or an arena that is not the one given,
    moves them apart. Errors are those of a block jackknife.

    Args:
        k: (n,) chords of the edge-to-edge runs in the order rolled; 0 for those that missed the shape.
        l1_cm: (n,) their lit lengths 𝓛_1.
        l3_cm3: (n,) their 𝓛_3.
        length_cm: (n,) their lengths.
        reachable: convex polygon in which the robot's centre moves, cm.
        weights: (n,) of the lines; alike when not given.

    Raises:
        RequestError: fewer than 50 runs, arrays of different length or not finite, or too few crossings.
    """
    weight = np.ones(np.size(k)) if weights is None else np.asarray(weights, dtype=float).ravel()
    columns = [np.asarray(column, dtype=float).ravel() for column in (k, l1_cm, l3_cm3, length_cm)]
    if len({weight.size, *(column.size for column in columns)}) != 1:
        raise RequestError("k, l1_cm, l3_cm3, length_cm and weights must have one value for each run")
    n = weight.size
    if n < 2 * _BLOCKS:
        raise RequestError(f"{n} runs are too few to compare with the arena; roll at least {2 * _BLOCKS}")
    rows = weight[:, None] * np.column_stack([*columns, np.ones(n)])
    if not np.isfinite(rows).all():
        raise RequestError("k, l1_cm, l3_cm3, length_cm and weights must be finite; drop runs with missing values")
    sums = np.add.reduceat(rows, np.arange(_BLOCKS) * n // _BLOCKS, axis=0)
    if (sums[:, 0] > 0).sum() < 2:
        raise RequestError("hardly a run crossed the shape: roll more, or check that the shape lies in the arena")

    def by_arena(total: Floats) -> Floats:
        area = reachable.area * total[..., 1] / total[..., 3]
        return np.stack([area, reachable.length * total[..., 0] / total[..., 4]], axis=-1)

    def log_ratio(total: Floats) -> Floats:
        return np.log(by_arena(total) / sizes(total[..., :3]))

    logs, sigma = _jackknifed(sums, log_ratio)
    p_values = np.asarray(2 * student.sf(np.abs(logs) / sigma, _BLOCKS - 1), dtype=float)
    area, perimeter = by_arena(sums.sum(axis=0)).tolist()
    ratio, spread, p = np.exp(logs).tolist(), (np.exp(logs) * sigma).tolist(), p_values.tolist()
    passed = 2 * min(p) >= _LEVEL  # the smaller of two after Holm
    verdict = (
        f"{'The arena and Eq. 1 agree' if passed else 'The arena and Eq. 1 disagree'}: by the arena the area is "
        f"{100 * (ratio[0] - 1):+.1f} ± {100 * spread[0]:.1f} % (p = {p[0]:.2g}) and the perimeter "
        f"{100 * (ratio[1] - 1):+.1f} ± {100 * spread[1]:.1f} % (p = {p[1]:.2g}) off Eq. 1's."
    )
    if not passed:
        verdict += " The lines are not uniform and isotropic, or the arena's size is not the one given."
    return ArenaConsistency(n, area, perimeter, ratio[0], spread[0], p[0], ratio[1], spread[1], p[1], passed, verdict)


def _statistics(lengths_cm: Floats, expected_cm: float, pool_cm: Floats, law: LawTable | None) -> Floats:
    """(tests, sessions) of the rows (sessions, n); large speaks against them."""
    n = lengths_cm.shape[1]
    shares = (np.searchsorted(pool_cm, np.sort(lengths_cm, axis=1)) + 0.5) / len(pool_cm)
    even = np.asarray(np.arange(n) + 0.5, dtype=float) / n
    distance = np.sum((shares - even) ** 2, axis=1) + 1 / (12 * n)
    rows = [np.abs(np.mean(lengths_cm, axis=1) - expected_cm), distance]
    if law is not None:
        rows.append(np.abs(law.likeliest(lengths_cm) - np.log(2.0)))
    return np.asarray(rows, dtype=float)


def _shares_beyond(null: Floats, statistic: ArrayLike) -> Floats:
    """The share of the sorted statistics that are at least as large, for each one given."""
    return np.asarray(1 - np.searchsorted(null, statistic, side="left") / len(null), dtype=float)


def _shape_sums(boundary: Boundary, theta_rad: Floats, p_cm: Floats) -> Floats:
    """Sums of (k, 𝓛_1, 𝓛_3) over those of the lines that cross the shape."""
    return np.array([column.sum() for column in cross_lines(boundary, theta_rad, p_cm)], dtype=float)


def _jackknifed(sums: Floats, of: Callable[[Floats], Floats]) -> tuple[Floats, Floats]:
    """``of`` the total of the blocks' sums (blocks, c), freed of its bias to first order, and its standard error."""
    blocks = len(sums)
    total = sums.sum(axis=0)
    without = of(total - sums)
    return blocks * of(total) - (blocks - 1) * without.mean(axis=0), jackknife_sigma(without)
