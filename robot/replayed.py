"""A stored robot as a device: it plays the runs that it once rolled, each when it is told to drive.

It is told where to and how fast, and rolls as it did then. What ends a run is found by whoever reads its samples,
with its own thresholds; bumps, broken links and their times are the stored ones.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lab.base.timeline import Timeline, sleep_until
from robot.device import Bump, Identity, Sample
from robot.edge import EdgePoint
from robot.errors import NotConnectedError, ReconnectError, RobotError
from robot.feeledge import FeltEdge

_LONGEST_STOP_S = 10.0  # whoever stops a robot gives up soon after


class RunsUsedUpError(RobotError):
    """A stored robot was told to drive once more than it did. Ask for fewer lines."""

    def __init__(self, robot: str) -> None:
        super().__init__(f"{robot}: all its stored runs are played; ask for fewer lines", robot=robot)


@dataclass(frozen=True, slots=True, eq=False)
class StoredRun:
    """One run as it was recorded. Times are in s of one clock, that of all runs; lengths in cm, robot's frame.

    Attributes:
        number: its own among all that share the clock.
        t_start_s: when it was told to drive.
        samples: (n, 5) time, light in lux, x, y, speed in cm/s, as in ``Sample``.
        t_end_s: when it ended.
        ended: how: ``bump`` and ``contact`` are told at ``t_end_s``, and ``link``; all else the samples tell.
        normal_heading_rad: heading from its end into the arena, where that was felt.
        rest_cm: where it came to rest, where that is known better than by the last sample.
        t_over_s: when it had come to rest, until when ``stop`` takes.
        reply_s: how long its answer to the drive command took, where the end hangs on it.
        lost: why it had to be called back, or set down anew, after this run; empty where it rolled on.
        depth_cm: how far from an edge of light it rested, square to it, once it had felt it.
    """

    number: int
    t_start_s: float
    samples: NDArray[np.float64]
    t_end_s: float
    ended: str
    normal_heading_rad: float | None = None
    rest_cm: tuple[float, float] | None = None
    t_over_s: float = -math.inf
    reply_s: float = 0.0
    lost: str = ""
    depth_cm: float = 0.0


class ReplayedRobot:
    """A ``RobotDevice`` that plays stored runs in their order.

    Args:
        identity: whose they are.
        runs: the runs, in order.
        plain_light: light samples in lux under one plain field after another, as ``expose`` counts them.
        timeline: the clock that it shares with the other devices of the replay.
        settle_s: how long after a field is shown its light is waited for.
    """

    def __init__(
        self,
        identity: Identity,
        runs: Sequence[StoredRun],
        plain_light: Sequence[Sequence[float]],
        timeline: Timeline,
        *,
        settle_s: float = 0.0,
    ) -> None:
        self.name = identity.name
        self.on_sample: Callable[[Sample], None] | None = None
        self.on_bump: Callable[[Bump], None] | None = None
        self.on_lost: Callable[[str], None] | None = None
        self._identity = identity
        self._runs = tuple(runs)
        self._plain_light = tuple(plain_light)
        self._timeline = timeline
        self._settle_s = settle_s
        self._next = 0
        self._run: StoredRun | None = None
        self._place = (math.nan, 0.0, 0.0)  # light, x, y of the last sample
        self._connected = False
        self._interval_s: float | None = None
        self._playing: asyncio.Task[None] | None = None
        self._resting: asyncio.Handle | None = None

    @property
    def used_up(self) -> bool:
        """Whether all stored runs are played."""
        return self._next >= len(self._runs)

    async def connect(self) -> None:
        """Begin with the first run."""
        self._connected = True

    async def reconnect(self, give_up_s: float = 60.0) -> int:
        """Come back when it did then, however long that took.

        Returns:
            1, or 0 when it is there.

        Raises:
            ReconnectError: It has no more runs.
        """
        if self._connected:
            return 0
        if self.used_up:
            raise ReconnectError(self.name, attempts=1, give_up_s=give_up_s, reason="its stored runs are used up")
        await sleep_until(self._timeline.due_s(self._runs[self._next].t_start_s))
        self._connected = True
        return 1

    async def disconnect(self) -> None:
        """Let it go."""
        self._connected = False
        self._fall_silent()

    async def identity(self) -> Identity:
        """Name, address, firmware and battery, as they were."""
        return self._identity

    async def battery_v(self) -> float:
        """Battery voltage when it was connected, V."""
        return self._identity.battery_v

    async def set_led(self, level: float, rgb: tuple[float, float, float] = (1.0, 0.0, 0.0)) -> None:
        """Do nothing: the film shows how it blinked."""

    async def start_stream(self, interval_s: float) -> None:
        """Deliver samples from now on; those of runs come when they came then."""
        self._interval_s = interval_s

    async def stop_stream(self) -> None:
        """Deliver no more samples."""
        self._interval_s = None

    def expose(self, field: int) -> None:
        """Say that the ``field``-th plain field of light is shown, from 0; beyond the last one nothing is streamed."""
        self._fall_silent()
        if field < len(self._plain_light) and self._plain_light[field] and self._interval_s is not None:
            self._playing = asyncio.create_task(self._show_plain(self._plain_light[field], self._interval_s))

    async def drive(self, heading_rad: float, speed_cm_s: float) -> None:
        """Roll the next stored run, whatever is asked for.

        Raises:
            RunsUsedUpError: There is none.
            NotConnectedError: It is lost, or not connected yet.
        """
        if not self._connected:
            raise NotConnectedError(self.name, "drive")
        if self.used_up:
            raise RunsUsedUpError(self.name)
        self._fall_silent()
        run = self._runs[self._next]
        self._next += 1
        self._run = run
        begins_s = self._timeline.begin_s(run.t_start_s, asyncio.get_running_loop().time())
        await sleep_until(begins_s)
        self._timeline.reach(("begun", run.number))
        self._playing = asyncio.create_task(self._play(run, begins_s - run.t_start_s))
        await asyncio.sleep(run.reply_s)

    async def stop(self) -> None:
        """Come to rest: at once where the run was to go on, else when it did.

        Raises:
            NotConnectedError: The link broke.
        """
        run, self._run = self._run, None
        if run is None:
            return
        self._fall_silent()
        over_s = self._timeline.due_s(run.t_over_s)
        now_s = asyncio.get_running_loop().time()
        if run.rest_cm is not None:
            self._place = (self._place[0], *run.rest_cm)
        if self._connected:
            self._give_rest()
        if now_s >= self._timeline.due_s(run.t_end_s) - 1e-6:
            await sleep_until(min(over_s, now_s + _LONGEST_STOP_S))
        self._timeline.reach(("over", run.number))
        if not self._connected:
            raise NotConnectedError(self.name, "stop")
        if run.lost:
            self._break(run.lost)
        else:  # heard by whoever waits for its rest after this
            self._resting = asyncio.get_running_loop().call_soon(self._give_rest)

    async def felt_edge(self) -> FeltEdge | None:
        """What it found of the edge of light that its last run ended at; None where it did not find it."""
        run = self._runs[self._next - 1] if self._next else None
        if not self.used_up:
            await sleep_until(self._timeline.due_s(self._runs[self._next].t_start_s))
        if run is None or run.normal_heading_rad is None:
            return None
        normal_rad, depth_cm = run.normal_heading_rad, run.depth_cm
        left = EdgePoint(run.t_end_s, 0.0, 0.0, into_ring=False)
        return FeltEdge(normal_rad, left, depth_cm * math.sin(normal_rad), depth_cm * math.cos(normal_rad))

    async def _show_plain(self, light_lux: Sequence[float], interval_s: float) -> None:
        loop = asyncio.get_running_loop()
        await asyncio.sleep(self._settle_s)
        while True:
            for lux in light_lux:
                await asyncio.sleep(interval_s)
                self._give(Sample(loop.time(), lux, 0.0, 0.0, 0.0))

    async def _play(self, run: StoredRun, shift_s: float) -> None:
        rows: list[list[float]] = run.samples.tolist()
        for t_s, *rest in rows:
            await sleep_until(t_s + shift_s)
            self._give(Sample(t_s + shift_s, *rest))
        t_end_s = run.t_end_s + shift_s
        match run.ended:
            case "bump" | "contact":
                await sleep_until(t_end_s)
                if self.on_bump is not None:
                    normal_rad = run.normal_heading_rad
                    self.on_bump(Bump(t_end_s, math.nan if normal_rad is None else normal_rad))
            case "link":
                await sleep_until(t_end_s)
                self._break(run.lost or "its link broke here")
            case _:  # whoever reads other levels may see no end yet: it stands still, as one that is stuck
                interval_s = self._interval_s or 0.05
                while True:
                    await asyncio.sleep(2 * interval_s)
                    self._give_rest()

    def _give(self, sample: Sample) -> None:
        self._place = (sample.light_lux, sample.x_cm, sample.y_cm)
        if self.on_sample is not None and self._interval_s is not None:
            self.on_sample(sample)

    def _give_rest(self) -> None:
        """A sample at rest."""
        self._give(Sample(asyncio.get_running_loop().time(), *self._place, 0.0))

    def _break(self, reason: str) -> None:
        self._connected = False
        if self.on_lost is not None:
            self.on_lost(reason)

    def _fall_silent(self) -> None:
        for under_way in (self._playing, self._resting):
            if under_way is not None:
                under_way.cancel()
        self._playing = self._resting = None
