"""The empty floor: what the camera sees where no robot is, and whether the camera stands still.

The floor is the pixelwise median of samples spread over the film. A robot that rests for most of it would melt into
it. Its LED gives it away: where the floor shows a small bright spot that a sample lacks, and the robot of that sample
is not there to hide it, a robot has melted in, and the floor about it is taken from the samples without the spot. A
robot that neither moves nor blinks all through the film cannot be told from a lamp of the room.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.base.errors import RequestError
from tracking.led import find_peaks
from tracking.median import median_of
from tracking.spot import fit_spot
from tracking.video import VideoFrame, read_frames, sample_frames

Plane = NDArray[np.uint8]
Floats32 = NDArray[np.float32]

DEFAULT_SAMPLES = 15
# More than this share of the picture changing between samples cannot be a robot: the camera or the light moved.
_STATIC_SHARE = 0.12
# Steps by which compressed video of a still scene never differs over a block of 4 x 4 pixels.
_STATIC_STEP = 8
# A coloured light's least height over its surroundings in U and V, grey levels.
_LEAST_COLOUR = 4.0
# Directions in the (U, V) plane along which coloured light is looked for.
_HUES = 12
_BLACK_LUMA = 16.0
_LEAST_LIGHT = 8.0  # darker than that, nothing can be said to be hidden
_LEAST_RANGE = 40.0  # grey levels; on a floor without any shape, its texture is no edge
# How far from a spot the projected light still matters to it, px: the spot's window and the shift on the ball.
_SURROUNDINGS_PX = 18
_BLUR_PX = 2.0
_STRIDE = 4
# A robot that has melted in: how far about its LED ball and shadow may hide the floor, in parts of the picture's width,
# and its spot's least height in grey levels.
_HIDDEN_SHARE = 0.12
_LEAST_GHOST = 8.0
_MOST_GHOSTS = 8
_GHOST_SNR = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Background:
    """The empty floor as a static camera sees it, and what may be seen on it.

    Attributes:
        luma: (h, w) uint8.
        chroma: its planes (U, V), each (ceil(h / 2), ceil(w / 2)) uint8, or None in a grey video.
        hue_rad: the direction atan2(V, U) of the light that shines in colour in the samples, NaN where none does.
        noise: standard deviation of a pixel's luma from frame to frame, grey levels.
        colour_noise: likewise of U and V.
        moving_share: share of the picture (0..1) that differs from the floor in the median sample.
        light: (h, w) float32, the projected light by itself: luma over black, blurred as the ball's shell blurs it.
        unevenness: (h / 4, w / 4) float32, how much that changes within reach of each block of 4 x 4 pixels, in parts
            of its whole range (0..1).
    """

    luma: Plane
    chroma: tuple[Plane, Plane] | None
    hue_rad: float
    noise: float
    colour_noise: float
    moving_share: float
    light: Floats32 = field(repr=False)
    unevenness: Floats32 = field(repr=False)

    @property
    def is_static(self) -> bool:
        """Whether the camera stood still: but for a robot's share, the samples show the same picture."""
        return self.moving_share <= _STATIC_SHARE

    def uneven_at(self, x_px: float, y_px: float) -> float:
        """``unevenness`` about a place in the picture; about the nearest one where that lies outside."""
        rows, columns = self.unevenness.shape
        row, column = int(y_px) // _STRIDE, int(x_px) // _STRIDE
        return float(self.unevenness[min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)])

    def hidden_at(self, x_px: float, y_px: float, luma: float) -> float:
        """The share of the floor's light that is missing about a place where the picture shows ``luma``; 0: none."""
        rows, columns = self.light.shape
        light = float(self.light[min(max(round(y_px), 0), rows - 1), min(max(round(x_px), 0), columns - 1)])
        return 1.0 - (luma - _BLACK_LUMA) / max(light, _LEAST_LIGHT)

    def check_size(self, luma: Plane, path: Path) -> None:
        """Raise RequestError where a video's pictures are not of the background's size."""
        if luma.shape != self.luma.shape:
            raise RequestError(
                f"{path}: pictures of {luma.shape[1]}x{luma.shape[0]} pixels, the background has "
                f"{self.luma.shape[1]}x{self.luma.shape[0]}; track videos of one camera setting at a time"
            )


def temporal_median(planes: Sequence[Plane]) -> Plane:
    """Take the pixelwise median of planes (h, w) of the same size, as uint8.

    Raises:
        RequestError: there is none, or their sizes differ.
    """
    if not planes:
        raise RequestError("a background needs at least one frame; give a video that is not empty")
    if any(plane.shape != planes[0].shape for plane in planes):
        raise RequestError("a background needs pictures of one size; track videos of one camera setting at a time")
    return median_of(planes)


def background_of(paths: Sequence[str | Path], *, samples: int = DEFAULT_SAMPLES) -> Background:
    """Learn the empty floor from about ``samples`` frames spread over one or more videos of the same scene.

    Many short videos (a session's segments) give their first frames, one video is sampled throughout. A robot
    that rests for more than half of the samples would melt into the floor, so samples in which nothing has
    moved since the last one count once.

    Raises:
        RequestError: no videos, or pictures of different sizes.
        VideoError: a video cannot be read.
    """
    if not paths:
        raise RequestError("no videos to learn a background from; give at least one")
    return background_from(sample_scene(paths, samples))


