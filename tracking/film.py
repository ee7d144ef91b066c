"""Films whose truth is known: a video file drawn frame by frame, and a table of what is in each of its frames.

For tests, demonstrations and whoever wants to know how far a tracker can be trusted. The pictures come from
``OverheadScene``; here the time goes wrong (lost, repeated and uneven frames), the lamp flickers, reflexes wander,
the picture is turned on its side, and an encoder takes its toll.

Example::

    rng = np.random.default_rng(1)
    shape = shapely.box(-15, -10, 15, 10)
    robots = rolling(wander(rng, (90.0, 50.0), length_cm=300.0), 20.0, blink_in(shape))
    truth = make_film("film.mkv", robots, rng, light_at=light_of(shape), faults=FilmFaults(dropped=0.02))
    track = track_video("film.mkv", calibration=truth.calibration)
    error_px = track[["x_px", "y_px"]] - truth.of()[["x_px", "y_px"]]
"""

# pyright: reportUnknownMemberType=false
# PyAV's stubs leave add_stream's keywords open; nothing of them leaves this module.

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from types import TracebackType

import av
import numpy as np
import pandas as pd
from av.container import OutputContainer
from av.video.stream import VideoStream
from numpy.typing import NDArray

from lab.base.errors import RequestError
from lab.base.pinhole import Pinhole
from tracking.calibration import Calibration
from tracking.cameras import chroma_planes, pack_i420
from tracking.staging import Robots, blink_in, default_optics, light_of, rolling, together, wander
from tracking.synthetic import CameraSettings, Glint, LightAt, OverheadScene

__all__ = [
    "FilmEncoding", "FilmFaults", "FilmTruth", "blink_in", "default_optics", "light_of", "make_film", "rolling",
    "together", "wander",
]  # fmt: skip

Plane = NDArray[np.uint8]
Floats = NDArray[np.float64]

FRAME_COLUMNS = ("frame", "t_s", "shown_s", "camera_frame", "dropped_before", "duplicate")
ROBOT_COLUMNS = (
    "frame", "robot", "t_s", "x_px", "y_px", "x_cm", "y_cm", "vx_cm_s", "vy_cm_s", "led_level", "led_on",
)  # fmt: skip
_TICKS = {".mp4": 90_000, ".mov": 90_000}


@dataclass(frozen=True, slots=True)
class FilmFaults:
    """What goes wrong with a film.

    Attributes:
        dropped: chance that a frame of the camera is not in the file; its stamp is missing with it.
        duplicated: chance that a frame shows the picture before it again, under a stamp of its own.
        jitter: standard deviation of a stamp against an even rate, in periods (at most 0.3): variable frame rate.
            The picture is taken when the stamp says.
        flicker: relative amplitude of the lamp's light, as of mains or of a DLP projector's wheel.
        flicker_hz: its frequency.
        readout_s: time from the first row's exposure to the last's (rolling shutter), which makes flicker bands.
        still_glints: white reflexes that stay where they are.
        moving_glints: white reflexes that cross the picture in straight lines, one after the other.
        rotation_deg: 0, 90, 180 or 270: the film is stored turned, and its metadata say by how much to turn it back
            (counterclockwise).
        grey: the camera knows no colour.
    """

    dropped: float = 0.0
    duplicated: float = 0.0
    jitter: float = 0.0
    flicker: float = 0.0
    flicker_hz: float = 100.0
    readout_s: float = 0.0
    still_glints: int = 0
    moving_glints: int = 0
    rotation_deg: int = 0
    grey: bool = False

    def __post_init__(self) -> None:
        if not (0.0 <= self.dropped < 1.0 and 0.0 <= self.duplicated < 1.0 and 0.0 <= self.jitter <= 0.3):
            raise RequestError("film: dropped and duplicated must lie in [0, 1), jitter in [0, 0.3]")
        if self.rotation_deg not in (0, 90, 180, 270):
            raise RequestError(f"film: a picture is turned by 0, 90, 180 or 270 degrees, not {self.rotation_deg}")
        if not 0.0 <= self.flicker < 1.0 or self.flicker_hz <= 0.0 or self.readout_s < 0.0:
            raise RequestError("film: flicker must lie in [0, 1), its frequency above 0, the read-out not below")


