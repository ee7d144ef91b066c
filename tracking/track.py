"""From video to track: one row a frame (and robot), times from the stream's PTS.

Two ways of looking, chosen from the data. One robot under a camera that stands still: the empty floor is learnt and
the LED followed on it, to a fraction of a pixel. Several robots, or a camera that moves: the red matrices are found in
each frame on their own and tied together by motion, to a pixel or two; that needs colour.
"""

from __future__ import annotations

import logging
import multiprocessing
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from lab.base.errors import RequestError
from tracking.background import Background, background_of
from tracking.calibration import Calibration
from tracking.follow import LedFollower, places
from tracking.kalman import smooth_track
from tracking.led import learn_levels
from tracking.markers import CameraMotion, Marker, MarkerSettings, find_markers, link
from tracking.video import read_frames

Progress = Callable[[int, int], None]
Floats = NDArray[np.float64]

_log = logging.getLogger(__name__)

PIXEL_COLUMNS = ("frame", "t_s", "x_px", "y_px", "led_on", "quality")
CM_COLUMNS = (
    "x_cm", "y_cm", "x_smooth_cm", "y_smooth_cm", "vx_cm_s", "vy_cm_s", "sigma_x_cm", "sigma_y_cm",
)  # fmt: skip
_BALL_CM = 7.3
# A matrix's centroid is good to about a pixel, whatever its pixels' noise.
_MARKER_VAR_PX2 = 1.0
# What no fit knows of itself. Compression moves a spot by about this over its height in grey levels (H.264 at constant
# quality 20 to 22), anew in each frame; lens and calibration by so much for good, which no smoothing takes away.
_COMPRESSION_PX = 4.5
_SYSTEMATIC_VAR_PX2 = 0.05**2


@dataclass(frozen=True, slots=True, eq=False)
class _Raw:
    """One robot's track in pixels; arrays of one entry a frame, NaN where not seen."""

    t_s: Floats
    place: Floats  # (n, 4): x, y, variance of x, of y
    amplitude: Floats
    quality: Floats


def track_video(
    path: str | Path,
    *,
    calibration: Calibration | None = None,
    robots: int = 1,
    background: Background | None = None,
    progress: Progress | None = None,
) -> pd.DataFrame:
    """Track the robots' LEDs through one video.

    Args:
        path: the video.
        calibration: the camera's, for positions in the arena; without it there are pixels only.
        robots: how many robots to keep apart.
        background: the empty floor, where it is known already; else it is learnt from the video.
        progress: called now and then with (frames done, frames in all as far as is known).

    Returns:
        One row a frame of the video, ordered by frame (and then robot). Columns ``frame`` (from 0), ``t_s`` (PTS),
        ``x_px y_px`` (NaN where the LED was not seen), ``led_on`` (bool; the brighter of the LED's two levels, or seen
        at all where it has only one; False where not seen), ``quality`` (0..1: how well a spot explains the picture;
        0 = not seen). With a calibration also, in the arena's frame, ``x_cm y_cm`` (NaN as above), ``x_smooth_cm
        y_smooth_cm vx_cm_s vy_cm_s sigma_x_cm sigma_y_cm`` (Kalman smoothed; gaps bridged, NaN only before the first
        and after the last sighting). With more than one robot also ``robot`` (from 0) after ``frame``.

    Raises:
        VideoError: the video cannot be read.
        CalibrationError: the calibration is for pictures of another size.
        RequestError: ``robots`` is below 1, or several robots or a moving camera meet a video without colour.
    """
    if robots < 1:
        raise RequestError(f"cannot track {robots} robots; ask for one or more")
    with _one_thread():
        if robots == 1 and background is None:
            background = background_of([path])
        still = background if robots == 1 and background is not None and background.is_static else None
        if still is not None:
            raws = [_follow(Path(path), still, calibration, threads=2, progress=progress)]
        else:
            raws = _mark(Path(path), robots, calibration, progress)
    tables: list[pd.DataFrame] = []
    for number, raw in enumerate(raws):
        # A matrix found by its colour is lit; of a followed spot the brightness tells.
        threshold = learn_levels(raw.amplitude).threshold if still is not None else 0.0
        table = _table(raw, calibration)
        table["led_on"] = raw.amplitude > threshold
        if robots > 1:
            table.insert(1, "robot", number)
        tables.append(table)
        if not (table["quality"] > 0).any():
            _log.warning("%s: robot %d was never seen; is its LED on and red?", path, number)
    if robots == 1:
        return tables[0]
    return pd.concat(tables).sort_values(["frame", "robot"], kind="stable", ignore_index=True)


