"""The commands of a BOLT: ids, targets, payloads and the layout of their answers, each in one place.

All scalars are big-endian. Device ids (DID): 10 api, 11 system info, 13 power, 16 drive, 18 sensors,
1A lights. A command that names a target is sent to that processor; the others are sent untargeted.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from types import MappingProxyType
from typing import Any

from robot.errors import DriveError, PayloadError
from robot.packets import Flag, Packet

HOST = 0x01
PRIMARY = 0x11
SECONDARY = 0x12

_TARGETED = (
    Flag.WANTS_RESPONSE | Flag.ACTIVITY | Flag.HAS_TARGET | Flag.HAS_SOURCE
)  # 0x3A: a reply can be told apart by who sent it
_UNTARGETED = Flag.WANTS_RESPONSE | Flag.ACTIVITY  # 0x0A

OK = 0x00
BAD_DID, BAD_CID, NOT_IMPLEMENTED, RESTRICTED, BAD_LENGTH = 0x01, 0x02, 0x03, 0x04, 0x05
FAILED, BAD_PARAMETER, BUSY, BAD_TARGET, TARGET_UNAVAILABLE = 0x06, 0x07, 0x08, 0x09, 0x0A
ERRORS: Mapping[int, str] = MappingProxyType(
    {
        OK: "success",
        BAD_DID: "it has no such device",
        BAD_CID: "it has no such command",
        NOT_IMPLEMENTED: "not implemented",
        RESTRICTED: "restricted",
        BAD_LENGTH: "wrong payload length",
        FAILED: "it failed",
        BAD_PARAMETER: "bad parameter",
        BUSY: "busy",
        BAD_TARGET: "no such target",
        TARGET_UNAVAILABLE: "target unavailable",
    }
)


@dataclass(frozen=True, slots=True)
class Command:
    """A command or notification: name, ids, target (None: untargeted), layouts in ``struct``'s notation.

    A layout of None means any bytes.
    """

    name: str
    did: int
    cid: int
    target: int | None = None
    layout: str | None = ""
    reply: str | None = ""

    @property
    def key(self) -> tuple[int, int]:
        """(did, cid)."""
        return self.did, self.cid

    def payload(self, *values: float) -> bytes:
        """Pack ``values`` by the request's layout."""
        return struct.pack(f">{self.layout or ''}", *values)

    def decode(self, data: bytes) -> tuple[Any, ...]:
        """Unpack the payload of an answer or notification.

        Raises:
            PayloadError: Its length does not fit the layout.
        """
        layout = f">{self.reply or ''}"
        if len(data) != struct.calcsize(layout):
            raise PayloadError(self.name, data, expected=f"{struct.calcsize(layout)} bytes")
        return struct.unpack(layout, data)


@dataclass(frozen=True, slots=True)
class Request:
    """A command with its payload, not yet numbered."""

    command: Command
    data: bytes = b""

    def packet(self, seq: int) -> Packet:
        """The packet that asks for it, numbered ``seq``."""
        command = self.command
        if command.target is None:
            return Packet(int(_UNTARGETED), command.did, command.cid, seq, self.data)
        return Packet(int(_TARGETED), command.did, command.cid, seq, self.data, target=command.target, source=HOST)


PING = Command("ping", 0x10, 0x00, layout=None, reply=None)
API_VERSION = Command("API version", 0x10, 0x01, reply="BB")
MAIN_APP_VERSION = Command("main app version", 0x11, 0x00, reply="HHH")
BOOTLOADER_VERSION = Command("bootloader version", 0x11, 0x01, reply="HHH")
MAC_ADDRESS = Command("MAC address", 0x11, 0x06, reply="12s")
DEEP_SLEEP = Command("deep sleep", 0x13, 0x00)
SLEEP = Command("sleep", 0x13, 0x01)
WAKE = Command("wake", 0x13, 0x0D)
BATTERY_VOLTAGE = Command("battery voltage", 0x13, 0x03, reply="H")
BATTERY_STATE = Command("battery voltage state", 0x13, 0x17, reply="B")
CHARGER_STATE = Command("charger state", 0x13, 0x1F, reply="B")
CHARGER_NOTIFY = Command("charger notify", 0x13, 0x20, layout="B")
RAW_MOTORS = Command("raw motors", 0x16, 0x01, SECONDARY, layout="BBBB")
RESET_YAW = Command("reset yaw", 0x16, 0x06, SECONDARY)
DRIVE = Command("drive", 0x16, 0x07, SECONDARY, layout="BHB")
STABILISATION = Command("stabilisation", 0x16, 0x0C, SECONDARY, layout="B")
LEDS = Command("LEDs", 0x1A, 0x1C, PRIMARY, layout=None)
MATRIX_PIXEL = Command("matrix pixel", 0x1A, 0x2D, SECONDARY, layout="BBBBB")
MATRIX_COLOUR = Command("matrix colour", 0x1A, 0x2F, SECONDARY, layout="BBB")
STREAM = Command("streaming mask", 0x18, 0x00, SECONDARY, layout="HBI")
STREAM_GET = Command("streaming mask get", 0x18, 0x01, SECONDARY, reply="HBI")
STREAM_EXTENDED = Command("extended mask", 0x18, 0x0C, SECONDARY, layout="I")
STREAM_EXTENDED_GET = Command("extended mask get", 0x18, 0x0D, SECONDARY, reply="I")
GYRO_MAX_NOTIFY = Command("gyro-max notify", 0x18, 0x0F, SECONDARY, layout="B")
COLLISION_SETUP = Command("configure collision", 0x18, 0x11, SECONDARY, layout="BBBBBB")
RESET_LOCATOR = Command("reset locator", 0x18, 0x13, SECONDARY)
LOCATOR_FLAGS = Command("locator flags", 0x18, 0x17, SECONDARY, layout="B")
AMBIENT_LIGHT = Command("ambient light", 0x18, 0x30, SECONDARY, reply="f")

