"""The camera's pictures on the page: the LED found in the newest ones, or a stored session's frame of a moment."""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from lab.base.errors import ChordlabError
from lab.live.folder import StoryFolder
from tracking.background import temporal_median
from tracking.led import find_peaks
from tracking.video import read_frames

Picture = NDArray[np.uint8]
Place = tuple[float, float]
_WIDTH = 480
_LED_RADIUS_CM = 1.0
_LEAST_RESPONSE = 3.0  # grey levels: a dimmed LED in a small picture
_HALF_TICK_S = 0.002  # time stamps in the film are whole milliseconds
_FLOORS = 15
_FLOOR_EVERY = 10
_TAIL = 25
_LIT_COLOUR, _DARK_COLOUR, _BLACK, _WHITE = (84, 176, 255), (234, 180, 93), (0, 0, 0), (255, 255, 255)


class Eye:
    """Follows the LED in the pictures that the session sends, well enough for the eye; what counts is the film's track.

    Args:
        folder: the session's, for its calibration.
    """

    def __init__(self, folder: StoryFolder) -> None:
        self._optics = folder.settings.camera_calibration()
        self._height_cm = folder.settings.led.height_cm
        self._floors: deque[Picture] = deque(maxlen=_FLOORS)
        self._floor: Picture | None = None
        self._tail: deque[Place] = deque(maxlen=_TAIL)
        self._count = 0

    def look(self, jpeg: bytes, *, lit: bool) -> tuple[bytes, Place | None]:
        """Mark the LED in a picture. Returns the picture as JPEG, and where the LED is on the floor, cm."""
        picture = cv2.imdecode(np.frombuffer(jpeg, dtype=np.uint8), cv2.IMREAD_COLOR)
        if picture is None:
            return jpeg, None
        colour: Picture = np.asarray(picture, dtype=np.uint8)
        red: Picture = np.ascontiguousarray(colour.max(axis=2))  # an LED of any colour is bright in one of them
        if self._count % _FLOOR_EVERY == 0:
            self._floors.append(red)
            self._floor = temporal_median(list(self._floors))
        self._count += 1
        if self._floor is None or len(self._floors) < 3:
            return jpeg, None
        scale = self._optics.optics.image_size[0] / colour.shape[1]
        spot_px = max(1.0, _LED_RADIUS_CM * float(self._optics.optics.camera_matrix[0, 0]) / 200.0 / scale)
        peaks = find_peaks(red, self._floor, spot_px, least=_LEAST_RESPONSE)
        if not peaks:
            return jpeg, None
        x_px, y_px, _ = peaks[0]
        self._tail.append((x_px, y_px))
        draw_led(colour, list(self._tail), lit=lit)
        at = np.array([[(x_px + 0.5) * scale - 0.5, (y_px + 0.5) * scale - 0.5]])
        x_cm, y_cm = self._optics.optics.to_plane(at, self._height_cm)[0]
        place = (float(x_cm), float(y_cm)) if math.isfinite(x_cm) and math.isfinite(y_cm) else None
        return _jpeg(colour), place


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
            path = folder.session.path("track.parquet")
            self._track = pd.read_parquet(path, columns=["t_s", "x_px", "y_px", "led_on"]).sort_values("t_s")
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
        if len(seen):
            places = (np.asarray(seen[["x_px", "y_px"]], dtype=float) * scale).tolist()
            draw_led(picture, [(float(x), float(y)) for x, y in places], lit=bool(seen["led_on"].iloc[-1]))


def draw_led(picture: Picture, tail: Sequence[Place], *, lit: bool) -> None:
    """Draw where the LED has been and is: a full ring where it is lit, an open one where it is dark."""
    for before, after in itertools.pairwise(tail):
        if math.dist(before, after) < 40:
            cv2.line(picture, _whole(before), _whole(after), _WHITE, 1, cv2.LINE_AA)
    here = _whole(tail[-1])
    cv2.circle(picture, here, 11, _BLACK, 4, cv2.LINE_AA)
    cv2.circle(picture, here, 11, _LIT_COLOUR if lit else _DARK_COLOUR, 2, cv2.LINE_AA)
    if lit:
        cv2.circle(picture, here, 5, _LIT_COLOUR, -1, cv2.LINE_AA)


def _whole(place: Place) -> tuple[int, int]:
    return round(place[0]), round(place[1])


def _jpeg(picture: Picture) -> bytes:
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 75])
    return data.tobytes()
