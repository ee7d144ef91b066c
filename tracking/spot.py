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

from tracking.spotkernels import ABSENT, AMPLITUDE, FREE, KNOWN, LOG_SIGMA, SHELL, WINDOW, X, Y, fit_window

Plane = NDArray[np.uint8]
Floats32 = NDArray[np.float32]
Floats = NDArray[np.float64]

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
    mode = ABSENT if floor is None else FREE if learn else KNOWN
    known = shell or _VAGUE
    found, p, covariance, scale, explained, beneath = fit_window(
        patch, _NOTHING if floor is None else floor, (left + origin[0], top + origin[1]),
        (x_px - left, y_px - top, sigma_px), free_sigma, mode, known.mean, known.precision, noise,
    )  # fmt: skip
    x, y = float(p[X]) + left, float(p[Y]) + top
    if not found or math.hypot(x - x_px, y - y_px) > 2.0 * max(sigma_px, 2.0):
        return None
    spot = Spot(
        x_px=x,
        y_px=y,
        amplitude=float(p[AMPLITUDE]),
        sigma_px=math.exp(float(p[LOG_SIGMA])),
        var_x_px2=scale * float(covariance[X, X]),
        var_y_px2=scale * float(covariance[Y, Y]),
        snr=float(p[AMPLITUDE]) / math.sqrt(scale * float(covariance[AMPLITUDE, AMPLITUDE])),
        explained=explained,
        beneath=beneath,
    )
    if mode != FREE:
        return spot, None
    # The prior went in as if the residuals were noise; they were found to be ``scale``.
    joint = np.linalg.inv(scale * covariance[SHELL:, SHELL:])
    prior = known.precision * (noise * noise / scale)
    return spot, Evidence(joint @ p[SHELL:] - prior @ known.mean, joint - prior)


_NOTHING = np.zeros((2, 2), dtype=np.float32)
_VAGUE = Shell(VAGUE_SHELL, VAGUE_PRECISION)