COMMANDS: tuple[Command, ...] = (
    *(PING, API_VERSION, MAIN_APP_VERSION, BOOTLOADER_VERSION, MAC_ADDRESS),
    *(DEEP_SLEEP, SLEEP, WAKE, BATTERY_VOLTAGE, BATTERY_STATE, CHARGER_STATE, CHARGER_NOTIFY),
    *(RAW_MOTORS, RESET_YAW, DRIVE, STABILISATION, LEDS, MATRIX_PIXEL, MATRIX_COLOUR),
    *(STREAM, STREAM_GET, STREAM_EXTENDED, STREAM_EXTENDED_GET, GYRO_MAX_NOTIFY, COLLISION_SETUP),
    *(RESET_LOCATOR, LOCATOR_FLAGS, AMBIENT_LIGHT),
)

WILL_SLEEP = Command("will sleep", 0x13, 0x19)
DID_SLEEP = Command("did sleep", 0x13, 0x1A)
CHARGER_CHANGED = Command("charger state changed", 0x13, 0x21, reply="B")
SENSOR_DATA = Command("sensor data", 0x18, 0x02, reply=None)
GYRO_MAX = Command("gyro max", 0x18, 0x10, reply="B")
COLLISION = Command("collision", 0x18, 0x12, reply="hhhBhhhBI")

STABILISE_NONE, STABILISE_FULL = 0, 1
MATRIX_SIDE = 8
_MOTOR_OFF, _MOTOR_FORWARD, _MOTOR_REVERSE = 0, 1, 2
_MOST = 255

Colour = tuple[int, int, int]
"""Red, green and blue, each 0 to 255."""


class BatteryState(IntEnum):
    """What the robot thinks of its battery."""

    OK = 1
    LOW = 2
    CRITICAL = 3


class ChargerState(IntEnum):
    """What the charger does."""

    NOT_CHARGING = 1
    CHARGING = 2
    CHARGED = 3


def drive(speed_units: int, heading_rad: float, *, flags: int = 0) -> Request:
    """Roll along the whole degree nearest to ``heading_rad``, clockwise from forward.

    Raises:
        DriveError: The heading is not finite.
    """
    if not math.isfinite(heading_rad):
        raise DriveError(f"a heading must be a finite number of radians, got {heading_rad}", value=heading_rad)
    return Request(DRIVE, DRIVE.payload(speed_units, round(math.degrees(heading_rad)) % 360, flags))


def raw_motors(left: int, right: int) -> Request:
    """Power the motors, each from -255 (full speed back) to 255.

    Raises:
        DriveError: A power is outside that.
    """
    for power in (left, right):
        if not -_MOST <= power <= _MOST:
            raise DriveError(f"a motor power of {power} does not exist: ask for -255 to 255", value=power)
    return Request(RAW_MOTORS, RAW_MOTORS.payload(_motor_mode(left), abs(left), _motor_mode(right), abs(right)))


def _motor_mode(power: int) -> int:
    if power == 0:
        return _MOTOR_OFF
    return _MOTOR_FORWARD if power > 0 else _MOTOR_REVERSE


def matrix_colour(red: int, green: int, blue: int) -> Request:
    """Light the whole matrix in one colour.

    Raises:
        DriveError: A level is outside 0 to 255.
    """
    return Request(MATRIX_COLOUR, MATRIX_COLOUR.payload(*_levels((red, green, blue))))


def matrix_pixel(column: int, row: int, colour: Colour) -> Request:
    """Light one pixel of the matrix, columns and rows 0 to 7.

    Raises:
        DriveError: There is no such pixel, or a level is outside 0 to 255.
    """
    for place in (column, row):
        if not 0 <= place < MATRIX_SIDE:
            raise DriveError(f"pixel ({column}, {row}) is off the matrix: ask for 0 to 7 each", value=place)
    return Request(MATRIX_PIXEL, MATRIX_PIXEL.payload(column, row, *_levels(colour)))


def leds(levels: Mapping[int, int]) -> Request:
    """Set LEDs by bit number, the others stay: 0-2 front RGB, 3-5 back RGB, each 0-255.

    Raises:
        DriveError: A level is outside 0 to 255.
    """
    mask = sum(1 << bit for bit in levels)
    return Request(LEDS, bytes([mask, *_levels(tuple(levels[bit] for bit in sorted(levels)))]))