def track_segments(
    paths: Sequence[str | Path] | Mapping[int, str | Path],
    calibration: Calibration | None,
    *,
    workers: int = 2,
    background: Background | None = None,
    progress: Progress | None = None,
) -> pd.DataFrame:
    """Track one robot through many segments filmed by one static camera, as a session's lines are.

    The background and the LED's two levels are learnt from all segments together: a line that misses the shape shows
    one level only.

    Args:
        paths: the segments, in the order of their lines (line = index), or a mapping from line to segment.
        calibration: the camera's, or None for pixels only.
        workers: processes to use ("spawn": a script that calls this needs the usual main guard).
        background: the empty floor, where it is known already.
        progress: called after each segment with (segments done, segments in all).

    Returns:
        The columns of ``track_video`` with ``line`` before them; ``frame`` and ``t_s`` start anew in each segment.
        No segments give an empty table.

    Raises:
        VideoError: a segment cannot be read.
        CalibrationError: the calibration is for pictures of another size.
        RequestError: the camera moved between or within the segments.
    """
    jobs = list(paths.items()) if isinstance(paths, Mapping) else list(enumerate(paths))
    if not jobs:
        columns = ("line", *PIXEL_COLUMNS, *(CM_COLUMNS if calibration is not None else ()))
        return pd.DataFrame(columns=list(columns))
    floor = background if background is not None else background_of([path for _, path in jobs])
    if not floor.is_static:
        raise RequestError(
            f"the segments do not show one still scene ({floor.moving_share:.0%} of the picture changes); "
            "fix the camera, or track the videos one by one"
        )
    files = [Path(path) for _, path in jobs]
    done: list[tuple[_Raw, pd.DataFrame]] = []
    for result in _run(files, floor, calibration, min(workers, len(jobs))):
        done.append(result)
        if progress is not None:
            progress(len(done), len(jobs))
    threshold = learn_levels(np.concatenate([raw.amplitude for raw, _ in done])).threshold
    tables: list[pd.DataFrame] = []
    for (line, _), (raw, table) in zip(jobs, done, strict=True):
        table["led_on"] = raw.amplitude > threshold
        table.insert(0, "line", line)
        tables.append(table)
    return pd.concat(tables, ignore_index=True)


