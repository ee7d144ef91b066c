"""Where a spot may be: maxima of a picture's difference to the empty floor."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.uint8] | NDArray[np.float32]


def find_peaks(
    plane: Values,
    floor: Values,
    sigma_px: float,
    *,
    count: int = 1,
    near: tuple[float, float] | None = None,
    prior_sigma_px: float = 10.0,
    least: float = 0.0,
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
        least: a response that is no higher is no peak.

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
        if highest <= least:
            break
        peaks.append((float(x), float(y), float(highest)))
        response[max(0, y - reach) : y + reach + 1, max(0, x - reach) : x + reach + 1] = 0.0
    return peaks
