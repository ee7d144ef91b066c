"""A measured session against Monte Carlo: does the robot see what Eq. 1's lines would show it?

The whole curves A(N) and P(N) are tested in `analysis.bandtest`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from analysis.boundary import Geometry
from analysis.estimate import Estimate, estimate
from analysis.invariants import invariants_table, lit_lengths
from analysis.montecarlo import simulate_chords, simulate_crossings
from analysis.quadrature import Moments, exact_moments
from lab.base.errors import RequestError

Floats = NDArray[np.float64]

REFERENCE_LINES = 200_000
SESSIONS = 999  # simulated; with the measured one a round thousand
_FEWEST_SESSIONS = 199
_LINES_AT_ONCE = 500_000  # bounds the memory
_MOST_LINES = 3_000_000  # of all simulated sessions, a second of work


@dataclass(frozen=True, slots=True)
class ChordTest:
    """Two-sample Kolmogorov–Smirnov test of chord lengths.

    Attributes:
        statistic: largest distance between the two cumulative distributions.
        p_value: probability of at least that distance if both samples are of one distribution: by `compare_chords`
            for chords that are independent, by `compare_chords_by_line` for those of lines with several.
        n_measured: chords measured.
        n_reference: chords of the reference.
    """

    statistic: float
    p_value: float
    n_measured: int
    n_reference: int


@dataclass(frozen=True, slots=True)
class Divergence:
    """Kullback–Leibler divergence D(first ‖ second) of two chord-length histograms.

    Attributes:
        nats: the plug-in estimate. Bins empty in either sample count half an event, which keeps it finite.
        bias_nats: its expected excess when both samples are of one distribution: a divergence of this size means
            nothing. `compare_chords_by_line` simulates it. `chord_divergence` knows only the first order of many
            independent chords, (occupied bins − 1)/2 · (1/n₁ + 1/n₂): within a tenth for 1000 lines on ten bins, but
            half too large where 100 lines leave most of forty bins nearly empty, and too small by a tenth where lines
            have many chords.
        bins: number of bins.
    """

    nats: float
    bias_nats: float
    bins: int

    @property
    def corrected_nats(self) -> float:
        """The estimate less its bias, not below 0."""
        return max(0.0, self.nats - self.bias_nats)


@dataclass(frozen=True, slots=True)
class ChordsByLine:
    """Chord lengths of a session against those of simulated sessions of as many lines.

    Attributes:
        test: Kolmogorov–Smirnov, its p-value by the simulated sessions: exact, however the chords of one line depend
            on each other.
        divergence: from the reference, its bias by the simulated sessions.
        divergence_p: share of sessions, the measured one among them, with at least that divergence.
        sessions: simulated.
    """

    test: ChordTest
    divergence: Divergence
    divergence_p: float
    sessions: int


class Known(Protocol):
    """A shape whose size and scatter are known: `analysis.quadrature.Moments`, or an entry of the figures."""

    @property
    def area_cm2(self) -> float:
        """True area."""
        ...

    @property
    def perimeter_cm(self) -> float:
        """True perimeter."""
        ...

    def covariance_at(self, n: float) -> Floats:
        """Covariance (2, 2) of (A cm², P cm) after ``n`` crossing lines."""
        ...


@dataclass(frozen=True, slots=True)
class Deviation:
    """How far an estimate lies from the truth: relative, and in the truth's own standard deviations.

    Attributes:
        area_rel: Â/A − 1.
        perimeter_rel: P̂/P − 1.
        z_area: (Â − A)/σ_A.
        z_perimeter: (P̂ − P)/σ_P.
        distance2: squared Mahalanobis distance, with the correlation of A and P.
        p_value: probability of at least that distance (χ², 2 degrees of freedom).

    The last two are NaN where the scatter is unknown or singular.
    """

    area_rel: float
    perimeter_rel: float
    z_area: float
    z_perimeter: float
    distance2: float
    p_value: float


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """A session beside the Monte Carlo of its shape.

    Attributes:
        estimate: from the measured lines.
        moments: exact, of the shape.
        deviation: of the estimate from the shape's area and perimeter.
        chords: Kolmogorov–Smirnov test of the chord lengths, honest for lines with several chords.
        divergence: of the measured chord lengths from the simulated ones, in nats, with its simulated bias.
        mean_chord_cm: measured; Cauchy's theorem puts it at πA/P.
        cauchy_chord_cm: πA/P of the shape.
    """

    estimate: Estimate
    moments: Moments
    deviation: Deviation
    chords: ChordTest
    divergence: Divergence
    mean_chord_cm: float
    cauchy_chord_cm: float


def chord_lengths(crossings: pd.DataFrame) -> Floats:
    """Lengths in cm of all chords of a crossings table (columns line, order, s_cm, entering).

    Lines whose crossings do not pair up are left out, as in `analysis.invariants.invariants_table`.
    """
    unpaired = invariants_table(crossings).attrs.get("unpaired_lines", ())
    return lit_lengths(crossings[~crossings["line"].isin(list(unpaired))])


def compare_chords(measured_cm: ArrayLike, reference_cm: ArrayLike) -> ChordTest:
    """Kolmogorov–Smirnov test of measured chord lengths against simulated ones (cm).

    Every chord counts as independent. Those of one line are not: for shapes with several chords a line the p-value is
    too small (`compare_chords_by_line` mends that).

    Raises:
        RequestError: either sample is empty.
    """
    measured, reference = _sample(measured_cm, "measured"), _sample(reference_cm, "reference")
    result = stats.ks_2samp(measured, reference, method="asymp")
    return ChordTest(float(result.statistic), float(result.pvalue), measured.size, reference.size)


def chord_divergence(
    first_cm: ArrayLike, second_cm: ArrayLike, *, bins: int = 40, normalise: bool = False
) -> Divergence:
    """D(first ‖ second) of two samples of chord lengths.

    ``normalise`` divides each sample by its longest chord first, which compares the kinds of shapes whatever
    their sizes, as the paper does with a disc as the second. Otherwise both share the bins from 0 to the longest
    chord of either.

    Raises:
        RequestError: a sample is empty, or ``bins`` is below 2.
    """
    first, second = _sample(first_cm, "first"), _sample(second_cm, "second")
    if bins < 2:
        raise RequestError(f"a chord histogram needs at least 2 bins, not {bins}")
    if normalise:
        first, second = first / first.max(), second / second.max()
    edges = np.linspace(0, max(float(first.max()), float(second.max())), bins + 1)
    p, q = (np.histogram(sample, edges)[0].astype(float) for sample in (first, second))
    bias = (np.count_nonzero(p + q) - 1) / 2 * (1 / first.size + 1 / second.size)
    return Divergence(_plug_in_nats(p, q), bias, bins)


def compare_chords_by_line(
    chords_cm: ArrayLike,
    crossing_lines: int,
    geometry: Geometry,
    rng: np.random.Generator,
    *,
    reference_lines: int = REFERENCE_LINES,
    sessions: int = SESSIONS,
    bins: int = 40,
) -> ChordsByLine:
    """Compare the chords (cm) of ``crossing_lines`` measured lines with simulated sessions of as many lines.

    A Monte Carlo test: as each simulated session is held against the same reference as the measured one, the
    p-values are exact. Very long sessions are held against fewer than ``sessions``, but 199 at least.

    Raises:
        RequestError: there are no chords, or no lines.
    """
    measured = _sample(chords_cm, "measured")
    if crossing_lines < 1 or bins < 2:
        raise RequestError(f"{crossing_lines} lines and {bins} bins compare nothing: give 1 and 2 at least")
    runs = min(sessions, max(_FEWEST_SESSIONS, _MOST_LINES // crossing_lines))
    reference = np.sort(simulate_chords(geometry, reference_lines, rng))
    edges = np.linspace(0, max(float(reference[-1]), float(measured.max())), bins + 1)
    expected = np.histogram(reference, edges)[0].astype(float)

    def judge(sample: Floats) -> tuple[float, float]:
        found = np.histogram(np.minimum(sample, edges[-1]), edges)[0].astype(float)
        return _distance(sample, reference), _plug_in_nats(found, expected)

    statistic, nats = judge(measured)
    simulated = np.array([judge(sample) for sample in _sessions(geometry, crossing_lines, runs, rng)])
    at_least = 1 + (simulated >= [statistic, nats]).sum(axis=0)
    return ChordsByLine(
        test=ChordTest(statistic, float(at_least[0]) / (runs + 1), measured.size, reference.size),
        divergence=Divergence(nats, float(simulated[:, 1].mean()), bins),
        divergence_p=float(at_least[1]) / (runs + 1),
        sessions=runs,
    )


def _sessions(geometry: Geometry, lines: int, runs: int, rng: np.random.Generator) -> Iterator[Floats]:
    """The chords (cm) of ``runs`` simulated sessions, one array each."""
    at_once = max(1, _LINES_AT_ONCE // lines)
    for first in range(0, runs, at_once):
        here = min(at_once, runs - first)
        found = simulate_crossings(geometry, lines * here, rng)
        yield from np.split(found.chords_cm, np.cumsum(found.counts)[lines - 1 : -1 : lines] // 2)


def _distance(sample_cm: Floats, reference_cm: Floats) -> float:
    """Kolmogorov and Smirnov's distance of a sample from a sorted reference."""
    ordered = np.sort(sample_cm)
    steps = np.arange(ordered.size + 1) / ordered.size
    below = np.searchsorted(reference_cm, ordered, side="left") / reference_cm.size
    up_to = np.searchsorted(reference_cm, ordered, side="right") / reference_cm.size
    return float(max((steps[1:] - below).max(), (up_to - steps[:-1]).max()))


