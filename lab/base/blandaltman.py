"""Agreement of two ways to measure one thing (Bland and Altman 1986, 1999)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import t as student

WITHIN_LIMITS = 1.96  # standard deviations either side of the mean difference: 95 % of a normal distribution
_FEWEST_FOR_TREND = 5

Interval = tuple[float, float]


@dataclass(frozen=True, slots=True)
class BlandAltman:
    """Differences of two methods against their means, in the unit of what was measured.

    Attributes:
        n: pairs.
        bias: mean difference, with its standard error ``bias_sigma`` and 95 % ``bias_interval``.
        sd: standard deviation of the differences.
        limits: limits of agreement, bias ∓ 1.96 sd, with the standard error ``limit_sigma`` of either and the 95 %
            intervals of the lower and of the upper one.
        trend: slope of difference on mean, with its standard error and p-value. NaN where the means do not differ.
        trend_at_zero: the line of the trend at mean 0.
    """

    n: int
    bias: float
    bias_sigma: float
    bias_interval: Interval
    sd: float
    limits: Interval
    limit_sigma: float
    lower_limit_interval: Interval
    upper_limit_interval: Interval
    trend: float
    trend_sigma: float
    trend_p: float
    trend_at_zero: float

    def to_dict(self) -> dict[str, Any]:
        """The JSON form; what is unknown becomes None."""
        values: dict[str, Any] = {name: getattr(self, name) for name in self.__slots__}
        for name in ("bias_interval", "limits", "lower_limit_interval", "upper_limit_interval"):
            values[name] = [_known(end) for end in getattr(self, name)]
        return {name: _known(value) if isinstance(value, float) else value for name, value in values.items()}


def _known(value: float) -> float | None:
    return value if np.isfinite(value) else None


def bland_altman(measured: ArrayLike, reference: ArrayLike) -> BlandAltman | None:
    """Compare ``measured`` (n,) with ``reference`` (n,), pair by pair; None below two pairs that are both known.

    Intervals are those of Bland and Altman, Stat. Methods Med. Res. 8 (1999) 135, sec. 2: Student's t with n - 1
    degrees of freedom, standard errors sd / √n of the bias and sd √(1/n + 1.96² / (2 (n - 1))) of a limit.

    >>> found = bland_altman([1.0, 2.5, 3.0, 4.5], [1.0, 2.0, 3.0, 4.0])
    >>> found.bias, round(found.sd, 3)
    (0.25, 0.289)
    """
    first, second = np.asarray(measured, dtype=float), np.asarray(reference, dtype=float)
    both = np.isfinite(first) & np.isfinite(second)
    n = int(both.sum())
    if n < 2:
        return None
    difference, mean = (first - second)[both], (first + second)[both] / 2.0
    bias, sd = float(difference.mean()), float(difference.std(ddof=1))
    bias_sigma = sd / float(np.sqrt(n))
    limit_sigma = sd * float(np.sqrt(1.0 / n + WITHIN_LIMITS**2 / (2.0 * (n - 1))))
    reach = float(student.ppf(0.975, n - 1))
    limits = (bias - WITHIN_LIMITS * sd, bias + WITHIN_LIMITS * sd)
    slope, slope_sigma, slope_p = np.nan, np.nan, np.nan
    spread = float(((mean - mean.mean()) ** 2).sum())
    if n >= _FEWEST_FOR_TREND and spread > 0.0:
        slope = float(((mean - mean.mean()) * difference).sum()) / spread
        rest = difference - bias - slope * (mean - mean.mean())
        slope_sigma = float(np.sqrt((rest**2).sum() / (n - 2) / spread))
        slope_p = float(2.0 * student.sf(abs(slope) / slope_sigma, n - 2)) if slope_sigma > 0.0 else float(slope == 0.0)
    return BlandAltman(
        n=n,
        bias=bias,
        bias_sigma=bias_sigma,
        bias_interval=(bias - reach * bias_sigma, bias + reach * bias_sigma),
        sd=sd,
        limits=limits,
        limit_sigma=limit_sigma,
        lower_limit_interval=(limits[0] - reach * limit_sigma, limits[0] + reach * limit_sigma),
        upper_limit_interval=(limits[1] - reach * limit_sigma, limits[1] + reach * limit_sigma),
        trend=slope,
        trend_sigma=slope_sigma,
        trend_p=slope_p,
        trend_at_zero=bias - slope * float(mean.mean()),
    )
