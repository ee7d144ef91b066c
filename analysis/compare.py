"""A measured session against Monte Carlo: does the robot see what Eq. 1's lines would show it?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from analysis.boundary import Geometry
from analysis.estimate import Estimate, estimate
from analysis.invariants import invariants_table, lit_lengths
from analysis.montecarlo import simulate_chords
from analysis.quadrature import Moments, exact_moments
from lab.base.errors import RequestError

Floats = NDArray[np.float64]

REFERENCE_LINES = 200_000


@dataclass(frozen=True, slots=True)
class ChordTest:
    """Two-sample Kolmogorov–Smirnov test of chord lengths.

    Chords of one line are not independent, so that for shapes with several chords a line the p-value is
    somewhat too small: doubt the robot only well below 0.01.

    Attributes:
        statistic: largest distance between the two cumulative distributions.
        p_value: probability of at least that distance if both samples are of one distribution.
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
        bias_nats: its expected excess when both samples are of one distribution, (occupied bins − 1)/2 · (1/n₁ + 1/n₂)
            to first order: a divergence of this size means nothing.
        bins: number of bins.
    """

    nats: float
    bias_nats: float
    bins: int

    @property
    def corrected_nats(self) -> float:
        """The estimate less its bias, not below 0."""
        return max(0.0, self.nats - self.bias_nats)


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
        chords: Kolmogorov–Smirnov test of the chord lengths.
        divergence: of the measured chord lengths from the simulated ones, in nats.
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
    occupied = (p > 0) | (q > 0)
    p, q = p[occupied], q[occupied]
    p[p == 0] = 0.5
    q[q == 0] = 0.5
    p_share, q_share = p / p.sum(), q / q.sum()
    nats = float(np.sum(p_share * np.log(p_share / q_share)))
    bias = (int(occupied.sum()) - 1) / 2 * (1 / first.size + 1 / second.size)
    return Divergence(nats, bias, bins)


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
    reference = simulate_chords(geometry, lines, rng)
    return Comparison(
        estimate=measured,
        moments=moments,
        deviation=deviation(measured, moments),
        chords=compare_chords(chords, reference),
        divergence=chord_divergence(chords, reference),
        mean_chord_cm=float(chords.mean()),
        cauchy_chord_cm=float(np.pi * moments.area_cm2 / moments.perimeter_cm),
    )


def _sample(lengths_cm: ArrayLike, which: str) -> Floats:
    sample = np.asarray(lengths_cm, dtype=float).ravel()
    if sample.size == 0 or not np.isfinite(sample).all():
        raise RequestError(f"the {which} chords are none, or not all finite; measure more lines")
    return sample
