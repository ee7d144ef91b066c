from __future__ import annotations

import asyncio
import math
from collections.abc import Callable

import pytest

from lab.clock import run
from robot import commands
from robot.commands import Request
from robot.profile import RobotProfile
from robot.tending import Tending


class _DeafLink:
    """A link that never changes: what its owner does has no effect on the next deadline."""

    is_open = True
    last_write_s = 0.0

    def __init__(self) -> None:
        self.asked = 0
        self.failed: list[float] = []

    async def ask(
        self, request: Request, *, timeout_s: float | None = None, wanted: Callable[[], bool] | None = None
    ) -> bytes:
        self.asked += 1
        return b""

    def fail(self, reason: str) -> None:
        self.failed.append(asyncio.get_running_loop().time())


def _tended(most: int) -> tuple[_DeafLink, Tending]:
    """One that may read the clock ``most`` times only, so that a busy loop fails instead of hanging."""
    loop = asyncio.get_running_loop()
    link = _DeafLink()
    tending = Tending("SB-0000", link, RobotProfile())
    reads = [0]

    def now_s() -> float:
        reads[0] += 1
        if reads[0] > most:
            raise RuntimeError(f"busy at {loop.time()} s")
        return loop.time()

    tending._now_s = now_s
    return link, tending


async def _let_run(s: float, *tasks: asyncio.Task[None]) -> None:
    done, others = await asyncio.wait(tasks, timeout=s)
    for task in others:
        task.cancel()
    assert [str(task.exception()) for task in done] == []


def test_a_keep_alive_without_effect_does_not_stop_the_clock() -> None:
    async def main() -> None:
        link, tending = _tended(20_000)
        await _let_run(10.0, asyncio.ensure_future(tending.tend()))
        # From 8 s on it is due in every turn, and a turn lasts at least a millisecond.
        assert 100 < link.asked <= 2_010

    run(main(), virtual=True)


@pytest.mark.parametrize("ahead_s", [0.0, 1e-16, 4e-10, 9e-10])
@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_two_deadlines_within_a_rounding_do_not_chase_each_other(ahead_s: float, turns: int) -> None:
    """A loop may wake its sleepers a clock's resolution early. One that then sleeps for the rest is woken
    at once when another is ready in that turn; two that do so in turn keep each other awake, and the clock still."""

    async def main() -> None:
        loop = asyncio.get_running_loop()
        links, both = zip(*(_tended(10_000) for _ in range(2)), strict=True)
        for link, tending in zip(links, both, strict=True):
            link.last_write_s = math.inf
            # Half a refresh is 0.4 s: awake at that instant, with the deadline just ahead.
            tending._repeat_at_s = 0.4 + ahead_s
            tending._motion = commands.drive(1, 0.0)
        one = loop.create_task(both[0].tend())
        # Both are awake at 0.4 s, in turns of the loop that may differ.
        await asyncio.sleep(0.4)
        for _ in range(turns):
            await asyncio.sleep(0)
        two = loop.create_task(both[1].tend())
        await _let_run(4.7, one, two)
        assert loop.time() == pytest.approx(5.1, abs=0.01)
        # A repeat every 0.8 s from 0.4 s on.
        assert [link.asked for link in links] == [6, 6]

    run(main(), virtual=True)


def test_the_watch_over_a_stream_does_not_chase_a_deadline_either() -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        tasks: list[asyncio.Task[None]] = []
        links: list[_DeafLink] = []
        await asyncio.sleep(2.999)
        for _ in range(2):
            link, tending = _tended(10_000)
            # A rounding before the silence is too long.
            tending._sampled_s = 4e-10
            links.append(link)
            tasks.append(loop.create_task(tending.watch()))
            await asyncio.sleep(0)
        await asyncio.wait(tasks, timeout=5.0)
        assert [link.failed for link in links] == [pytest.approx([3.0], abs=1.001e-3)] * 2

    run(main(), virtual=True)


@pytest.mark.parametrize("begun_s", [0.0, 0.3, 1.4, 1.4999, 1.5001])
@pytest.mark.parametrize("sampled_s", [0.0, 0.1, 1.6, 2.7, 2.99, 2.9985])
def test_silence_is_noticed_in_time_and_not_before(begun_s: float, sampled_s: float) -> None:
    """Whenever the watch looks: from the last sample to the word that the link is lost, 3 s at most."""

    async def main() -> None:
        link, tending = _tended(10_000)
        watching = asyncio.ensure_future(tending.watch())
        await asyncio.sleep(begun_s)
        tending.expect_samples(0.05)
        await asyncio.sleep(sampled_s)
        tending.sampled_at(begun_s + sampled_s)
        await watching
        (failed_s,) = link.failed
        assert 2.99 < failed_s - begun_s - sampled_s <= 3.0

    run(main(), virtual=True)


def test_a_stream_slower_than_the_silence_is_not_silent_between_its_frames() -> None:
    async def main() -> None:
        link, tending = _tended(100_000)
        watching = asyncio.ensure_future(tending.watch())
        tending.expect_samples(10.0)
        for _ in range(5):
            await asyncio.sleep(10.0)
            tending.sampled_at(asyncio.get_running_loop().time())
        assert link.failed == []
        await watching
        assert link.failed == [pytest.approx(70.0, abs=0.01)]

    run(main(), virtual=True)
