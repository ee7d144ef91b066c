"""Where the LED's spot is in a patch of the picture, to a fraction of a pixel, with an honest error.

The spot sits on a ball, and the ball hides the floor: what lies under the spot is not the background but the ball's
own shell, lit by the same projector. A plane of a pixel p about a spot at q is modelled as

    constant + share * floor(p + shift) * (1 + slope . u + bulge * u . u) + amplitude * exp(-u . u / 2)

with u = (p - q) / sigma. ``share`` is how bright the shell is against the floor. ``shift``: the light that falls on the
ball at p, some cm above the floor and seen from aside, is the light of another place of the floor. ``slope`` and
``bulge`` are the shading of the sphere. All six change smoothly over the picture and are learnt as the robot moves
(``tracking.shell``); what is known of them enters as a prior, so that where the floor is flat they cost little, and
where an edge of the projected shape runs under the spot they keep it from being pulled there.

Without those the position reaches the Cramér-Rao bound: with independent noise of sigma n per pixel, the Fisher
information on x is the sum of (dG/dx)² / n² = pi / 2 (amplitude / n)² for any radius well above a pixel, hence an
error of sqrt(2 / pi) / SNR = 0.80 / SNR pixels per axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lab.base.compiled import compiled

Plane = NDArray[np.uint8]
Floats32 = NDArray[np.float32]
Floats = NDArray[np.float64]

# The spot's window in its own radii: beyond it lies less than a percent of the information on its place.
WINDOW = 3.4
_ITERATIONS = 15
_SATURATED = 250.0
# Parameters: what is the spot's own, then what the shell adds.
_CONSTANT, _AMPLITUDE, _X, _Y, _LOG_SIGMA, _SHELL = 0, 1, 2, 3, 4, 5
SHELL_SIZE = 6
_SIZE = _SHELL + SHELL_SIZE
# What lies under the spot: something even, a shell that is known, or one to be fitted.
_ABSENT, _KNOWN, _FREE = 0, 1, 2
# Share, shift x, shift y (px), slope x, slope y, bulge: nothing known but that a shell is dimmer than the floor.
VAGUE_SHELL = np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
VAGUE_PRECISION = np.diag([4.0, 1 / 16.0, 1 / 16.0, 1 / 0.03**2, 1 / 0.03**2, 1 / 0.03**2])


@dataclass(frozen=True, slots=True)
class Spot:
    """A fitted spot, in the pixels of the plane it was fitted in.

    ``amplitude``: height over what lies beneath (grey levels); ``sigma_px``: its radius; ``var_x_px2`` and
    ``var_y_px2``: variances of the position; ``snr``: amplitude over its own standard error; ``explained``: share
    (0..1) of what a flat patch leaves unexplained near the spot that the spot explains; ``beneath``: what is left of
    the picture under the spot without it (grey levels).
    """

    x_px: float
    y_px: float
    amplitude: float
    sigma_px: float
    var_x_px2: float
    var_y_px2: float
    snr: float
    explained: float
    beneath: float


@dataclass(frozen=True, slots=True, eq=False)
class Shell:
    """What is known of the shell under a spot: ``mean`` (6,) and ``precision`` (6, 6), order as in VAGUE_SHELL."""

    mean: Floats
    precision: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What one patch alone says of the shell: ``precision`` (6, 6), singular as a rule, and precision times mean."""

    weighted: Floats
    precision: Floats


