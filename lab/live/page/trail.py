"""Where the LEDs were, from the films of the runs that are over: the page's own quick look at them.

The session is not asked for anything: its films lie in its folder, a run's own at once after the run.
"""

from __future__ import annotations

import math
import threading

import numpy as np
import pandas as pd

from lab.base.errors import ChordlabError
from lab.live.feed import shrunk
from lab.live.folder import Sightings, StoryFolder
from lab.live.page.eye import Eye
from tracking.video import read_frames

_WIDTH = 480
_LOOK_EVERY_S = 0.15  # of the film's time: a step of two centimetres
_REST_S = 0.3


class Trail:
    """Reads the runs' films as they come, the newest first where there are several, in a thread of its own.

    Args:
        folder: the session's.

    Attributes:
        films: how many have been read.
    """

    def __init__(self, folder: StoryFolder) -> None:
        self.films = 0
        self._folder = folder
        self._eye = Eye(folder)
        self._read: set[int] = set()
        self._seen: list[tuple[float, float, float, float]] = []
        self._given_up = threading.Event()

    def start(self) -> None:
        """Begin."""
        threading.Thread(target=self._follow, name="chordlab-trail", daemon=True).start()

    def give_up(self) -> None:
        """End soon: another session is shown."""
        self._given_up.set()

    def sightings(self) -> Sightings:
        """What was seen so far, in the order of time; what was lit is judged by all that is known by now."""
        seen = list(self._seen)
        states = self._eye.are_lit([height for *_, height in seen], otherwise=False)
        return Sightings.of((t_s, x_cm, y_cm, lit) for (t_s, x_cm, y_cm, _), lit in zip(seen, states, strict=True))

    def read_next(self) -> bool:
        """Read one film more. Whether there was one."""
        try:
            films = self._folder.session.segments()
            waiting = [run.line for run in self._folder.story.runs if run.line not in self._read and run.line in films]
            if not waiting:
                return False
            self._read.add(waiting[-1])
            frames: pd.DataFrame = pd.read_parquet(
                self._folder.session.line_path(waiting[-1], "video.frames.parquet"), columns=["t_host_s"]
            )
            times_s = np.asarray(frames["t_host_s"], dtype=float)
            with read_frames(films[waiting[-1]], threads=1, quiet=True) as reader:
                next_s = -math.inf
                for frame in reader:
                    chroma = frame.chroma()
                    if chroma is None or frame.index >= len(times_s) or self._given_up.is_set():
                        break
                    if times_s[frame.index] < next_s:
                        continue
                    next_s = times_s[frame.index] + _LOOK_EVERY_S
                    height, width = frame.luma.shape
                    picture = shrunk(frame.luma, chroma, (_WIDTH, max(1, round(height * _WIDTH / width))))
                    self._look(picture, float(times_s[frame.index]))
        except (OSError, ValueError, KeyError, ChordlabError):
            return True  # a film that cannot be read leaves a gap
        self.films += 1
        return True

    def _look(self, picture: np.ndarray[tuple[int, ...], np.dtype[np.uint8]], t_s: float) -> None:
        spots = self._eye.look(picture)
        for (x_cm, y_cm), spot in zip(self._eye.on_the_floor(spots, _WIDTH), spots, strict=True):
            if math.isfinite(x_cm) and math.isfinite(y_cm):
                self._seen.append((t_s, x_cm, y_cm, spot.height))

    def _follow(self) -> None:
        while not self._given_up.is_set():
            if not self.read_next():
                self._given_up.wait(_REST_S)
