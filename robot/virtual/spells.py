"""States that pass: what lasts for a while, and what then ends it."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable

# Timers may fire a clock's resolution early.
_EARLY_S = 1e-6


class Spells:
    """Named spells of time, each with what ends it. Of two that overlap under one name, the later end counts."""

    def __init__(self) -> None:
        self._timers: set[asyncio.TimerHandle] = set()
        self._ends: dict[str, tuple[float, Callable[[], None]]] = {}

    def after(self, delay_s: float, action: Callable[[], None]) -> None:
        """Do ``action`` in ``delay_s``, unless closed before."""

        def run() -> None:
            self._timers.discard(timer)
            action()

        timer = asyncio.get_running_loop().call_later(max(0.0, delay_s), run)
        self._timers.add(timer)

    def begin(self, name: str, for_s: float, end: Callable[[], None]) -> None:
        """Do ``end`` in ``for_s``, or when the spell of that name that already runs ends, whichever is later."""
        loop = asyncio.get_running_loop()
        end_s = loop.time() + for_s
        running = self._ends.get(name)
        if running is not None:
            # Who began first knows what to go back to.
            end_s, end = max(end_s, running[0]), running[1]
        self._ends[name] = end_s, end

        def over() -> None:
            spell = self._ends.get(name)
            if spell is not None and loop.time() >= spell[0] - _EARLY_S:
                del self._ends[name]
                spell[1]()

        if end_s < math.inf:
            self.after(end_s - loop.time(), over)

    def close(self) -> None:
        """End every spell now, and do nothing that was to come."""
        for timer in self._timers:
            timer.cancel()
        self._timers.clear()
        ends, self._ends = self._ends, {}
        for _, end in ends.values():
            end()
