"""A measured session against Monte Carlo: does the robot see what Eq. 1's lines would show it?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from analysis.boundary import Geometry
from analysis.estimate import Estimate, estimate
from analysis.invariants import CrossingsError, line_invariants
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


@dataclass(frozen=True, slots=True)
class Deviation:
    """How far an estimate lies from the truth, in the truth's own standard deviations.

    Attributes:
        z_area: (Â − A)/σ_A.
        z_perimeter: (P̂ − P)/σ_P.
        distance2: squared Mahalanobis distance, with the correlation of A and P.
        p_value: probability of at least that distance (χ², 2 degrees of freedom).
    """

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
    lengths: list[Floats] = []
    ordered = crossings.sort_values(["line", "order"], kind="stable")
    for _, line in ordered.groupby("line", sort=True):
        s_cm = np.asarray(line["s_cm"], dtype=float)
        try:
            line_invariants(s_cm, np.asarray(line["entering"], dtype=bool))
        except CrossingsError:
            continue
        lengths.append(s_cm[1::2] - s_cm[::2])
    return np.concatenate(lengths) if lengths else np.empty(0)


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


def deviation(measured: Estimate, moments: Moments) -> Deviation:
    """Set an estimate against a shape's exact area and perimeter, in the shape's own σ/√N.

    The shape's σ is used and not the estimate's, which over few lines is as uncertain as the estimate.
    """
    covariance = moments.covariance_at(measured.n)
    error = np.array([measured.area_cm2 - moments.area_cm2, measured.perimeter_cm - moments.perimeter_cm])
    z_area, z_perimeter = error / np.sqrt(np.diag(covariance))
    distance2 = float(error @ np.linalg.solve(covariance, error))
    return Deviation(float(z_area), float(z_perimeter), distance2, float(stats.chi2.sf(distance2, 2)))


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
