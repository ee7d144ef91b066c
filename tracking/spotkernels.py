"""The fit of ``tracking.spot``, compiled: Levenberg-Marquardt over the pixels of one window.

Parameters, in order: a constant, the spot's amplitude, its place x and y, the logarithm of its radius, and the six of
the shell: share, shift x and y (px), slope x and y, bulge.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lab.base.compiled import compiled

Floats32 = NDArray[np.float32]
Floats = NDArray[np.float64]

# The spot's window in its own radii: beyond it lies less than a percent of the information on its place.
WINDOW = 3.4
_ITERATIONS = 15
_SATURATED = 250.0
# Parameters: what is the spot's own, then what the shell adds.
CONSTANT, AMPLITUDE, X, Y, LOG_SIGMA, SHELL = 0, 1, 2, 3, 4, 5
SHELL_SIZE = 6
_SIZE = SHELL + SHELL_SIZE
# What lies under the spot: something even, a shell that is known, or one to be fitted.
ABSENT, KNOWN, FREE = 0, 1, 2


@compiled(fastmath=True)
def fit_window(
    plane: Floats32,
    floor: Floats32,
    origin: tuple[int, int],
    start: tuple[float, float, float],
    free_sigma: bool,
    shell: int,
    mean: Floats,
    precision: Floats,
    noise: float,
) -> tuple[bool, Floats, Floats, float, float, float]:
    """Fit by Levenberg-Marquardt from ``start`` (x, y, sigma).

    Gives (found, parameters, covariance, error scale, explained, what lies beneath).

    ``origin``: the floor's pixel (x, y) under the plane's first one. ``shell``: one of the three modes above.
    """
    rows, columns = plane.shape
    p = np.zeros(_SIZE)
    covariance = np.zeros((_SIZE, _SIZE))
    x0, y0, sigma0 = start
    reach = max(3.0, WINDOW * sigma0)
    left, right = max(0, math.ceil(x0 - reach)), min(columns - 1, math.floor(x0 + reach))
    top, bottom = max(0, math.ceil(y0 - reach)), min(rows - 1, math.floor(y0 + reach))
    fewest = 30 if shell == FREE else 12
    width, height = right - left + 1, bottom - top + 1
    if width < 3 or height < 3:
        return False, p, covariance, 1.0, 0.0, 0.0
    # The window's pixels, listed; clipped ones say nothing of the shape and are left out while enough are left.
    us, vs, values = np.empty(width * height), np.empty(width * height), np.empty(width * height)
    clipped = 0
    for i in range(top, bottom + 1):
        for j in range(left, right + 1):
            if (j - x0) ** 2 + (i - y0) ** 2 <= reach * reach and plane[i, j] >= _SATURATED:
                clipped += 1
    keep_clipped = clipped > 0.25 * width * height
    n = 0
    rim, rim_count, peak = 0.0, 0, 0.0
    for i in range(top, bottom + 1):
        for j in range(left, right + 1):
            r2 = (j - x0) ** 2 + (i - y0) ** 2
            value = float(plane[i, j])
            if r2 < 2.0:
                peak = max(peak, value)
            if r2 > reach * reach or (value >= _SATURATED and not keep_clipped):
                continue
            us[n], vs[n], values[n] = j, i, value
            n += 1
            if r2 > 0.5 * reach * reach:
                rim += value
                rim_count += 1
    if n < fewest or rim_count == 0:
        return False, p, covariance, 1.0, 0.0, 0.0
    p[X], p[Y], p[LOG_SIGMA] = x0, y0, math.log(sigma0)
    p[SHELL:] = mean
    p[CONSTANT] = rim / rim_count
    p[AMPLITUDE] = max(4.0, peak - p[CONSTANT])
    if shell != ABSENT:
        i, j = (
            min(max(round(y0) + origin[1], 0), len(floor) - 1),
            min(max(round(x0) + origin[0], 0), floor.shape[1] - 1),
        )
        p[CONSTANT] -= mean[0] * floor[i, j]
    free = np.zeros(_SIZE, dtype=np.bool_)
    free[:LOG_SIGMA] = True
    free[LOG_SIGMA] = free_sigma
    free[SHELL:] = shell == FREE
    index = np.flatnonzero(free)
    size = len(index)
    if n < size + 4:
        return False, p, covariance, 1.0, 0.0, 0.0
    damping = 1e-3
    rest = np.empty(n)
    rest_t = np.empty(n)
    prior = precision * (noise * noise)
    normal, gradient, cost = _normal(us, vs, values, n, floor, origin, p, index, shell, mean, prior, rest)
    for _ in range(_ITERATIONS):
        damped = normal.copy()
        for k in range(size):
            damped[k, k] *= 1.0 + damping
        step = _invert(damped) @ gradient
        trial = p.copy()
        for k in range(size):
            trial[index[k]] += step[k]
        trial[LOG_SIGMA] = min(max(trial[LOG_SIGMA], math.log(0.5 * sigma0)), math.log(2.0 * sigma0))
        normal_t, gradient_t, cost_t = _normal(
            us, vs, values, n, floor, origin, trial, index, shell, mean, prior, rest_t
        )
        if cost_t <= cost:
            moved = max(abs(trial[X] - p[X]), abs(trial[Y] - p[Y]))
            shifted = max(abs(trial[SHELL + 1] - p[SHELL + 1]), abs(trial[SHELL + 2] - p[SHELL + 2]))
            p, normal, gradient, cost = trial, normal_t, gradient_t, cost_t
            rest, rest_t = rest_t, rest
            damping = max(damping * 0.1, 1e-9)
            if moved < 1e-3 and shifted < 1e-2:
                break
        else:
            damping *= 10.0
            if damping > 1e6:
                break
        if abs(p[X] - x0) > reach or abs(p[Y] - y0) > reach:
            return False, p, covariance, 1.0, 0.0, 0.0
    if p[AMPLITUDE] <= 0.0:
        return False, p, covariance, 1.0, 0.0, 0.0
    inverse = _invert(normal)
    for k in range(size):
        for m in range(size):
            covariance[index[k], index[m]] = inverse[k, m]
    scale, explained, beneath = _judge(us, vs, values, rest, n, size, p)
    return True, p, covariance, scale, explained, beneath


@compiled(fastmath=True)
def _judge(
    us: Floats, vs: Floats, values: Floats, rest: Floats, n: int, size: int, p: Floats
) -> tuple[float, float, float]:
    """The residuals' variance, the share of the picture's variance the spot explains, and what lies beneath the spot.

    Residuals that belong together (compression, a shell other than the model's) mislead more than noise of the
    same size: what counts is their power at the spot's own scale, seen in sums over blocks of one radius.
    """
    s = math.exp(p[LOG_SIGMA])
    left, top = us[0], vs[0]
    for k in range(n):
        left, top = min(left, us[k]), min(top, vs[k])
    block = max(2.0, s)
    side = int(2.0 * WINDOW * s / block) + 3
    sums, counts = np.zeros((side, side)), np.zeros((side, side))
    cost, bumps = 0.0, 0.0
    under, weight = 0.0, 0.0
    for k in range(n):
        i, j = min(side - 1, int((vs[k] - top) / block)), min(side - 1, int((us[k] - left) / block))
        sums[i, j] += rest[k]
        counts[i, j] += 1.0
        cost += rest[k] * rest[k]
        shape = math.exp(-0.5 * ((us[k] - p[X]) ** 2 + (vs[k] - p[Y]) ** 2) / (s * s))
        bump = p[AMPLITUDE] * shape
        bumps += bump * bump
        under += shape * (values[k] - bump)
        weight += shape
    # Grey levels are whole numbers: a residual below their rounding (variance 1/12) is luck.
    white = max(cost / max(n - size, 1), 1.0 / 12.0)
    power, blocks = 0.0, 0
    for i in range(side):
        for j in range(side):
            if counts[i, j] > 0.5 * block * block:
                power += sums[i, j] ** 2 / counts[i, j]
                blocks += 1
    coarse = power / max(blocks - 0.6 * size, 4.0)
    return max(white, coarse), bumps / (bumps + max(cost, n / 12.0)), under / weight


@compiled(fastmath=True)
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


@compiled(fastmath=True)
def _normal(
    us: Floats,
    vs: Floats,
    values: Floats,
    n: int,
    floor: Floats32,
    origin: tuple[int, int],
    p: Floats,
    index: NDArray[np.int64],
    shell: int,
    mean: Floats,
    prior: Floats,
    rest: Floats,
) -> tuple[Floats, Floats, float]:
    """The normal matrix JᵀJ, the gradient Jᵀr and the cost rᵀr of the model at ``p``; the residuals go to ``rest``."""
    size = len(index)
    s = math.exp(p[LOG_SIGMA])
    x, y, amplitude, constant = p[X], p[Y], p[AMPLITUDE], p[CONSTANT]
    share, shift_x, shift_y = p[SHELL], p[SHELL + 1], p[SHELL + 2]
    slope_x, slope_y, bulge = p[SHELL + 3], p[SHELL + 4], p[SHELL + 5]
    rows, columns = floor.shape
    whole_x, whole_y = math.floor(shift_x), math.floor(shift_y)
    fx, fy = shift_x - whole_x, shift_y - whole_y
    jacobian, jac = np.empty((n, size)), np.zeros(_SIZE)
    cost = 0.0
    jac[CONSTANT] = 1.0
    for k in range(n):
        u, v = (us[k] - x) / s, (vs[k] - y) / s
        r2 = u * u + v * v
        shape = math.exp(-0.5 * r2)
        bump = amplitude * shape
        value = values[k] - constant - bump
        jac[AMPLITUDE] = shape
        jac[X], jac[Y] = bump * u / s, bump * v / s
        jac[LOG_SIGMA] = bump * r2
        if shell != ABSENT:
            j, i = int(us[k] + whole_x) + origin[0], int(vs[k] + whole_y) + origin[1]
            j, i = min(max(j, 0), columns - 2), min(max(i, 0), rows - 2)
            a, b, c, d = floor[i, j], floor[i, j + 1], floor[i + 1, j], floor[i + 1, j + 1]
            light = (1.0 - fy) * ((1.0 - fx) * a + fx * b) + fy * ((1.0 - fx) * c + fx * d)
            shade = 1.0 + slope_x * u + slope_y * v + bulge * r2
            value -= share * light * shade
            jac[SHELL] = light * shade
            jac[SHELL + 1] = share * shade * ((1.0 - fy) * (b - a) + fy * (d - c))
            jac[SHELL + 2] = share * shade * ((1.0 - fx) * (c - a) + fx * (d - b))
            jac[SHELL + 3] = share * light * u
            jac[SHELL + 4] = share * light * v
            jac[SHELL + 5] = share * light * r2
            jac[X] -= share * light * (slope_x + 2.0 * bulge * u) / s
            jac[Y] -= share * light * (slope_y + 2.0 * bulge * v) / s
        rest[k] = value
        cost += value * value
        for m in range(size):
            jacobian[k, m] = jac[index[m]]
    turned = jacobian.T
    normal: Floats = turned @ jacobian
    gradient: Floats = turned @ rest[:n]
    if shell == FREE:
        for m in range(size):
            if index[m] < SHELL:
                continue
            for q in range(size):
                if index[q] < SHELL:
                    continue
                weight = prior[index[m] - SHELL, index[q] - SHELL]
                off = mean[index[q] - SHELL] - p[index[q]]
                normal[m, q] += weight
                gradient[m] += weight * off
                cost += weight * off * (mean[index[m] - SHELL] - p[index[m]])
    return normal, gradient, float(cost)