@dataclass(frozen=True, slots=True)
class FilmEncoding:
    """How a film is stored; the container follows from its name (.mkv, .mp4, .mov, .avi).

    Attributes:
        codec: "h264" or "mjpeg".
        quality: H.264's constant quality, 0 (best) to 51; Motion JPEG's quantiser scale is a fifth of it.
        key_frames: frames from one key frame to the next.
        b_frames: at most so many frames in a row that are stored out of their order, as phones do.
        movflags: FFmpeg's flags for mp4, such as "faststart" or "frag_keyframe+empty_moov".
        preset: x264's effort. From "superfast" on it stores as cameras do (arithmetic coding, smoothed blocks), which
            costs more to decode.
    """

    codec: str = "h264"
    quality: int = 20
    key_frames: int = 30
    b_frames: int = 0
    movflags: str = ""
    preset: str = "ultrafast"

    def __post_init__(self) -> None:
        if self.codec not in ("h264", "mjpeg"):
            raise RequestError(f'film: codec "{self.codec}" is not known; choose h264 or mjpeg')


@dataclass(frozen=True, slots=True, eq=False)
class FilmTruth:
    """What is truly in a film.

    Attributes:
        path: the film.
        calibration: the camera's, exact.
        frames: one row a frame of the file: ``frame`` (from 0), ``t_s`` (its PTS), ``shown_s`` (when its picture was
            taken: ``t_s``, of a duplicate that of the frame it repeats), ``camera_frame`` (the camera's number),
            ``dropped_before`` (frames missing before it), ``duplicate`` (bool).
        robots: one row a frame and robot: ``frame``, ``robot``, ``t_s``, ``x_px y_px`` (the LED in the upright
            picture, lit or not), ``led_level`` (0..1) and ``led_on`` (level above a half) as the picture shows them;
            ``x_cm y_cm vx_cm_s vy_cm_s`` as they were at ``t_s``.
        dropped: the camera's numbers of the frames that were lost.
        rate_hz: the camera's nominal rate.
    """

    path: Path
    calibration: Calibration
    frames: pd.DataFrame
    robots: pd.DataFrame
    dropped: tuple[int, ...]
    rate_hz: float

    def of(self, robot: int = 0) -> pd.DataFrame:
        """The rows of one robot, one a frame."""
        return self.robots[self.robots["robot"] == robot].reset_index(drop=True)


@dataclass(frozen=True, slots=True)
class _Shot:
    """One frame of the file: its stamp, and the moment its picture was taken."""

    t_s: float
    shown_s: float
    camera_frame: int
    dropped_before: int


def make_film(
    path: str | Path,
    robots: Robots,
    rng: np.random.Generator,
    *,
    light_at: LightAt | None = None,
    optics: Pinhole | None = None,
    duration_s: float = 10.0,
    camera: CameraSettings | None = None,
    faults: FilmFaults | None = None,
    encoding: FilmEncoding | None = None,
    light_from_cm: Sequence[float] | None = None,
    extra_glints: Callable[[float], Sequence[Glint]] | None = None,
) -> FilmTruth:
    """Write a film of robots that roll under a camera, and say what is in it.

    Args:
        path: the film, .mkv, .mp4, .mov or .avi.
        robots: t_s from the film's start -> what there is to see of each robot; always as many (``rolling``,
            ``together``), or none at all.
        rng: noise and faults are drawn from it.
        light_at: (x_cm, y_cm, height_cm) -> lux; default an evenly dim floor of 20 lux (``light_of`` for a lit shape).
        optics: the camera; default 1280 x 720 pixels, 4 px/cm at the LED's height, slightly tilted.
        duration_s: how long it runs.
        camera: noise, exposure (motion blur), rate, brightness of the LED; ``drop_probability`` there is not used.
        faults: what goes wrong.
        encoding: codec and quality.
        light_from_cm: the projector's centre (3,) where the ball is to throw a shadow.
        extra_glints: t_s -> further reflexes, for a glint at a certain place.

    Returns:
        The truth, frame by frame.

    Raises:
        RequestError: the name's ending is none of the four, uneven stamps are asked of an .avi, which has none, the
            film would be empty, or the file cannot be written there.
    """
    file = Path(path)
    optics = optics or default_optics()
    camera, faults, encoding = camera or CameraSettings(), faults or FilmFaults(), encoding or FilmEncoding()
    scene_rng, time_rng, glint_rng = rng.spawn(3)
    scene = OverheadScene(optics, light_at or _dim, scene_rng, camera, light_from_cm=light_from_cm)
    shots, lost = _shots(duration_s, camera.rate_hz, faults, _time_base(file, camera.rate_hz, faults), time_rng)
    reflexes = _Reflexes(faults, optics.image_size, duration_s, glint_rng)
    rows: list[tuple[float | int | bool, ...]] = []
    picture, taken_s = np.empty((0, 0), dtype=np.uint8), math.nan
    with _Encoder(file, optics.image_size, camera.rate_hz, faults, encoding) as encoder:
        for number, shot in enumerate(shots):
            seen = robots(shot.shown_s)
            if shot.shown_s != taken_s:
                glints = [*reflexes.at(shot.shown_s), *(extra_glints(shot.shown_s) if extra_glints else ())]
                light = _flicker(shot.shown_s, optics.image_size[1], camera.exposure_s, faults)
                picture, taken_s = scene.render(seen, light=light, glints=glints), shot.shown_s
            encoder.add(picture, shot.t_s)
            pixels = optics.project([(view.x_cm, view.y_cm, view.led_height_cm) for view in seen])
            now = seen if shot.t_s == shot.shown_s else robots(shot.t_s)
            for robot, (shown, there) in enumerate(zip(seen, now, strict=True)):
                rows.append(
                    (number, robot, shot.t_s, *(float(value) for value in pixels[robot]), there.x_cm, there.y_cm,
                     there.vx_cm_s, there.vy_cm_s, shown.led_level, shown.led_level > 0.5)
                )  # fmt: skip
    frames = pd.DataFrame(
        [(n, s.t_s, s.shown_s, s.camera_frame, s.dropped_before, s.t_s != s.shown_s) for n, s in enumerate(shots)],
        columns=list(FRAME_COLUMNS),
    )
    height_cm = next((view.led_height_cm for view in robots(0.0)), 7.3)
    return FilmTruth(
        path=file,
        calibration=Calibration(optics, height_cm),
        frames=frames,
        robots=pd.DataFrame(rows, columns=list(ROBOT_COLUMNS)),
        dropped=tuple(lost),
        rate_hz=camera.rate_hz,
    )