def _plug_in_nats(p: Floats, q: Floats) -> float:
    """D(p ‖ q) of two histograms' counts; bins empty in one of them count half an event."""
    occupied = (p > 0) | (q > 0)
    p, q = (np.where(counts[occupied] > 0, counts[occupied], 0.5) for counts in (p, q))
    p_share, q_share = p / p.sum(), q / q.sum()
    return float(np.sum(p_share * np.log(p_share / q_share)))


def deviation(measured: Estimate, known: Known) -> Deviation:
    """Set an estimate against a shape's exact area and perimeter, in the shape's own σ/√N.

    The shape's σ is used and not the estimate's: as long as the rare long chords are missing from a sample, A and
    its uncertainty are both too small.
    """
    covariance = known.covariance_at(measured.n)
    error = np.array([measured.area_cm2 - known.area_cm2, measured.perimeter_cm - known.perimeter_cm])
    with np.errstate(divide="ignore", invalid="ignore"):
        z_area, z_perimeter = error / np.sqrt(np.maximum(np.diag(covariance), 0.0))
    distance2 = squared_distance(error, covariance)
    return Deviation(
        area_rel=float(error[0] / known.area_cm2),
        perimeter_rel=float(error[1] / known.perimeter_cm),
        z_area=float(z_area),
        z_perimeter=float(z_perimeter),
        distance2=distance2,
        p_value=float(stats.chi2.sf(distance2, 2)),
    )


