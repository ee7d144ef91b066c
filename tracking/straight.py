"""The straight line through a run's frames, which reflections and lost LEDs cannot pull away."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

TUKEY = 4.685  # 95 % efficiency on Gaussian residuals
FINEST_CM = 0.02  # no camera here is better: keeps the weights finite on noiseless tracks
_STARTS = 64
_ROUNDS = 12


@dataclass(frozen=True, slots=True, eq=False)
class Straight:
    """A line through frames: a point on it, the unit vector of travel, residuals (n,) and their scale."""

    point_cm: Floats
    along: Floats
    residual_cm: Floats
    scale_cm: float


def straight_through(xy_cm: Floats, weight: Floats) -> Straight:
    """Weighted total least squares with Tukey's biweight, from the best of many two-point lines.

    The start is the line through two frames half a run apart with the least median residual (Rousseeuw 1984),
    so up to half of the frames may lie anywhere.
    """
    xy = xy_cm
    half = max(len(xy) // 2, 1)
    first = np.unique(np.linspace(0, len(xy) - half - 1, _STARTS).astype(int))
    chord = xy[first + half] - xy[first]
    size = np.hypot(chord[:, 0], chord[:, 1])
    chord[size == 0] = (1.0, 0.0)
    chord /= np.where(size == 0, 1.0, size)[:, None]
    off = (xy[None, :, 1] - xy[first, None, 1]) * chord[:, :1] - (xy[None, :, 0] - xy[first, None, 0]) * chord[:, 1:]
    best = int(np.argmin(np.where(size == 0, np.inf, np.median(np.abs(off), axis=1))))
    point, along, residual = xy[first[best]], chord[best], np.asarray(off[best], dtype=float)
    scale = FINEST_CM
    for _ in range(_ROUNDS):
        scale = max(1.4826 * float(np.median(np.abs(residual))), FINEST_CM)
        pull = weight * np.clip(1.0 - (residual / (TUKEY * scale)) ** 2, 0.0, None) ** 2
        point = np.average(xy, axis=0, weights=pull)
        centred = xy - point
        _, vectors = np.linalg.eigh((centred * pull[:, None]).T @ centred)
        turned = np.asarray(vectors[:, 1], dtype=float)
        settled = abs(float(along @ turned)) > 1 - 1e-14
        along = turned
        residual = centred[:, 1] * along[0] - centred[:, 0] * along[1]
        if settled:
            break
    progress = (xy - point) @ along
    if float(np.median(progress[half:]) - np.median(progress[: len(xy) - half])) < 0:
        along, residual = -along, -residual
    return Straight(np.asarray(point, dtype=float), along, residual, scale)
