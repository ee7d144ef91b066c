"""One robot of a session: it rolls leg after leg, blinks over the shape, and is called back when its link breaks."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from lab.base.colours import Rgb
from lab.base.errors import ChordlabError
from lab.session.blinker import Blinker
from lab.session.levels import SessionLevels
from lab.session.run import Run
from lab.settings.settings import Settings
from robot.crossings import CrossingDetector
from robot.device import Bump, Identity, RobotDevice, Sample
from robot.edge import EdgeLevels, EdgePoint, RingedDetector
from robot.errors import LinkLostError, NotConnectedError, ReplyTimeoutError
from robot.feeledge import EdgeError, FeltEdge, KnowsEdge, feel_edge
from robot.turning import Leg, Navigator, Policy, navigator_for

_log = logging.getLogger(__name__)

GIVE_UP_S = 15.0  # for what takes a second when all is well
_BATTERY_EVERY_S = 60.0
_AT_REST_CM_S = 0.3
_BRAKING_S = 2.0
_FEELING_CM_S = 12.0  # slow enough to find the ring's edge to a few millimetres
_CHARGED_V = 0.15  # above the limit: a robot taken off its charger at the very limit would pause at once
_LINK_ERRORS = (LinkLostError, NotConnectedError, ReplyTimeoutError)


class SessionError(ChordlabError):
    """The session cannot begin or go on."""


class Note(Protocol):
    """Where a roller tells what befell it: into the log and to whoever watches."""

    def __call__(self, kind: str, text: str, **data: object) -> None:
        """Take note; ``text`` is one line for people, ``data`` goes into the log."""
        ...


class Onlooker(Protocol):
    """Who looks on while robots roll."""

    def __call__(self, robot: str, sample: Sample, *, lit: bool, line: int | None, battery_v: float) -> None:
        """A robot's sample; whether its LED is to be lit, and the run that it is on. Must return quickly."""
        ...


