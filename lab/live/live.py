"""A session's end of the live page: the pace of its clock, what people ask, and what they are told."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager

from lab.clock import Pace
from lab.live.channel import Command, Ends, take_commands
from lab.live.controls import Controls
from lab.live.feed import Feed


class Live:
    """What a session has of a page, or, without one, what stands for it.

    Args:
        ends: the session's ends of the channel to the page server; None: there is no page.
        speed: how many times real time a virtual bench goes; None: as fast as it can.
        can_pause: whether the robots can wait between two runs.
        next_shape: what comes after this session; empty: nothing.
        say: told in words that the page is gone.
    """

    def __init__(
        self,
        ends: Ends | None = None,
        *,
        speed: float | None = None,
        can_pause: bool = True,
        next_shape: str = "",
        say: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.pace = Pace(speed)
        self.controls = Controls(self.pace, can_pause=can_pause)
        self.feed = Feed(ends)
        self._ends = ends
        self._say = say
        self.feed.tell(speed=speed, can_pause=can_pause, next_shape=next_shape, paused=False, state="")

    def telling(self, say: Callable[[str], None]) -> Callable[[str], None]:
        """``say``, and the page is told the same."""

        def both(text: str) -> None:
            say(text)
            self.feed.tell(said=text)

        return both

    @asynccontextmanager
    async def attended(self) -> AsyncGenerator[None]:
        """Take the page's commands on the running loop meanwhile."""
        if self._ends is None:
            yield
            return
        listening = asyncio.create_task(self._listen(self._ends))
        try:
            yield
        finally:
            listening.cancel()
            await asyncio.gather(listening, return_exceptions=True)

    async def _listen(self, ends: Ends) -> None:
        await take_commands(ends, self._take)
        self._say("the live page is gone; the session goes on")
        self.controls.resume()

    def _take(self, command: Command) -> None:
        if command.get("do") == "look":
            self.feed.look()
            return
        self.controls.take(command)
        self.feed.tell(paused=self.controls.paused, stopping=self.controls.stop_asked)