def squared_distance(error: Floats, covariance: Floats) -> float:
    """Squared Mahalanobis distance of ``error`` (2,); NaN where ``covariance`` (2, 2) is unknown or singular."""
    if not np.isfinite(covariance).all() or np.linalg.matrix_rank(covariance) < 2:
        return float("nan")
    return float(error @ np.linalg.solve(covariance, error))


def compare(
    geometry: Geometry,
    k: ArrayLike,
    l1_cm: ArrayLike,
    l3_cm3: ArrayLike,
    *,
    chords_cm: ArrayLike,
    rng: np.random.Generator,
    lines: int = REFERENCE_LINES,
) -> Comparison:
    """Compare a session's lines and chords with ``lines`` simulated ones of its shape.

    ``k``, ``l1_cm``, ``l3_cm3`` (lines,) are the session's invariants, ``chords_cm`` (chords,) its chord lengths.

    Raises:
        analysis.estimate.NoLinesError: no line crossed the shape.
        RequestError: there are no chords.
    """
    measured = estimate(k, l1_cm, l3_cm3)
    moments = exact_moments(geometry)
    chords = _sample(chords_cm, "measured")
    by_line = compare_chords_by_line(chords, measured.n, geometry, rng, reference_lines=lines)
    return Comparison(
        estimate=measured,
        moments=moments,
        deviation=deviation(measured, moments),
        chords=by_line.test,
        divergence=by_line.divergence,
        mean_chord_cm=float(chords.mean()),
        cauchy_chord_cm=float(np.pi * moments.area_cm2 / moments.perimeter_cm),
    )


def _sample(lengths_cm: ArrayLike, which: str) -> Floats:
    sample = np.asarray(lengths_cm, dtype=float).ravel()
    if sample.size == 0 or not np.isfinite(sample).all():
        raise RequestError(f"the {which} chords are none, or not all finite; measure more lines")
    return sample