def _dim(x_cm: Floats, y_cm: Floats, height_cm: float) -> Floats:
    return np.full_like(x_cm, 20.0)


def _time_base(file: Path, rate_hz: float, faults: FilmFaults) -> Fraction:
    """The finest step of the file's stamps."""
    ending = file.suffix.lower()
    if ending == ".avi":
        if faults.jitter > 0.0:
            raise RequestError(f"{file}: an .avi has no stamps of its own for an uneven rate; make it .mkv or .mp4")
        return 1 / Fraction(rate_hz).limit_denominator(1001)
    if ending != ".mkv" and ending not in _TICKS:
        raise RequestError(f"{file}: a film is written as .mkv, .mp4, .mov or .avi; name it so")
    return Fraction(1, _TICKS.get(ending, 1000))


def _shots(
    duration_s: float, rate_hz: float, faults: FilmFaults, base: Fraction, rng: np.random.Generator
) -> tuple[list[_Shot], list[int]]:
    """The frames that reach the file, and the camera's numbers of those that do not. The first always does."""
    count = round(duration_s * rate_hz)
    if count < 1:
        raise RequestError(f"film: {duration_s:g} s at {rate_hz:g} frames a second is no frame; make it longer")
    jitter = rng.normal(0.0, faults.jitter, count) if faults.jitter > 0.0 else np.zeros(count)
    jitter[0] = 0.0  # a film begins at 0: mp4 rounds where it begins to a millisecond
    stamps = (np.arange(count) + np.clip(jitter, -0.45, 0.45)) / rate_hz
    drops, repeats = rng.random(count) < faults.dropped, rng.random(count) < faults.duplicated
    shots: list[_Shot] = []
    lost: list[int] = []
    before, shown_s = 0, 0.0
    for number in range(count):
        if number and drops[number]:
            lost.append(number)
            before += 1
            continue
        t_s = max(0, round(float(stamps[number]) / base)) * float(base)
        shown_s = shown_s if number and repeats[number] else t_s
        shots.append(_Shot(t_s, shown_s, number, before))
        before = 0
    return shots, lost


def _flicker(t_s: float, rows: int, exposure_s: float, faults: FilmFaults) -> Floats | None:
    """The lamp's light averaged over each row's exposure, (rows,), 1 in the mean.

    The mean of cos(ω t) over an exposure T about t is cos(ω t) sin(ω T / 2) / (ω T / 2).
    """
    if faults.flicker == 0.0:
        return None
    moments = t_s + (np.arange(rows) / max(1, rows - 1) - 0.5) * faults.readout_s
    # np.sinc(x) is sin(π x) / (π x).
    return 1.0 + faults.flicker * float(np.sinc(faults.flicker_hz * exposure_s)) * np.cos(
        2.0 * math.pi * faults.flicker_hz * moments
    )


