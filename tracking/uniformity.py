"""Test statistics for lines mapped to the unit square: is (U, V) uniform?

Every statistic takes rows of samples, (..., n), and gives one number a row, so that a table of the null
distribution is one call. U lives on a circle (theta = 0 and pi are one direction), V on an interval.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

# Landler, Ruxton, Malkemper, Movement Ecology 7 (2019) 30, after Hermans and Rasson (1985)
_HERMANS_RASSON = 2.895
ORDER = 4


def rayleigh(u: ArrayLike) -> Floats:
    """Rayleigh's statistic 2 n R^2 of the angles 2 pi U; chi-square with two degrees for independent lines."""
    angle = 2.0 * np.pi * np.asarray(u, dtype=float)
    return np.asarray(
        2.0 * angle.shape[-1] * (np.cos(angle).mean(axis=-1) ** 2 + np.sin(angle).mean(axis=-1) ** 2), dtype=float
    )


def hermans_rasson(u: ArrayLike) -> Floats:
    """The statistic of Hermans and Rasson on the angles 2 pi U: sees several favoured directions at once.

    T = (1/n) sum_ij [pi - c_ij - pi/2 - 2.895 (|sin(a_i - a_j)| - 2/pi)] with c_ij the angle between i and j
    and the sign such that large T speaks against uniformity. In O(n log n): the diameters that part i
    from j cover c_ij of the half turn, so sum c_ij follows from the count on either side of a turning
    diameter; on axes in order, |sin| is sin and its pair sum two running sums.
    """
    angle = 2.0 * np.pi * np.mod(np.asarray(u, dtype=float), 1.0)
    n = angle.shape[-1]
    upper = angle >= np.pi
    axis = np.where(upper, angle - np.pi, angle)
    order = np.argsort(axis, axis=-1)
    axis = np.take_along_axis(axis, order, axis=-1)
    # a diameter turning from 0 to pi gains the lower-half points' partners: count points left of it
    step = np.where(np.take_along_axis(upper, order, axis=-1), 1, -1)
    left = (n - upper.sum(axis=-1))[..., None] + np.cumsum(step, axis=-1)
    first = (n - upper.sum(axis=-1)).astype(float)
    gaps = np.diff(axis, axis=-1)
    count = left[..., :-1].astype(float)
    parted = (count * (n - count) * gaps).sum(axis=-1)
    parted += first * (n - first) * (axis[..., 0] + np.pi - axis[..., -1])
    sine, cosine = np.sin(axis), np.cos(axis)
    crossed = (sine[..., 1:] * np.cumsum(cosine, axis=-1)[..., :-1]).sum(axis=-1)
    crossed -= (cosine[..., 1:] * np.cumsum(sine, axis=-1)[..., :-1]).sum(axis=-1)
    between = n * n * np.pi / 2 - 2.0 * parted
    return np.asarray((between - _HERMANS_RASSON * (2.0 * crossed - n * n * 2.0 / np.pi)) / n, dtype=float)


def cramer_von_mises(v: ArrayLike) -> Floats:
    """The statistic of Cramer and von Mises of V against the uniform distribution on [0, 1]."""
    ordered = np.sort(np.asarray(v, dtype=float), axis=-1)
    n = ordered.shape[-1]
    place: Floats = np.asarray((2.0 * np.arange(1, n + 1) - 1.0) / (2.0 * n), dtype=float)
    return np.asarray(1.0 / (12.0 * n) + ((ordered - place) ** 2).sum(axis=-1), dtype=float)


