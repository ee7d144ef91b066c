"""The host's side of a robot that measures by itself: it is told to start, and its lines are listened to.

Such a robot runs ``robot.micropython`` and needs no host to drive; what it has worked out arrives line by line.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

from bleak import BleakClient
from bleak.backends.characteristic import BleakGATTCharacteristic
from bleak.backends.client import BaseBleakClient
from bleak.backends.scanner import BaseBleakScanner
from bleak.exc import BleakBluetoothNotAvailableError, BleakError

from lab.base.errors import RequestError
from robot.crossings import Levels
from robot.device import Identity
from robot.errands import Errands
from robot.errors import (
    BluetoothUnavailableError,
    DriveError,
    LinkLostError,
    NotConnectedError,
    PayloadError,
    ReplyTimeoutError,
    RobotError,
    RobotUnreachableError,
)
from robot.link import find, reason_of
from robot.micropython import wire
from robot.profile import RobotProfile

__all__ = ["OnboardLine", "SelfGuided"]

_log = logging.getLogger(__name__)

_CLOSE_TIMEOUT_S = 5.0
_SESSIONS = 256
_LEAST_NAP_S = 0.001  # see robot.bolt: who waits for a deadline must not wait in turns that take no time


@dataclass(frozen=True, slots=True)
class OnboardLine:
    """One line from wall to wall, and the robot's own estimate after it.

    Attributes:
        line: Its number in the session, from 1.
        k: Chords; 0 if it missed the shape.
        l1_cm, l3_cm3: The signed pair sums of its crossings.
        length_cm: From wall to wall, by the robot's odometer.
        t_robot_s: When it ended, on the robot's clock.
        area_cm2, perimeter_cm: The robot's estimate; NaN before the first line that crossed.
        lines: How many lines crossed the shape: the N of the estimate.
        t_host_s: When it arrived, on the event loop's clock.
    """

    line: int
    k: int
    l1_cm: float
    l3_cm3: float
    length_cm: float
    t_robot_s: float
    area_cm2: float
    perimeter_cm: float
    lines: int
    t_host_s: float


@dataclass(frozen=True, slots=True)
class _Status:
    state: int
    session: int
    runs: int
    light: float
    battery_v: float


class SelfGuided:
    """A robot that measures by itself, through bleak.

    After a lost link, ``connect`` again takes up the session that still runs: lines told meanwhile count as lost,
    though not from the robot's own estimate.

    Args:
        name: Advertised name, "CL-" and four hexadecimal digits.
        backend: bleak client backend; None is the platform's own.
        scanner_backend: bleak scanner backend; None is the platform's own.
        profile: Time-outs: ``scan_timeout_s``, ``connect_timeout_s``, ``reply_timeout_s``, ``silence_s``.

    Attributes:
        on_line: Called with each line as it arrives, in their order.
        on_lost: Called once per connection when the link breaks, falls silent, or the robot stops unasked, with
            the reason; never after ``disconnect``.
        lost_lines: Lines of this session that the robot took and this host never heard whole.
        duplicates: Lines that arrived once more, and were passed over.
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
        self.on_line: Callable[[OnboardLine], None] | None = None
        self.on_lost: Callable[[str], None] | None = None
        self.lost_lines = 0
        self.duplicates = 0
        self._backend = backend
        self._scanner_backend = scanner_backend
        self._client: BleakClient | None = None
        self._firmware = ""
        self._top_speed_cm_s = math.inf
        self._session = -1  # no session of the robot's has this number
        self._rolling = False
        self._last = 0
        self._half: tuple[float, ...] | None = None
        self._heard_s = 0.0
        self._waiting: set[asyncio.Future[_Status]] = set()
        self._watcher: asyncio.Task[None] | None = None
        self._errands = Errands()

    @property
    def rolling(self) -> bool:
        """Whether a session that this host started runs, as far as known."""
        return self._rolling

    async def connect(self) -> None:
        """Find the robot, connect, check that it speaks the same records, and subscribe.

        Raises:
            BluetoothUnavailableError: This machine's radio is missing or off.
            RobotNotFoundError: No such name is heard.
            RobotUnreachableError: It is heard but does not connect, or is no such robot.
            PayloadError: It speaks another version of the records.
        """
        if self._client is not None:
            return
        profile = self.profile
        device = await find(self.name, profile.scan_timeout_s, self._scanner_backend, prefix=wire.NAME_PREFIX)
        client = BleakClient(device, self._disconnected, timeout=profile.connect_timeout_s, backend=self._backend)
        try:
            async with asyncio.timeout(profile.connect_timeout_s):
                await client.connect()
                self._introduced(bytes(await client.read_gatt_char(wire.IDENTITY_UUID)))
                for uuid, heard in (
                    (wire.STATUS_UUID, self._on_status),
                    (wire.LINE_UUID, self._on_half),
                    (wire.ESTIMATE_UUID, self._on_estimate),
                ):
                    await client.start_notify(uuid, self._guarded(uuid, heard))
                if not client.is_connected:
                    raise BleakError("it disconnected")
        except BaseException as error:
            # Also when cancelled: nobody would let go of it later.
            await self._let_go(client)
            if isinstance(error, BleakBluetoothNotAvailableError):
                raise BluetoothUnavailableError(self.name, reason_of(error)) from error
            if isinstance(error, (BleakError, OSError, TimeoutError)):
                raise RobotUnreachableError(self.name, address=device.address, reason=reason_of(error)) from error
            raise
        self._client = client
        loop = asyncio.get_running_loop()
        self._heard_s = loop.time()
        self._watcher = loop.create_task(self._watch(), name=f"watch {self.name}")

    async def disconnect(self) -> None:
        """Stop the robot and let it go. Does nothing when it is not connected."""
        if self._client is not None:
            # A robot that does not hear it stops by itself once it has been alone for a while.
            with contextlib.suppress(RobotError):
                await self.stop()
        client, self._client = self._client, None
        self._rolling = False
        self._forget("it was let go")
        if client is not None:
            await self._let_go(client)
        await self._errands.settle(_CLOSE_TIMEOUT_S)

    async def identity(self) -> Identity:
        """Name, address, the program's version and the battery (0 V where the robot does not measure it)."""
        battery_v = await self.battery_v()
        address = self._client.address if self._client is not None else ""
        return Identity(self.name, address, self._firmware, battery_v)

    async def battery_v(self) -> float:
        """Battery voltage, V; 0 where the robot does not measure it."""
        return (await self._status("battery")).battery_v

    async def light(self) -> float:
        """A fresh reading of the light, in the robot's unit: one comes every 0.1 s at rest, every 0.5 s rolling."""
        return (await self._status("light")).light

    async def start(self, speed_cm_s: float, seed: int, levels: Levels) -> None:
        """Begin a session at line 1; returns once the robot says that it rolls. One that runs is given up.

        Args:
            speed_cm_s: Rolling speed, sent as whole mm/s.
            seed: Of the robot's turns, 32 bits.
            levels: Thresholds, in the unit of ``light``.

        Raises:
            DriveError: The robot cannot roll at that speed.
            RequestError: The seed does not fit.
            RobotError: The robot is gone or does not answer.
        """
        speed_mm_s = round(10.0 * speed_cm_s) if math.isfinite(speed_cm_s) else 0
        if not 0 < speed_mm_s <= 10.0 * self._top_speed_cm_s:
            raise DriveError(
                f"{self.name} cannot roll at {speed_cm_s:g} cm/s: ask for 0.1 to {self._top_speed_cm_s:g} cm/s",
                value=speed_cm_s,
            )
        if not 0 <= seed < 2**32:
            raise RequestError(f"{self.name}: a seed of {seed} does not fit 32 bits; ask for 0 to {2**32 - 1}")
        session = ((await self._status("start")).session + 1) % _SESSIONS
        self._rolling = False
        self._session, self._last, self._half = session, 0, None
        self.lost_lines = self.duplicates = 0
        thresholds = (levels.low_lux, levels.mid_lux, levels.high_lux)
        record = struct.pack(wire.START_FORMAT, wire.START, session, speed_mm_s, seed, *thresholds)
        await self._tell("start", record)
        await self._status("start", lambda status: status.state == wire.ROLLING and status.session == session)
        self._rolling = True

    async def stop(self) -> None:
        """End the session; returns once the robot says that it stands. The line in progress has never been.

        Raises:
            RobotError: The robot is gone or does not answer.
        """
        self._rolling = False
        await self._tell("stop", struct.pack(wire.STOP_FORMAT, wire.STOP))
        await self._status("stop", lambda status: status.state == wire.IDLE)

    def _introduced(self, data: bytes) -> None:
        # The version comes first, and a later one may have another length.
        if data[:1] != bytes((wire.VERSION,)) or len(data) != struct.calcsize(wire.IDENTITY_FORMAT):
            raise PayloadError("identity", data, expected=f"version {wire.VERSION} of the records")
        _, major, minor, build, _, top_mm_s = struct.unpack(wire.IDENTITY_FORMAT, data)
        self._firmware = f"{major}.{minor}.{build}"
        self._top_speed_cm_s = top_mm_s / 10.0

    async def _tell(self, what: str, record: bytes) -> None:
        client = self._client
        if client is None:
            raise NotConnectedError(self.name, what)
        try:
            async with asyncio.timeout(self.profile.reply_timeout_s):
                await client.write_gatt_char(wire.CONTROL_UUID, record, response=True)
        except TimeoutError as error:
            raise ReplyTimeoutError(self.name, what, timeout_s=self.profile.reply_timeout_s) from error
        except (BleakError, OSError) as error:
            self._fail(reason_of(error))
            raise LinkLostError(self.name, reason_of(error)) from error

    async def _status(self, what: str, holds: Callable[[_Status], bool] = lambda _: True) -> _Status:
        """The next status for which ``holds``."""
        if self._client is None:
            raise NotConnectedError(self.name, what)
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(self.profile.reply_timeout_s):
                while True:
                    heard: asyncio.Future[_Status] = loop.create_future()
                    self._waiting.add(heard)
                    try:
                        status = await heard
                    finally:
                        self._waiting.discard(heard)
                    if holds(status):
                        return status
        except TimeoutError as error:
            raise ReplyTimeoutError(self.name, what, timeout_s=self.profile.reply_timeout_s) from error

    def _guarded(
        self, uuid: str, heard: Callable[[bytes], None]
    ) -> Callable[[BleakGATTCharacteristic, bytearray], None]:
        def notified(_: BleakGATTCharacteristic, data: bytearray) -> None:
            self._heard_s = asyncio.get_running_loop().time()
            try:
                heard(bytes(data))
            except ValueError as error:
                _log.warning("dropped a notification (%s) of %s: %s", uuid[:8], self.name, error)

        return notified

    def _on_status(self, data: bytes) -> None:
        state, session, runs, _, light, battery_mv = wire.unpack(wire.STATUS_FORMAT, data)
        status = _Status(int(state), int(session), int(runs), light, battery_mv / 1000.0)
        if session == self._session:
            # Lines are told before the status that counts them.
            ahead = self._ahead(status.runs)
            self.lost_lines += ahead
            self._last += ahead
        if self._rolling and (state != wire.ROLLING or session != self._session):
            self._fail("it stopped by itself")
            return
        for heard in self._waiting:
            if not heard.done():
                heard.set_result(status)

    def _ahead(self, number: int) -> int:
        """How many lines ``number`` is beyond the last one known; 0 if it is not. Numbers wrap."""
        ahead = (number - self._last) % wire.LINE_NUMBERS
        return ahead if ahead < wire.LINE_NUMBERS // 2 else 0

    def _on_half(self, data: bytes) -> None:
        half = wire.unpack(wire.LINE_FORMAT, data)
        if not all(map(math.isfinite, half)):
            raise ValueError("a line's lengths are no numbers")
        self._half = half if half[0] == self._session else None

    def _on_estimate(self, data: bytes) -> None:
        session, number, area_cm2, perimeter_cm, lines = wire.unpack(wire.ESTIMATE_FORMAT, data)
        half, self._half = self._half, None
        if half is None or half[:2] != (session, number):
            return  # its other half was lost: the next number or status will tell
        ahead = self._ahead(int(number))
        if ahead == 0:
            self.duplicates += 1
            return
        self.lost_lines += ahead - 1
        self._last += ahead
        if self.on_line is not None:
            _, _, k, l1_cm, l3_cm3, length_cm, t_ms = half
            self.on_line(
                OnboardLine(
                    line=self._last,
                    k=int(k),
                    l1_cm=l1_cm,
                    l3_cm3=l3_cm3,
                    length_cm=length_cm,
                    t_robot_s=t_ms / 1000.0,
                    area_cm2=area_cm2,
                    perimeter_cm=perimeter_cm,
                    lines=int(lines),
                    t_host_s=self._heard_s,
                )
            )

    async def _watch(self) -> None:
        """Take a robot that has fallen silent for lost: its heart beats twice a second at least."""
        loop, silence_s = asyncio.get_running_loop(), self.profile.silence_s
        while True:
            quiet_at_s = self._heard_s + silence_s
            if loop.time() >= quiet_at_s:
                self._fail(f"no word for {silence_s:g} s")
                return
            await asyncio.sleep(max(_LEAST_NAP_S, quiet_at_s - loop.time()))

    def _disconnected(self, client: BleakClient) -> None:
        if client is self._client:
            self._fail("it disconnected")

    def _fail(self, reason: str) -> None:
        """Take the link for lost."""
        client, self._client = self._client, None
        if client is None:
            return
        self._rolling = False
        self._forget(reason)
        self._errands.start(self._let_go(client))
        if self.on_lost is not None:
            self.on_lost(reason)
        else:
            _log.error("lost the link to %s: %s", self.name, reason)

    def _forget(self, reason: str) -> None:
        """End the watch, and every wait for a status."""
        watcher, self._watcher = self._watcher, None
        if watcher is not None:
            watcher.cancel()
        for heard in self._waiting:
            if not heard.done():
                heard.set_exception(LinkLostError(self.name, reason))

    async def _let_go(self, client: BleakClient) -> None:
        # A link that breaks while it is closed is closed.
        with contextlib.suppress(BleakError, OSError, TimeoutError):
            async with asyncio.timeout(_CLOSE_TIMEOUT_S):
                await client.disconnect()
