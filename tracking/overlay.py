"""A preview video: the track drawn over the pictures that it was found in."""

from __future__ import annotations

import fractions
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, cast

import av
import cv2
import numpy as np
import pandas as pd
from av.error import FFmpegError
from numpy.typing import NDArray

from lab.base.errors import RequestError
from tracking.video import VideoFrame, read_frames

Picture = NDArray[np.uint8]

_NEEDED = ("frame", "x_px", "y_px", "led_on")
# Blue-green-red; told apart by eyes that cannot tell red from green (Okabe & Ito 2008).
_COLOURS = ((0, 159, 230), (233, 180, 86), (115, 158, 0), (66, 228, 240), (178, 114, 0), (167, 121, 204))
_TIME_BASE = fractions.Fraction(1, 1000)
_WHITE, _BLACK = (255, 255, 255), (0, 0, 0)


def write_preview(
    video: str | Path | Sequence[str | Path],
    track: pd.DataFrame | Sequence[pd.DataFrame],
    out_path: str | Path,
    *,
    tail_s: float = 1.0,
    rate_hz: float | None = None,
    starts_s: Sequence[float] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Draw position, tail and LED state of each robot over the video.

    A ring with a white middle marks an LED that is on, an open ring one that is dim; without a ring the robot was not
    seen. The tail shows where it was in the last ``tail_s``. The preview keeps the video's own times, uneven as they
    may be; several videos follow one another in it. It is written aside and gets its name when it is whole.

    Args:
        video: the video that was tracked, or several of one size.
        track: its track, as ``track_video`` gives it (``robot`` where there are several), or one for each video.
        out_path: the preview, .mp4 or .mkv (H.264).
        tail_s: length of the tail in s.
        rate_hz: frames a second of the preview; default the video's own times.
        starts_s: when each video begins in the preview; default each a frame after the one before.
        progress: called now and then with (frames drawn, frames in all).

    Returns:
        ``out_path`` as a Path.

    Raises:
        RequestError: a track lacks columns or belongs to a longer video, or the preview cannot be written.
        VideoError: a video cannot be read.
    """
    videos = [Path(video)] if isinstance(video, (str, Path)) else [Path(one) for one in video]
    tracks = [track] if isinstance(track, pd.DataFrame) else list(track)
    for table in tracks:
        missing = [name for name in _NEEDED if name not in table.columns]
        if missing:
            raise RequestError(f"the track has no column {', '.join(missing)}; give a table made by track_video")
    total = sum(int(table["frame"].max()) + 1 if len(table) else 0 for table in tracks)
    with _Writer(Path(out_path)) as writer:
        drawn, start_s = 0, 0.0
        for number, (file, table) in enumerate(zip(videos, tracks, strict=True)):
            robots = _by_robot(table)
            start_s = start_s if starts_s is None else starts_s[number]
            with read_frames(file, quiet=True) as reader:
                period_s = 1.0 / (rate_hz or reader.info.rate_hz)
                tail = max(1, round(tail_s * reader.info.rate_hz))
                end_s, first_s, frames = start_s, None, 0
                for frame in reader:
                    first_s = frame.t_s if first_s is None else first_s
                    picture = _picture(frame)
                    _draw_all(picture, robots, frame.index, tail)
                    name = f"{file.stem}  " if len(videos) > 1 else ""
                    _caption(picture, f"{name}frame {frame.index}  t = {frame.t_s:.2f} s")
                    end_s = start_s + (frames * period_s if rate_hz else frame.t_s - first_s)
                    writer.write(picture, end_s, reader.info.rate_hz)
                    frames, drawn = frames + 1, drawn + 1
                    if progress is not None and drawn % 25 == 0:
                        progress(drawn, max(drawn, total))
            start_s = end_s + period_s
            if len(table) and int(table["frame"].max()) >= frames:
                raise RequestError(f"{file}: {frames} frames, but the track goes on to frame {table['frame'].max()}")
    return Path(out_path)


def draw_frame(frame: VideoFrame, track: pd.DataFrame, *, tail: int = 30) -> Picture:
    """Draw the track over one frame: (h, w, 3) uint8, blue-green-red. ``tail``: its length in frames."""
    picture = _picture(frame)
    _draw_all(picture, _by_robot(track), frame.index, tail)
    return picture


def _draw_all(picture: Picture, robots: list[NDArray[np.float64]], frame: int, tail: int) -> None:
    for number, places in enumerate(robots):
        _draw(picture, places, frame, tail, _COLOURS[number % len(_COLOURS)], _name(number, robots))


def _by_robot(track: pd.DataFrame) -> list[NDArray[np.float64]]:
    """One array (frames, 3) a robot: x, y, LED; row = frame number, NaN where there is no row."""
    length = int(track["frame"].max()) + 1 if len(track) else 0
    numbers = np.asarray(track["robot"], dtype=int) if "robot" in track.columns else np.zeros(len(track), dtype=int)
    values = np.asarray(track[["x_px", "y_px", "led_on"]], dtype=float)
    frames = np.asarray(track["frame"], dtype=int)
    robots: list[NDArray[np.float64]] = []
    for number in range(int(numbers.max(initial=0)) + 1):
        places = np.full((length, 3), np.nan)
        mine = numbers == number
        places[frames[mine]] = values[mine]
        robots.append(places)
    return robots


def _name(number: int, robots: list[NDArray[np.float64]]) -> str:
    return str(number) if len(robots) > 1 else ""


def _picture(frame: VideoFrame) -> Picture:
    """The frame in colour, upright, cut to even sides as H.264 wants them."""
    colour: Picture = np.asarray(frame.decoded.to_ndarray(format="bgr24"), dtype=np.uint8)
    upright = np.rot90(colour, frame.quarter_turns)
    return np.ascontiguousarray(upright[: upright.shape[0] & ~1, : upright.shape[1] & ~1])


def _draw(
    picture: Picture, places: NDArray[np.float64], frame: int, tail: int, colour: tuple[int, int, int], name: str
) -> None:
    past = places[max(0, frame - tail) : frame + 1]
    # Sixteenths of a pixel, which OpenCV draws between the pixels.
    points = [None if np.isnan(place[0]) else np.rint(place[:2] * 16.0).astype(np.int32) for place in past]
    for before, after in itertools.pairwise(points):
        if before is not None and after is not None:
            cv2.line(picture, _pair(before), _pair(after), colour, 2, cv2.LINE_AA, 4)
    if frame >= len(places) or not points or points[-1] is None:
        return
    here = _pair(points[-1])
    radius = max(8, round(0.018 * min(picture.shape[:2])))
    cv2.circle(picture, here, radius * 16, _BLACK, 4, cv2.LINE_AA, 4)
    cv2.circle(picture, here, radius * 16, colour, 2, cv2.LINE_AA, 4)
    if places[frame, 2] > 0:
        cv2.circle(picture, here, radius * 5, _WHITE, -1, cv2.LINE_AA, 4)
    if name:
        at = int(places[frame, 0]) + radius + 4, int(places[frame, 1]) - radius
        _text(picture, name, at, colour)


def _pair(point: NDArray[np.int32]) -> tuple[int, int]:
    return int(point[0]), int(point[1])


def _caption(picture: Picture, text: str) -> None:
    _text(picture, text, (8, picture.shape[0] - 10), _WHITE)


def _text(picture: Picture, text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
    """Write on a dark plate, no outline: in OpenCV 5 bolder letters are wider, and come to lie beside the thin ones."""
    (width, height), base = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.6, 1)
    plate = picture[
        max(0, at[1] - height - 4) : max(0, at[1] + base + 2), max(0, at[0] - 4) : max(0, at[0] + width + 4)
    ]
    plate //= 4
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.6, colour, 1, cv2.LINE_AA)


class _Writer:
    """An H.264 file, a context manager: opened with its first picture, whose size it takes; named when it is whole."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._aside = path.with_name(path.name + ".part")
        self._last = -1
        self._where = f"{path}: cannot write a preview there; give an .mp4 or .mkv in a folder that exists"
        kind = {".mkv": "matroska", ".mp4": "mp4"}.get(path.suffix.lower())
        if kind is None or not path.parent.is_dir():
            raise RequestError(self._where)
        try:
            # PyAV's stubs leave the packets' kind open, and promise a union over all codecs: met here and nowhere else.
            self._container = cast("Any", av.open(str(self._aside), mode="w", format=kind))
        except (FFmpegError, OSError) as error:
            raise RequestError(self._where) from error
        self._stream: Any = None

    def __enter__(self) -> _Writer:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        try:
            if kind is None and self._stream is not None:
                self._container.mux(self._stream.encode(None))
        finally:
            self._container.close()
            if kind is not None or self._stream is None:
                self._aside.unlink(missing_ok=True)
            else:
                self._aside.replace(self._path)

    def write(self, picture: Picture, t_s: float, rate_hz: float) -> None:
        """Add a picture (h, w, 3) at a time from the preview's start; ``rate_hz`` is the nominal one."""
        if self._stream is None:
            stream = self._container.add_stream("libx264", rate=fractions.Fraction(rate_hz).limit_denominator(1001))
            stream.height, stream.width = picture.shape[:2]
            stream.pix_fmt = "yuv420p"
            stream.options = {"crf": "23", "preset": "veryfast"}
            stream.codec_context.time_base = _TIME_BASE
            self._stream = stream
        video = av.VideoFrame.from_ndarray(picture, format="bgr24")
        if video.width != self._stream.width or video.height != self._stream.height:
            raise RequestError(f"{self._path}: a preview shows videos of one size; draw them one by one")
        self._last = max(self._last + 1, round(t_s / _TIME_BASE))
        video.pts, video.time_base = self._last, _TIME_BASE
        self._container.mux(self._stream.encode(video))