def background_from(frames: Sequence[VideoFrame]) -> Background:
    """Learn the empty floor from sampled frames; see ``background_of``."""
    lumas = [frame.luma for frame in frames]
    kept = _distinct(lumas)
    floor = temporal_median([lumas[number] for number in kept])
    found = [chroma for frame in frames if (chroma := frame.chroma()) is not None]
    colours = tuple([chroma[which] for chroma in found] for which in (0, 1)) if len(found) == len(frames) else ()
    floors = tuple(temporal_median([planes[number] for number in kept]) for planes in colours)
    _exorcise(lumas, floor, colours, floors)
    chroma = (floors[0], floors[1]) if floors else None
    colour_noise = max(_noise(planes, plane) for planes, plane in zip(colours, floors, strict=True)) if floors else 1.0
    light = _light(floor)
    return Background(
        luma=floor,
        chroma=chroma,
        hue_rad=_hue(found, chroma, colour_noise) if chroma is not None else math.nan,
        noise=_noise(lumas, floor),
        colour_noise=colour_noise,
        moving_share=_moving_share(lumas, floor),
        light=light,
        unevenness=_unevenness(light),
    )


def _light(floor: Plane) -> Floats32:
    over = np.maximum(floor.astype(np.float32) - np.float32(_BLACK_LUMA), 0.0)
    return np.asarray(cv2.GaussianBlur(over, (0, 0), _BLUR_PX), dtype=np.float32)


