"""The camera's pictures on the page: the newest of a running session, or a stored session's frame of a moment."""

from __future__ import annotations

import itertools
import math
from collections import deque
from typing import Any

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from lab.base.errors import ChordlabError
from lab.live.folder import StoryFolder
from lab.live.page.eye import Eye, Place
from tracking.video import read_frames

Picture = NDArray[np.uint8]
_WIDTH = 480
_HALF_TICK_S = 0.002  # time stamps in the film are whole milliseconds
_TAIL = 5
_FARTHEST_PX = 60.0  # between two looks; farther off it is another LED
_LIT_COLOUR, _DARK_COLOUR, _BLACK, _WHITE = (84, 176, 255), (234, 180, 93), (0, 0, 0), (255, 255, 255)


class Newest:
    """The pictures that a running session sends, with the LEDs in them marked.

    Args:
        folder: the session's.
    """

    def __init__(self, folder: StoryFolder) -> None:
        self._eye = Eye(folder)
        self._before: list[Place] = []
        self._tail: deque[tuple[Place, Place]] = deque(maxlen=_TAIL * self._eye.leds)

    def mark(self, jpeg: bytes, *, lit: bool) -> tuple[bytes, list[tuple[float, float, bool]]]:
        """Mark the LEDs in a picture; ``lit``: what the session says, for while nothing else tells.

        Returns the picture as JPEG, and where the LEDs are on the floor, (x, y) cm, and whether they are lit.
        """
        read = cv2.imdecode(np.frombuffer(jpeg, dtype=np.uint8), cv2.IMREAD_COLOR)
        if read is None:
            return jpeg, []
        picture: Picture = np.asarray(read, dtype=np.uint8)
        spots = self._eye.look(picture)
        states = self._eye.are_lit([spot.height for spot in spots], otherwise=lit)
        here = [(spot.x_px, spot.y_px) for spot in spots]
        for place in here:
            last = min(self._before, key=lambda before: math.dist(before, place), default=place)
            if 0 < math.dist(last, place) < _FARTHEST_PX:
                self._tail.append((last, place))
        self._before = here
        for before, after in self._tail:
            cv2.line(picture, _whole(before), _whole(after), _WHITE, 1, cv2.LINE_AA)
        for place, shines in zip(here, states, strict=True):
            draw_led(picture, place, lit=shines)
        places = self._eye.on_the_floor(spots, picture.shape[1])
        return _jpeg(picture), [(*place, shines) for place, shines in zip(places, states, strict=True)]


class Film:
    """The stored film, a frame at a time.

    Args:
        folder: the session's.
    """

    def __init__(self, folder: StoryFolder) -> None:
        self._folder = folder
        self._segments = folder.session.segments()
        self._track: pd.DataFrame | None = None
        try:
            track = pd.read_parquet(folder.session.path("track.parquet"))
            columns = [name for name in ("t_s", "x_px", "y_px", "led_on", "robot") if name in track]
            self._track = track[columns].sort_values("t_s")
        except (OSError, ValueError, KeyError, ChordlabError):
            self._track = None

    def at(self, t_s: float) -> bytes | None:
        """The picture at a time with the track up to it, as JPEG; None where nothing was filmed then."""
        runs = [run for run in self._folder.story.runs if run.line in self._segments and run.t_start_s <= t_s]
        for run in reversed(runs[-3:]):
            try:
                frames: Any = pd.read_parquet(self._folder.session.line_path(run.line, "video.frames.parquet"))
                times = frames["t_host_s"].to_numpy(dtype=float)
                if not len(times):
                    continue
                row = max(0, int(np.searchsorted(times, t_s, side="right")) - 1)
                camera_s = frames["t_camera_s"].to_numpy(dtype=float)
                with read_frames(self._segments[run.line], threads=1, quiet=True) as reader:
                    frame = next(reader)
                    due_s = frame.t_s + float(camera_s[row] - camera_s[0]) - _HALF_TICK_S
                    if row > 0:
                        reader.seek(due_s)
                        frame = next(each for each in reader if each.t_s >= due_s)
            except (OSError, ValueError, KeyError, StopIteration, ChordlabError):
                continue
            colour: Picture = np.asarray(frame.decoded.to_ndarray(format="bgr24"), dtype=np.uint8)
            scale = _WIDTH / colour.shape[1]
            small: Picture = np.asarray(
                cv2.resize(colour, (_WIDTH, round(colour.shape[0] * scale)), interpolation=cv2.INTER_AREA),
                dtype=np.uint8,
            )
            self._mark(small, float(times[row]), scale)
            return _jpeg(small)
        return None

    def _mark(self, picture: Picture, t_s: float, scale: float) -> None:
        if self._track is None:
            return
        past = self._track[(self._track["t_s"] > t_s - 2.0) & (self._track["t_s"] <= t_s + 0.01)]
        seen = past[np.isfinite(np.asarray(past["x_px"], dtype=float))]
        for _, own in seen.groupby("robot") if "robot" in seen else [(0, seen)]:
            if not len(own):
                continue
            places: list[Place] = [
                (float(x) * scale, float(y) * scale) for x, y in np.asarray(own[["x_px", "y_px"]], dtype=float)
            ]
            for before, after in itertools.pairwise(places):
                if math.dist(before, after) < _FARTHEST_PX:
                    cv2.line(picture, _whole(before), _whole(after), _WHITE, 1, cv2.LINE_AA)
            draw_led(picture, places[-1], lit=bool(own["led_on"].iloc[-1]))


def draw_led(picture: Picture, place: Place, *, lit: bool) -> None:
    """Draw where an LED is: a full ring where it is lit, an open one where it is dark."""
    here = _whole(place)
    cv2.circle(picture, here, 11, _BLACK, 4, cv2.LINE_AA)
    cv2.circle(picture, here, 11, _LIT_COLOUR if lit else _DARK_COLOUR, 2, cv2.LINE_AA)
    if lit:
        cv2.circle(picture, here, 5, _LIT_COLOUR, -1, cv2.LINE_AA)


def _whole(place: Place) -> tuple[int, int]:
    return round(place[0]), round(place[1])


def _jpeg(picture: Picture) -> bytes:
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 75])
    return data.tobytes()
