"""The compiled loop that looks light up in an image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lab.base.compiled import compiled

Floats = NDArray[np.float64]


def _sample_plane(
    image: NDArray[np.float32], homography: Floats, x_cm: Floats, y_cm: Floats, offset: float, out: Floats
) -> None:
    height, width = image.shape
    for i in range(x_cm.size):
        x, y = x_cm[i], y_cm[i]
        w = homography[2, 0] * x + homography[2, 1] * y + homography[2, 2]
        u = (homography[0, 0] * x + homography[0, 1] * y + homography[0, 2]) / w
        v = (homography[1, 0] * x + homography[1, 1] * y + homography[1, 2]) / w
        light = 0.0
        # the test is false for NaN too; the image carries a dark rim, so nothing is lost at its edge
        if w > 0 and u >= 0 and v >= 0 and u < width - 1 and v < height - 1:
            column, row = int(u), int(v)
            fu, fv = u - column, v - row
            above = image[row, column] * (1 - fu) + image[row, column + 1] * fu
            below = image[row + 1, column] * (1 - fu) + image[row + 1, column + 1] * fu
            light = above * (1 - fv) + below * fv
        out[i] = offset + light


sample_plane = compiled(error_model="numpy")(_sample_plane)
"""Bilinear light under points of a plane.

``image`` float32 (height, width) with a dark rim of one pixel, ``homography`` (3, 3) from plane cm to the
image's pixels, ``x_cm`` and ``y_cm`` (n,) contiguous; ``offset`` plus the light goes to ``out`` (n,).
"""