@compiled(fastmath=True)
def _fit(
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

    ``origin``: the floor's pixel (x, y) under the plane's first one. ``shell``: one of the three modes below.
    """
    rows, columns = plane.shape
    p = np.zeros(_SIZE)
    covariance = np.zeros((_SIZE, _SIZE))
    x0, y0, sigma0 = start
    reach = max(3.0, WINDOW * sigma0)
    left, right = max(0, math.ceil(x0 - reach)), min(columns - 1, math.floor(x0 + reach))
    top, bottom = max(0, math.ceil(y0 - reach)), min(rows - 1, math.floor(y0 + reach))
    fewest = 30 if shell == _FREE else 12
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
    p[_X], p[_Y], p[_LOG_SIGMA] = x0, y0, math.log(sigma0)
    p[_SHELL:] = mean
    p[_CONSTANT] = rim / rim_count
    p[_AMPLITUDE] = max(4.0, peak - p[_CONSTANT])
    if shell != _ABSENT:
        i, j = (
            min(max(round(y0) + origin[1], 0), len(floor) - 1),
            min(max(round(x0) + origin[0], 0), floor.shape[1] - 1),
        )
        p[_CONSTANT] -= mean[0] * floor[i, j]
    free = np.zeros(_SIZE, dtype=np.bool_)
    free[:_LOG_SIGMA] = True
    free[_LOG_SIGMA] = free_sigma
    free[_SHELL:] = shell == _FREE
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
        trial[_LOG_SIGMA] = min(max(trial[_LOG_SIGMA], math.log(0.5 * sigma0)), math.log(2.0 * sigma0))
        normal_t, gradient_t, cost_t = _normal(
            us, vs, values, n, floor, origin, trial, index, shell, mean, prior, rest_t
        )
        if cost_t <= cost:
            moved = max(abs(trial[_X] - p[_X]), abs(trial[_Y] - p[_Y]))
            shifted = max(abs(trial[_SHELL + 1] - p[_SHELL + 1]), abs(trial[_SHELL + 2] - p[_SHELL + 2]))
            p, normal, gradient, cost = trial, normal_t, gradient_t, cost_t
            rest, rest_t = rest_t, rest
            damping = max(damping * 0.1, 1e-9)
            if moved < 1e-3 and shifted < 1e-2:
                break
        else:
            damping *= 10.0
            if damping > 1e6:
                break
        if abs(p[_X] - x0) > reach or abs(p[_Y] - y0) > reach:
            return False, p, covariance, 1.0, 0.0, 0.0
    if p[_AMPLITUDE] <= 0.0:
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
    s = math.exp(p[_LOG_SIGMA])
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
        shape = math.exp(-0.5 * ((us[k] - p[_X]) ** 2 + (vs[k] - p[_Y]) ** 2) / (s * s))
        bump = p[_AMPLITUDE] * shape
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
    s = math.exp(p[_LOG_SIGMA])
    x, y, amplitude, constant = p[_X], p[_Y], p[_AMPLITUDE], p[_CONSTANT]
    share, shift_x, shift_y = p[_SHELL], p[_SHELL + 1], p[_SHELL + 2]
    slope_x, slope_y, bulge = p[_SHELL + 3], p[_SHELL + 4], p[_SHELL + 5]
    rows, columns = floor.shape
    whole_x, whole_y = math.floor(shift_x), math.floor(shift_y)
    fx, fy = shift_x - whole_x, shift_y - whole_y
    jacobian, jac = np.empty((n, size)), np.zeros(_SIZE)
    cost = 0.0
    jac[_CONSTANT] = 1.0
    for k in range(n):
        u, v = (us[k] - x) / s, (vs[k] - y) / s
        r2 = u * u + v * v
        shape = math.exp(-0.5 * r2)
        bump = amplitude * shape
        value = values[k] - constant - bump
        jac[_AMPLITUDE] = shape
        jac[_X], jac[_Y] = bump * u / s, bump * v / s
        jac[_LOG_SIGMA] = bump * r2
        if shell != _ABSENT:
            j, i = int(us[k] + whole_x) + origin[0], int(vs[k] + whole_y) + origin[1]
            j, i = min(max(j, 0), columns - 2), min(max(i, 0), rows - 2)
            a, b, c, d = floor[i, j], floor[i, j + 1], floor[i + 1, j], floor[i + 1, j + 1]
            light = (1.0 - fy) * ((1.0 - fx) * a + fx * b) + fy * ((1.0 - fx) * c + fx * d)
            shade = 1.0 + slope_x * u + slope_y * v + bulge * r2
            value -= share * light * shade
            jac[_SHELL] = light * shade
            jac[_SHELL + 1] = share * shade * ((1.0 - fy) * (b - a) + fy * (d - c))
            jac[_SHELL + 2] = share * shade * ((1.0 - fx) * (c - a) + fx * (d - b))
            jac[_SHELL + 3] = share * light * u
            jac[_SHELL + 4] = share * light * v
            jac[_SHELL + 5] = share * light * r2
            jac[_X] -= share * light * (slope_x + 2.0 * bulge * u) / s
            jac[_Y] -= share * light * (slope_y + 2.0 * bulge * v) / s
        rest[k] = value
        cost += value * value
        for m in range(size):
            jacobian[k, m] = jac[index[m]]
    turned = jacobian.T
    normal: Floats = turned @ jacobian
    gradient: Floats = turned @ rest[:n]
    if shell == _FREE:
        for m in range(size):
            if index[m] < _SHELL:
                continue
            for q in range(size):
                if index[q] < _SHELL:
                    continue
                weight = prior[index[m] - _SHELL, index[q] - _SHELL]
                off = mean[index[q] - _SHELL] - p[index[q]]
                normal[m, q] += weight
                gradient[m] += weight * off
                cost += weight * off * (mean[index[m] - _SHELL] - p[index[m]])
    return normal, gradient, float(cost)


def fit_spot(
    plane: Plane | Floats32,
    x_px: float,
    y_px: float,
    sigma_px: float,
    *,
    free_sigma: bool = False,
    floor: Floats32 | None = None,
    shell: Shell | None = None,
    learn: bool = True,
    noise: float = 1.0,
    origin: tuple[int, int] = (0, 0),
) -> tuple[Spot, Evidence | None] | None:
    """Fit a Gaussian spot near (``x_px``, ``y_px``).

    Args:
        plane: (h, w) the frame's plane, or a piece of it.
        x_px: where to begin; the disc of ``WINDOW`` radii about it is fitted.
        y_px: likewise.
        sigma_px: the spot's radius, or with ``free_sigma`` a first guess at it (0.6 to 1.7 times is in reach).
        free_sigma: fit the radius too.
        floor: the light of the whole empty floor over black; None where the patch lies on something even.
        shell: what is known of the shell under the spot, by default next to nothing.
        learn: fit the shell too; else it is taken as known for sure.
        noise: standard deviation of a pixel, grey levels; it weighs the prior ``shell`` against the picture.
        origin: the floor's pixel (x, y) under the plane's first one.

    Returns:
        The spot in pixels of ``plane``, and what the patch by itself says of the shell (None where that was not asked).
        None where no spot is found within 2 sigma of the start or the picture ends too near.
    """
    rows, columns = plane.shape
    column, row = round(x_px), round(y_px)
    if not (0 <= column < columns and 0 <= row < rows):
        return None
    half = math.ceil(WINDOW * sigma_px) + 1
    left, top = max(0, column - half), max(0, row - half)
    patch = plane[top : row + half + 1, left : column + half + 1].astype(np.float32)
    mode = _ABSENT if floor is None else _FREE if learn else _KNOWN
    known = shell or _VAGUE
    found, p, covariance, scale, explained, beneath = _fit(
        patch, _NOTHING if floor is None else floor, (left + origin[0], top + origin[1]),
        (x_px - left, y_px - top, sigma_px), free_sigma, mode, known.mean, known.precision, noise,
    )  # fmt: skip
    x, y = float(p[_X]) + left, float(p[_Y]) + top
    if not found or math.hypot(x - x_px, y - y_px) > 2.0 * max(sigma_px, 2.0):
        return None
    spot = Spot(
        x_px=x,
        y_px=y,
        amplitude=float(p[_AMPLITUDE]),
        sigma_px=math.exp(float(p[_LOG_SIGMA])),
        var_x_px2=scale * float(covariance[_X, _X]),
        var_y_px2=scale * float(covariance[_Y, _Y]),
        snr=float(p[_AMPLITUDE]) / math.sqrt(scale * float(covariance[_AMPLITUDE, _AMPLITUDE])),
        explained=explained,
        beneath=beneath,
    )
    if mode != _FREE:
        return spot, None
    # The prior went in as if the residuals were noise; they were found to be ``scale``.
    joint = np.linalg.inv(scale * covariance[_SHELL:, _SHELL:])
    prior = known.precision * (noise * noise / scale)
    return spot, Evidence(joint @ p[_SHELL:] - prior @ known.mean, joint - prior)


_NOTHING = np.zeros((2, 2), dtype=np.float32)
_VAGUE = Shell(VAGUE_SHELL, VAGUE_PRECISION)
