"""A virtual robot that measures by itself: the program of ``robot.micropython`` on a virtual body and radio."""

from __future__ import annotations

import asyncio
import math
import re
from collections import deque

from lab.base.errors import RequestError
from robot.micropython import wire
from robot.micropython.main import IDLE_STATUS_MS, SAMPLE_MS, Roamer, identity
from robot.virtual.body import Body, Impact
from robot.virtual.radio import CONNECTION_TIMEOUT, GattCharacteristic, GattService, Peripheral, VirtualRadio

SERVICES = (
    GattService(
        wire.SERVICE_UUID,
        tuple(
            GattCharacteristic(uuid, read=read, write=write, notify=notify) for uuid, read, write, notify in wire.TABLE
        ),
    ),
)


def address_of(name: str) -> str:
    """The Bluetooth address of the virtual robot called ``name``.

    Raises:
        RequestError: The name is not such a robot's.
    """
    if not re.fullmatch(re.escape(wire.NAME_PREFIX) + "[0-9A-Fa-f]{4}", name):
        raise RequestError(
            f"virtual self-guided robot: {name!r} is not its name; "
            f"call it {wire.NAME_PREFIX} and four hexadecimal digits"
        )
    digits = name[-4:].upper()
    # The two top bits set make it a static random address.
    return f"D0:5F:C1:00:{digits[:2]}:{digits[2:]}"


class BodyHardware:
    """A virtual body as the ``Hardware`` of ``Roamer``; on the event loop's clock.

    Args:
        body: What rolls and sees.
        top_speed_cm_s: The fastest that it may be told.
    """

    def __init__(self, body: Body, top_speed_cm_s: float = 150.0) -> None:
        self.top_speed_cm_s = top_speed_cm_s
        self._body = body
        self._heading_rad = 0.0
        self._speed_cm_s = 0.0
        self._origin_cm = body.locator_cm
        self._normal_rad: float | None = None
        body.on_bump = self._met
        self._loop = asyncio.get_running_loop()
        self._started_s = self._loop.time()

    def clock_ms(self) -> int:
        """Since it was made; rounded, since timers may fire a clock's resolution early."""
        return round(1000.0 * (self._loop.time() - self._started_s))

    def sleep_until(self, at_ms: int) -> None:
        """Return at once: on the loop, timers do the waiting."""

    def tend(self) -> None:
        """Bring the body up to now, and repeat the drive command: the body stops by itself without."""
        self._body.advance(self._loop.time())
        if self._speed_cm_s > 0:
            self._body.drive(self._heading_rad, self._speed_cm_s)

    def drive(self, heading_rad: float, speed_cm_s: float) -> None:
        """Roll; the way counts from here."""
        self._heading_rad, self._speed_cm_s = heading_rad, speed_cm_s
        self._origin_cm = self._body.locator_cm
        self._body.drive(heading_rad, speed_cm_s)

    def stop(self) -> None:
        """Brake."""
        self._speed_cm_s = 0.0
        self._body.stop()

    def way_cm(self) -> float:
        """Distance from where the drive began, by the locator."""
        x_cm, y_cm = self._body.locator_cm
        return math.hypot(x_cm - self._origin_cm[0], y_cm - self._origin_cm[1])

    def light(self) -> float:
        """One reading, lux."""
        return self._body.light_lux()

    def bumped(self) -> float | None:
        """Heading of the wall's inward normal, once per bump."""
        normal_rad, self._normal_rad = self._normal_rad, None
        return normal_rad

    def battery_mv(self) -> int:
        """In mV."""
        return round(1000.0 * self._body.battery_v)

    def _met(self, impact: Impact) -> None:
        self._normal_rad = impact.normal_heading_rad


class _AirLink:
    """A virtual radio's peripheral as the ``Link`` of ``Roamer``."""

    def __init__(self, peripheral: Peripheral) -> None:
        self._peripheral = peripheral
        self.commands: deque[bytes] = deque()

    def connected(self) -> bool:
        return self._peripheral.is_connected

    def command(self) -> bytes | None:
        return self.commands.popleft() if self.commands else None

    def notify(self, uuid: str, record: bytes) -> None:
        self._peripheral.notify(uuid, record)


class VirtualSelfGuided:
    """A self-guided robot that lives in this process, and rolls on when its host is gone.

    Args:
        radio: The radio it advertises on, already started when ``start`` is called.
        body: What rolls and sees.
        name: "CL-" and four hexadecimal digits; its address follows from them.

    Raises:
        RequestError: The name is not such a robot's.
    """

    def __init__(self, radio: VirtualRadio, body: Body, name: str = "CL-0001") -> None:
        self.name = name
        self.address = address_of(name)
        self.body = body
        self._radio = radio
        self._peripheral: Peripheral | None = None
        self._hardware: BodyHardware | None = None
        self._roamer: Roamer | None = None
        self._link: _AirLink | None = None
        self._beat: asyncio.Handle | None = None

    @property
    def is_connected(self) -> bool:
        """Whether a host holds the link."""
        return self._peripheral is not None and self._peripheral.is_connected

    @property
    def rolling(self) -> bool:
        """Whether it is in a session."""
        return self._roamer is not None and self._roamer.state == wire.ROLLING

    async def start(self) -> None:
        """Switch it on: it advertises.

        Raises:
            RequestError: Another robot on the radio has the same address.
        """
        if self._peripheral is not None:
            return
        peripheral = await self._radio.add_peripheral(self.name, self.address, SERVICES)
        self.body.advance(asyncio.get_running_loop().time())
        self._hardware = hardware = BodyHardware(self.body)
        self._link = _AirLink(peripheral)
        self._roamer = Roamer(hardware, self._link)
        peripheral.on_connect = self._wake
        peripheral.on_read = lambda uuid: identity(hardware) if uuid == wire.IDENTITY_UUID else b""
        peripheral.on_write = self._written
        self._peripheral = peripheral
        await peripheral.start()

    async def close(self) -> None:
        """Switch it off."""
        peripheral, self._peripheral = self._peripheral, None
        if self._beat is not None:
            self._beat.cancel()
        self._beat = self._roamer = self._link = None
        if self._hardware is not None:
            self._hardware.stop()
        if peripheral is not None:
            await peripheral.close()

    def drop_link(self) -> None:
        """Break the link as if the robot had gone out of range; it rolls on."""
        if self._peripheral is not None:
            self._peripheral.hang_up(CONNECTION_TIMEOUT)

    def _written(self, uuid: str, value: bytes) -> None:
        if uuid == wire.CONTROL_UUID and self._link is not None:
            self._link.commands.append(value)
            self._wake()

    def _wake(self) -> None:
        """Take the next step of the program now."""
        if self._beat is not None:
            self._beat.cancel()
        self._beat = asyncio.get_running_loop().call_soon(self._step)

    def _step(self) -> None:
        """One step, and the timer for the next: at rest, as often as it has something to tell."""
        if self._roamer is None:
            return
        self._roamer.step()
        pause_ms = SAMPLE_MS if self.rolling or self.body.moving else IDLE_STATUS_MS if self.is_connected else 0
        self._beat = asyncio.get_running_loop().call_later(pause_ms / 1000.0, self._step) if pause_ms else None
