"""Where the LED is in a patch of the picture, to a fraction of a pixel, and where to look for it.

The spot is fitted by least squares together with what lies under it: a constant plus the picture of the empty floor
times a free factor, since the ball hides or dims the projected light beneath it. The estimate of the position reaches
the Cramér-Rao bound of about 0.80 / SNR pixels for a spot of sigma 3 px (SNR = peak over pixel noise), and its
covariance comes from the fit's own residuals, so that a bad fit says that it is bad.
"""

# numba's decorators carry no types: the functions behind them are typed here by hand.
# pyright: reportUnknownMemberType=false, reportUntypedFunctionDecorator=false, reportMissingTypeStubs=false
from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

Plane = NDArray[np.uint8]
Floats32 = NDArray[np.float32]
Floats = NDArray[np.float64]

_ITERATIONS = 12
_SATURATED = 250.0
# A prior on how much of the floor's picture shows on the ball: 0.5 ± 1. It only matters where the floor is flat
# and the factor cannot be told from the constant.
_FLOOR_SHARE, _FLOOR_SHARE_PRECISION = 0.5, 1.0


@dataclass(frozen=True, slots=True)
class Spot:
    """A fitted spot, in the pixels of the plane it was fitted in.

    ``amplitude``: height over what lies beneath (grey levels); ``sigma_px``: its radius; ``var_x_px2`` and
    ``var_y_px2``: variances of the position; ``snr``: amplitude over its own standard error; ``explained``: share
    (0..1) of what the floor alone leaves unexplained that the spot explains.
    """

    x_px: float
    y_px: float
    amplitude: float
    sigma_px: float
    var_x_px2: float
    var_y_px2: float
    snr: float
    explained: float


def fit_spot(
    plane: Plane, floor: Plane, x_px: float, y_px: float, sigma_px: float, *, free_sigma: bool = False
) -> Spot | None:
    """Fit a Gaussian spot near (``x_px``, ``y_px``).

    Args:
        plane: (h, w) the frame's plane.
        floor: (h, w) the same plane of the empty floor.
        x_px: where to begin; the patch of ±4 sigma about it is fitted.
        y_px: likewise.
        sigma_px: the spot's radius, or with ``free_sigma`` a first guess at it (0.6 to 1.7 times is in reach).
        free_sigma: fit the radius too.

    Returns:
        The spot, or None where none is found within 2 sigma of the start or the patch leaves the picture by
        more than half.
    """
    rows, columns = plane.shape
    half = max(4, math.ceil(4.0 * sigma_px))
    column, row = round(x_px), round(y_px)
    if not (0 <= column < columns and 0 <= row < rows):
        return None
    left, right = max(0, column - half), min(columns, column + half + 1)
    top, bottom = max(0, row - half), min(rows, row + half + 1)
    seen = plane[top:bottom, left:right].astype(np.float32)
    beneath = floor[top:bottom, left:right].astype(np.float32)
    x, y, amplitude, sigma, var_x, var_y, snr, explained = _fit(
        seen, beneath, x_px - left, y_px - top, sigma_px, free_sigma
    )
    if not explained > 0.0 or math.hypot(x + left - x_px, y + top - y_px) > 2.0 * max(sigma_px, 2.0):
        return None
    return Spot(x + left, y + top, amplitude, sigma, var_x, var_y, snr, explained)


