"""A robot on trial: rolled by the unit of its speed byte, its words kept, so that what it does can be measured.

Nothing is corrected on the way: it is driven by a ``neutral`` profile, under which one cm/s is one unit.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from robot.collision import AXES
from robot.device import Bump, RobotDevice, Sample
from robot.errors import RobotError
from robot.fitting import TURN, Floats, path_of
from robot.profile import RobotProfile

FINEST_S = 0.001  # the stream's interval counts in whole milliseconds
GIVE_UP_S = 4.0
MOVED_CM = 0.3  # less is jitter
_STALLED_S = 2.0  # longer than any turn on the spot, and then some way at any speed
_STILL_S, _STILL_CM = 0.3, 0.02


class CharacteriseError(RobotError):
    """A measurement cannot be made; the line says which and what to do."""


def neutral(profile: RobotProfile) -> RobotProfile:
    """``profile`` with everything that is to be measured at values that change nothing."""
    return replace(
        profile,
        cm_s_per_unit=1.0,
        least_speed_units=1,
        least_interval_s=FINEST_S,
        motion_latency_s=0.0,
        light_latency_s=0.0,
        drift_rad_per_cm=0.0,
        locator_scale=1.0,
        collision_axes=AXES,
    )


@dataclass(frozen=True, slots=True)
class Roll:
    """One roll: what was told, when, and what came back until the robot was at rest again."""

    heading_rad: float
    units: int
    t_command_s: float
    samples: tuple[Sample, ...]
    bump: Bump | None

    @property
    def t_s(self) -> Floats:
        """Times of the samples (n,)."""
        return np.array([sample.t_host_s for sample in self.samples])

    @property
    def path_cm(self) -> Floats:
        """Path by the odometer (n,)."""
        return path_of([sample.x_cm for sample in self.samples], [sample.y_cm for sample in self.samples])

    @property
    def speed_cm_s(self) -> Floats:
        """Speed by the odometer (n,)."""
        return np.array([sample.speed_cm_s for sample in self.samples])

    @property
    def rolled_cm(self) -> float:
        """Path in all."""
        return float(self.path_cm[-1]) if self.samples else 0.0

    @property
    def end_cm(self) -> tuple[float, float]:
        """Where it came to rest, in the robot's frame."""
        return (self.samples[-1].x_cm, self.samples[-1].y_cm) if self.samples else (0.0, 0.0)


class Trial:
    """A connected robot under trial: its callbacks are taken over.

    Args:
        robot: Driven by a ``neutral`` profile.
        rng: Phases and headings are drawn from it.

    Attributes:
        heading_rad: The heading of the last roll.
        lost: Why the link was lost; empty while it holds.
    """

    def __init__(self, robot: RobotDevice, rng: Generator) -> None:
        self.robot = robot
        self.rng = rng
        self.heading_rad = 0.0
        self.interval_s = 0.05
        self.lost = ""
        self._samples: list[Sample] = []
        self._bump: Bump | None = None
        self._news = asyncio.Event()
        robot.on_sample, robot.on_bump, robot.on_lost = self._on_sample, self._on_bump, self._on_lost

    def _on_sample(self, sample: Sample) -> None:
        self._samples.append(sample)
        self._news.set()

    def _on_bump(self, bump: Bump) -> None:
        if self._bump is None:
            self._bump = bump
        self._news.set()

    def _on_lost(self, reason: str) -> None:
        self.lost = reason
        self._news.set()

    async def stream(self, interval_s: float) -> None:
        """Stream at ``interval_s`` from now on."""
        self.interval_s = interval_s
        await self.robot.start_stream(interval_s)

    async def next_sample(self) -> Sample:
        """Wait for the next sample.

        Raises:
            CharacteriseError: None comes, or the link is lost.
        """
        known = len(self._samples)
        try:
            async with asyncio.timeout(GIVE_UP_S):
                while len(self._samples) == known:
                    self._check_link()
                    self._news.clear()
                    await self._news.wait()
        except TimeoutError:
            raise self.error(
                f"no sample for {GIVE_UP_S:g} s; bring it nearer to the computer and start again"
            ) from None
        return self._samples[-1]

    async def listen(self, for_s: float) -> list[Sample]:
        """The samples that come within ``for_s``, fewer when the link breaks."""
        known = len(self._samples)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(for_s):
                while not self.lost:
                    self._news.clear()
                    await self._news.wait()
        return self._samples[known:]

    async def rest(self) -> None:
        """Stop, and wait until it stands."""
        await self.robot.stop()
        loop = asyncio.get_running_loop()
        until_s = loop.time() + GIVE_UP_S
        stood_since = last = await self.next_sample()
        # Longer than a command may take to come into force.
        while last.t_host_s - stood_since.t_host_s < _STILL_S and last.t_host_s < until_s:
            last = await self.next_sample()
            if math.hypot(last.x_cm - stood_since.x_cm, last.y_cm - stood_since.y_cm) > _STILL_CM:
                stood_since = last

    async def roll(self, heading_rad: float, units: int, *, for_s: float, until_cm: float = math.inf) -> Roll:
        """Roll from rest for at most ``for_s``, ``until_cm`` of path, a bump or a stall, and come to rest again.

        Raises:
            CharacteriseError: The link is lost, or no samples come.
        """
        await self.next_sample()
        # The command comes at a random phase of the stream, or all repeats would round alike.
        await asyncio.sleep(float(self.rng.uniform(0.0, self.interval_s)))
        loop = asyncio.get_running_loop()
        first = len(self._samples) - 1
        self._bump, self.heading_rad = None, heading_rad % TURN
        start = moved = self._samples[first]
        t_command_s = loop.time()
        await self.robot.drive(self.heading_rad, float(units))
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout_at(t_command_s + for_s):
                while self._bump is None:
                    self._check_link()
                    last = self._samples[-1]
                    if math.hypot(last.x_cm - start.x_cm, last.y_cm - start.y_cm) >= until_cm:
                        break
                    if math.hypot(last.x_cm - moved.x_cm, last.y_cm - moved.y_cm) > MOVED_CM:
                        moved = last
                    elif last.t_host_s - max(moved.t_host_s, t_command_s) > _STALLED_S:
                        break
                    self._news.clear()
                    await self._news.wait()
        bump = self._bump
        await self.rest()
        return Roll(self.heading_rad, units, t_command_s, tuple(self._samples[first:]), bump)

    def turned_round(self) -> float:
        """The heading back where the last roll came from, a little aside so that it does not wear one track."""
        return self.heading_rad + math.pi + float(self.rng.uniform(-0.6, 0.6))

    def error(self, message: str) -> CharacteriseError:
        """An error of this robot."""
        return CharacteriseError(f"{self.robot.name}: {message}", robot=self.robot.name)

    def _check_link(self) -> None:
        if self.lost:
            raise self.error(f"the link was lost ({self.lost}); bring it nearer to the computer and start again")

    async def call_back(self) -> None:
        """Connect anew after a link that was broken on purpose.

        Raises:
            RobotError: It does not come back.
        """
        for wait_s in (0.5, 2.0, 5.0, math.inf):
            await self.robot.disconnect()
            try:
                await self.robot.connect()
            except RobotError:
                if wait_s == math.inf:
                    raise
                await asyncio.sleep(wait_s)
            else:
                self.lost, self._samples = "", []
                return
