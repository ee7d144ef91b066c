"""What the pages of one server show: a running session's folder and news, or a stored session."""

from __future__ import annotations

import contextlib
import math
import threading
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from lab.base.errors import ChordlabError
from lab.live.channel import Command, Ends, read_news, send_command
from lab.live.folder import NOTHING_SEEN, Sightings, StoryFolder
from lab.live.page.pictures import Eye, Film
from lab.live.story import Moment

_LARGEST_MESSAGE = 1 << 16
_KEPT_LIGHT = 2000
_KEPT_PLACES = 4000


class Source:
    """What is shown, for all pages together. `refresh` may run in a thread of its own; the rest only reads.

    Args:
        ends: the page server's ends of the channel to a running session; None for a stored one.
        folder: the stored session's.

    Attributes:
        folder: the session that is shown, once there is one.
        version: grows whenever there is something new to draw.
        trouble: why nothing is shown, in words.
        session_gone: whether the running session's process has left.
    """

    def __init__(self, ends: Ends | None = None, folder: Path | None = None) -> None:
        self.folder: StoryFolder | None = None
        self.version = 0
        self.trouble = ""
        self.session_gone = threading.Event()
        self.light: deque[tuple[float, float]] = deque(maxlen=_KEPT_LIGHT)
        self._ends = ends
        self._lock = threading.Lock()
        self._news: dict[str, Any] = {}
        self._picture: tuple[float, bool, bytes] | None = None
        self._shown: bytes | None = None
        self._eye: Eye | None = None
        self._film: Film | None = None
        self._seen: deque[tuple[float, float, float, bool]] = deque(maxlen=_KEPT_PLACES)
        self._sightings: Sightings = NOTHING_SEEN
        self._frames: tuple[float, bytes | None] = (math.nan, None)
        if folder is not None:
            self._open(folder)
        if ends is not None:
            threading.Thread(target=self._hear, args=(ends,), name="chordlab-news", daemon=True).start()
            threading.Thread(target=self._until_gone, args=(ends,), name="chordlab-end", daemon=True).start()

    @property
    def is_live(self) -> bool:
        """Whether there is a running session behind it that takes commands."""
        return self._ends is not None and not self.session_gone.is_set()

    def news(self, name: str, otherwise: Any = None) -> Any:
        """The newest that the running session has told under a name."""
        return self._news.get(name, otherwise)

    def batteries(self, moment: Moment) -> dict[str, float]:
        """Each robot's battery, V, newest."""
        robots: dict[str, Any] = self.news("robots", {}) if self.is_live else {}
        told = {name: float(robot["battery_v"]) for name, robot in robots.items() if robot.get("battery_v")}
        return {**moment.battery_v, **told}

    def command(self, command: Command) -> bool:
        """Hand a command to the running session. Whether it is still there."""
        return self._ends is not None and send_command(self._ends, command)

    def refresh(self) -> None:
        """Take what the folder and the news have gained. Never raises for a folder: ``trouble`` says what is wrong."""
        told = self.news("folder")
        if told is not None and (self.folder is None or str(self.folder.session.folder) != told):
            self._open(Path(told))
        folder = self.folder
        if folder is None:
            return
        try:
            if folder.read():
                self.version += 1
        except ChordlabError as error:
            self._fail(str(error))
        with self._lock:
            picture, self._picture = self._picture, None
        if picture is not None and folder.has_camera:
            self._look(folder, *picture)

    def moment(self, t_s: float = math.inf) -> Moment | None:
        """What was known of the session at a time; None before there is a session."""
        return None if self.folder is None else self.folder.story.at(t_s)

    def sightings(self, t_s: float) -> Sightings:
        """Where the LED was seen up to a time."""
        if not self._seen:
            return self._sightings.until(t_s)
        times, x_cm, y_cm, lit = zip(*tuple(self._seen), strict=True)
        return Sightings(np.array(times), np.array(x_cm), np.array(y_cm), np.array(lit, dtype=bool))

    def picture(self, t_s: float) -> bytes | None:
        """The camera's picture with the LED marked: the newest of a running session, or that of a time."""
        if self._shown is not None:
            return self._shown
        if self._film is None:
            return None
        if self._frames[0] != t_s:
            self._frames = (t_s, self._film.at(t_s))
        return self._frames[1]

    def _open(self, path: Path) -> None:
        try:
            self.folder = folder = StoryFolder(path)
            folder.read()
        except ChordlabError as error:
            self._fail(str(error))
            return
        self.trouble = ""
        self._seen.clear()
        self.light.clear()
        self._shown = None
        if self._ends is None:
            self._film = Film(folder) if folder.has_camera else None
            self._sightings = folder.sightings()
        elif folder.has_camera:
            self._eye = Eye(folder)
        self.version += 1
        threading.Thread(target=self._learn, args=(folder,), name="chordlab-names", daemon=True).start()

    def _learn(self, folder: StoryFolder) -> None:
        with contextlib.suppress(ChordlabError):  # the log's own leading name stays
            folder.learn_names()
        self.version += 1

    def _fail(self, trouble: str) -> None:
        if trouble != self.trouble:
            self.trouble = trouble
            self.version += 1

    def _look(self, folder: StoryFolder, t_s: float, lit: bool, jpeg: bytes) -> None:
        robots: dict[str, Any] = self.news("robots", {})
        eye = self._eye = self._eye or Eye(folder)
        self._shown, place = eye.look(jpeg, lit=lit)
        if place is not None and len(robots) <= 1:
            self._seen.append((t_s, *place, lit))
        self.version += 1

    def _hear(self, ends: Ends) -> None:
        while True:
            try:
                head, body = read_news(ends.news.recv(_LARGEST_MESSAGE))
            except ValueError:
                continue
            except OSError:  # the session's socket is closed
                return
            with self._lock:
                if head.get("kind") == "picture":
                    self._picture = (float(head["t_s"]), bool(head["lit"]), body)
                else:
                    self.light.extend((float(t_s), float(lux)) for t_s, lux in head.pop("light", []))
                    self._news = head
                    self.version += 1

    def _until_gone(self, ends: Ends) -> None:
        with contextlib.suppress(OSError):
            while ends.commands.recv(64):  # the session never writes here: this is its end
                pass
        self.session_gone.set()
        self.version += 1
