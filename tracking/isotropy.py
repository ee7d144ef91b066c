"""Are the robot's lines isotropic and homogeneous? Tests of true lines, with effect sizes.

Only then do the means over its lines stand for the integrals over all lines, and so for area and
perimeter. Lines are mapped to (U, V), uniform on the unit square if they are right (`tracking.linespace`).

Successive runs share an end point on the wall, so they are dependent even when each is perfect: tests for
independent lines at 5 % condemn 7 to 34 % of perfect sessions. Every p-value therefore comes from a table of
whole sessions simulated with perfect turns in the same region, with as many runs as were seen; nothing
is thinned away.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from shapely import Polygon

from lab.base.errors import RequestError
from tracking.linespace import LineSpace, roll
from tracking.uniformity import cramer_von_mises, hermans_rasson, holm, neyman, rayleigh, smooth_means

Floats = NDArray[np.float64]

_FEWEST_LINES = 10
_LEVEL = 0.05
_BOOTSTRAPS = 999
# noncentrality at which chi-square with two degrees exceeds its 95 % point with probability 0.8
_SEEN_AT = 9.635
# runs simulated at once: bounds the memory of a table for long sessions
_RUNS_AT_ONCE = 500_000


class TooFewLinesError(RequestError):
    """Too few usable lines to test; carries ``lines`` and ``needed``."""

    def __init__(self, lines: int, needed: int) -> None:
        super().__init__(f"{lines} usable lines are too few to test isotropy; roll at least {needed}")
        self.lines = lines
        self.needed = needed


@dataclass(frozen=True, slots=True)
class LineTest:
    """One test: its statistic, raw p-value, and p-value after Holm's correction over the four."""

    name: str
    looks_for: str
    statistic: float
    p_value: float
    holm_p_value: float


@dataclass(frozen=True, slots=True)
class IsotropyReport:
    """What the lines' statistics say.

    ``isotropy_p`` is Holm's over Rayleigh and Hermans-Rasson (directions), ``homogeneity_p`` Holm's over
    Cramer-von Mises (places) and Neyman (joint), ``joint_p`` Neyman's own. ``passed`` is: no test of the four
    rejects at 5 % after Holm's correction over all four. ``bias`` = 2R is the amplitude of the excess along one
    axis (density 1 + bias cos), with a 95 % interval from a moving-block bootstrap; ``favoured_rad`` the
    direction of travel, in [0, pi), of that excess; ``smallest_bias`` the bias that this many lines show
    in 8 sessions of 10. Mean run lengths in cm: predicted is pi A/P of the region (Cauchy), for runs of
    at least ``shortest_cm`` their simulated mean.
    """

    lines: int
    skipped: int
    outside: int
    tests: tuple[LineTest, ...]
    isotropy_p: float
    homogeneity_p: float
    joint_p: float
    bias: float
    bias_low: float
    bias_high: float
    smallest_bias: float
    favoured_rad: float
    mean_run_cm: float
    predicted_run_cm: float
    run_length_p: float
    passed: bool
    verdict: str

    def to_dict(self) -> dict[str, Any]:
        """The JSON form: numbers, and one dict a test."""
        fields: dict[str, Any] = {name: getattr(self, name) for name in self.__slots__ if name != "tests"}
        fields["tests"] = [{name: getattr(test, name) for name in test.__slots__} for test in self.tests]
        return fields


@dataclass(frozen=True, slots=True, eq=False)
class NullTable:
    """What perfect sessions of ``lines`` runs in one region give: sorted statistics, one (sessions,) array each."""

    reachable: Polygon
    lines: int
    shortest_cm: float
    statistics: dict[str, Floats]
    precision: Floats
    mean_run_cm: float

    def p_value(self, name: str, statistic: float) -> float:
        """The share of perfect sessions at least as extreme, (1 + #)/(1 + sessions)."""
        null = self.statistics[name]
        beyond = len(null) - int(np.searchsorted(null, statistic, side="left"))
        return (1 + beyond) / (1 + len(null))


def _statistics(u: Floats, v: Floats, length_cm: Floats, precision: Floats, run_cm: float) -> dict[str, Floats]:
    """Every statistic of the rows (..., n); large speaks against the lines."""
    return {
        "rayleigh": rayleigh(u),
        "hermans_rasson": hermans_rasson(u),
        "cramer_von_mises": cramer_von_mises(v),
        "neyman": neyman(smooth_means(u, v), precision),
        "run_length": np.abs(length_cm.mean(axis=-1) - run_cm),
    }


_LOOKS_FOR = {
    "rayleigh": "one favoured direction",
    "hermans_rasson": "several favoured directions",
    "cramer_von_mises": "favoured places across the arena",
    "neyman": "directions and places that go together",
}


