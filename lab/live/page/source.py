"""What the pages of one server show: a running session's folder and news, or a stored session."""

from __future__ import annotations

import contextlib
import math
import threading
from collections import deque
from pathlib import Path
from typing import Any

from lab.base.errors import ChordlabError
from lab.live import charts
from lab.live.channel import Command, Ends, read_news, send_command
from lab.live.folder import NOTHING_SEEN, Sightings, StoryFolder
from lab.live.page.figures import Drawings, draw
from lab.live.page.pictures import Film, Newest
from lab.live.page.trail import Trail
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
        log_version: grows with the log and what follows from it.
        trouble: why nothing is shown, in words.
        light: each robot's newest light samples, (t_s, lux).
        session_gone: whether the running session's process has left.
    """

    def __init__(self, ends: Ends | None = None, folder: Path | None = None) -> None:
        self.folder: StoryFolder | None = None
        self.version = self.log_version = self.picture_number = 0
        self.trouble = ""
        self.session_gone = threading.Event()
        self.light: dict[str, deque[tuple[float, float]]] = {}
        self._ends = ends
        self._lock = threading.Lock()
        self._news: dict[str, Any] = {}
        self._picture: tuple[float, bool, bytes] | None = None
        self._shown: bytes | None = None
        self._newest: Newest | None = None
        self._film: Film | None = None
        self._trail: Trail | None = None
        self._seen: deque[tuple[float, float, float, bool]] = deque(maxlen=_KEPT_PLACES)
        self._track: Sightings = NOTHING_SEEN
        self._drawn: dict[charts.Ink, tuple[tuple[object, ...], Drawings]] = {}
        self._films = 0
        self._frames: tuple[float, bytes | None] = (math.nan, None)
        if folder is not None:
            self._open(folder)
        if ends is not None:
            threading.Thread(target=self._hear, args=(ends,), name="chordlab-news", daemon=True).start()
            threading.Thread(target=self._until_gone, args=(ends,), name="chordlab-end", daemon=True).start()

    @property
    def is_live(self) -> bool:
        """Whether it is the source of a running session, even where that has left, and not of a stored one."""
        return self._ends is not None

    def news(self, name: str, otherwise: Any = None) -> Any:
        """The newest that the running session has told under a name."""
        return self._news.get(name, otherwise)

    def batteries(self, moment: Moment) -> dict[str, float]:
        """Each robot's battery, V, newest."""
        robots: dict[str, Any] = self.news("robots", {})
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
                self._grow()
        except ChordlabError as error:
            self._fail(str(error))
        with self._lock:
            picture, self._picture = self._picture, None
        if picture is not None and self._newest is not None:
            self._look(self._newest, *picture)
        if self._trail is not None and self._trail.films != self._films:
            self._films = self._trail.films
            self._grow()

    def moment(self, t_s: float = math.inf) -> Moment | None:
        """What was known of the session at a time; None before there is a session."""
        return None if self.folder is None else self.folder.story.at(t_s)

    def drawings(self, t_s: float, ink: charts.Ink) -> Drawings | None:
        """The figures of a time, drawn once for all pages that show them alike; None before there is a session."""
        folder, moment = self.folder, self.moment(t_s)
        if folder is None or moment is None:
            return None
        key = (folder, self.log_version, moment.t_s, len(self._seen))
        held = self._drawn.get(ink)
        if held is None or held[0] != key:
            held = self._drawn[ink] = (key, draw(folder, moment, self.sightings(t_s), ink))
        return held[1]

    def sightings(self, t_s: float) -> Sightings:
        """Where LEDs were seen up to a time: in the films, and since the last film in the newest pictures."""
        if self._trail is None:
            return self._track.until(t_s)
        filmed = self._trail.sightings()
        since_s = filmed.t_s[-1] if len(filmed.t_s) else -math.inf
        return filmed.and_then([seen for seen in tuple(self._seen) if seen[0] > since_s]).until(t_s)

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
        self.light = {}
        self._shown = self._newest = self._film = None
        if self._trail is not None:
            self._trail.give_up()
        self._track = folder.sightings()
        self._trail = Trail(folder) if folder.has_camera and not len(self._track.t_s) else None
        if self._trail is not None:
            self._trail.start()
        if folder.has_camera and self.is_live:
            self._newest = Newest(folder)
        elif folder.has_camera:
            self._film = Film(folder)
        self._grow()
        threading.Thread(target=self._learn, args=(folder,), name="chordlab-names", daemon=True).start()

    def _learn(self, folder: StoryFolder) -> None:
        with contextlib.suppress(ChordlabError):  # the log's own leading name stays
            folder.learn_names()
        self._grow()

    def _grow(self) -> None:
        self.log_version += 1
        self.version += 1

    def _fail(self, trouble: str) -> None:
        if trouble != self.trouble:
            self.trouble = trouble
            self.version += 1

    def _look(self, newest: Newest, t_s: float, lit: bool, jpeg: bytes) -> None:
        self._shown, places = newest.mark(jpeg, lit=lit)
        self._seen.extend((t_s, *place) for place in places if math.isfinite(place[0]) and math.isfinite(place[1]))
        self.picture_number += 1
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
                    for robot, samples in head.pop("light", {}).items():
                        light = self.light.setdefault(robot, deque(maxlen=_KEPT_LIGHT))
                        light.extend((float(t_s), float(lux)) for t_s, lux in samples)
                    self._news = head
                    self.version += 1

    def _until_gone(self, ends: Ends) -> None:
        with contextlib.suppress(OSError):
            while ends.commands.recv(64):  # the session never writes here: this is its end
                pass
        self.session_gone.set()
        self.version += 1