@dataclass(slots=True)
class _Reflexes:
    """The still glints, and the moving ones: each crosses the picture within its own stretch of the film."""

    faults: FilmFaults
    size: tuple[int, int]
    duration_s: float
    rng: np.random.Generator
    _still: list[Glint] = field(default_factory=list[Glint])
    _ways: list[tuple[Floats, Floats, Glint]] = field(default_factory=list[tuple[Floats, Floats, Glint]])

    def __post_init__(self) -> None:
        size = np.asarray(self.size, dtype=float)
        for _ in range(self.faults.still_glints):
            x, y = self.rng.uniform(0.05, 0.95, 2) * size
            self._still.append(self._glint(x, y))
        for _ in range(self.faults.moving_glints):
            # From one side of the picture to the other.
            ends = self.rng.uniform(0.0, 1.0, (2, 2)) * size
            axis = int(self.rng.integers(2))
            ends[:, axis] = (0.0, size[axis]) if self.rng.random() < 0.5 else (size[axis], 0.0)
            self._ways.append((ends[0], ends[1], self._glint(0.0, 0.0)))

    def _glint(self, x_px: float, y_px: float) -> Glint:
        luma, sigma_px = self.rng.uniform(80.0, 220.0), self.rng.uniform(2.0, 4.5)
        return Glint(float(x_px), float(y_px), float(luma), float(sigma_px))

    def at(self, t_s: float) -> list[Glint]:
        """The glints that are to be seen at a time."""
        seen = list(self._still)
        if self._ways:
            part, number = math.modf(t_s / self.duration_s * len(self._ways))
            start, end, look = self._ways[min(int(number), len(self._ways) - 1)]
            x, y = start + part * (end - start)
            seen.append(Glint(float(x), float(y), look.luma, look.sigma_px))
        return seen


class _Encoder:
    """The film's file; a context manager."""

    def __init__(
        self, file: Path, size: tuple[int, int], rate_hz: float, faults: FilmFaults, encoding: FilmEncoding
    ) -> None:
        self._faults = faults
        self._base = _time_base(file, rate_hz, faults)
        rate = Fraction(rate_hz).limit_denominator(1001)
        options = {"video_track_timescale": str(self._base.denominator)} if file.suffix.lower() in _TICKS else {}
        if encoding.movflags:
            options["movflags"] = encoding.movflags
        if not file.parent.is_dir():
            raise RequestError(f"{file}: no such folder for a film; make it first")
        self._container: OutputContainer = av.open(str(file), mode="w", options=options)
        self._stream = self._add_stream(encoding, rate)
        # The picture is stored turned clockwise by what the metadata turn back.
        self._turns = -(faults.rotation_deg // 90) % 4
        width, height = size
        self._stream.width, self._stream.height = (height, width) if self._turns % 2 else (width, height)
        self._stream.codec_context.time_base = self._base
        self._stream.time_base = self._base
        if faults.rotation_deg:
            self._stream.set_display_rotation(faults.rotation_deg)

    def _add_stream(self, encoding: FilmEncoding, rate: Fraction) -> VideoStream:
        if encoding.codec == "mjpeg":
            quality = str(max(2, min(31, round(encoding.quality / 5))))
            stream = self._container.add_stream("mjpeg", rate=rate, options={"qmin": quality, "qmax": quality})
            stream.pix_fmt = "yuvj420p"
            return stream
        options = {"preset": encoding.preset, "crf": str(encoding.quality), "bf": str(encoding.b_frames)}
        stream = self._container.add_stream("libx264", rate=rate, options=options)
        stream.pix_fmt = "gray" if self._faults.grey else "yuv420p"
        stream.gop_size = encoding.key_frames
        return stream

    def __enter__(self) -> _Encoder:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if kind is None:
            self._container.mux(self._stream.encode(None))
        self._container.close()

    def add(self, i420: Plane, t_s: float) -> None:
        """Encode one upright picture, packed I420."""
        stream = self._stream
        layout = "yuvj420p" if stream.pix_fmt == "yuvj420p" else "yuv420p"
        packed = _turned(i420, self._turns)
        if self._faults.grey:
            packed = packed.copy()
            packed[packed.shape[0] * 2 // 3 :] = 128
        frame = av.VideoFrame.from_numpy_buffer(np.ascontiguousarray(packed), format=layout)
        if stream.pix_fmt == "gray":
            frame = av.VideoFrame.from_numpy_buffer(np.ascontiguousarray(packed[: packed.shape[0] * 2 // 3]), "gray")
        frame.pts, frame.time_base = round(t_s / self._base), self._base
        self._container.mux(stream.encode(frame))


def _turned(i420: Plane, quarter_turns: int) -> Plane:
    """A packed picture turned counterclockwise."""
    if quarter_turns == 0:
        return i420
    height = i420.shape[0] * 2 // 3
    u, v = (np.rot90(plane, quarter_turns) for plane in chroma_planes(i420))
    return pack_i420(np.rot90(i420[:height], quarter_turns), (u, v))