def _smooth(u: ArrayLike, v: ArrayLike, order: int) -> Iterator[tuple[int, int, Floats]]:
    """Neyman's functions one by one, each with its number of half waves in U and its degree in V."""
    u_in, v_in = np.broadcast_arrays(np.asarray(u, dtype=float), np.asarray(v, dtype=float))
    height = 2.0 * v_in - 1.0
    legendre = [np.ones_like(height), height]
    for degree in range(2, order + 1):
        legendre.append(((2 * degree - 1) * height * legendre[-1] - (degree - 1) * legendre[-2]) / degree)
    waves = np.exp(1j * np.pi * u_in)
    turning = np.ones_like(waves)
    for half_waves in range(order + 1):
        for degree in range(half_waves % 2, order + 1 - half_waves, 2):
            norm = np.sqrt((2.0 * degree + 1.0) * (2.0 if half_waves else 1.0))
            product = turning * (legendre[degree] * norm)
            if half_waves or degree:
                yield half_waves, degree, product.real
            if half_waves:
                yield half_waves, degree, product.imag
        turning = turning * waves


def smooth_functions(u: ArrayLike, v: ArrayLike, order: int = ORDER) -> Floats:
    """Neyman's orthonormal functions on the square, to total degree ``order``: (..., n) lines give (..., n, m).

    A function of a line must not depend on which way its normal points: (U + 1, 1 - V) is the same line.
    So even Legendre polynomials of V go with whole waves of U, cos and sin of 2 pi m U, and odd ones with
    half waves, cos and sin of pi (2m + 1) U. All have mean 0 and mean square 1 on the square; to degree 4
    there are 14.
    """
    return np.stack([values for *_, values in _smooth(u, v, order)], axis=-1)


def smooth_means(u: ArrayLike, v: ArrayLike, order: int = ORDER) -> Floats:
    """The means (..., m) of `smooth_functions` over the lines (..., n)."""
    return np.stack([values.mean(axis=-1) for *_, values in _smooth(u, v, order)], axis=-1)


def smooth_terms(order: int = ORDER) -> list[tuple[int, int]]:
    """The half waves in U and the degree in V of each of `smooth_functions`; waves come as cos, sin."""
    return [(half_waves, degree) for half_waves, degree, _ in _smooth(0.0, 0.0, order)]


def neyman(means: Floats, precision: Floats) -> Floats:
    """Neyman's smooth statistic: the quadratic form of the means (..., 14) in the inverse (14, 14) of their covariance.

    For n independent lines ``precision`` is n times the identity and the statistic chi-square with 14
    degrees of freedom; successive runs share end points, so theirs comes from simulated chains.
    """
    return np.asarray(np.einsum("...i,ij,...j->...", means, precision, means), dtype=float)


def hermans_rasson_weights(waves: int) -> Floats:
    """Weights (waves,) of |sum exp(i m a)|^2 / n, m = 1, 2, ..., in the statistic of Hermans and Rasson.

    From pi/2 - c = (4/pi) sum_odd cos(mc)/m^2 and 2/pi - |sin c| = (4/pi) sum_even cos(mc)/(m^2 - 1).
    """
    m = np.arange(1, waves + 1, dtype=float)
    odd = m % 2 == 1
    return np.asarray(4.0 / np.pi / np.where(odd, m * m, (m * m - 1.0 + odd) / _HERMANS_RASSON), dtype=float)


def cramer_von_mises_weights(waves: int) -> Floats:
    """Weights (waves,) of |sum cos(j pi V)|^2 / n, j = 1, 2, ..., in the statistic of Cramer and von Mises.

    Its kernel's eigenfunctions are sqrt(2) cos(j pi V), with the eigenvalues 1/(j pi)^2 (Anderson and Darling 1952).
    """
    j = np.arange(1, waves + 1, dtype=float)
    return np.asarray(2.0 / (np.pi * j) ** 2, dtype=float)


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's step-down correction: each p-value times the hypotheses still in play, kept monotone, at most 1.

    >>> holm([0.01, 0.04, 0.03])
    [0.03, 0.06, 0.06]
    """
    corrected = [1.0] * len(p_values)
    worst = 0.0
    for rank, index in enumerate(sorted(range(len(p_values)), key=lambda i: p_values[i])):
        worst = max(worst, min(1.0, (len(p_values) - rank) * p_values[index]))
        corrected[index] = worst
    return corrected