class Roller:
    """One robot on the floor.

    Args:
        robot: the device, not yet connected.
        settings: the session's.
        cruising_cm_s: the speed that its command's units allow.
        rng: source of its turns.
        led_rgb: the colour of its LED, drive levels 0 to 1.
        note: takes what befalls it.
    """

    def __init__(
        self,
        robot: RobotDevice,
        settings: Settings,
        cruising_cm_s: float,
        rng: np.random.Generator,
        led_rgb: Rgb,
        note: Note,
    ) -> None:
        self.robot = robot
        self.battery_v = math.nan
        self.bumped_s = -math.inf
        self.onlooker: Onlooker | None = None
        self._settings = settings
        self._cruising_cm_s = cruising_cm_s
        self._led_rgb = led_rgb
        self._note = note
        self._light_latency_s = settings.profile().light_latency_s
        self._navigator: Navigator = navigator_for(settings.motion.turning, rng)
        self._levels: SessionLevels | None = None
        self._run: Run | None = None
        self._over = asyncio.Event()
        self._felt: FeltEdge | None = None
        self._listeners: list[Callable[[Sample], None]] = []
        self._blinker = Blinker(robot, settings.led, led_rgb, self._over_shape)
        self._lost = ""
        self._battery_read_s = 0.0
        self._longest_cm = settings.arena.longest_line_cm

    @property
    def name(self) -> str:
        """The robot's name."""
        return self.robot.name

    @property
    def used_up(self) -> bool:
        """Whether it is a stored robot whose runs are all played."""
        return bool(getattr(self.robot, "used_up", False))

    async def connect(self) -> Identity:
        """Find the robot and start its stream of light.

        Raises:
            RobotError: it is not to be had.
            SessionError: its battery is low.
        """
        robot, settings = self.robot, self._settings
        robot.on_sample, robot.on_bump, robot.on_lost = self._on_sample, self._on_bump, self._on_lost
        await robot.connect()
        identity = await robot.identity()
        self.battery_v, self._battery_read_s = identity.battery_v, asyncio.get_running_loop().time()
        if identity.battery_v < settings.link.battery_low_v:
            raise SessionError(
                f"{self.name}: battery at {identity.battery_v:.2f} V, below {settings.link.battery_low_v} V; charge it"
            )
        await robot.set_led(settings.led.dark_level, self._led_rgb)
        await robot.start_stream(settings.sensor.interval_s)
        return identity

    async def light(self, count: int) -> list[float]:
        """The next ``count`` light samples, lux. Raises SessionError when they do not come."""
        seen: list[float] = []
        await self._listen(lambda sample: seen.append(sample.light_lux) or len(seen) >= count, GIVE_UP_S)
        if len(seen) < count:
            raise SessionError(
                f"{self.name}: only {len(seen)} light samples in {GIVE_UP_S:g} s; "
                "bring the robot nearer to the computer and try again"
            )
        return seen

    def begin(self, levels: SessionLevels) -> Leg:
        """Take the session's light levels, and say where the first leg goes."""
        self._levels = levels
        return self._navigator.first()

    async def roll_leg(self, leg: Leg, line: int) -> Run:
        """Roll one leg to its end, however it ends, and come to rest.

        Raises:
            RobotError: the robot refuses a command.
        """
        levels = self._levels
        if levels is None:
            raise SessionError(f"{self.name}: the light levels are not known yet; run the preflight first")
        loop = asyncio.get_running_loop()
        run = Run(
            line,
            self.name,
            leg,
            loop.time(),
            self._cruising_cm_s,
            self._settings.motion.length_from == "odometry",
            CrossingDetector(levels.shape)
            if levels.edge is None
            else RingedDetector(levels.edge, light_latency_s=self._light_latency_s),
            self._felt.run_up_cm(leg.heading_rad) if self._felt is not None else 0.0,
            self._longest_cm,
        )
        self._over.clear()
        self._felt = None
        self._run = run  # before it drives: on a short run the bump can come before the command's reply
        self._blinker.changed()  # a run that ended in the light left the LED lit
        try:
            async with asyncio.timeout(GIVE_UP_S):
                await self.robot.drive(leg.heading_rad, run.speed_cm_s)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self._settings.motion.run_timeout_s):
                    await self._over.wait()
            if not run.ended:
                self._finish(run, "timeout")
            await self._stop()
            if run.entered is not None and levels.edge is not None:
                await self._feel_edge(run, levels.edge, run.entered)
        except (*_LINK_ERRORS, TimeoutError) as error:
            self._on_lost(str(error))
        finally:
            self._run = None
        return run

    async def next_leg(self, run: Run, *, moved: bool = False) -> Leg:
        """What to do after ``run``: call the robot back, let it charge, turn.

        Args:
            run: the last one.
            moved: whether it may have been carried since: it then sets out anew.

        Raises:
            ReconnectError: its link broke and it did not come back.
            SessionError: its battery was not charged in time.
        """
        if self._lost:  # after a bump too, while it was told to stop: that line is whole
            await self._call_back()
            return self._navigator.first()
        if await self._rested() or moved:
            return self._navigator.first()
        return self._navigator.next(run.as_leg_end())

    async def follow_with_led(self) -> None:
        """Show by the LED whether the robot is over the shape, until cancelled."""
        await self._blinker.follow()

    def _over_shape(self) -> bool:
        return self._run is not None and self._run.detector.lit

    async def halt(self) -> None:
        """Stop the robot, whatever state it is in."""
        self._run = None
        with contextlib.suppress(ChordlabError, TimeoutError):
            async with asyncio.timeout(GIVE_UP_S):
                await self.robot.stop()

    async def roll(
        self, heading_rad: float, speed_cm_s: float, until: Callable[[Sample], bool], timeout_s: float
    ) -> bool:
        """Roll until a sample says so, at the longest for ``timeout_s``, and come to rest; whether one said so.

        ``until`` is shown every sample from the command to the rest.
        """
        found = asyncio.Event()

        def ear(sample: Sample) -> None:
            if until(sample):
                found.set()

        self._listeners.append(ear)
        try:
            async with asyncio.timeout(GIVE_UP_S):
                await self.robot.drive(heading_rad, speed_cm_s)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(timeout_s):
                    await found.wait()
            await self._stop()
        finally:
            self._listeners.remove(ear)
        return found.is_set()

    async def _stop(self) -> None:
        """Stop; where light marks the edge, wait for the rest, since the next move starts from there."""
        async with asyncio.timeout(GIVE_UP_S):
            await self.robot.stop()
        if self._settings.arena.edge != "bump":
            await self._listen(lambda sample: sample.speed_cm_s < _AT_REST_CM_S, _BRAKING_S)

    async def _feel_edge(self, run: Run, levels: EdgeLevels, entered: EdgePoint) -> None:
        """Find the heading from the ring straight into the arena, where the policy turns by it."""
        if self._settings.motion.turning == Policy.INTERIOR:
            return
        if isinstance(self.robot, KnowsEdge):
            self._felt = await self.robot.felt_edge()
            if self._felt is not None:
                run.normal_heading_rad = self._felt.normal_heading_rad
            return
        arena = self._settings.arena
        radius_cm = arena.radius_cm - arena.ring_cm if arena.kind == "disc" else math.inf
        speed_cm_s = min(run.speed_cm_s, _FEELING_CM_S)
        try:
            self._felt = await feel_edge(
                self,
                levels,
                entered,
                run.leg.heading_rad,
                speed_cm_s,
                radius_cm=radius_cm,
                rolled_cm=run.length_cm,
                light_latency_s=self._light_latency_s,
            )
        except EdgeError as error:
            if error.in_ring:
                raise
            _log.warning("%s: %s", self.name, error)  # it stands inside, and heads anywhere
        else:
            run.normal_heading_rad = self._felt.normal_heading_rad

    async def _listen(self, until: Callable[[Sample], bool], timeout_s: float) -> bool:
        """Wait for a sample that ``until`` accepts."""
        heard = asyncio.Event()

        def ear(sample: Sample) -> None:
            if not heard.is_set() and until(sample):
                heard.set()

        self._listeners.append(ear)
        try:
            async with asyncio.timeout(timeout_s):
                await heard.wait()
        except TimeoutError:
            return False
        finally:
            self._listeners.remove(ear)
        return True

    async def _call_back(self) -> None:
        """Reconnect. The robot stands somewhere inside, facing anywhere: its frame is a new one."""
        limit_s = self._settings.link.reconnect_s
        if limit_s == 0:
            raise SessionError(f"{self.name}: the link was lost ({self._lost}); bring it nearer and run again")
        self._note(
            "lost",
            f"{self.name}: the link was lost ({self._lost}); calling it back for up to {limit_s:g} s",
            robot=self.name,
            reason=self._lost,
        )
        attempts = await self.robot.reconnect(limit_s)
        self._lost = ""
        self._note("back", f"{self.name}: back after {attempts} attempts", robot=self.name, attempts=attempts)

    async def _rested(self) -> bool:
        """Read the battery now and then; when it is low, wait until it is charged.

        Whether the robot may stand and face elsewhere now: after a pause, or after it had to be called back.
        """
        loop, link = asyncio.get_running_loop(), self._settings.link
        if loop.time() - self._battery_read_s < _BATTERY_EVERY_S:
            return False
        called_back = await self._read_battery()
        if self.battery_v >= link.battery_low_v:
            return called_back
        self._note(
            "pause",
            f"{self.name}: battery at {self.battery_v:.2f} V, below {link.battery_low_v:g} V: paused; charge it and "
            "put it back, the session goes on by itself",
            robot=self.name,
            battery_v=self.battery_v,
        )
        patient_until_s = loop.time() + link.charge_wait_s
        while self.battery_v < link.battery_low_v + _CHARGED_V:
            if loop.time() >= patient_until_s:
                raise SessionError(
                    f"{self.name}: battery still at {self.battery_v:.2f} V after {link.charge_wait_s:g} s; "
                    "what was rolled is kept, charge it and run again"
                )
            await asyncio.sleep(GIVE_UP_S)
            await self._read_battery()
        self._note("resume", f"{self.name}: battery at {self.battery_v:.2f} V: going on", robot=self.name)
        return True

    async def _read_battery(self) -> bool:
        """Read the battery; whether the robot had to be called back for it."""
        called_back = False
        try:
            self.battery_v = await self.robot.battery_v()
        except _LINK_ERRORS as error:
            self._lost = self._lost or str(error)
            await self._call_back()
            called_back = True
            self.battery_v = await self.robot.battery_v()
        self._battery_read_s = asyncio.get_running_loop().time()
        return called_back

    def _on_sample(self, sample: Sample) -> None:
        for listener in tuple(self._listeners):
            listener(sample)
        run = self._run
        self._show(sample, run)
        if run is None:
            return
        if run.ended:
            if run.ended == "bump" and run.at_rest is None:
                run.at_rest = sample
            return
        lit = run.detector.lit
        run.feed(sample)
        if run.detector.lit != lit:
            self._blinker.changed()
        if run.entered is not None:
            self._finish(run, "edge", run.entered.t_s)
        elif run.arrived:
            self._finish(run, "stop")
        elif run.stalled:
            self._finish(run, "stall")

    def _show(self, sample: Sample, run: Run | None) -> None:
        if self.onlooker is not None:
            lit, line = (False, None) if run is None else (run.detector.lit, run.line)
            self.onlooker(self.name, sample, lit=lit, line=line, battery_v=self.battery_v)

    def _on_bump(self, bump: Bump) -> None:
        self.bumped_s = bump.t_host_s
        run = self._run
        if run is not None and not run.ended:
            run.normal_heading_rad = bump.normal_heading_rad
            self._finish(run, "bump", bump.t_host_s)

    def _on_lost(self, reason: str) -> None:
        self._lost = self._lost or reason
        if self._run is not None and not self._run.ended:
            self._finish(self._run, "link")

    def _finish(self, run: Run, ended: str, t_s: float | None = None) -> None:
        run.finish(asyncio.get_running_loop().time() if t_s is None else t_s, ended)
        self._over.set()