@njit(cache=True)
def _fit(
    seen: Floats32, beneath: Floats32, x0: float, y0: float, sigma0: float, free_sigma: bool
) -> tuple[float, float, float, float, float, float, float, float]:
    """Levenberg-Marquardt on (constant, floor's share, amplitude, x, y, ln sigma); explained = 0 where it fails."""
    failed = (x0, y0, 0.0, sigma0, 1.0, 1.0, 0.0, 0.0)
    rows, columns = seen.shape
    size = 6 if free_sigma else 5
    weights = np.ones((rows, columns), dtype=np.float32)
    # Clipped pixels say nothing of the shape: leave them out, as long as enough are left.
    clipped = 0
    for i in range(rows):
        for j in range(columns):
            if seen[i, j] >= _SATURATED:
                weights[i, j] = 0.0
                clipped += 1
    if clipped > rows * columns // 4:
        weights[:] = 1.0
    count = 0.0
    mean_floor = 0.0
    for i in range(rows):
        for j in range(columns):
            count += weights[i, j]
            mean_floor += weights[i, j] * beneath[i, j]
    mean_floor /= count
    if count < 3 * size:
        return failed
    # What the floor alone leaves: two unknowns, in closed form, the floor's share held by its prior.
    sff, sfs, ssum = 0.0, 0.0, 0.0
    for i in range(rows):
        for j in range(columns):
            f = beneath[i, j] - mean_floor
            sff += weights[i, j] * f * f
            sfs += weights[i, j] * f * seen[i, j]
            ssum += weights[i, j] * seen[i, j]
    share = (sfs + _FLOOR_SHARE * _FLOOR_SHARE_PRECISION) / (sff + _FLOOR_SHARE_PRECISION)
    constant = ssum / count
    without = 0.0
    for i in range(rows):
        for j in range(columns):
            rest = seen[i, j] - constant - share * (beneath[i, j] - mean_floor)
            without += weights[i, j] * rest * rest
    if without <= 0.0:
        return failed
    ci, cj = min(max(round(y0), 0), rows - 1), min(max(round(x0), 0), columns - 1)
    start = max(4.0, seen[ci, cj] - constant)
    p = np.array([constant, share, start, x0, y0, math.log(sigma0)])
    damping = 1e-3
    normal, gradient, cost = _normal(seen, beneath, weights, mean_floor, p, size)
    for _ in range(_ITERATIONS):
        damped = normal.copy()
        for k in range(size):
            damped[k, k] *= 1.0 + damping
        inverse = _invert(damped)
        trial = p.copy()
        for k in range(size):
            for m in range(size):
                trial[k] += inverse[k, m] * gradient[m]
        trial[5] = min(max(trial[5], math.log(0.5 * sigma0)), math.log(2.0 * sigma0))
        normal_t, gradient_t, cost_t = _normal(seen, beneath, weights, mean_floor, trial, size)
        if cost_t <= cost:
            moved = max(abs(trial[3] - p[3]), abs(trial[4] - p[4]))
            p, normal, gradient, cost = trial, normal_t, gradient_t, cost_t
            damping = max(damping * 0.1, 1e-9)
            if moved < 1e-4:
                break
        else:
            damping *= 10.0
            if damping > 1e6:
                break
        if abs(p[3] - x0) > columns or abs(p[4] - y0) > rows:
            return failed
    if p[2] <= 0.0:
        return failed
    # Grey levels are whole numbers: a residual below their rounding (variance 1/12) is luck.
    variance = max(cost / max(count - size, 1.0), 1.0 / 12.0)
    inverse = _invert(normal)
    error = math.sqrt(variance * inverse[2, 2])
    return (
        p[3],
        p[4],
        p[2],
        math.exp(p[5]),
        variance * inverse[3, 3],
        variance * inverse[4, 4],
        p[2] / error,
        max(0.0, 1.0 - cost / without),
    )


@njit(cache=True)
def _invert(matrix: Floats) -> Floats:
    """Invert a small positive definite matrix by Gauss-Jordan; no pivots needed, and no library to compile in."""
    size = len(matrix)
    left = matrix.copy()
    right = np.zeros((size, size))
    for k in range(size):
        right[k, k] = 1.0
    for k in range(size):
        pivot = left[k, k]
        if not pivot > 0.0:
            pivot = 1e-30
        for m in range(size):
            left[k, m] /= pivot
            right[k, m] /= pivot
        for i in range(size):
            if i != k:
                factor = left[i, k]
                for m in range(size):
                    left[i, m] -= factor * left[k, m]
                    right[i, m] -= factor * right[k, m]
    return right


@njit(cache=True)
def _normal(
    seen: Floats32, beneath: Floats32, weights: Floats32, mean_floor: float, p: Floats, size: int
) -> tuple[Floats, Floats, float]:
    """The normal matrix JᵀJ, the gradient Jᵀr and the cost rᵀr of the spot model at ``p``."""
    rows, columns = seen.shape
    constant, share, amplitude, x, y = p[0], p[1], p[2], p[3], p[4]
    s2 = math.exp(2.0 * p[5])
    across = np.empty(columns)
    for j in range(columns):
        across[j] = math.exp(-0.5 * (j - x) ** 2 / s2)
    normal = np.zeros((size, size))
    gradient = np.zeros(size)
    jac = np.empty(6)
    cost = 0.0
    for i in range(rows):
        dy = i - y
        down = math.exp(-0.5 * dy * dy / s2)
        for j in range(columns):
            if weights[i, j] == 0.0:
                continue
            dx = j - x
            shape = across[j] * down
            bump = amplitude * shape
            floor = beneath[i, j] - mean_floor
            rest = seen[i, j] - constant - share * floor - bump
            jac[0], jac[1], jac[2] = 1.0, floor, shape
            jac[3], jac[4] = bump * dx / s2, bump * dy / s2
            jac[5] = bump * (dx * dx + dy * dy) / s2
            for k in range(size):
                gradient[k] += jac[k] * rest
                for m in range(k + 1):
                    normal[k, m] += jac[k] * jac[m]
            cost += rest * rest
    gradient[1] += _FLOOR_SHARE_PRECISION * (_FLOOR_SHARE - share)
    normal[1, 1] += _FLOOR_SHARE_PRECISION
    cost += _FLOOR_SHARE_PRECISION * (_FLOOR_SHARE - share) ** 2
    for k in range(size):
        for m in range(k):
            normal[m, k] = normal[k, m]
    return normal, gradient, cost


