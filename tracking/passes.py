"""The ways of looking through a video: each gives one RawTrack a robot, in pixels.

Under a camera that stands still an LED is followed on the floor that was learnt (one robot, or several told apart), or
balls whose LEDs are off are found on it. Under a camera that moves, red matrices are found in each frame on its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lab.base.errors import RequestError
from tracking.ahead import read_ahead
from tracking.background import Background, background_from, sample_scene
from tracking.balls import BALL_LINKS, find_balls, learn_ball_px
from tracking.calibration import Calibration
from tracking.follow import LedFollower
from tracking.identity import LedMark, identify
from tracking.lights import Light, LitFloor
from tracking.markers import CameraMotion, Marker, MarkerSettings, find_markers, link
from tracking.sighting import Sighting, places
from tracking.team import follow_team
from tracking.video import VideoFrame, probe, read_frames

Progress = Callable[[int, int], None]
Floats = NDArray[np.float64]

_BALL_CM = 7.3
# A matrix's centroid is good to about a pixel, whatever its pixels' noise.
_MARKER_VAR_PX2 = 1.0
# So is a ball's outline.
_BALL_VAR_PX2 = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class RawTrack:
    """One robot's track in pixels; arrays of one entry a frame, NaN where not seen.

    ``identity``: how surely it is this robot, 0 where not seen; NaN where nothing says so; None for a lone robot.
    """

    t_s: Floats
    place: Floats  # (n, 4): x, y, variance of x, of y
    amplitude: Floats
    quality: Floats
    identity: Floats | None = None
    amplitude_sigma: Floats | None = None  # None: nothing tells the LED's levels apart


@dataclass(frozen=True, slots=True, eq=False)
class FilmSlices:
    """Of each frame of a film in several files: which file, the frame's number and time in it."""

    file: NDArray[np.int64]
    frame: NDArray[np.int64]
    t_s: Floats


def check_still(floor: Background) -> None:
    """Raise RequestError where the camera that the floor was learnt from moved."""
    if not floor.is_static:
        raise RequestError(
            f"the segments do not show one still scene ({floor.moving_share:.0%} of the picture changes); "
            "fix the camera, or track the videos one by one"
        )


def follow_one(
    path: Path,
    floor: Background,
    calibration: Calibration | None,
    *,
    threads: int,
    progress: Progress | None = None,
) -> RawTrack:
    """Track one robot under a static camera."""
    follower = LedFollower(floor)
    times: list[float] = []
    with read_frames(path, threads=threads) as reader, closing(read_ahead(reader)) as frames:
        for frame in frames:
            if not times:
                floor.check_size(frame.luma, path)
                _check(calibration, frame.luma)
            follower.step(frame.t_s, frame.luma, frame.chroma)
            times.append(frame.t_s)
            _report(progress, len(times), reader.info.n_frames)
    _report(progress, len(times), len(times), last=True)
    return _raw(np.asarray(times, dtype=float), follower.finish())


def follow_several(
    files: Sequence[Path],
    floor: LitFloor,
    robots: int,
    leds: Sequence[LedMark] | None,
    calibration: Calibration | None,
    progress: Progress | None,
) -> tuple[list[RawTrack], FilmSlices]:
    """Follow several robots under a static camera through a film in one or more files."""
    stands: list[tuple[int, int, float]] = []
    total = sum(probe(file).n_frames for file in files)

    def film() -> Iterator[VideoFrame]:
        stands.clear()
        last_s, shift_s = -np.inf, 0.0
        for number, file in enumerate(files):
            with read_frames(file) as reader:
                for frame in reader:
                    if frame.index == 0:
                        floor.background.check_size(frame.luma, file)
                        _check(calibration, frame.luma)
                        # A file whose clock begins anew goes on where the one before it ended.
                        shift_s = last_s + 1.0 / reader.info.rate_hz - frame.t_s if frame.t_s <= last_s else 0.0
                    stands.append((number, frame.index, frame.t_s))
                    last_s = frame.t_s + shift_s
                    yield replace(frame, t_s=last_s)

    times, members = follow_team(film, floor, robots, leds, lambda done: _report(progress, done, total))
    _report(progress, len(times), len(times), last=True)
    number, frame, t_s = np.array(stands, dtype=float).reshape(-1, 3).T
    raws = [_raw(times, member.sightings, member.certainty) for member in members]
    return raws, FilmSlices(number.astype(np.int64), frame.astype(np.int64), t_s)


def follow_balls(
    path: Path,
    robots: int,
    calibration: Calibration | None,
    background: Background | None,
    progress: Progress | None,
) -> list[RawTrack]:
    """Follow balls whose LEDs are off under a static camera."""
    samples = sample_scene([path])
    floor = background if background is not None else background_from(samples)
    _check(calibration, floor.luma)
    check_still(floor)
    ball_px = learn_ball_px(samples, floor) if calibration is None else _ball_px(calibration, floor.luma.shape)
    if ball_px == 0.0:
        raise RequestError(f"{path}: nothing round stands out from the floor; is a ball in the picture?")
    times: list[float] = []
    found: list[list[Light]] = []
    with read_frames(path) as reader:
        for frame in reader:
            found.append(find_balls(frame, floor, ball_px, robots + 2))
            times.append(frame.t_s)
            _report(progress, len(times), reader.info.n_frames)
    _report(progress, len(times), len(times), last=True)
    t_s = np.asarray(times, dtype=float)
    raws: list[RawTrack] = []
    for identity in identify(np.maximum.accumulate(t_s).tolist(), found, robots, None, BALL_LINKS):
        place, quality, sure = np.full((len(times), 4), np.nan), np.zeros(len(times)), np.zeros(len(times))
        for number, ball in identity.lights.items():
            place[number] = ball.x_px, ball.y_px, _BALL_VAR_PX2, _BALL_VAR_PX2
            quality[number], sure[number] = ball.height, identity.certainty[number]
        raws.append(RawTrack(t_s, place, np.full(len(times), np.nan), quality, sure if robots > 1 else None))
    return raws


def follow_markers(
    path: Path, robots: int, calibration: Calibration | None, progress: Progress | None
) -> list[RawTrack]:
    """Track robots under a moving camera."""
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
    raws: list[RawTrack] = []
    for identity in identities:
        place = np.full((len(times), 4), np.nan)
        amplitude, quality = np.full(len(times), np.nan), np.zeros(len(times))
        for number, marker in identity.items():
            place[number] = marker.x_px, marker.y_px, _MARKER_VAR_PX2, _MARKER_VAR_PX2
            amplitude[number], quality[number] = marker.redness, marker.quality
        unknown = np.full(len(times), np.nan) if robots > 1 else None
        raws.append(RawTrack(np.asarray(times, dtype=float), place, amplitude, quality, unknown))
    return raws


def _raw(t_s: Floats, seen: list[Sighting | None], identity: Floats | None = None) -> RawTrack:
    return RawTrack(
        t_s=t_s,
        place=places(seen, t_s),
        amplitude=np.array([sighting.amplitude if sighting else np.nan for sighting in seen]),
        quality=np.array([sighting.quality if sighting else 0.0 for sighting in seen]),
        identity=identity,
        amplitude_sigma=np.array([sighting.amplitude_sigma if sighting else np.nan for sighting in seen]),
    )


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
