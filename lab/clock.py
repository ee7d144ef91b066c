"""The clock of a session is its asyncio event loop: real on the bench, jumping on the virtual bench.

On the virtual bench nothing waits: when no callback is ready, the loop's clock jumps to the next
timer. Hours of rolling take seconds, and a run depends on its seed alone.
"""

from __future__ import annotations

import asyncio
import math
import selectors
import signal
import sys
import threading
import time
from collections.abc import Callable, Coroutine, Mapping
from functools import partial
from typing import Any, TypeVar

T = TypeVar("T")

_SHORTEST_WAIT_S = 0.005  # a selector waits whole milliseconds; a shorter wait is made up for by the next
_LATE_S = 0.1
_FROZEN_TURN_S = 1.0
_ONE_TURN_S = 1e-9


class Pace:
    """How fast virtual time goes: so many times as fast as real time, or as fast as it can; and whether it goes at all.

    Args:
        speed: virtual seconds in one second; None: as fast as it can.

    Attributes:
        frozen: while it is true virtual time stands still; only files and sockets move the loop on.
    """

    def __init__(self, speed: float | None = None, *, now: Callable[[], float] = time.monotonic) -> None:
        self.speed = speed
        self.frozen = False
        self._now = now
        self._ahead_s = math.inf  # of virtual time over real time × speed, real seconds; known from the first look on

    def wait_s(self, virtual_s: float, timeout_s: float) -> float:
        """How many real seconds to wait at a virtual time for the one ``timeout_s`` later; 0 where they are few."""
        if self.speed is None:
            return 0.0
        now_s = self._now()
        if virtual_s / self.speed - self._ahead_s < now_s - _LATE_S:
            # What is late stays late: nobody can follow a robot that catches up.
            self._ahead_s = virtual_s / self.speed - now_s
        wait_s = (virtual_s + timeout_s) / self.speed - self._ahead_s - now_s
        return wait_s if wait_s > _SHORTEST_WAIT_S else 0.0


class _JumpingSelector(selectors.BaseSelector):
    """A selector that moves virtual time on instead of waiting for its time-out."""

    def __init__(self, start_s: float, pace: Pace) -> None:
        self._selector = selectors.DefaultSelector()
        self._pace = pace
        self.now_s = start_s

    def register(self, fileobj: Any, events: int, data: Any = None) -> selectors.SelectorKey:
        return self._selector.register(fileobj, events, data)

    def unregister(self, fileobj: Any) -> selectors.SelectorKey:
        return self._selector.unregister(fileobj)

    def modify(self, fileobj: Any, events: int, data: Any = None) -> selectors.SelectorKey:
        return self._selector.modify(fileobj, events, data)

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        # No timer at all: only a file descriptor (a signal, a thread) can wake the loop, so wait for it.
        if timeout is None:
            return self._selector.select(None)
        if timeout > 0 and self._pace.frozen:
            return self._selector.select(_FROZEN_TURN_S)
        if timeout > 0:
            wait_s = self._pace.wait_s(self.now_s, timeout)
            # Woken before its time by a command, the loop asks again: the sum of times is that of an unpaced run.
            if wait_s > 0 and (events := self._selector.select(wait_s)):
                return events
            self.now_s += timeout
        return self._selector.select(0)

    def close(self) -> None:
        self._selector.close()

    def get_map(self) -> Mapping[Any, selectors.SelectorKey]:
        return self._selector.get_map()


class VirtualTimeLoop(asyncio.SelectorEventLoop):
    """An event loop whose ``time()`` starts at ``start_s`` and jumps to the next timer when nothing is ready."""

    def __init__(self, start_s: float = 0.0, pace: Pace | None = None) -> None:
        self._jumping = _JumpingSelector(start_s, pace or Pace())
        super().__init__(self._jumping)

    @property
    def _clock_resolution(self) -> float:
        """Timers before now and this run in one turn, says asyncio.

        Rounding must never make a turn that waits for 1e-16 s; beyond 1e7 s a double's step is longer than 1e-9 s.
        """
        return max(_ONE_TURN_S, math.ulp(self.time()))

    @_clock_resolution.setter
    def _clock_resolution(self, _: float) -> None:
        """What asyncio sets is the monotonic clock's."""

    def time(self) -> float:
        """Virtual seconds; ``start_s`` when the loop was made."""
        return self._jumping.now_s


if sys.platform == "win32":
    _RealLoop = asyncio.ProactorEventLoop
else:
    _RealLoop = asyncio.SelectorEventLoop


class ShiftedLoop(_RealLoop):
    """An event loop at real time whose ``time()`` was ``start_s`` when it was made."""

    def __init__(self, start_s: float) -> None:
        self._ahead_s = start_s - time.monotonic()
        super().__init__()

    def time(self) -> float:
        """Monotonic seconds, shifted."""
        return time.monotonic() + self._ahead_s


def run(main: Coroutine[Any, Any, T], *, virtual: bool, not_before_s: float = 0.0, pace: Pace | None = None) -> T:
    """Run ``main`` to its end on a fresh loop: at virtual time, or at the machine's monotonic time.

    Ctrl-C cancels ``main`` (so that it can stop the robot and close its files) and then raises
    KeyboardInterrupt, as ``asyncio.Runner`` does; a request to terminate (SIGTERM, on POSIX) does the same.

    Args:
        main: what to run.
        virtual: whether time jumps from timer to timer.
        not_before_s: where the clock of an earlier run stood. Virtual time starts there; a monotonic clock that
            stands below it, since the machine was started again meanwhile, is shifted.
        pace: how fast virtual time goes; None: as fast as it can.
    """
    if virtual:
        factory = partial(VirtualTimeLoop, not_before_s, pace)
    else:
        factory = partial(ShiftedLoop, not_before_s) if time.monotonic() < not_before_s else None
    told: list[int] = []
    with asyncio.Runner(loop_factory=factory) as runner:
        try:
            return runner.run(_until_terminated(main, told))
        except asyncio.CancelledError:
            if told:
                raise KeyboardInterrupt from None
            raise


async def _until_terminated(main: Coroutine[Any, Any, T], told: list[int]) -> T:
    """Await ``main``; SIGTERM cancels it and is put into ``told``."""
    task, loop = asyncio.current_task(), asyncio.get_running_loop()
    ours = (
        sys.platform != "win32"
        and threading.current_thread() is threading.main_thread()
        and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    )
    if not ours or task is None:
        return await main

    def terminate() -> None:
        told.append(signal.SIGTERM)
        task.cancel()

    loop.add_signal_handler(signal.SIGTERM, terminate)
    try:
        return await main
    finally:
        loop.remove_signal_handler(signal.SIGTERM)
