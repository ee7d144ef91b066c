"""The empty floor: what the camera sees where no robot is, and whether the camera stands still."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.base.errors import RequestError
from tracking.led import find_peaks
from tracking.video import VideoFrame, read_frames, sample_frames

Plane = NDArray[np.uint8]

DEFAULT_SAMPLES = 15
# More than this share of the picture changing between samples cannot be a robot: the camera or the light moved.
_STATIC_SHARE = 0.12
# Steps by which compressed video of a still scene never differs over a block of 4 x 4 pixels.
_STATIC_STEP = 8
# A red light's least height in V over its surroundings, grey levels.
_LEAST_RED = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Background:
    """The empty floor as a static camera sees it, and what may be seen on it.

    Attributes:
        luma: (h, w) uint8.
        red: (ceil(h / 2), ceil(w / 2)) uint8, the V plane, or None where nothing red shines on the floor.
        noise: standard deviation of a pixel's luma from frame to frame, grey levels.
        red_noise: likewise of V.
        moving_share: share of the picture (0..1) that differs from the floor in the median sample.
    """

    luma: Plane
    red: Plane | None
    noise: float
    red_noise: float
    moving_share: float

    @property
    def is_static(self) -> bool:
        """Whether the camera stood still: but for a robot's share, the samples show the same picture."""
        return self.moving_share <= _STATIC_SHARE

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
    # Partition in bands: fifteen full frames at once would be copied as a whole.
    out: Plane = np.empty_like(planes[0], order="C")
    for top in range(0, len(out), 64):
        band = np.stack([plane[top : top + 64] for plane in planes])
        out[top : top + 64] = np.partition(band, len(planes) // 2, axis=0)[len(planes) // 2]
    return out


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
    return background_from(_sample(paths, samples))


def background_from(frames: Sequence[VideoFrame]) -> Background:
    """Learn the empty floor from sampled frames; see ``background_of``."""
    lumas = [frame.luma for frame in frames]
    kept = _distinct(lumas)
    floor = temporal_median([lumas[number] for number in kept])
    chromas = [frame.chroma() for frame in frames]
    reds = [chroma[1] for chroma in chromas if chroma is not None]
    red = temporal_median([reds[number] for number in kept]) if len(reds) == len(frames) else None
    if red is not None and not _shows_red(reds, red):
        red = None
    return Background(
        luma=floor,
        red=red,
        noise=_noise(lumas, floor),
        red_noise=_noise(reds, red) if red is not None else 1.0,
        moving_share=_moving_share(lumas, floor),
    )


def _sample(paths: Sequence[str | Path], samples: int) -> list[VideoFrame]:
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


def _shows_red(reds: Sequence[Plane], floor: Plane) -> bool:
    """Whether a red light stands out in at least a third of the samples."""
    least = max(_LEAST_RED, 4.0 * _noise(reds, floor))
    seen = 0
    for red in reds:
        peaks = find_peaks(red, floor, 1.5)
        seen += bool(peaks) and peaks[0][2] > least
    return 3 * seen >= len(reds)


def _moving_share(lumas: Sequence[Plane], floor: Plane) -> float:
    still = _blocks(floor)
    shares = [float(np.mean(np.abs(_blocks(luma) - still) > _STATIC_STEP)) for luma in lumas]
    return float(np.median(shares))
