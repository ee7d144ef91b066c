"""The driver of a Sphero BOLT: the real one, or the virtual one through the same bleak client."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from collections.abc import Callable
from types import TracebackType
from typing import Self

from bleak.backends.client import BaseBleakClient
from bleak.backends.scanner import BaseBleakScanner

from robot import commands, preparing, status
from robot.backoff import persist
from robot.collision import wall_normal_heading
from robot.commands import BatteryState, ChargerState, Collision, Colour, Request
from robot.device import Attitude, Bump, Identity, Sample
from robot.errands import Errands
from robot.errors import CommandError, DriveError, LinkLostError, PayloadError, ReplyTimeoutError, RobotError
from robot.link import Heard, Link, scan
from robot.packets import Packet
from robot.preparing import MOTORS_OFF, STABILISED
from robot.profile import RobotProfile
from robot.stream import OFF, Stream
from robot.tending import Tending

__all__ = ["Bolt", "Heard", "scan"]

_log = logging.getLogger(__name__)

_SENSOR_DATA = commands.SENSOR_DATA.key
_COLLISION = commands.COLLISION.key
_FAREWELL_TIMEOUT_S = 2.0
# Braking and half a turn on the spot take about a second.
_AIM_S = 2.0
_AIMING: Colour = (0, 0, 255)
_DARK: Colour = (0, 0, 0)
_UNSTABILISED = Request(commands.STABILISATION, commands.STABILISATION.payload(commands.STABILISE_NONE))


class Bolt:
    """A Sphero BOLT as a ``RobotDevice``.

    While it rolls, a task repeats the drive command: a BOLT that hears nothing stops by itself, so it
    stops when this program does. Others keep it awake and watch over the stream. As a context manager it is
    connected on the way in, and stopped and let go on every way out.

    Args:
        name: Advertised name, "SB-" and four hexadecimal digits.
        backend: bleak client backend; None is the platform's own.
        scanner_backend: bleak scanner backend; None is the platform's own.
        profile: Scales, rates and time-outs.

    Attributes:
        on_sample: Called for each streamed sample.
        on_attitude: Called for each frame of a stream that carries the attitude, before ``on_sample``.
        on_bump: Called for each wall that the robot runs into.
        on_lost: Called once a connection when the link breaks unasked, with the reason.
    """

    def __init__(
        self,
        name: str,
        *,
        backend: type[BaseBleakClient] | None = None,
        scanner_backend: type[BaseBleakScanner] | None = None,
        profile: RobotProfile | None = None,
    ) -> None:
        self.name = name
        self.profile = profile if profile is not None else RobotProfile()
        self.on_sample: Callable[[Sample], None] | None = None
        self.on_attitude: Callable[[Attitude], None] | None = None
        self.on_bump: Callable[[Bump], None] | None = None
        self.on_lost: Callable[[str], None] | None = None
        self._link = Link(name, self.profile, backend=backend, scanner_backend=scanner_backend)
        self._link.on_notification = self._notified
        self._link.on_lost = self._lost
        self._tending = Tending(name, self._link, self.profile)
        self._wanted = False
        self._heading_rad = 0.0
        self._facing_rad = 0.0
        self._raw: Request | None = None
        self._stream: Stream | None = None
        self._led: tuple[float, tuple[float, float, float]] | None = None
        self._errands = Errands()
        self._now_s: Callable[[], float] = float

    async def __aenter__(self) -> Self:
        await self.connect()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.disconnect()

    @property
    def bad_frames(self) -> int:
        """Frames that arrived damaged since the link was opened."""
        return self._link.parser.bad_checksums + self._link.parser.malformed

    @property
    def reply_flags(self) -> int | None:
        """Flags byte of its last answer to a command that names its target; None before the first."""
        return self._link.reply_flags

    async def connect(self) -> None:
        """Find the robot, connect, wake it, and make where it stands and faces its frame.

        Raises:
            RobotError: Bluetooth is off, or the robot is unknown, unreachable or refuses.
        """
        if self._link.is_open:
            return
        self._stream, self._led = None, None
        self._heading_rad, self._facing_rad, self._raw = 0.0, 0.0, None
        self._wanted = True
        await self._open(again=False)

    async def reconnect(self, give_up_s: float = 60.0) -> int:
        """Win a lost robot back: stopped before anything else, then streaming and lit as it was.

        Its frame is a new one, as after ``connect``: where it stands and faces then. Between two attempts
        there is a pause, 0.5 s at first and twice as long each time up to 8 s. Cancelled, it leaves nothing
        connected and nothing running.

        Args:
            give_up_s: No attempt goes on, or is begun, after this long.

        Returns:
            How many attempts it took; 0 when the link is there.

        Raises:
            ReconnectError: It did not come back, or ``disconnect`` was called meanwhile.
            DriveError: ``give_up_s`` is no time.
        """
        if self._link.is_open:
            return 0
        self._wanted = True
        return await persist(self.name, lambda: self._open(again=True), give_up_s, lambda: self._wanted)

    async def _open(self, *, again: bool) -> None:
        """Connect and set the robot up; with ``again``, stop it first and take up what it did before."""
        self._now_s = asyncio.get_running_loop().time
        # The link before may still be closing.
        await self._errands.settle(_FAREWELL_TIMEOUT_S)
        try:
            self._check(self._wanted, "it was let go meanwhile")
            await self._link.open()
            self._check(self._wanted, "it was let go meanwhile")
            if again:
                # One that sleeps refuses, or does not answer, before it has been woken.
                with contextlib.suppress(CommandError, ReplyTimeoutError):
                    await self._halt()
            await self._link.ask(Request(commands.WAKE))
            if again:
                await self._halt()
            await self._set_up()
            if again and self._stream is not None:
                await self._begin_stream(self._stream)
            if again and self._led is not None:
                await self.set_led(*self._led)
            # Nobody would be told of a link that broke just after the last answer.
            self._check(self._link.is_open, "it broke while it was set up")
        except BaseException:
            # Also when cancelled: a robot half set up must not stay connected.
            self._tending.dismiss()
            await self._link.close()
            raise
        self._tending.start()

    def _check(self, holds: bool, otherwise: str) -> None:
        if not holds:
            raise LinkLostError(self.name, otherwise)

    async def _halt(self) -> None:
        await preparing.halt(self._link, self._heading_rad, raw=self._raw is not None)

    async def _set_up(self) -> None:
        await preparing.balance(self._link)
        self._raw = None
        await self._take_frame()
        await preparing.feel_bumps(self._link, self.profile)

    async def _take_frame(self) -> None:
        """Make where the robot stands and faces its frame."""
        await preparing.reset_yaw(self._link)
        self._heading_rad = self._facing_rad = 0.0
        await preparing.reset_locator(self._link)

    async def disconnect(self) -> None:
        """Stop the robot, dark its matrix, and let it go. Does nothing when it is not connected."""
        self._wanted = False
        tasks = self._tending.dismiss()
        try:
            if tasks:
                await asyncio.wait(tasks, timeout=_FAREWELL_TIMEOUT_S)
            if self._link.is_open:
                # The robot stops by itself in the end, so a farewell that fails loses nothing.
                with contextlib.suppress(RobotError, TimeoutError):
                    async with asyncio.timeout(_FAREWELL_TIMEOUT_S):
                        await self.stop()
                        await self._link.ask(OFF)
                        await self._link.ask(commands.matrix_colour(*_DARK))
        finally:
            self._tending.dismiss()
            await self._link.close()
            await self._errands.settle(_FAREWELL_TIMEOUT_S)

    async def identity(self) -> Identity:
        """Name, address, firmware and battery."""
        return await status.identity(self._link)

    async def battery_v(self) -> float:
        """Battery voltage, V."""
        return await status.battery_v(self._link)

    async def battery_state(self) -> BatteryState:
        """Whether the robot finds its battery fine, low or critical."""
        return await status.battery_state(self._link)

    async def charger_state(self) -> ChargerState:
        """Whether it stands on the charger, and is full."""
        return await status.charger_state(self._link)

    async def drive(self, heading_rad: float, speed_cm_s: float) -> None:
        """Roll along ``heading_rad`` (sent as a whole degree) at ``speed_cm_s`` until told otherwise.

        A newer ``drive``, ``stop`` or ``raw_motors`` before the robot has answered takes its place.

        Raises:
            DriveError: The speed or heading is out of reach.
            RobotError: The robot refuses or is gone.
        """
        await self._roll(heading_rad, self.profile.speed_units(speed_cm_s))

    async def stop(self) -> None:
        """Come to rest, facing as before."""
        await self._roll(self._heading_rad, 0)

    async def _roll(self, heading_rad: float, speed_units: int) -> None:
        request, raw = commands.drive(speed_units, heading_rad), self._raw
        self._heading_rad = heading_rad
        before = () if raw is None else (MOTORS_OFF, STABILISED)
        if await self._tending.move(request, lasts=speed_units > 0, before=before):
            # Only now: a bump reported before this came from the heading before.
            self._facing_rad = math.radians(round(math.degrees(heading_rad)) % 360)
            if self._raw is raw:
                self._raw = None

    async def raw_motors(self, left: int, right: int) -> None:
        """Power the motors, each from -255 (back) to 255, without balance, until ``drive`` or ``stop``.

        Nothing tells where the robot heads then: the normals of bumps count from its last heading, which it
        faces again when it is stopped.

        Raises:
            DriveError: A power is outside that.
            RobotError: The robot refuses or is gone.
        """
        request = commands.raw_motors(left, right)
        # Before the answer: once it is sent, the robot may have lost its balance.
        self._raw = request
        await self._tending.move(request, lasts=left != 0 or right != 0, before=(_UNSTABILISED,))

    async def aim(self, heading_rad: float) -> None:
        """Face ``heading_rad`` on the spot and make that forward: headings, bumps and way count from it afterwards.

        The back LED is blue meanwhile, so that who stands behind the robot sees its back.

        Raises:
            DriveError: The heading is not finite.
            RobotError: The robot refuses or is gone.
        """
        commands.drive(0, heading_rad)  # refuses before the light is on
        try:
            await self.set_lights(back=_AIMING)
            await self._roll(heading_rad, 0)
            await asyncio.sleep(_AIM_S)
            await self._take_frame()
        finally:
            with contextlib.suppress(RobotError):
                await self._link.ask(commands.lights(None, _DARK), timeout_s=_FAREWELL_TIMEOUT_S)

    async def set_led(self, level: float, rgb: tuple[float, float, float] = (1.0, 0.0, 0.0)) -> None:
        """Light the whole matrix at ``level`` from 0 (off) to 1 (full); ``rgb``: its colour at 1, red by default.

        Raises:
            DriveError: The level, or one of the colour's parts, is outside 0 to 1.
        """
        for part in (level, *rgb):
            if not 0 <= part <= 1:
                raise DriveError(f"an LED level of {part:g} does not exist: ask for 0 to 1", value=part)
        red, green, blue = (round(255 * level * part) for part in rgb)
        await self._link.ask(commands.matrix_colour(red, green, blue))
        self._led = level, rgb

    async def set_pixel(self, column: int, row: int, colour: Colour) -> None:
        """Light one pixel of the matrix, columns and rows 0 to 7; ``reconnect`` does not restore it.

        Raises:
            DriveError: There is no such pixel or colour.
        """
        await self._link.ask(commands.matrix_pixel(column, row, colour))

    async def set_lights(self, front: Colour | None = None, back: Colour | None = None) -> None:
        """Colour the front and the back LED; None leaves one as it is. ``reconnect`` does not restore them.

        Raises:
            DriveError: There is no such colour.
        """
        if front is not None or back is not None:
            await self._link.ask(commands.lights(front, back))

    async def start_stream(self, interval_s: float, *, attitude: bool = False) -> None:
        """Deliver a ``Sample`` every ``interval_s`` (whole milliseconds) to ``on_sample``.

        Args:
            interval_s: At least the profile's ``least_interval_s``.
            attitude: Whether to deliver an ``Attitude`` to ``on_attitude`` too.

        Raises:
            DriveError: The interval is not what the link holds.
        """
        profile = self.profile
        await self._begin_stream(
            Stream.every(interval_s, profile.least_interval_s, attitude=attitude, locator_scale=profile.locator_scale)
        )

    async def _begin_stream(self, stream: Stream) -> None:
        self._tending.expect_samples(math.inf)
        off, *chosen = stream.requests
        await self._link.ask(off)
        # Frames of the stream before were answered for by now.
        self._stream = stream
        for request in chosen:
            await self._link.ask(request)
        self._tending.expect_samples(stream.interval_ms / 1000)

    async def stop_stream(self) -> None:
        """Deliver no more samples."""
        self._tending.expect_samples(math.inf)
        await self._link.ask(OFF)
        self._stream = None

    def _notified(self, packet: Packet) -> None:
        key = (packet.did, packet.cid)
        try:
            if key == _SENSOR_DATA:
                self._sampled(packet.data)
            elif key == _COLLISION:
                self._bumped(Collision.decode(packet.data))
            elif key == commands.WILL_SLEEP.key:
                self._errands.start(self._ping())
            elif key == commands.DID_SLEEP.key:
                self._link.fail("it fell asleep")
        except PayloadError as error:
            _log.warning("dropped a notification of %s: %s", self.name, error)

    def _sampled(self, data: bytes) -> None:
        if self._stream is None:
            return
        now_s = self._now_s()
        sample, attitude = self._stream.read(data, now_s)
        self._tending.sampled_at(now_s)
        if attitude is not None and self.on_attitude is not None:
            self.on_attitude(attitude)
        if self.on_sample is not None:
            self.on_sample(sample)

    def _bumped(self, collision: Collision) -> None:
        if self.on_bump is not None:
            axes = self.profile.collision_axes
            normal_rad = wall_normal_heading(collision.x_g, collision.y_g, self._facing_rad, axes)
            self.on_bump(Bump(self._now_s(), normal_rad))

    def _lost(self, reason: str) -> None:
        self._errands.start(self._link.close())
        # A link that breaks while it is being set up fails ``connect`` instead.
        if self._tending.dismiss():
            if self.on_lost is not None:
                self.on_lost(reason)
            else:
                _log.error("lost the link to %s: %s", self.name, reason)

    async def _ping(self) -> None:
        try:
            await self._link.ask(Request(commands.PING))
        except RobotError as error:
            self._link.fail(str(error))
