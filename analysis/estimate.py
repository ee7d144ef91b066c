"""Area and perimeter from measured lines, and how far to trust them (delta method)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import f as fisher

from analysis.invariants import area_cm2, perimeter_cm
from lab.base.errors import ChordlabError, RequestError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Log-gradients of A ∝ 𝓛_3/𝓛_1 and P ∝ k 𝓛_3/𝓛_1² with respect to (k, 𝓛_1, 𝓛_3).
_GRADIENT = np.array([[0.0, -1.0, 1.0], [1.0, -2.0, 1.0]])


class NoLinesError(ChordlabError):
    """No line has crossed the shape yet, so that there is nothing to estimate from."""

    def __init__(self) -> None:
        super().__init__("no line has crossed the shape; roll more lines, or check that the shape lies in the arena")


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Area and perimeter after ``n`` lines that crossed the shape.

    Attributes:
        n: number of lines with k ≥ 1.
        area_cm2: Eq. 1.
        perimeter_cm: Cauchy's theorem with Eq. 1.
        covariance: (2, 2) of (area_cm2, perimeter_cm), in cm⁴, cm³, cm²; NaN for n = 1.
    """

    n: int
    area_cm2: float
    perimeter_cm: float
    covariance: Floats

    @property
    def sigma_area_cm2(self) -> float:
        """Standard deviation of the area."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def sigma_perimeter_cm(self) -> float:
        """Standard deviation of the perimeter."""
        return float(np.sqrt(self.covariance[1, 1]))

    @property
    def correlation(self) -> float:
        """Correlation of area and perimeter; NaN where one of them does not scatter."""
        return float(_correlation(self.covariance[0, 0], self.covariance[1, 1], self.covariance[0, 1]))

    def region(self, level: float, *, points: int = 181) -> tuple[Floats, Floats]:
        """Outline (area_cm2, perimeter_cm) of where the truth lies with confidence ``level``; closed.

        An ellipse in (log A, log P), in which the estimates are less skewed and never negative, its size by
        Hotelling's T² because the covariance is estimated from the same lines. Needs three lines or more.

        Raises:
            RequestError: the level does not lie between 0 and 1, or there are fewer than three lines.
        """
        radius2 = self._hotelling(level)
        size = np.array([self.area_cm2, self.perimeter_cm])
        x, y = _contour(np.log(size), self.covariance / np.outer(size, size), radius2, points)
        return np.exp(x), np.exp(y)

    def holds(self, area_cm2: float, perimeter_cm: float, level: float) -> bool:
        """Whether `region` at this level holds the given area and perimeter, both above 0."""
        size = np.array([self.area_cm2, self.perimeter_cm])
        off = np.log(np.array([area_cm2, perimeter_cm]) / size)
        squared = off @ np.linalg.solve(self.covariance / np.outer(size, size), off)
        return bool(squared <= self._hotelling(level))

    def _hotelling(self, level: float) -> float:
        """The squared radius 2(n − 1)/(n − 2) F(2, n − 2)."""
        _check_level(level)
        if self.n < 3:
            raise RequestError(f"{self.n} line(s) say nothing about their own scatter: roll at least 3")
        return float(2 * (self.n - 1) / (self.n - 2) * fisher.ppf(level, 2, self.n - 2))


@dataclass(frozen=True, slots=True, eq=False)
class RunningEstimates:
    """The estimates after 1 … n crossing lines; every array has shape (n,).

    ``row`` is the index of each crossing line in the arrays that were given. The sigmas and the correlation
    are NaN for the first line.
    """

    n: Ints
    row: Ints
    area_cm2: Floats
    perimeter_cm: Floats
    sigma_area_cm2: Floats
    sigma_perimeter_cm: Floats
    correlation: Floats


def relative_covariance(mean: ArrayLike, covariance: ArrayLike) -> Floats:
    """Delta method: covariance (2, 2) of the relative errors of (A, P) for one line; divide by N for N lines.

    ``mean`` (3,) and ``covariance`` (3, 3) are those of (k, 𝓛_1, 𝓛_3) over the lines that cross the shape.
    """
    centre = np.asarray(mean, dtype=float)
    scaled = np.asarray(covariance, dtype=float) / np.outer(centre, centre)
    return _GRADIENT @ scaled @ _GRADIENT.T


def ratio_bias(mean: ArrayLike, covariance: ArrayLike) -> Floats:
    """Relative bias (2,) of (Â, P̂) for one line to second order; divide by N for N lines.

    A ratio of means is biased: with c_ij the relative covariances of (k, 𝓛_1, 𝓛_3),
    Â: c_11 − c_13 and P̂: 3 c_11 + c_k3 − 2 c_13 − 2 c_k1.
    """
    centre = np.asarray(mean, dtype=float)
    c = np.asarray(covariance, dtype=float) / np.outer(centre, centre)
    return np.array([c[1, 1] - c[1, 2], 3 * c[1, 1] + c[0, 2] - 2 * c[1, 2] - 2 * c[0, 1]])


def estimate(k: ArrayLike, l1_cm: ArrayLike, l3_cm3: ArrayLike, *, correct_bias: bool = False) -> Estimate:
    """Estimate area and perimeter from the lines' invariants.

    ``k``, ``l1_cm``, ``l3_cm3`` (lines,): chords, 𝓛_1 and 𝓛_3 of each line. Lines with k = 0 crossed the arena
    but not the shape and are left out. ``correct_bias`` takes the plug-in `ratio_bias` off, which matters
    below some hundred lines.

    Raises:
        NoLinesError: no line has k ≥ 1.
        RequestError: the arrays' lengths differ or a value is not finite.
    """
    values, _ = _crossing_lines(k, l1_cm, l3_cm3)
    n = len(values)
    if n == 0:
        raise NoLinesError
    covariance = np.cov(values, rowvar=False) if n > 1 else np.full((3, 3), np.nan)
    return estimate_from_moments(n, values.mean(axis=0), covariance, correct_bias=correct_bias)


def estimate_from_moments(n: int, mean: ArrayLike, covariance: ArrayLike, *, correct_bias: bool = False) -> Estimate:
    """Estimate from the mean (3,) and covariance (3, 3) of (k, 𝓛_1, 𝓛_3) over ``n`` lines.

    For sums that were kept on board or merged between robots.
    """
    centre = np.asarray(mean, dtype=float)
    area = float(area_cm2(centre[1], centre[2]))
    perimeter = float(perimeter_cm(centre[0], centre[1], centre[2]))
    if correct_bias and n > 1:
        bias = ratio_bias(centre, covariance) / n
        area *= 1 - float(bias[0])
        perimeter *= 1 - float(bias[1])
    size = np.array([area, perimeter])
    return Estimate(n, area, perimeter, relative_covariance(centre, covariance) * np.outer(size, size) / n)


def running_estimates(k: ArrayLike, l1_cm: ArrayLike, l3_cm3: ArrayLike) -> RunningEstimates:
    """Give the estimates after each crossing line, in one pass of cumulative sums.

    Arguments as for `estimate`. No crossing line at all gives empty arrays.
    """
    values, row = _crossing_lines(k, l1_cm, l3_cm3)
    n = np.arange(1, len(values) + 1)
    if not len(values):
        empty = np.empty(0)
        return RunningEstimates(n, row, empty, empty, empty, empty, empty)
    count = n[:, None]
    # Sums about the overall mean: the running variance is then a difference of small numbers.
    overall = values.mean(axis=0)
    centred = values - overall
    shift = np.cumsum(centred, axis=0) / count
    products = np.cumsum(centred[:, :, None] * centred[:, None, :], axis=0)
    mean = overall + shift
    with np.errstate(invalid="ignore", divide="ignore"):
        scatter = (products - count[:, :, None] * shift[:, :, None] * shift[:, None, :]) / (count[:, :, None] - 1)
        relative = scatter / (mean[:, :, None] * mean[:, None, :]) / count[:, :, None]
        cov = np.einsum("ai,nij,bj->nab", _GRADIENT, relative, _GRADIENT)
        cov[0] = np.nan
        variance_a = np.maximum(cov[:, 0, 0], 0.0)
        variance_p = np.maximum(cov[:, 1, 1], 0.0)
        area = area_cm2(mean[:, 1], mean[:, 2])
        perimeter = perimeter_cm(mean[:, 0], mean[:, 1], mean[:, 2])
        return RunningEstimates(
            n=n,
            row=row,
            area_cm2=area,
            perimeter_cm=perimeter,
            sigma_area_cm2=area * np.sqrt(variance_a),
            sigma_perimeter_cm=perimeter * np.sqrt(variance_p),
            correlation=_correlation(variance_a, variance_p, cov[:, 0, 1]),
        )


def ellipse(mean: ArrayLike, covariance: ArrayLike, level: float, *, points: int = 181) -> tuple[Floats, Floats]:
    """Draw the ellipse that holds ``level`` of a two-dimensional normal distribution.

    ``mean`` (2,) and ``covariance`` (2, 2) may be in either order, (A, P) or (P, A): the first returned array
    belongs to the first coordinate. Closed: the last point is the first. For two dimensions the χ² quantile
    is −2 ln(1 − level).
    """
    _check_level(level)
    return _contour(np.asarray(mean, dtype=float), np.asarray(covariance, dtype=float), -2 * np.log1p(-level), points)


def _check_level(level: float) -> None:
    if not 0 < level < 1:
        raise RequestError(f"a confidence level lies between 0 and 1, not {level}")


def _contour(centre: Floats, covariance: Floats, radius2: float, points: int) -> tuple[Floats, Floats]:
    """Where the squared Mahalanobis distance from ``centre`` is ``radius2``."""
    values, vectors = np.linalg.eigh(covariance)
    radii = np.sqrt(np.maximum(values, 0.0) * radius2)
    phase = np.linspace(0, 2 * np.pi, points)
    circle = np.stack([np.cos(phase), np.sin(phase)])
    x, y = centre[:, None] + vectors @ (radii[:, None] * circle)
    return x, y


def _crossing_lines(k: ArrayLike, l1_cm: ArrayLike, l3_cm3: ArrayLike) -> tuple[Floats, Ints]:
    columns = [np.asarray(column, dtype=float).ravel() for column in (k, l1_cm, l3_cm3)]
    if len({column.size for column in columns}) != 1:
        raise RequestError("k, l1_cm and l3_cm3 must have one value for each line; their lengths differ")
    values = np.column_stack(columns)
    if not np.isfinite(values).all():
        raise RequestError("k, l1_cm and l3_cm3 must be finite; drop the lines with missing values first")
    row = np.flatnonzero(values[:, 0] >= 1)
    return values[row], row.astype(np.int64)


def _correlation(variance_a: ArrayLike, variance_p: ArrayLike, covariance: ArrayLike) -> Floats:
    size = np.sqrt(np.asarray(variance_a, dtype=float) * np.asarray(variance_p, dtype=float))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(size > 0, np.clip(np.asarray(covariance, dtype=float) / size, -1.0, 1.0), np.nan)