def _sessions(
    region: Polygon, lines: int, sessions: int, rng: np.random.Generator, *, shortest_cm: float, successive: bool
) -> tuple[Floats, Floats, Floats]:
    """(U, V, length) of perfect sessions, each (sessions, lines), without the runs below ``shortest_cm``."""
    spare = 1.0
    while True:
        runs = int(lines * spare) + (10 if shortest_cm > 0 else 0)
        rolls = roll(region, sessions, runs, rng, successive=successive)
        kept = rolls.length_cm >= shortest_cm
        if int(kept.sum(axis=1).min()) >= lines:
            break
        spare *= 1.3
        if spare > 50:
            raise RequestError(
                f"runs of at least {shortest_cm:g} cm hardly occur in this region; lower shortest_cm below its diameter"
            )
    first = np.argsort(~kept, axis=1, kind="stable")[:, :lines]
    theta, p, length = (np.take_along_axis(a, first, axis=1) for a in (rolls.theta_rad, rolls.p_cm, rolls.length_cm))
    u, v = LineSpace.of(region).uniforms(theta, p)
    return u, v, length


def tabulate(
    reachable: Polygon,
    lines: int,
    rng: np.random.Generator,
    *,
    sessions: int = 1999,
    shortest_cm: float = 0.0,
    successive: bool = True,
) -> NullTable:
    """Tabulate the statistics of perfect sessions: Lambert's turn at every wall of the region.

    Args:
        reachable: convex polygon in which the ball's centre moves, cm.
        lines: runs in each session.
        rng: source of the simulated sessions.
        sessions: how many; p-values come in steps of 1/(sessions + 1).
        shortest_cm: runs shorter than this are left out, as the camera leaves them out.
        successive: the runs follow each other; False for lines drawn afresh each.

    Raises:
        RegionError: the region is not convex.
    """
    at_once = max(1, _RUNS_AT_ONCE // lines)
    parts = [
        _sessions(reachable, lines, min(at_once, sessions - begun), rng, shortest_cm=shortest_cm, successive=successive)
        for begun in range(0, sessions, at_once)
    ]
    means = np.concatenate([smooth_means(u, v) for u, v, _ in parts])
    # about 0, not about the table's own mean: without a cut on length the functions' means are 0 exactly
    precision = np.asarray(np.linalg.inv(means.T @ means / len(means)), dtype=float)
    run_cm = np.pi * reachable.area / reachable.length
    if shortest_cm > 0:
        run_cm = float(np.concatenate([length.ravel() for _, _, length in parts]).mean())
    rows = [_statistics(u, v, length, precision, run_cm) for u, v, length in parts]
    statistics = {name: np.sort(np.concatenate([row[name] for row in rows])) for name in rows[0]}
    return NullTable(reachable, lines, shortest_cm, statistics, precision, run_cm)


def _bias(u: Floats, rng: np.random.Generator) -> tuple[float, float, float, float]:
    """(2R, low, high, mean angle) of the angles 2 pi U.

    R is never below its noise, so percentiles of bootstrapped R would exclude 0 for perfect lines. Instead
    the 95 % radius of the bootstrapped mean vectors about their own mean is laid around R.
    """
    vectors = np.exp(2j * np.pi * u)
    n = len(vectors)
    block = int(np.ceil(n ** (1 / 3)))
    starts = rng.integers(0, n, size=(_BOOTSTRAPS, -(-n // block)))
    picks = ((starts[:, :, None] + np.arange(block)) % n).reshape(_BOOTSTRAPS, -1)[:, :n]
    mean = complex(vectors.mean())
    radius = float(np.quantile(np.abs(vectors[picks].mean(axis=1) - mean), 0.95))
    resultant = abs(mean)
    low, high = max(0.0, resultant - radius), min(1.0, resultant + radius)
    return 2 * resultant, 2 * low, 2 * high, float(np.angle(mean))


def examine_lines(
    theta_rad: ArrayLike,
    p_cm: ArrayLike,
    run_length_cm: ArrayLike,
    reachable: Polygon,
    rng: np.random.Generator,
    *,
    shortest_cm: float = 0.0,
    successive: bool = True,
    null: NullTable | None = None,
) -> IsotropyReport:
    """Test whether lines are isotropic and homogeneous in the region that the ball's centre can reach.

    Args:
        theta_rad: direction of each line's normal, (n,), in the order rolled; lines with NaN are skipped.
        p_cm: signed distance of each line, (n,).
        run_length_cm: length of each run, (n,).
        reachable: convex polygon in which the ball's centre moves.
        rng: source of the simulated sessions and of the bootstrap.
        shortest_cm: runs shorter than this are left out, here and in the simulated sessions; set it where
            the camera cannot see short runs, for else their absence counts as a fault.
        successive: the runs follow each other, each from where the last one ended.
        null: a table from `tabulate`, to be shared between sessions of equal length.

    Raises:
        TooFewLinesError: fewer than 10 lines are left.
        RegionError: the region is not convex.
        RequestError: the arrays differ in length, or the table is for another number of lines.
    """
    theta, p, length = (np.asarray(a, dtype=float).ravel() for a in (theta_rad, p_cm, run_length_cm))
    if not len(theta) == len(p) == len(length):
        raise RequestError("theta, p and run length must be one number each a line; they differ in length")
    usable = np.isfinite(theta) & np.isfinite(p) & np.isfinite(length)
    skipped = int(len(theta) - usable.sum())
    usable &= ~(length < shortest_cm)
    theta, p, length = theta[usable], p[usable], length[usable]
    if len(theta) < _FEWEST_LINES:
        raise TooFewLinesError(len(theta), _FEWEST_LINES)
    if null is None:
        null = tabulate(reachable, len(theta), rng, shortest_cm=shortest_cm, successive=successive)
    if null.lines != len(theta) or null.shortest_cm != shortest_cm or not null.reachable.equals(reachable):
        raise RequestError(
            f"the table is for {null.lines} runs of at least {null.shortest_cm:g} cm, the session has {len(theta)} "
            f"of at least {shortest_cm:g} cm, or it is for another region; tabulate again"
        )
    space = LineSpace.of(reachable)
    u, v_raw = space.uniforms(theta, p)
    v = np.clip(v_raw, 0.0, 1.0)
    seen = {name: float(s) for name, s in _statistics(u, v, length, null.precision, null.mean_run_cm).items()}
    raw = {name: null.p_value(name, statistic) for name, statistic in seen.items()}
    corrected = holm([raw[name] for name in _LOOKS_FOR])
    tests = tuple(
        LineTest(name, looks_for, seen[name], raw[name], p_holm)
        for (name, looks_for), p_holm in zip(_LOOKS_FOR.items(), corrected, strict=True)
    )
    bias, low, high, angle = _bias(u, rng)
    inflation = float(null.statistics["rayleigh"].mean()) / 2
    smallest = float(np.sqrt(2 * _SEEN_AT * inflation / len(u)))
    # the normal's direction, turned by a quarter into the direction of travel
    favoured = float(np.mod(space.direction(float(np.mod(angle / (2 * np.pi), 1.0))) + np.pi / 2, np.pi))
    verdict = _verdict(tests, len(u), bias, smallest, favoured)
    if raw["run_length"] < _LEVEL:
        verdict += (
            f" Runs are {length.mean():.1f} cm long on average where {null.mean_run_cm:.1f} cm are expected "
            f"(p = {raw['run_length']:.2g}): are they cut short, or is the region not the one rolled in?"
        )
    return IsotropyReport(
        lines=len(u),
        skipped=skipped,
        outside=int(((v_raw < 0) | (v_raw > 1)).sum()),
        tests=tests,
        isotropy_p=min(holm([raw["rayleigh"], raw["hermans_rasson"]])),
        homogeneity_p=min(holm([raw["cramer_von_mises"], raw["neyman"]])),
        joint_p=raw["neyman"],
        bias=bias,
        bias_low=low,
        bias_high=high,
        smallest_bias=smallest,
        favoured_rad=favoured,
        mean_run_cm=float(length.mean()),
        predicted_run_cm=null.mean_run_cm,
        run_length_p=raw["run_length"],
        passed=min(corrected) >= _LEVEL,
        verdict=verdict,
    )


def _verdict(tests: tuple[LineTest, ...], lines: int, bias: float, smallest: float, favoured_rad: float) -> str:
    worst = min(tests, key=lambda test: (test.holm_p_value, test.p_value))
    if worst.holm_p_value >= _LEVEL:
        return (
            f"No fault found in {lines} lines: they look isotropic and homogeneous (smallest p after Holm's correction "
            f"{worst.holm_p_value:.2g}). An excess along one axis of {100 * min(smallest, 1):.0f} % or more would show "
            "in 8 sessions of 10."
        )
    found = [test for test in tests if test.holm_p_value < _LEVEL]
    faults = "; ".join(f"{test.looks_for}, p = {test.holm_p_value:.2g}" for test in found)
    axis = ""
    if found[0].name == "rayleigh":
        axis = f" Travel near {np.degrees(favoured_rad):.0f} deg is {100 * bias:.0f} % too frequent."
    return f"The {lines} lines are not isotropic and homogeneous ({faults}); area and perimeter will be biased.{axis}"
