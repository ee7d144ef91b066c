"""Whether many measurements are as good as they say: shares, pulls (z) against the normal law, p-values, outliers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

FEWEST = 5  # below, neither spread nor uniformity can be judged


@dataclass(frozen=True, slots=True)
class Share:
    """``hits`` out of ``of``, with Wilson's 95 % interval ``low`` … ``high``; all shares are NaN for none of none."""

    hits: int
    of: int
    low: float
    high: float

    @classmethod
    def counted(cls, hits: int, of: int) -> Share:
        """Count ``hits`` of ``of`` trials."""
        if of == 0:
            return cls(0, 0, float("nan"), float("nan"))
        interval = stats.binomtest(hits, of).proportion_ci(0.95, method="wilson")
        return cls(hits, of, float(interval.low), float(interval.high))

    @property
    def value(self) -> float:
        """The share itself."""
        return self.hits / self.of if self.of else float("nan")


@dataclass(frozen=True, slots=True)
class Pull:
    """Pulls z = (measured − true)/σ of several measurements; they are standard normal where σ tells the truth.

    Attributes:
        count: How many are known.
        mean: Their mean; NaN for none.
        sigma: Its standard error: never less than the 1/√count of honest pulls.
        spread: Their standard deviation; NaN below two.
        spread_sigma: Its standard error, wider for heavy tails; NaN below two.
        mean_p: Probability of so large a mean where there is no bias.
        spread_p: Probability of a spread so far from 1 by chance; NaN below FEWEST.
    """

    count: int
    mean: float
    sigma: float
    spread: float
    spread_sigma: float
    mean_p: float
    spread_p: float

    @classmethod
    def of(cls, z: ArrayLike) -> Pull:
        """Take the finite ones of ``z`` (n,)."""
        known = np.asarray(z, dtype=float)
        known = known[np.isfinite(known)]
        nan, n = float("nan"), int(known.size)
        if n == 0:
            return cls(0, nan, nan, nan, nan, nan, nan)
        mean = float(known.mean())
        spread = float(known.std(ddof=1)) if n > 1 else nan
        sigma = max(1.0, spread if n > 1 else 1.0) / math.sqrt(n)
        mean_p = float(2 * stats.norm.sf(abs(mean) / sigma))
        if n == 1 or spread <= 0:
            return cls(n, mean, sigma, spread, nan, mean_p, nan)
        # var(ln s) = (κ − 1)/4n; κ is 3 for the normal law, and more for skewed estimates from few lines
        tails = max(3.0, float(((known - mean) ** 4).mean()) / float(known.var()) ** 2)
        log_sigma = math.sqrt((tails - 1) / (4 * n))
        spread_p = float(2 * stats.norm.sf(abs(math.log(spread)) / log_sigma)) if n >= FEWEST else nan
        return cls(n, mean, sigma, spread, spread * log_sigma, mean_p, spread_p)


@dataclass(frozen=True, slots=True)
class Uniformity:
    """Whether p-values (``count`` of them, ``small`` of them ≤ 0.05) are too small for true hypotheses, and how sure.

    One-sided: a careful test's p-values, corrected for several looks, are too large, and no harm is in that.
    """

    count: int
    small: int
    p_value: float

    @classmethod
    def of(cls, p_values: ArrayLike) -> Uniformity:
        """Take the finite ones of ``p_values`` (n,); below FEWEST by their smallest alone."""
        known = np.asarray(p_values, dtype=float)
        known = known[np.isfinite(known)]
        n, small = int(known.size), int((known <= 0.05).sum())
        if n == 0:
            return cls(0, 0, float("nan"))
        if n < FEWEST:
            return cls(n, small, float(min(1.0, n * known.min())))
        rank = float(stats.kstest(known, "uniform", alternative="greater").pvalue)
        return cls(n, small, min(1.0, 2 * min(rank, more_than(small, n, 0.05))))


def more_than(hits: int, of: int, share: float) -> float:
    """Probability of ``hits`` or more out of ``of`` trials that each succeed with probability ``share``."""
    return float(stats.binom.sf(hits - 1, of, share))


def uniform_band(n: int, level: float = 0.95) -> tuple[Floats, Floats, Floats]:
    """Expected value, and limits at ``level``, of each of ``n`` sorted uniform numbers (order statistics)."""
    rank = np.arange(1, n + 1)
    expected = rank / (n + 1)
    low, high = (stats.beta.ppf(share, rank, n + 1 - rank) for share in ((1 - level) / 2, (1 + level) / 2))
    return expected, np.asarray(low, dtype=float), np.asarray(high, dtype=float)


def outlying(values: ArrayLike, *, least: float = 0.0, limit: float = 5.0) -> Bools:
    """Which of ``values`` (n,) lie far from the rest; none below FEWEST known ones.

    Args:
        values: NaN is never an outlier.
        least: The unit of distance is the scaled median deviation, but not less than this.
        limit: Distance from the median, in units, beyond which a value is outlying.
    """
    found = np.asarray(values, dtype=float)
    known = found[np.isfinite(found)]
    if known.size < FEWEST:
        return np.zeros(found.shape, dtype=np.bool_)
    middle = float(np.median(known))
    unit = max(least, 1.4826 * float(np.median(np.abs(known - middle))), 1e-12)
    return np.isfinite(found) & (np.abs(found - middle) > limit * unit)


def extreme_z(n: int, level: float = 0.01) -> float:
    """The |z| that the largest of ``n`` honest pulls passes with probability ``level``, or less."""
    return float(stats.norm.isf(level / (2 * max(n, 1))))
