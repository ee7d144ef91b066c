"""What people ask of a session while it rolls, taken by the session's own loop."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine, Generator, Mapping
from contextlib import contextmanager
from typing import Any, Protocol

from lab.base.given import one_line
from lab.clock import Pace

_LONGEST_NOTE = 500


class Log(Protocol):
    """Where what was asked is kept; it adds the time."""

    def __call__(self, kind: str, **data: object) -> None:
        """Append one event."""
        ...


class Controls:
    """Pause, resume, stop, next shape, and notes.

    A pause begins between two runs, and where all robots rest the clock of a virtual bench stands still. A stop is
    at once: the run in progress is given up, as at the end of a session of several robots.

    Args:
        pace: of the clock that stands still in a pause.
        can_pause: whether the robots can wait between two runs; one that rolls by itself cannot.
    """

    def __init__(self, pace: Pace, *, can_pause: bool = True) -> None:
        self.can_pause = can_pause
        self.wants_next = False
        self._pace = pace
        self._going = asyncio.Event()
        self._going.set()
        self._stop = asyncio.Event()
        self._log: Log | None = None
        self._notes: list[str] = []
        self._robots = 0
        self._resting = 0
        self._told = False

    @property
    def paused(self) -> bool:
        """Whether a pause is asked for; it begins with the end of the runs in progress."""
        return not self._going.is_set()

    @property
    def stop_asked(self) -> bool:
        """Whether the session is to end."""
        return self._stop.is_set()

    def take(self, command: Mapping[str, Any]) -> None:
        """Do what a command of the page says, {"do": …}; one that makes no sense is passed over."""
        match command:
            case {"do": "pause"}:
                self.pause()
            case {"do": "resume"}:
                self.resume()
            case {"do": "stop"}:
                self.stop()
            case {"do": "next"}:
                self.stop(then_next=True)
            case {"do": "note", "text": str(text)}:
                self.note(text)
            case _:
                pass

    def pause(self) -> None:
        """Let the robots rest after their runs in progress."""
        if self.can_pause and not self.stop_asked:
            self._going.clear()

    def resume(self) -> None:
        """Let them go on."""
        if not self.paused:
            return
        self._going.set()
        self._pace.frozen = False
        if self._told and self._log is not None:
            self._log("resume", robot="", by="page")
        self._told = False

    def stop(self, *, then_next: bool = False) -> None:
        """End the session, and with ``then_next`` begin the next shape's."""
        self.wants_next = then_next
        self._pace.frozen = False
        self._stop.set()

    def note(self, text: str) -> None:
        """Keep a remark: in the log, or until there is one."""
        kept = one_line(text, _LONGEST_NOTE)
        if not kept:
            return
        if self._log is None:
            self._notes.append(kept)
        else:
            self._log("note", text=kept)

    @contextmanager
    def attending(self, robots: int, log: Log) -> Generator[None]:
        """While so many robots roll, ``log`` is open."""
        self._log, self._robots = log, robots
        waiting, self._notes = self._notes, []
        for text in waiting:
            log("note", text=text)
        try:
            yield
        finally:
            self._log = None
            self._pace.frozen = False

    async def between_runs(self) -> bool:
        """Called by each robot between two of its runs: waits while paused. Whether it waited."""
        if not self.paused:
            return False
        if not self._told and self._log is not None:
            self._log("pause", robot="", by="page")
            self._told = True
        self._resting += 1
        self._stand_still()
        try:
            await self._going.wait()  # as long as people like; a page that dies ends it
        finally:
            self._resting -= 1
        return True

    def left(self) -> None:
        """Called for a robot that will roll no more."""
        self._robots -= 1
        self._stand_still()

    async def unless_stopped(self, work: Coroutine[Any, Any, None]) -> bool:
        """Await ``work``, or cancel it at a stop. Whether it came to its end; its errors are raised."""
        working, stop = asyncio.ensure_future(work), asyncio.ensure_future(self._stop.wait())
        try:
            await asyncio.wait({working, stop}, return_when=asyncio.FIRST_COMPLETED)
            if working.done():
                working.result()
                return True
            return False
        finally:
            stop.cancel()
            working.cancel()
            await asyncio.gather(working, stop, return_exceptions=True)

    def _stand_still(self) -> None:
        self._pace.frozen = self.paused and 0 < self._robots <= self._resting