def _unevenness(light: Floats32) -> Floats32:
    small = np.ascontiguousarray(light[::_STRIDE, ::_STRIDE])
    darkest, brightest = np.percentile(small, (0.5, 99.5))
    kernel = np.ones((2 * (-(-_SURROUNDINGS_PX // _STRIDE)) + 1,) * 2, dtype=np.uint8)
    change = cv2.dilate(small, kernel) - cv2.erode(small, kernel)
    return np.asarray(change / max(float(brightest - darkest), _LEAST_RANGE), dtype=np.float32)


def _exorcise(
    lumas: Sequence[Plane], floor: Plane, colours: Sequence[Sequence[Plane]], floors: Sequence[Plane]
) -> None:
    """Take robots that have melted into the floor out of it again, in place, in luma and in colour."""
    small = [np.ascontiguousarray(luma[::2, ::2]) for luma in lumas]
    least = max(_LEAST_GHOST, 4.0 * _noise(lumas, floor))
    for _ in range(_MOST_GHOSTS):
        still = np.ascontiguousarray(floor[::2, ::2])
        robots = [
            [
                (x, y)
                for x, y, high in find_peaks(luma, still, 1.5, count=3)
                if high > least and _above(luma, still, x, y)
            ]
            for luma in small
        ]
        ghost = _ghost(small, still, robots, least)
        if ghost is None:
            return
        (x, y), free = ghost
        reach = round(_HIDDEN_SHARE * floor.shape[1] / 2.0)
        box = np.s_[max(0, 2 * y - reach) : 2 * y + reach + 1, max(0, 2 * x - reach) : 2 * x + reach + 1]
        half = tuple(slice(side.start // 2, side.stop // 2) for side in box)
        floor[box] = temporal_median([lumas[number][box] for number in free])
        for planes, plane in zip(colours, floors, strict=True):
            plane[half] = temporal_median([planes[number][half] for number in free])


def _above(luma: Plane, still: Plane, x: float, y: float) -> bool:
    """Whether a sample is brighter than the floor at a peak: beside a spot that is missing, peaks are only its rim."""
    return int(luma[int(y), int(x)]) > int(still[int(y), int(x)]) + 2


def _ghost(
    small: Sequence[Plane], still: Plane, robots: Sequence[Sequence[tuple[float, float]]], least: float
) -> tuple[tuple[int, int], list[int]] | None:
    """Find a spot of the floor that is missing in samples: its place, and the samples that show the floor there.

    What a ball or its shadow hides is missing as well, for instance the corner of a lit shape: the samples with a light
    near by are not asked, and the floor itself must show a spot.
    """
    near = _HIDDEN_SHARE * still.shape[1]
    for luma in small:
        for x, y, height in find_peaks(still, luma, 1.5, count=3):
            if height < least:
                continue
            fitted = fit_spot(still, x, y, 1.5, free_sigma=True)
            if fitted is None or fitted[0].explained < 0.5 or fitted[0].amplitude < least:
                continue
            box = np.s_[max(0, int(y) - 10) : int(y) + 11, max(0, int(x) - 10) : int(x) + 11]
            free: list[int] = []
            for number, other in enumerate(small):
                peaks = find_peaks(still[box], other[box], 1.5)
                hidden = any(math.hypot(rx - x, ry - y) < near for rx, ry in robots[number])
                if not hidden and peaks and peaks[0][2] > 0.7 * least:
                    free.append(number)
            if free and _is_spot(still, temporal_median([small[number] for number in free]), x, y, least):
                return (int(x), int(y)), free
    return None


def _is_spot(still: Plane, free: Plane, x: float, y: float, least: float) -> bool:
    """Whether what the floor has too much is a spot: what a ball hides of a shape is an edge or a corner."""
    fitted = fit_spot(cv2.subtract(still, free, dtype=cv2.CV_32F).astype(np.float32), x, y, 1.5, free_sigma=True)
    return fitted is not None and fitted[0].snr > _GHOST_SNR and fitted[0].amplitude > least


def sample_scene(paths: Sequence[str | Path], samples: int = DEFAULT_SAMPLES) -> list[VideoFrame]:
    """Take about ``samples`` frames spread over one or more videos of the same scene; see ``background_of``."""
    files = [Path(path) for path in paths]
    if len(files) >= samples:
        picked = np.unique(np.linspace(0, len(files) - 1, samples).round().astype(int))
        frames: list[VideoFrame] = []
        for number in picked:
            with read_frames(files[int(number)], threads=1) as reader:
                frames.append(next(reader))
        return frames
    if len(files) == 1:
        keys = _key_frames(files[0], samples)
        if 3 * len(keys) >= 2 * samples:
            return keys
    each = -(-samples // len(files))
    return [frame for path in files for frame in sample_frames(path, each)]


def _key_frames(file: Path, count: int) -> list[VideoFrame]:
    """Key frames spread over a video: of a long one they are all that needs decoding. Fewer where it has fewer."""
    frames: list[VideoFrame] = []
    with read_frames(file, threads=1) as reader:
        info = reader.info
        if info.duration_s <= 0.0:
            return frames
        for place in range(count):
            reader.seek(info.start_s + info.duration_s * (place + 0.5) / count)
            frame = next(reader, None)
            if frame is not None and all(frame.t_s != other.t_s for other in frames):
                frames.append(frame)
    return frames


def _distinct(lumas: Sequence[Plane]) -> list[int]:
    """Number the samples, leaving out those in which nothing moved since the one before: a robot at rest."""
    kept = [0]
    blocks = [_blocks(luma) for luma in lumas]
    for number in range(1, len(lumas)):
        change = np.abs(blocks[number] - blocks[kept[-1]])
        if float(change.max()) > _STATIC_STEP:
            kept.append(number)
    # Two samples have no median: with fewer than three, nothing is gained by leaving any out.
    return kept if len(kept) >= 3 else list(range(len(lumas)))


def _blocks(luma: Plane) -> NDArray[np.int16]:
    """Means over blocks of 4 x 4 pixels: noise and compression leave them, motion does not."""
    size = max(1, luma.shape[1] // 4), max(1, luma.shape[0] // 4)
    return np.asarray(cv2.resize(luma, size, interpolation=cv2.INTER_AREA), dtype=np.int16)


def _noise(planes: Sequence[Plane], floor: Plane) -> float:
    """A pixel's standard deviation: from the median absolute difference to the floor, at least half a grey level."""
    spreads = [float(np.mean(np.minimum(cv2.absdiff(plane[::4, ::4], floor[::4, ::4]), 12))) for plane in planes]
    # A Gaussian's mean absolute deviation is 0.80 sigma.
    return max(0.5, float(np.median(spreads)) / 0.80)


def _hue(chromas: Sequence[tuple[Plane, Plane]], floors: tuple[Plane, Plane], noise: float) -> float:
    """The direction in (U, V) of the light that stands out in at least a third of the samples; NaN where none does.

    Of each sample the highest spot along any of a dozen directions counts.
    """
    least = max(_LEAST_COLOUR, 4.0 * noise)
    steps: list[complex] = []
    zero = np.zeros(floors[0].shape, dtype=np.float32)
    for u, v in chromas:
        du, dv = (plane.astype(np.float32) - floor for plane, floor in zip((u, v), floors, strict=True))
        # The strongest step in any direction: its place first, its direction then.
        size = np.asarray(cv2.magnitude(cv2.blur(du, (3, 3)), cv2.blur(dv, (3, 3))), dtype=np.float32)
        peaks = find_peaks(size, zero, 1.5)
        if not peaks:
            continue
        x, y = int(peaks[0][0]), int(peaks[0][1])
        box = np.s_[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2]
        step = complex(float(du[box].mean()), float(dv[box].mean()))
        if abs(step) > least:
            steps.append(step)
    if 3 * len(steps) < len(chromas):
        return math.nan
    directions = np.asarray(steps) / np.abs(steps)
    # Several colours on one floor: the most frequent one.
    near = [directions[np.abs(np.angle(directions / one)) < math.pi / _HUES] for one in directions]
    most = max(near, key=len)
    return float(np.angle(most.sum())) if 3 * len(most) >= len(chromas) else math.nan


def _moving_share(lumas: Sequence[Plane], floor: Plane) -> float:
    still = _blocks(floor)
    shares = [float(np.mean(np.abs(_blocks(luma) - still) > _STATIC_STEP)) for luma in lumas]
    return float(np.median(shares))
