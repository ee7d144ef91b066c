"""Means of values that come in clusters: frames of a run, chords of a line. Within a cluster they may go together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import t as student

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Mean:
    """A mean with its standard error; ``clusters`` independent groups stand behind it. NaN where undetermined."""

    value: float
    sigma: float
    clusters: int

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """The interval by Student's t with one degree of freedom less than there are clusters."""
        if self.clusters < 2:
            return np.nan, np.nan
        reach = float(student.ppf(0.5 + level / 2.0, self.clusters - 1)) * self.sigma
        return self.value - reach, self.value + reach

    def p_value(self, expected: float) -> float:
        """Two-sided p-value of the mean being ``expected``; 1 where nothing can be said."""
        gap = abs(self.value - expected)
        if self.clusters < 2 or not np.isfinite(gap):
            return 1.0
        if self.sigma == 0.0:
            return 1.0 if gap == 0.0 else 0.0
        return float(2.0 * student.sf(gap / self.sigma, self.clusters - 1))


def clustered_mean(values: ArrayLike, cluster: ArrayLike) -> Mean:
    """Mean of ``values`` (n,), its error from the sums over clusters; NaN values are left out.

    The mean is the ratio of two sums over clusters (values, counts), its variance that of Cochran 1977, Eq. 6.13,
    so that it holds however the values of one cluster depend on each other.

    >>> clustered_mean([1.0, 1.0, 4.0, 4.0], [0, 0, 1, 1])
    Mean(value=2.5, sigma=1.5, clusters=2)
    """
    value, label = np.asarray(values, dtype=float), np.asarray(cluster)
    known = np.isfinite(value)
    _, group = np.unique(label[known], return_inverse=True)
    if not len(group):
        return Mean(np.nan, np.nan, 0)
    count = np.bincount(group).astype(float)
    mean = float(value[known].mean())
    if len(count) < 2:
        return Mean(mean, np.nan, len(count))
    strays = np.bincount(group, weights=value[known]) - mean * count
    many = len(count)
    return Mean(mean, float(np.sqrt(many / (many - 1) * (strays**2).sum()) / count.sum()), many)
