"""What keeps one connection to a robot alive, and what notices that it is dead."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Sequence
from typing import Protocol

from robot import commands
from robot.commands import Request
from robot.errors import ReplyTimeoutError, RobotError
from robot.profile import RobotProfile

# Who waits for a deadline sleeps at least this long, far above what an event loop may wake it early by: else
# it could find the deadline a rounding ahead for ever, in turns that take no virtual time. What must be
# noticed in time is therefore looked at this much before.
_LEAST_NAP_S = 0.001
# However short the profile's silence is, a repeated command is given this long to be answered.
_LEAST_ANSWER_S = 0.5


class Asked(Protocol):
    """The part of a ``Link`` that is tended."""

    @property
    def is_open(self) -> bool:
        """Whether commands can be sent."""
        ...

    @property
    def last_write_s(self) -> float:
        """Loop time of the last write."""
        ...

    async def ask(
        self, request: Request, *, timeout_s: float | None = None, wanted: Callable[[], bool] | None = None
    ) -> bytes:
        """Send ``request`` and return the payload of its answer."""
        ...

    def fail(self, reason: str) -> None:
        """Take the link for lost."""
        ...


class Tending:
    """Repeats the command that a robot moves by, keeps it awake, and watches over its stream and its answers.

    A BOLT that hears nothing stops by itself, so one whose command is repeated here stops when this program
    does. A robot that is gone without a word is noticed within the profile's ``silence_s`` of the last sample
    when it streams; of the last answer when it rolls; of the question when it is told to roll or stop.

    Args:
        name: What the tasks are called by.
        link: Whom to ask.
        profile: Times.
    """

    def __init__(self, name: str, link: Asked, profile: RobotProfile) -> None:
        self._sampled_s = math.inf
        self._name = name
        self._link = link
        self._profile = profile
        self._motion: Request | None = None
        self._repeat_at_s = math.inf
        self._answered_s = 0.0
        self._silence_s = profile.silence_s
        self._tasks: tuple[asyncio.Task[None], ...] = ()

    def start(self) -> None:
        """Begin to tend a link that has been opened and set up."""
        loop = asyncio.get_running_loop()
        self._tasks = (
            loop.create_task(self.tend(), name=f"tend {self._name}"),
            loop.create_task(self.watch(), name=f"watch {self._name}"),
        )

    def dismiss(self) -> tuple[asyncio.Task[None], ...]:
        """End it: nothing is repeated or expected any more. The cancelled tasks, none when it was not begun."""
        tasks, self._tasks = self._tasks, ()
        for task in tasks:
            task.cancel()
        self._motion = None
        self._repeat_at_s = self._sampled_s = math.inf
        return tasks

    def expect_samples(self, interval_s: float) -> None:
        """From now on a sample comes every ``interval_s``; infinity for none."""
        # A stream slower than the silence is not silent between two of its frames.
        self._silence_s = max(self._profile.silence_s, 2 * interval_s)
        self._sampled_s = self._now_s() if interval_s < math.inf else math.inf

    def sampled_at(self, t_s: float) -> None:
        """A sample has come; none counts that was on its way when the stream was ended."""
        if self._sampled_s < math.inf:
            self._sampled_s = t_s

    async def move(self, motion: Request, *, lasts: bool, before: Sequence[Request] = ()) -> bool:
        """Send the command ``motion``, which takes the place of any older one; repeat it from now on if it ``lasts``.

        Args:
            motion: What to do.
            lasts: Whether the robot moves by it, rather than coming to rest.
            before: What must be answered before.

        Returns:
            Whether the robot has said that it does so; not when a newer command overtook this one.

        Raises:
            RobotError: The robot refuses or is gone. One that says nothing within ``silence_s`` is taken for lost.
        """
        # Set before the wait, so that nothing older is repeated after this.
        self._motion, self._repeat_at_s = motion, math.inf

        def wanted() -> bool:
            return self._motion is motion

        answer_s = max(_LEAST_ANSWER_S, self._profile.silence_s)
        try:
            for request in before:
                await self._link.ask(request, timeout_s=answer_s, wanted=wanted)
                if not wanted():
                    return False
            await self._link.ask(motion, timeout_s=answer_s, wanted=wanted)
        except ReplyTimeoutError as error:
            if wanted():
                self._link.fail(str(error))
                raise
            return False
        if lasts and wanted():
            self._moved()
        return True

    def _now_s(self) -> float:
        return asyncio.get_running_loop().time()

    def _moved(self) -> None:
        """The robot has said that it does as told."""
        self._answered_s = self._now_s()
        self._repeat_at_s = self._answered_s + self._profile.refresh_s

    async def tend(self) -> None:
        """Repeat the motion command and keep the robot awake, until the link is no more."""
        profile, link = self._profile, self._link
        while link.is_open:
            try:
                if self._now_s() >= self._repeat_at_s:
                    await self._repeat()
                elif self._now_s() >= link.last_write_s + profile.keep_alive_s:
                    await link.ask(Request(commands.PING))
            except RobotError as error:
                link.fail(str(error))
                return
            next_s = min(link.last_write_s + profile.keep_alive_s, self._repeat_at_s)
            # At most half a refresh, so that a drive begun meanwhile is seen in time.
            await asyncio.sleep(max(_LEAST_NAP_S, min(next_s - self._now_s(), profile.refresh_s / 2)))

    async def _repeat(self) -> None:
        """Send the motion command once more; a robot that has answered none for too long is lost."""
        motion = self._motion
        if motion is None:
            return
        left_s = self._answered_s + self._profile.silence_s - _LEAST_NAP_S - self._now_s()
        try:
            await self._link.ask(motion, timeout_s=max(_LEAST_ANSWER_S, left_s), wanted=lambda: self._motion is motion)
        except ReplyTimeoutError:
            # One that was overtaken by a newer command need not be answered.
            if self._motion is motion:
                raise
        else:
            if self._motion is motion:
                self._moved()

    async def watch(self) -> None:
        """Take a link whose stream has fallen silent for lost."""
        while self._link.is_open:
            left_s = self._sampled_s + self._silence_s - _LEAST_NAP_S - self._now_s()
            if left_s <= 0:
                self._link.fail(f"no sample for {self._silence_s:g} s")
                return
            # At most half a silence, so that a stream begun meanwhile is seen in time.
            await asyncio.sleep(max(_LEAST_NAP_S, min(self._profile.silence_s / 2, left_s)))
