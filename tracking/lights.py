"""The lights on the floor, all of them at once, to a pixel or so: where, how bright, of what colour.

An LED's colour is the angle of its step in (U, V), which neither its brightness nor the white light beneath it
changes. Where a film has no colour, or its LEDs have none, lights are found in luma and have no hue.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking.background import Background, background_from
from tracking.led import find_peaks
from tracking.video import VideoFrame

Plane = NDArray[np.uint8]
Floats32 = NDArray[np.float32]
Chroma = tuple[Plane, Plane]

_SIGMA_PX = 1.5  # of a spot in the colour planes; a matched filter forgives half or twice as much
_LEAST_COLOUR = 4.0  # grey levels
_LEAST_LUMA = 8.0
_LEAST_SNR = 6.0
_REACH_PX = 7  # two lights are farther apart, colour pixels: the balls see to it
_RAYLEIGH_MEDIAN = 1.177  # of a magnitude whose two parts have variance 1
_HUE_SIGMA_RAD = 0.1  # how much a hue wanders with clipping and the floor beneath


@dataclass(frozen=True, slots=True)
class Light:
    """One light in one frame: its place in luma pixels, its height in grey levels, its hue with its error (rad).

    The hue is the angle in the (U, V) plane, NaN where colour does not tell.
    """

    x_px: float
    y_px: float
    height: float
    hue_rad: float
    hue_sigma_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class LitFloor:
    """The floor without its lights, and how much stands out from it.

    ``noise``: of the matched response of U and V away from lights; NaN where lights are not told by colour.
    """

    background: Background
    noise: float

    @property
    def in_colour(self) -> bool:
        """Whether lights are told by their colour."""
        return math.isfinite(self.noise)


def learn_floor(
    frames: Sequence[VideoFrame], *, coloured: bool = False, background: Background | None = None
) -> LitFloor:
    """Learn the floor from frames spread over a film of a still scene.

    Of each pixel's colours in the samples the one most like the floor's at large is taken, so that a light melts into
    the floor only where it shines at one place in every sample.

    Args:
        frames: the samples.
        coloured: the LEDs are known to have colours; else colour is used where it stands out in a third of the samples.
        background: the empty floor, where it is known already.
    """
    floor = background if background is not None else background_from(frames)
    chromas = [chroma for frame in frames if (chroma := frame.chroma()) is not None]
    if not chromas or len(chromas) < len(frames):
        return LitFloor(floor, math.nan)
    unlit = _unlit([chroma[0] for chroma in chromas]), _unlit([chroma[1] for chroma in chromas])
    sizes = [float(np.median(_response(chroma, unlit)[2])) for chroma in chromas]
    noise = max(0.1, float(np.median(sizes)) / _RAYLEIGH_MEDIAN)
    lit = sum(bool(_find_coloured(chroma, unlit, noise, 1)) for chroma in chromas)
    known = coloured or 3 * lit >= len(chromas)
    return LitFloor(replace(floor, chroma=unlit), noise if known else math.nan)


def _unlit(planes: Sequence[Plane]) -> Plane:
    stack = np.stack(planes).astype(np.int16)
    away = np.abs(stack - np.int16(np.median(stack[:, ::4, ::4])))
    return np.take_along_axis(stack, away.argmin(axis=0)[None], axis=0)[0].astype(np.uint8)


def find_lights(frame: VideoFrame, floor: LitFloor, most: int) -> list[Light]:
    """Find up to ``most`` lights in a frame, the strongest first."""
    beneath = floor.background.chroma
    if floor.in_colour and beneath is not None:
        chroma = frame.chroma()
        return [] if chroma is None else _find_coloured(chroma, beneath, floor.noise, most)
    luma, still = (np.ascontiguousarray(plane[::2, ::2]) for plane in (frame.luma, floor.background.luma))
    least = max(_LEAST_LUMA, 3.0 * floor.background.noise)
    peaks = find_peaks(luma, still, _SIGMA_PX, count=most)
    return [Light(2.0 * x, 2.0 * y, height, math.nan, math.pi) for x, y, height in peaks if height > least]


def _response(chroma: Chroma, floor: Chroma) -> tuple[Floats32, Floats32, Floats32]:
    """Matched responses of U and V, and their magnitude; a drift of the white balance is taken off."""
    steps: list[Floats32] = []
    for plane, beneath in zip(chroma, floor, strict=True):
        difference = cv2.subtract(plane, beneath, dtype=cv2.CV_32F)
        matched = np.asarray(cv2.GaussianBlur(difference, (0, 0), 0.8 * _SIGMA_PX), dtype=np.float32)
        matched -= np.median(matched[::8, ::8])
        steps.append(matched)
    return steps[0], steps[1], np.asarray(cv2.magnitude(steps[0], steps[1]), dtype=np.float32)


def _find_coloured(chroma: Chroma, floor: Chroma, noise: float, most: int) -> list[Light]:
    step_u, step_v, size = _response(chroma, floor)
    least = max(_LEAST_COLOUR, _LEAST_SNR * noise)
    left = size.copy()
    lights: list[Light] = []
    for _ in range(most):
        _, height, _, (column, row) = cv2.minMaxLoc(left)
        if height < least:
            break
        x, y = _centre(size, column, row)
        hue = math.atan2(float(step_v[row, column]), float(step_u[row, column]))
        # A colour pixel j stands for the luma pixels 2 j and 2 j + 1.
        lights.append(Light(2.0 * x + 0.5, 2.0 * y + 0.5, height, hue, math.hypot(_HUE_SIGMA_RAD, noise / height)))
        left[max(0, row - _REACH_PX) : row + _REACH_PX + 1, max(0, column - _REACH_PX) : column + _REACH_PX + 1] = 0.0
    return lights


def _centre(size: Floats32, column: int, row: int) -> tuple[float, float]:
    """Centroid of what rises above half of the peak."""
    left, top = max(0, column - 3), max(0, row - 3)
    window = size[top : row + 4, left : column + 4].astype(np.float64)
    weight = np.maximum(window - 0.5 * float(size[row, column]), 0.0)
    total = float(weight.sum())
    columns, rows = np.arange(weight.shape[1], dtype=float), np.arange(weight.shape[0], dtype=float)
    return left + float(weight.sum(axis=0) @ columns) / total, top + float(weight.sum(axis=1) @ rows) / total
