"""The clock of a replay: when, on the event loop's clock, what was stored is due."""

from __future__ import annotations

import asyncio
import math
from collections import defaultdict
from typing import Literal

Mark = tuple[Literal["begun", "over"], int]
"""A run has begun, or is over: which of both, and the run's number."""

# Whoever is later than what was stored moves all the rest on; who is earlier by more than this skips the wait.
_LONGEST_WAIT_S = 5.0
_SAME_S = 1e-6  # late by no more is in time


class Timeline:
    """What several replayed devices share: one shift from stored times to the loop's, and how far the runs have come.

    Times are in s. Used on one event loop.
    """

    def __init__(self) -> None:
        self._shift_s = -math.inf  # until the first run begins
        self._marks: defaultdict[Mark, asyncio.Event] = defaultdict(asyncio.Event)

    def due_s(self, t_s: float) -> float:
        """When the stored time ``t_s`` is due on the loop's clock; minus infinity before the first run."""
        return t_s + self._shift_s

    def begin_s(self, t_s: float, now_s: float) -> float:
        """When what was stored from ``t_s`` on begins: now, or a little later where the replay is ahead."""
        if not -_SAME_S <= self.due_s(t_s) - now_s <= _LONGEST_WAIT_S:
            self._shift_s = now_s - t_s
        return self.due_s(t_s)

    def reach(self, mark: Mark) -> None:
        """Say that a run has begun or is over."""
        self._marks[mark].set()

    async def reached(self, mark: Mark) -> None:
        """Wait until a run has begun or is over."""
        await self._marks[mark].wait()


async def sleep_until(due_s: float) -> None:
    """Sleep until the loop's clock shows ``due_s``; not at all where that is past."""
    now_s = asyncio.get_running_loop().time()
    if due_s > now_s:
        await asyncio.sleep(due_s - now_s)
