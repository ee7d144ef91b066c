"""Robots whose LEDs are off: the balls themselves, as discs that stand out from the empty floor under a still camera.

A ball is brighter than the floor or of another colour; its shadow is only darker, and does not count. The soft mask
of what stands out is matched to a disc with the floor around it, so two balls that touch are two. Then the circle
along which brightness changes most is the ball's outline: light that its shell throws on the floor does not move it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking.background import Background
from tracking.lights import Light
from tracking.pieces import LinkSettings
from tracking.video import VideoFrame

Plane = NDArray[np.uint8]
Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]

_FULL = 24.0  # grey levels over the noise from which a pixel certainly is no floor
_LEAST_FILLED = 0.35  # of the disc, less the part of the ring around it
_LEAST_PX = 6.0
_ROUND = 0.6  # share of its bounding circle that a component must fill to tell the balls' size

# A ball's place wanders by a pixel or two with what its shell shows, and it may start and stop at once.
BALL_LINKS = LinkSettings(place_var_px2=4.0, q_px2_s3=1.0e6, coast_s=0.5, least_frames=8)


def find_balls(frame: VideoFrame, floor: Background, ball_px: float, most: int) -> list[Light]:
    """Find up to ``most`` balls of diameter ``ball_px`` in a frame, the surest first.

    Returns:
        Lights without a hue; the height is how well (0..1) the disc is filled and set off from what is around it.
    """
    mask = _mask(frame, floor)
    radius = ball_px / 2.0
    disc, ring = _disc(radius, 1.35 * radius)
    filled = np.asarray(cv2.filter2D(mask, -1, disc, borderType=cv2.BORDER_REPLICATE), dtype=np.float32)
    around = np.asarray(cv2.filter2D(mask, -1, ring, borderType=cv2.BORDER_REPLICATE), dtype=np.float32)
    # Half of the ring may belong to a neighbour that it touches.
    score = filled - 0.5 * around
    reach = math.floor(0.95 * ball_px)
    slopes = _slopes(frame.luma)
    balls: list[Light] = []
    for _ in range(most):
        _, height, _, (column, row) = cv2.minMaxLoc(score)
        if height < _LEAST_FILLED:
            break
        x, y, _ = _outline(slopes, *_centre(mask, column, row, radius), np.array([radius]))
        balls.append(Light(x, y, float(height), math.nan, math.pi))
        cv2.circle(score, (column, row), reach, (-1.0,), -1)
    return balls


def learn_ball_px(frames: Sequence[VideoFrame], floor: Background) -> float:
    """The balls' diameter in the picture, px: the median of what is round and stands out from the floor; 0: nothing."""
    seen: list[float] = []
    for frame in frames:
        slopes = _slopes(frame.luma)
        solid = (_mask(frame, floor) > 0.5).astype(np.uint8)
        solid = cv2.morphologyEx(solid, cv2.MORPH_CLOSE, np.ones((3, 3), dtype=np.uint8))
        outlines, _ = cv2.findContours(solid, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        for outline in outlines:
            (x, y), radius = cv2.minEnclosingCircle(outline)
            if 2.0 * radius >= _LEAST_PX and cv2.contourArea(outline) > _ROUND * math.pi * radius**2:
                seen.append(2.0 * _outline(slopes, x, y, radius * np.linspace(0.6, 1.1, 21))[2])
    return float(np.median(seen)) if seen else 0.0


def _mask(frame: VideoFrame, floor: Background) -> Floats32:
    """How surely (0..1) each pixel is no floor: brighter than it, or of another colour."""
    size = frame.luma.shape[1], frame.luma.shape[0]
    brighter = cv2.subtract(frame.luma, floor.luma).astype(np.float32) - np.float32(3.0 * floor.noise)
    apart = np.maximum(brighter, 0.0)
    chroma = frame.chroma()
    if chroma is not None and floor.chroma is not None:
        colour = sum(
            cv2.absdiff(one, other).astype(np.float32) for one, other in zip(chroma, floor.chroma, strict=True)
        )
        tinted = np.maximum(np.asarray(colour, dtype=np.float32) - np.float32(6.0 * floor.colour_noise), 0.0)
        apart = apart + 2.0 * np.asarray(cv2.resize(tinted, size, interpolation=cv2.INTER_LINEAR), dtype=np.float32)
    return np.asarray(np.minimum(apart / np.float32(_FULL), 1.0), dtype=np.float32)


def _slopes(luma: Plane) -> tuple[Floats32, Floats32]:
    """Luma's gradient (x, y), each (h, w)."""
    smooth = cv2.GaussianBlur(luma, (0, 0), 1.0)
    across, down = (cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3) for order in ((1, 0), (0, 1)))
    return np.asarray(across, dtype=np.float32), np.asarray(down, dtype=np.float32)


def _outline(slopes: tuple[Floats32, Floats32], x: float, y: float, radii: Floats) -> tuple[float, float, float]:
    """The circle (x, y, radius) near a place across which luma changes most, on the mean of its arc in the picture."""
    rows, columns = slopes[0].shape
    reach = math.ceil(0.25 * float(radii.max()))
    offsets = np.arange(-reach, reach + 1, dtype=float)
    angle = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    # (radius, y offset, x offset, angle)
    at_x = x + offsets[None, None, :, None] + radii[:, None, None, None] * np.cos(angle)
    at_y = y + offsets[None, :, None, None] + radii[:, None, None, None] * np.sin(angle)
    at_x, at_y = np.broadcast_arrays(at_x, at_y)
    inside = (at_x >= 0) & (at_x <= columns - 1) & (at_y >= 0) & (at_y <= rows - 1)
    column = np.clip(np.rint(at_x), 0, columns - 1).astype(np.intp)
    row = np.clip(np.rint(at_y), 0, rows - 1).astype(np.intp)
    across = np.abs(slopes[0][row, column] * np.cos(angle) + slopes[1][row, column] * np.sin(angle))
    change = np.where(inside, across, 0.0).sum(axis=3) / np.maximum(inside.sum(axis=3), 24)
    size, down, along = np.unravel_index(int(np.argmax(change)), change.shape)
    return x + float(offsets[along]), y + float(offsets[down]), float(radii[size])


def _disc(inner: float, outer: float) -> tuple[Floats32, Floats32]:
    """A disc and the ring around it as kernels of sum 1."""
    half = math.ceil(outer)
    rows, columns = np.mgrid[-half : half + 1, -half : half + 1]
    away = np.hypot(rows, columns)
    disc = (away <= inner).astype(np.float32)
    ring = ((away > inner) & (away <= outer)).astype(np.float32)
    return disc / disc.sum(), ring / ring.sum()


def _centre(mask: Floats32, column: int, row: int, radius: float) -> tuple[float, float]:
    """Centroid of the mask within the ball's reach, which follows it."""
    x, y = float(column), float(row)
    half = math.ceil(radius)
    for _ in range(2):
        left, top = max(0, round(x) - half), max(0, round(y) - half)
        window = mask[top : round(y) + half + 1, left : round(x) + half + 1]
        rows = np.arange(top, top + window.shape[0], dtype=float)
        columns = np.arange(left, left + window.shape[1], dtype=float)
        weight = window * (np.hypot(rows[:, None] - y, columns - x) <= radius + 1.0)
        total = float(weight.sum())
        if total <= 0.0:
            break
        x, y = float(weight.sum(axis=0) @ columns) / total, float(weight.sum(axis=1) @ rows) / total
    return x, y
