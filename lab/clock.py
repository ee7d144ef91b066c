"""The clock of a session is its asyncio event loop: real on the bench, jumping on the virtual bench.

On the virtual bench nothing waits: when no callback is ready, the loop's clock jumps to the next
timer. Hours of rolling take seconds, and a run depends on its seed alone.
"""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Coroutine, Mapping
from typing import Any, TypeVar

T = TypeVar("T")


class _JumpingSelector(selectors.BaseSelector):
    """A selector that moves virtual time on instead of waiting for its time-out."""

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()
        self.now_s = 0.0

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
        if timeout > 0:
            self.now_s += timeout
        return self._selector.select(0)

    def close(self) -> None:
        self._selector.close()

    def get_map(self) -> Mapping[Any, selectors.SelectorKey]:
        return self._selector.get_map()


class VirtualTimeLoop(asyncio.SelectorEventLoop):
    """An event loop whose ``time()`` starts at 0 and jumps to the next timer when nothing is ready."""

    def __init__(self) -> None:
        self._jumping = _JumpingSelector()
        super().__init__(self._jumping)
        # Two timers closer than this run in one turn, so that rounding never makes a turn that waits for 1e-16 s.
        self._clock_resolution = 1e-9

    def time(self) -> float:
        """Virtual seconds since the loop was made."""
        return self._jumping.now_s


def run(main: Coroutine[Any, Any, T], *, virtual: bool) -> T:
    """Run ``main`` to its end on a fresh loop: at virtual time, or at the machine's monotonic time.

    Ctrl-C cancels ``main`` (so that it can stop the robot and close its files) and then raises
    KeyboardInterrupt, as ``asyncio.Runner`` does.
    """
    factory = VirtualTimeLoop if virtual else None
    with asyncio.Runner(loop_factory=factory) as runner:
        return runner.run(main)
