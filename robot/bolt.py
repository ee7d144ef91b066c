"""The driver of a Sphero BOLT: the real one, or the virtual one through the same bleak client."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from collections.abc import Callable, Coroutine
from typing import Any

from bleak.backends.client import BaseBleakClient
from bleak.backends.scanner import BaseBleakScanner

from robot import commands
from robot.collision import wall_normal_heading
from robot.commands import Collision, Request
from robot.device import Bump, Identity, Sample
from robot.errors import DriveError, PayloadError, RobotError
from robot.link import Heard, Link, scan
from robot.packets import Packet
from robot.profile import RobotProfile

__all__ = ["Bolt", "Heard", "scan"]

_log = logging.getLogger(__name__)

# Locator for the way, velocity for the speed, light for the crossings: one frame of 28 bytes without escapes.
_STREAM = commands.layout_for("locator_x_m", "locator_y_m", "velocity_x_m_s", "velocity_y_m_s", "ambient_lux")
_SENSOR_DATA = commands.SENSOR_DATA.key
_COLLISION = commands.COLLISION.key
_CM_PER_M = 100.0
_COLLISION_METHOD = 1
_FAREWELL_TIMEOUT_S = 2.0
# Who waits for a deadline sleeps at least this long, far above what an event loop may wake it early by: else
# it could find the deadline a rounding ahead for ever, in turns that take no virtual time.
_LEAST_NAP_S = 0.001


class Bolt:
    """A Sphero BOLT as a ``RobotDevice``.

    While it rolls, a task repeats the drive command: a BOLT that hears nothing stops by itself, so it
    stops when this program does. Others keep it awake and watch over the stream.

    Args:
        name: Advertised name, "SB-" and four hexadecimal digits.
        backend: bleak client backend; None is the platform's own.
        scanner_backend: bleak scanner backend; None is the platform's own.
        profile: Scales, rates and time-outs.

    Attributes:
        on_sample: Called for each streamed sample.
        on_bump: Called for each wall that the robot runs into.
        on_lost: Called once when the link breaks unasked, with the reason.
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
        self.on_bump: Callable[[Bump], None] | None = None
        self.on_lost: Callable[[str], None] | None = None
        self._link = Link(name, self.profile, backend=backend, scanner_backend=scanner_backend)
        self._link.on_notification = self._notified
        self._link.on_lost = self._lost
        self._heading_rad = 0.0
        self._facing_rad = 0.0
        self._speed_units = 0
        self._driving = asyncio.Lock()
        self._refresh_at_s = math.inf
        self._last_sample_s = math.inf
        self._tenders: tuple[asyncio.Task[None], ...] = ()
        self._errands: set[asyncio.Task[None]] = set()
        self._now_s: Callable[[], float] = float

    @property
    def bad_frames(self) -> int:
        """Frames that arrived damaged since the link was opened."""
        return self._link.parser.bad_checksums + self._link.parser.malformed

    async def connect(self) -> None:
        """Find the robot, connect, wake it, and make where it stands and faces its frame.

        Raises:
            RobotError: Bluetooth is off, or the robot is unknown, unreachable or refuses.
        """
        if self._link.is_open:
            return
        loop = asyncio.get_running_loop()
        self._now_s = loop.time
        self._heading_rad, self._facing_rad, self._speed_units = 0.0, 0.0, 0
        self._refresh_at_s = self._last_sample_s = math.inf
        await self._link.open()
        threshold = self.profile.collision_threshold
        setup = (
            Request(commands.WAKE),
            commands.stream(0, 0),
            Request(commands.STABILISATION, commands.STABILISATION.payload(commands.STABILISE_FULL)),
            Request(commands.RESET_YAW),
            # 0: the locator's axes stay where the yaw was reset, and do not turn with later resets.
            Request(commands.LOCATOR_FLAGS, commands.LOCATOR_FLAGS.payload(0)),
            Request(commands.RESET_LOCATOR),
            commands.collision_setup(
                _COLLISION_METHOD, (threshold, threshold, threshold, threshold), self.profile.collision_dead_s
            ),
        )
        try:
            for request in setup:
                await self._link.ask(request)
        except BaseException:
            # Also when cancelled: a robot half set up must not stay connected.
            await self._link.close()
            raise
        self._tenders = (
            loop.create_task(self._tend(), name=f"tend {self.name}"),
            loop.create_task(self._watch(), name=f"watch {self.name}"),
        )

    async def disconnect(self) -> None:
        """Stop the robot, dark its matrix, and let it go. Does nothing when it is not connected."""
        tenders = self._dismiss()
        if tenders:
            await asyncio.wait(tenders, timeout=_FAREWELL_TIMEOUT_S)
        self._refresh_at_s = self._last_sample_s = math.inf
        try:
            if self._link.is_open:
                # The robot stops by itself in the end, so a farewell that fails loses nothing.
                with contextlib.suppress(RobotError, TimeoutError):
                    async with asyncio.timeout(_FAREWELL_TIMEOUT_S):
                        await self.stop()
                        await self._link.ask(commands.stream(0, 0))
                        await self._link.ask(commands.matrix_colour(0, 0, 0))
        finally:
            await self._link.close()
            if self._errands:
                _, late = await asyncio.wait(self._errands, timeout=_FAREWELL_TIMEOUT_S)
                for errand in late:
                    errand.cancel()

    async def identity(self) -> Identity:
        """Name, address, firmware and battery."""
        (digits,) = commands.MAC_ADDRESS.decode(await self._link.ask(Request(commands.MAC_ADDRESS)))
        version = commands.MAIN_APP_VERSION.decode(await self._link.ask(Request(commands.MAIN_APP_VERSION)))
        text = bytes(digits).decode("ascii", errors="replace").upper()
        return Identity(
            name=self.name,
            address=":".join(text[i : i + 2] for i in range(0, 12, 2)),
            firmware=".".join(str(part) for part in version),
            battery_v=await self.battery_v(),
        )

    async def battery_v(self) -> float:
        """Battery voltage, V."""
        (hundredths,) = commands.BATTERY_VOLTAGE.decode(await self._link.ask(Request(commands.BATTERY_VOLTAGE)))
        return hundredths / 100.0

    async def drive(self, heading_rad: float, speed_cm_s: float) -> None:
        """Roll along ``heading_rad`` (sent as a whole degree) at ``speed_cm_s`` until told otherwise.

        Raises:
            DriveError: The speed or heading is out of reach.
            RobotError: The robot refuses or is gone.
        """
        await self._drive(heading_rad, self.profile.speed_units(speed_cm_s))

    async def stop(self) -> None:
        """Come to rest, facing as before."""
        await self._drive(self._heading_rad, 0)

    async def _drive(self, heading_rad: float, speed_units: int) -> None:
        request = commands.drive(speed_units, heading_rad)
        # Set before the wait, so that a repeat that waits for the lock does not undo this.
        self._heading_rad, self._speed_units = heading_rad, speed_units
        self._refresh_at_s = math.inf
        async with self._driving:
            await self._link.ask(request)
            # Only now: a bump reported before this came from the heading before.
            self._facing_rad = math.radians(round(math.degrees(heading_rad)) % 360)
            if self._speed_units > 0:
                self._refresh_at_s = self._now_s() + self.profile.refresh_s

    async def set_led(self, level: float) -> None:
        """Light the whole matrix red at ``level`` from 0 (off) to 1 (full).

        Raises:
            DriveError: The level is outside 0 to 1.
        """
        if not 0 <= level <= 1:
            raise DriveError(f"an LED level of {level:g} does not exist: ask for 0 to 1", value=level)
        await self._link.ask(commands.matrix_colour(round(255 * level), 0, 0))

    async def start_stream(self, interval_s: float) -> None:
        """Deliver a ``Sample`` every ``interval_s`` (whole milliseconds) to ``on_sample``.

        Raises:
            DriveError: The interval is not 1 ms to 65 s.
        """
        interval_ms = round(interval_s * 1000) if math.isfinite(interval_s) else 0
        if not 1 <= interval_ms <= 0xFFFF:
            raise DriveError(f"a stream every {interval_s:g} s is impossible: ask for 0.001 to 65 s", value=interval_s)
        await self._link.ask(commands.stream(0, 0))
        await self._link.ask(commands.stream_extended(_STREAM.extended))
        await self._link.ask(commands.stream(interval_ms, _STREAM.primary))
        self._last_sample_s = self._now_s()

    async def stop_stream(self) -> None:
        """Deliver no more samples."""
        self._last_sample_s = math.inf
        await self._link.ask(commands.stream(0, 0))

    def _notified(self, packet: Packet) -> None:
        key = (packet.did, packet.cid)
        try:
            if key == _SENSOR_DATA:
                self._sampled(packet.data)
            elif key == _COLLISION:
                self._bumped(Collision.decode(packet.data))
            elif key == commands.WILL_SLEEP.key:
                self._spawn(self._ping())
            elif key == commands.DID_SLEEP.key:
                self._link.fail("it fell asleep")
        except PayloadError as error:
            _log.warning("dropped a notification of %s: %s", self.name, error)

    def _sampled(self, data: bytes) -> None:
        x_m, y_m, velocity_x, velocity_y, light_lux = _STREAM.decode(data)
        now_s = self._now_s()
        if self._last_sample_s < math.inf:
            self._last_sample_s = now_s
        if self.on_sample is not None:
            speed_cm_s = _CM_PER_M * math.hypot(velocity_x, velocity_y)
            self.on_sample(Sample(now_s, light_lux, _CM_PER_M * x_m, _CM_PER_M * y_m, speed_cm_s))

    def _bumped(self, collision: Collision) -> None:
        if self.on_bump is not None:
            normal_rad = wall_normal_heading(collision.x_g, collision.y_g, self._facing_rad)
            self.on_bump(Bump(self._now_s(), normal_rad))

    def _lost(self, reason: str) -> None:
        self._refresh_at_s = self._last_sample_s = math.inf
        self._speed_units = 0
        self._spawn(self._link.close())
        # A link that breaks while it is being set up fails ``connect`` instead.
        if self._dismiss():
            if self.on_lost is not None:
                self.on_lost(reason)
            else:
                _log.error("lost the link to %s: %s", self.name, reason)

    def _dismiss(self) -> tuple[asyncio.Task[None], ...]:
        """Cancel the tasks that tend the connection, and return them."""
        tenders, self._tenders = self._tenders, ()
        for tender in tenders:
            tender.cancel()
        return tenders

    async def _tend(self) -> None:
        """Repeat the drive command and keep the robot awake."""
        profile = self.profile
        while self._link.is_open:
            try:
                if self._now_s() >= self._refresh_at_s:
                    await self._repeat()
                elif self._now_s() >= self._link.last_write_s + profile.keep_alive_s:
                    await self._link.ask(Request(commands.PING))
            except RobotError as error:
                self._link.fail(str(error))
                return
            next_s = min(self._link.last_write_s + profile.keep_alive_s, self._refresh_at_s)
            # At most half a refresh, so that a drive begun meanwhile is seen in time.
            nap_s = min(next_s - self._now_s(), profile.refresh_s / 2)
            await asyncio.sleep(max(_LEAST_NAP_S, nap_s))

    async def _watch(self) -> None:
        """Take a link whose stream has fallen silent for lost."""
        silence_s = self.profile.silence_s
        while self._link.is_open:
            quiet_at_s = self._last_sample_s + silence_s
            if self._now_s() >= quiet_at_s:
                self._link.fail(f"no sample for {silence_s:g} s")
                return
            await asyncio.sleep(max(_LEAST_NAP_S, min(silence_s / 2, quiet_at_s - self._now_s())))

    async def _repeat(self) -> None:
        """Send the drive command once more, unless a newer one is on its way."""
        async with self._driving:
            if self._now_s() >= self._refresh_at_s:
                await self._link.ask(commands.drive(self._speed_units, self._heading_rad))
                if self._refresh_at_s < math.inf:
                    self._refresh_at_s = self._now_s() + self.profile.refresh_s

    async def _ping(self) -> None:
        try:
            await self._link.ask(Request(commands.PING))
        except RobotError as error:
            self._link.fail(str(error))

    def _spawn(self, errand: Coroutine[Any, Any, None]) -> None:
        """Run ``errand`` on the side, held until it is done."""
        task = asyncio.get_running_loop().create_task(errand)
        self._errands.add(task)
        task.add_done_callback(self._errands.discard)