@contextmanager
def _one_thread() -> Generator[None]:
    """Keep OpenCV to one thread: its threads cost more than they give on patches this small."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _run(
    files: Sequence[Path], floor: Background, calibration: Calibration | None, workers: int
) -> Generator[tuple[_Raw, pd.DataFrame]]:
    if workers <= 1 or len(files) < 4:  # a process costs a second or two to start
        with _one_thread():
            for file in files:
                yield _segment(file, floor, calibration)
        return
    pool = ProcessPoolExecutor(
        workers,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_Job.prepare,
        initargs=(floor, calibration),
    )
    with pool:
        # Chunks large enough to spare messages, small enough that no worker is left alone at the end.
        yield from pool.map(_Job.run, files, chunksize=max(1, min(16, len(files) // (4 * workers))))


def _segment(file: Path, floor: Background, calibration: Calibration | None) -> tuple[_Raw, pd.DataFrame]:
    raw = _follow(file, floor, calibration, threads=1)
    return raw, _table(raw, calibration)


class _Job:
    """What a worker process holds between segments: sent once, not with each."""

    floor: Background
    calibration: Calibration | None

    @classmethod
    def prepare(cls, floor: Background, calibration: Calibration | None) -> None:
        cv2.setNumThreads(1)
        cls.floor, cls.calibration = floor, calibration

    @classmethod
    def run(cls, file: Path) -> tuple[_Raw, pd.DataFrame]:
        return _segment(file, cls.floor, cls.calibration)


def _follow(
    path: Path,
    floor: Background,
    calibration: Calibration | None,
    *,
    threads: int,
    progress: Progress | None = None,
) -> _Raw:
    """Track one robot under a static camera."""
    follower = LedFollower(floor)
    times: list[float] = []
    with read_frames(path, threads=threads) as reader:
        for frame in reader:
            if not times:
                floor.check_size(frame.luma, path)
                _check(calibration, frame.luma)
            chroma = frame.chroma() if floor.red is not None else None
            follower.step(frame.t_s, frame.luma, None if chroma is None else chroma[1])
            times.append(frame.t_s)
            _report(progress, len(times), reader.info.n_frames)
    seen = follower.sightings
    _report(progress, len(times), len(times), last=True)
    return _Raw(
        t_s=np.asarray(times, dtype=float),
        place=places(seen),
        amplitude=np.array([sighting.amplitude if sighting else np.nan for sighting in seen]),
        quality=np.array([sighting.quality if sighting else 0.0 for sighting in seen]),
    )


def _mark(path: Path, robots: int, calibration: Calibration | None, progress: Progress | None) -> list[_Raw]:
    """Track several robots, or one under a moving camera."""
    times: list[float] = []
    found: list[list[Marker]] = []
    camera: list[tuple[float, float]] = []
    motion = CameraMotion()
    settings: MarkerSettings | None = None
    with read_frames(path) as reader:
        for frame in reader:
            chroma = frame.chroma()
            if chroma is None:
                raise RequestError(
                    f"{path}: no colour to tell {robots} robot(s) by under a moving camera; "
                    "film in colour, or one robot with a camera that stands still"
                )
            if settings is None:
                _check(calibration, frame.luma)
                settings = MarkerSettings(ball_px=_ball_px(calibration, frame.luma.shape))
            found.append(find_markers(frame.luma, chroma[1], settings, most=2 * robots))
            camera.append(motion.step(frame.luma))
            times.append(frame.t_s)
            _report(progress, len(times), reader.info.n_frames)
        size = reader.info.size
    identities = link(found, camera, robots, settings or MarkerSettings(ball_px=_ball_px(calibration, size)))
    _report(progress, len(times), len(times), last=True)
    raws: list[_Raw] = []
    for identity in identities:
        place = np.full((len(times), 4), np.nan)
        amplitude, quality = np.full(len(times), np.nan), np.zeros(len(times))
        for number, marker in identity.items():
            place[number] = marker.x_px, marker.y_px, _MARKER_VAR_PX2, _MARKER_VAR_PX2
            amplitude[number], quality[number] = marker.redness, marker.quality
        raws.append(_Raw(np.asarray(times, dtype=float), place, amplitude, quality))
    return raws


def _ball_px(calibration: Calibration | None, shape: tuple[int, ...]) -> float:
    """The ball's diameter: from the calibration, else a tenth of the picture's shorter side."""
    if calibration is None:
        return 0.1 * min(shape)
    height, width = shape
    middle = calibration.cm_per_px([[width / 2.0, height / 2.0]])[0]
    return _BALL_CM / float(np.sqrt(abs(np.linalg.det(middle))))


def _check(calibration: Calibration | None, luma: NDArray[np.uint8]) -> None:
    if calibration is not None:
        calibration.check_size((luma.shape[1], luma.shape[0]))


def _report(progress: Progress | None, done: int, total: int, *, last: bool = False) -> None:
    if progress is not None and (last or done % 50 == 0):
        progress(done, max(done, total))


def _table(raw: _Raw, calibration: Calibration | None) -> pd.DataFrame:
    """The columns of one robot's track; ``led_on`` is left to whoever knows the levels."""
    table = pd.DataFrame(
        {
            "frame": np.arange(len(raw.t_s), dtype=np.int64),
            "t_s": raw.t_s,
            "x_px": raw.place[:, 0],
            "y_px": raw.place[:, 1],
            "led_on": np.zeros(len(raw.t_s), dtype=bool),
            "quality": raw.quality,
        }
    )
    if calibration is None:
        return table
    pixels = raw.place[:, :2]
    arena = calibration.to_arena(pixels)
    slopes = calibration.cm_per_px(pixels)
    variance_px2 = raw.place[:, 2:] + ((_COMPRESSION_PX / raw.amplitude) ** 2)[:, None]
    variance_cm2 = (slopes**2 @ variance_px2[:, :, None])[:, :, 0]
    # One figure for the whole track: the scale hardly changes over the arena.
    scales = np.sum(slopes**2, axis=2)[np.isfinite(pixels[:, 0])]
    systematic_cm2 = _SYSTEMATIC_VAR_PX2 * float(np.median(scales)) if len(scales) else 0.0
    # A frame without a later stamp than the one before (a stuck clock) has its row, but tells the filter nothing.
    latest = np.maximum.accumulate(raw.t_s)
    rises = np.diff(latest, prepend=-np.inf) > 0
    smooth = smooth_track(raw.t_s[rises], *arena[rises].T, *variance_cm2[rises].T)
    of_row = np.cumsum(rises) - 1
    columns = (
        *arena.T,
        *(
            values[of_row]
            for values in (
                smooth.x_cm, smooth.y_cm, smooth.vx_cm_s, smooth.vy_cm_s,
                np.sqrt(smooth.sigma_x_cm**2 + systematic_cm2), np.sqrt(smooth.sigma_y_cm**2 + systematic_cm2),
            )
        ),
    )  # fmt: skip
    for name, values in zip(CM_COLUMNS, columns, strict=True):
        table[name] = values
    return table