def lights(front: Colour | None, back: Colour | None) -> Request:
    """Colour the front and the back LED; the mask leaves the one that is None as it is.

    Raises:
        DriveError: A level is outside 0 to 255.
    """
    sides = ((0, front), (3, back))
    return leds({first + i: level for first, colour in sides if colour for i, level in enumerate(colour)})


def _levels(levels: tuple[int, ...]) -> tuple[int, ...]:
    for level in levels:
        if not 0 <= level <= _MOST:
            raise DriveError(f"a light level of {level} does not exist: ask for 0 to 255", value=level)
    return levels


def collision_setup(method: int, thresholds: tuple[int, int, int, int], dead_s: float) -> Request:
    """Configure the collision detector; method 0 is off, ``dead_s`` is rounded to 10 ms.

    Sources disagree on the order of the second and third of the four bytes: give both the same value.
    """
    return Request(COLLISION_SETUP, COLLISION_SETUP.payload(method, *thresholds, round(dead_s * 100)))


def stream(interval_ms: int, mask: int, *, count: int = 0) -> Request:
    """Stream the channels of ``mask``; interval 0 ends the stream, ``count`` 0 is endless."""
    return Request(STREAM, STREAM.payload(interval_ms, count, mask))


def stream_extended(mask: int) -> Request:
    """Choose the channels of the extended mask."""
    return Request(STREAM_EXTENDED, STREAM_EXTENDED.payload(mask))


# Channel -> bit, in the order in which the values are sent: descending bits of each mask.
PRIMARY_CHANNELS: Mapping[str, int] = MappingProxyType(
    {
        "quaternion_x": 0x2000000,
        "quaternion_y": 0x1000000,
        "quaternion_z": 0x800000,
        "quaternion_w": 0x400000,
        "pitch_deg": 0x40000,
        "roll_deg": 0x20000,
        "yaw_deg": 0x10000,
        "acceleration_x_g": 0x8000,
        "acceleration_y_g": 0x4000,
        "acceleration_z_g": 0x2000,
        "acceleration_g": 0x200,
        "locator_x_m": 0x40,
        "locator_y_m": 0x20,
        "velocity_x_m_s": 0x10,
        "velocity_y_m_s": 0x8,
        "speed_m_s": 0x4,
        "core_time": 0x2,
    }
)
EXTENDED_CHANNELS: Mapping[str, int] = MappingProxyType(
    {"gyro_x_deg_s": 0x2000000, "gyro_y_deg_s": 0x1000000, "gyro_z_deg_s": 0x800000, "ambient_lux": 0x40000}
)


@dataclass(frozen=True, slots=True)
class StreamLayout:
    """Which float32 values a stream frame holds, in order."""

    names: tuple[str, ...]
    primary: int
    extended: int
    packer: struct.Struct

    def decode(self, data: bytes) -> tuple[float, ...]:
        """The values of one frame, in the order of ``names``.

        Raises:
            PayloadError: The frame does not hold exactly these values.
        """
        if len(data) != self.packer.size:
            raise PayloadError(SENSOR_DATA.name, data, expected=f"{len(self.names)} float32")
        return self.packer.unpack(data)


def layout_of(primary: int, extended: int) -> StreamLayout:
    """The layout of a stream with these masks; bits without a channel are ignored."""
    names = tuple(
        name
        for channels, mask in ((PRIMARY_CHANNELS, primary), (EXTENDED_CHANNELS, extended))
        for name, bit in channels.items()
        if mask & bit
    )
    return StreamLayout(names, primary, extended, struct.Struct(f">{len(names)}f"))


def layout_for(*names: str) -> StreamLayout:
    """The layout of a stream that carries the channels ``names``, in the order of the wire."""
    primary = sum(PRIMARY_CHANNELS[name] for name in names if name in PRIMARY_CHANNELS)
    extended = sum(EXTENDED_CHANNELS[name] for name in names if name in EXTENDED_CHANNELS)
    return layout_of(primary, extended)


@dataclass(frozen=True, slots=True)
class Collision:
    """A collision report: acceleration in g, axis bits (1 X, 2 Y), power, speed byte, the robot's clock."""

    x_g: float
    y_g: float
    z_g: float
    axis: int
    power: tuple[int, int, int]
    speed_units: int
    t_robot_s: float

    @classmethod
    def decode(cls, data: bytes) -> Collision:
        """Read the 18 bytes of the report.

        Raises:
            PayloadError: There are not 18.
        """
        x, y, z, axis, power_x, power_y, power_z, speed, time_ms = COLLISION.decode(data)
        return cls(x / 4096, y / 4096, z / 4096, axis, (power_x, power_y, power_z), speed, time_ms / 1000)

    def encode(self) -> bytes:
        """The 18 bytes of the report, accelerations cut to what an i16 holds."""
        x, y, z = (max(-32768, min(32767, round(value * 4096))) for value in (self.x_g, self.y_g, self.z_g))
        clock_ms = round(self.t_robot_s * 1000) & 0xFFFFFFFF
        return struct.pack(">hhhBhhhBI", x, y, z, self.axis, *self.power, self.speed_units, clock_ms)