def find_peaks(
    plane: Plane,
    floor: Plane,
    sigma_px: float,
    *,
    count: int = 1,
    near: tuple[float, float] | None = None,
    prior_sigma_px: float = 10.0,
) -> list[tuple[float, float, float]]:
    """Find where a spot may be: maxima of the difference to the floor, made locally high-pass.

    The difference is matched to the spot (smoothed by its own radius) less its surroundings, so that the ball
    and its shadow, which are wide, do not count.

    Args:
        plane: (h, w) the frame's plane, or a box of it.
        floor: (h, w) likewise of the empty floor.
        sigma_px: the spot's radius.
        count: at most how many.
        near: (x, y) where it is expected; the response is weighted by a Gaussian about it.
        prior_sigma_px: that Gaussian's radius.

    Returns:
        (x, y, response in grey levels), the strongest first; pixels of ``plane``.
    """
    difference = cv2.subtract(plane, floor, dtype=cv2.CV_32F)
    matched = cv2.GaussianBlur(difference, (0, 0), max(0.6, 0.8 * sigma_px))
    around = cv2.blur(difference, (2 * math.ceil(3.0 * sigma_px) + 1,) * 2)
    response = np.asarray(cv2.subtract(matched, around), dtype=np.float32)
    if near is not None:
        columns = np.arange(plane.shape[1], dtype=np.float32) - near[0]
        rows = np.arange(plane.shape[0], dtype=np.float32) - near[1]
        spread = 2.0 * prior_sigma_px**2
        response *= np.exp(-columns * columns / spread) * np.exp(-rows * rows / spread)[:, None]
    reach = math.ceil(4.0 * sigma_px)
    peaks: list[tuple[float, float, float]] = []
    for _ in range(count):
        _, highest, _, (x, y) = cv2.minMaxLoc(response)
        if highest <= 0.0:
            break
        peaks.append((float(x), float(y), float(highest)))
        response[max(0, y - reach) : y + reach + 1, max(0, x - reach) : x + reach + 1] = 0.0
    return peaks


@dataclass(frozen=True, slots=True)
class LedLevels:
    """How bright the LED shines: the median amplitudes of its two levels and the threshold between (grey levels).

    ``low`` is 0 where only one level was seen: then the LED is taken as on wherever it is seen.
    """

    low: float
    high: float
    threshold: float


def learn_levels(amplitudes: NDArray[np.float64], *, apart: float = 2.0) -> LedLevels:
    """Learn the LED's two levels from all amplitudes of a track, by Otsu's threshold on their logarithms.

    The two count as two only if their medians are at least ``apart`` times each other and lie at least three of
    the larger one's standard deviations apart; each must hold 1 % of the frames.
    """
    known = amplitudes[np.isfinite(amplitudes) & (amplitudes > 0)]
    if len(known) == 0:
        return LedLevels(0.0, 0.0, 0.0)
    logs = np.sort(np.log(known))
    single = LedLevels(0.0, float(np.median(known)), 0.0)
    n = len(logs)
    fewest = max(2, math.ceil(0.01 * n))
    if n < 2 * fewest:
        return single
    cut = np.arange(fewest, n - fewest + 1)
    below = np.cumsum(logs)[cut - 1]
    total = float(logs.sum())
    # Otsu (1979): maximise the variance between the classes.
    between = (below / cut - (total - below) / (n - cut)) ** 2 * cut * (n - cut)
    split = int(cut[int(np.argmax(between))])
    dim, bright = logs[:split], logs[split:]
    gap = float(np.median(bright) - np.median(dim))
    if gap < math.log(apart) or gap < 3.0 * float(_spread(bright)):
        return single
    low, high = math.exp(float(np.median(dim))), math.exp(float(np.median(bright)))
    # Half way between the levels: the frame in which it switched goes to the level it held for longer.
    return LedLevels(low, high, 0.5 * (low + high))


def _spread(values: NDArray[np.float64]) -> float:
    """Standard deviation, estimated from the median absolute deviation."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))
