"""A preview video: the track drawn over the pictures that it was found in."""

from __future__ import annotations

import fractions
import itertools
from pathlib import Path
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
_WHITE, _BLACK = (255, 255, 255), (0, 0, 0)


def write_preview(
    video: str | Path, track: pd.DataFrame, out_path: str | Path, *, tail_s: float = 1.0, rate_hz: float | None = None
) -> Path:
    """Draw position, tail and LED state of each robot over the video.

    A ring with a white middle marks an LED that is on, an open ring one that is dim; without a ring the robot was not
    seen. The tail shows where it was in the last ``tail_s``.

    Args:
        video: the video that was tracked.
        track: its track, as ``track_video`` gives it (``robot`` where there are several).
        out_path: the preview, .mp4 or .mkv (H.264).
        tail_s: length of the tail in s.
        rate_hz: frames a second of the preview; default the video's own.

    Returns:
        ``out_path`` as a Path.

    Raises:
        RequestError: the track lacks columns or belongs to a longer video, or the preview cannot be written.
        VideoError: the video cannot be read.
    """
    missing = [name for name in _NEEDED if name not in track.columns]
    if missing:
        raise RequestError(f"the track has no column {', '.join(missing)}; give a table made by track_video")
    out = Path(out_path)
    robots = _by_robot(track)
    with read_frames(video) as reader:
        rate = fractions.Fraction(rate_hz or reader.info.rate_hz).limit_denominator(1001)
        tail = max(1, round(tail_s * reader.info.rate_hz))
        writer = _Writer(out, rate)
        try:
            drawn = 0
            for frame in reader:
                picture = _picture(frame)
                for number, places in enumerate(robots):
                    _draw(picture, places, frame.index, tail, _COLOURS[number % len(_COLOURS)], _name(number, robots))
                _caption(picture, f"{frame.index}  {frame.t_s:.2f} s")
                writer.write(picture)
                drawn += 1
        finally:
            writer.close()
    if len(track) and int(track["frame"].max()) >= drawn:
        raise RequestError(f"{video}: {drawn} frames, but the track goes on to frame {int(track['frame'].max())}")
    return out


def draw_frame(frame: VideoFrame, track: pd.DataFrame, *, tail: int = 30) -> Picture:
    """Draw the track over one frame: (h, w, 3) uint8, blue-green-red. ``tail``: its length in frames."""
    picture = _picture(frame)
    robots = _by_robot(track)
    for number, places in enumerate(robots):
        _draw(picture, places, frame.index, tail, _COLOURS[number % len(_COLOURS)], _name(number, robots))
    return picture


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
    for thickness, ink in ((4, _BLACK), (1, colour)):
        cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.6, ink, thickness, cv2.LINE_AA)


class _Writer:
    """An H.264 file that is opened with its first picture, whose size it takes."""

    def __init__(self, path: Path, rate: fractions.Fraction) -> None:
        self._rate = rate
        where = f"{path}: cannot write a preview there; give an .mp4 or .mkv in a folder that exists"
        if not path.parent.is_dir():
            raise RequestError(where)
        try:
            # PyAV's stubs leave the packets' kind open, and promise a union over all codecs: met here and nowhere else.
            self._container = cast("Any", av.open(str(path), mode="w"))
        except (FFmpegError, ValueError) as error:
            raise RequestError(where) from error
        self._stream: Any = None

    def write(self, picture: Picture) -> None:
        if self._stream is None:
            stream = self._container.add_stream("libx264", rate=self._rate)
            stream.height, stream.width = picture.shape[:2]
            stream.pix_fmt = "yuv420p"
            stream.options = {"crf": "23", "preset": "veryfast"}
            self._stream = stream
        video = av.VideoFrame.from_ndarray(picture, format="bgr24")
        for packet in self._stream.encode(video):
            self._container.mux(packet)

    def close(self) -> None:
        if self._stream is not None:
            for packet in self._stream.encode():
                self._container.mux(packet)
        self._container.close()
