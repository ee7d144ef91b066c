"""What the virtual BOLT's firmware does with a packet. It knows no radio: bytes of frames go out by a callable."""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from robot import commands
from robot.collision import collision_acceleration
from robot.commands import COMMANDS, MATRIX_SIDE, BatteryState, ChargerState, Collision, Command
from robot.packets import NOTIFICATION_SEQ, Flag, Packet, encode
from robot.profile import RobotProfile
from robot.virtual.body import Body, Impact
from robot.virtual.channels import channels_of

_NOTIFICATION_FLAGS = int(Flag.ACTIVITY | Flag.HAS_SOURCE)
_LED_BITS = 0x3F
_REVERSE = 0x01
_MOTOR_SIGN = {0: 0, 1: 1, 2: -1}
_BATTERY_LOW_V, _BATTERY_CRITICAL_V = 3.6, 3.5
# Distance between the two wheels that run inside the shell; an estimate from photographs.
_TRACK_CM = 4.0
# How long the ball takes to lose its speed at a wall: 25 cm/s then give 2.5 g, well above any threshold.
_CONTACT_S = 0.01
_G_CM_S2 = 980.665
# Instants this close are the same one: far above rounding, far below any interval.
_INSTANT_S = 1e-6

_BY_KEY = {command.key: command for command in COMMANDS}
_KNOWN_DIDS = {command.did for command in COMMANDS} | {0x19}
_WHEN_ASLEEP = {commands.WAKE.key, commands.PING.key, commands.DEEP_SLEEP.key}


@dataclass(frozen=True, slots=True)
class FirmwareSettings:
    """Who the robot is.

    Attributes:
        version: Firmware version.
        mac: Twelve hexadecimal digits.
    """

    version: tuple[int, int, int] = (6, 0, 46)
    mac: str = "d05fb8000000"


class _RefusedError(Exception):
    """A command is answered with ``code``."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


class Firmware:
    """Answers commands by moving and reading a ``Body``.

    Args:
        body: The robot's body; whoever calls has advanced it to the present.
        settings: Identity.
        profile: What the robot is truly like: its scales, its flags, how late it sees.
        send: Takes each frame that the robot sends.
        move: Takes each action of the motors and does it, at once or when the robot gets round to it.

    Attributes:
        asleep: Whether it has gone to sleep: only wake and ping are answered.
        stream_interval_s: Time between stream frames; 0 for none.
        wants_deep_sleep: Whether it was told to switch off.
    """

    def __init__(
        self,
        body: Body,
        settings: FirmwareSettings,
        profile: RobotProfile,
        send: Callable[[bytes], None],
        move: Callable[[Callable[[], None]], None],
    ) -> None:
        self.body = body
        self.settings = settings
        self.profile = profile
        self._send = send
        self._move = move
        # What the light sensor saw, (instant, lux), oldest first: sent when it is as old as it must be.
        self._seen: deque[tuple[float, float]] = deque()
        self._handlers: dict[tuple[int, int], Callable[[bytes], bytes]] = {
            commands.PING.key: bytes,
            commands.API_VERSION.key: lambda _: bytes((2, 0)),
            commands.MAIN_APP_VERSION.key: self._version,
            commands.BOOTLOADER_VERSION.key: self._version,
            commands.MAC_ADDRESS.key: lambda _: settings.mac.encode("ascii"),
            commands.DEEP_SLEEP.key: self._deep_sleep,
            commands.SLEEP.key: self._sleep,
            commands.WAKE.key: self._wake,
            commands.BATTERY_VOLTAGE.key: lambda _: struct.pack(">H", round(body.battery_v * 100)),
            commands.BATTERY_STATE.key: self._battery_state,
            commands.CHARGER_STATE.key: lambda _: bytes((ChargerState.NOT_CHARGING,)),
            commands.CHARGER_NOTIFY.key: lambda _: b"",
            commands.RAW_MOTORS.key: self._raw_motors,
            commands.RESET_YAW.key: self._reset_yaw,
            commands.DRIVE.key: self._drive,
            commands.STABILISATION.key: self._stabilisation,
            commands.LEDS.key: self._leds,
            commands.MATRIX_PIXEL.key: self._matrix_pixel,
            commands.MATRIX_COLOUR.key: self._matrix_colour,
            commands.STREAM.key: self._stream,
            commands.STREAM_GET.key: lambda _: self._stream_setting,
            commands.STREAM_EXTENDED.key: self._stream_extended,
            commands.STREAM_EXTENDED_GET.key: lambda _: struct.pack(">I", self._extended),
            commands.GYRO_MAX_NOTIFY.key: lambda _: b"",
            commands.COLLISION_SETUP.key: self._collision_setup,
            commands.RESET_LOCATOR.key: self._reset_locator,
            commands.LOCATOR_FLAGS.key: lambda _: b"",
            commands.AMBIENT_LIGHT.key: lambda _: struct.pack(">f", self._light_lux()),
        }
        self.boot()
        body.on_bump = self._bumped

    def boot(self) -> None:
        """Forget what a host has set up, as after a switch-on or a new connection."""
        self.asleep = False
        self.wants_deep_sleep = False
        self.stream_interval_s = 0.0
        self._stream_setting = bytes(7)
        self._primary = 0
        self._extended = 0
        self._frames_left = math.inf
        self._layout = commands.layout_of(0, 0)
        self._readers: tuple[Callable[[], float], ...] = ()
        self._collision_method = 0
        self._collision_dead_s = 0.0
        self._deaf_until_s = -math.inf
        self._pixels: list[tuple[int, ...]] = [(0, 0, 0)] * (MATRIX_SIDE * MATRIX_SIDE)
        self._raw_cm_s: float | None = None
        self._raw_heading_rad = 0.0
        self._seen.clear()

    @property
    def streams_light(self) -> bool:
        """Whether the stream that runs carries the light sensor."""
        return self.stream_interval_s > 0 and "ambient_lux" in self._layout.names

    def forget_light(self) -> None:
        """Forget what was sensed for a stream that has ended or changed."""
        self._seen.clear()

    def sense(self) -> None:
        """Look at the light now, to tell of it when ``light_latency_s`` has passed."""
        self._seen.append((self.body.t_s, self.body.light_lux()))

    def _light_lux(self) -> float:
        """The reading of ``light_latency_s`` ago; the oldest there is when the stream is younger than that.

        Outside a stream of light nothing has been sensed ahead, and a single reading is of the present.
        """
        seen = self._seen
        if not seen:
            return self.body.light_lux()
        then_s = self.body.t_s - self.profile.light_latency_s
        while len(seen) > 1 and seen[1][0] <= then_s + _INSTANT_S:
            seen.popleft()
        return seen[0][1]

    def handle(self, packet: Packet) -> None:
        """Do what ``packet`` asks and answer when it wants an answer."""
        code, reply = commands.OK, b""
        try:
            reply = self._obey(packet)
        except _RefusedError as refusal:
            code = refusal.code
        wants = packet.flags & Flag.WANTS_RESPONSE and not (packet.flags & Flag.ONLY_ERROR and code == commands.OK)
        if not wants:
            return
        flags = int(Flag.RESPONSE | Flag.ACTIVITY)
        if packet.target is not None and packet.source is not None:
            flags = self.profile.reply_flags
        elif packet.target is not None:
            flags |= Flag.HAS_SOURCE
        elif packet.source is not None:
            flags |= Flag.HAS_TARGET
        target = packet.source if flags & Flag.HAS_TARGET else None
        source = packet.target if flags & Flag.HAS_SOURCE else None
        self._send(encode(Packet(flags, packet.did, packet.cid, packet.seq, reply, target, source, code)))

    def _obey(self, packet: Packet) -> bytes:
        key = (packet.did, packet.cid)
        command = _BY_KEY.get(key)
        if packet.target is not None and packet.target not in (commands.PRIMARY, commands.SECONDARY):
            raise _RefusedError(commands.BAD_TARGET)
        if packet.did not in _KNOWN_DIDS:
            raise _RefusedError(commands.BAD_DID)
        if command is None:
            raise _RefusedError(commands.BAD_CID)
        if command.target is not None and packet.target != command.target:
            # The other processor does not have this command.
            raise _RefusedError(commands.BAD_CID)
        if command.layout is not None and len(packet.data) != struct.calcsize(f">{command.layout}"):
            raise _RefusedError(commands.BAD_LENGTH)
        if self.asleep and key not in _WHEN_ASLEEP:
            raise _RefusedError(commands.TARGET_UNAVAILABLE)
        return self._handlers[key](packet.data)

    def notify(self, command: Command, data: bytes = b"") -> None:
        """Send a notification; it comes from the processor that owns the command's device."""
        source = commands.SECONDARY if command.did == commands.SENSOR_DATA.did else commands.PRIMARY
        self._send(encode(Packet(_NOTIFICATION_FLAGS, command.did, command.cid, NOTIFICATION_SEQ, data, source=source)))

    def stream_frame(self) -> None:
        """Send one frame of the stream."""
        self.notify(commands.SENSOR_DATA, self._layout.packer.pack(*[read() for read in self._readers]))
        self._frames_left -= 1
        if self._frames_left <= 0:
            self._end_stream()

    def _end_stream(self) -> None:
        self.stream_interval_s = 0.0
        self._seen.clear()

    def fall_asleep(self) -> None:
        """Stop, stream no more, and answer nothing but wake."""
        self._move(self.body.stop)
        self._end_stream()
        self.asleep = True
        self.notify(commands.DID_SLEEP)

    def _version(self, _: bytes) -> bytes:
        return struct.pack(">HHH", *self.settings.version)

    def _deep_sleep(self, _: bytes) -> bytes:
        self._move(self.body.stop)
        self.wants_deep_sleep = True
        return b""

    def _sleep(self, _: bytes) -> bytes:
        self.fall_asleep()
        return b""

    def _wake(self, _: bytes) -> bytes:
        self.asleep = False
        return b""

    def _battery_state(self, _: bytes) -> bytes:
        volts = self.body.battery_v
        if volts < _BATTERY_CRITICAL_V:
            return bytes((BatteryState.CRITICAL,))
        return bytes((BatteryState.LOW if volts < _BATTERY_LOW_V else BatteryState.OK,))

    def _drive(self, data: bytes) -> bytes:
        units, degrees, flags = struct.unpack(">BHB", data)
        if degrees > 359:
            raise _RefusedError(commands.BAD_PARAMETER)
        heading_rad = math.radians(degrees) + (math.pi if flags & _REVERSE else 0.0)

        def roll() -> None:
            self._raw_cm_s = None
            self.body.drive(heading_rad, self._speed_cm_s(units))

        self._move(roll)
        return b""

    def _speed_cm_s(self, units: int) -> float:
        """What the wheels make of a speed byte: too small a one does not turn them."""
        return units * self.profile.cm_s_per_unit if units >= self.profile.least_speed_units else 0.0

    def _raw_motors(self, data: bytes) -> bytes:
        """Roll by the mean of the two wheels, or spin by their difference: whichever is more.

        A real one does both at once and rolls an arc, which this body does not.
        """
        left_mode, left, right_mode, right = data
        if left_mode not in _MOTOR_SIGN or right_mode not in _MOTOR_SIGN:
            raise _RefusedError(commands.BAD_PARAMETER)
        left_cm_s = _MOTOR_SIGN[left_mode] * self._speed_cm_s(left)
        right_cm_s = _MOTOR_SIGN[right_mode] * self._speed_cm_s(right)
        mean_cm_s = (left_cm_s + right_cm_s) / 2.0
        if left_cm_s != right_cm_s and abs(left_cm_s - right_cm_s) / 2.0 >= abs(mean_cm_s):
            # The left wheel ahead: clockwise, as headings are.
            self._move(lambda: self.body.spin((left_cm_s - right_cm_s) / _TRACK_CM))
        else:
            self._move(lambda: self._roll_raw(mean_cm_s))
        return b""

    def _roll_raw(self, speed_cm_s: float) -> None:
        """Roll ahead or back. The ball turns round to go back: told so again, it goes on, and not round again."""
        body = self.body
        if body.moving and self._raw_cm_s is not None and self._raw_cm_s * speed_cm_s > 0:
            heading_rad = self._raw_heading_rad
        else:
            heading_rad = body.heading_rad + (math.pi if speed_cm_s < 0 else 0.0)
        self._raw_cm_s, self._raw_heading_rad = speed_cm_s, heading_rad
        body.drive(heading_rad, abs(speed_cm_s))

    def _reset_yaw(self, _: bytes) -> bytes:
        self.body.reset_yaw()
        return b""

    def _reset_locator(self, _: bytes) -> bytes:
        self.body.reset_locator()
        return b""

    def _stabilisation(self, data: bytes) -> bytes:
        if data[0] > 5:
            raise _RefusedError(commands.BAD_PARAMETER)
        return b""

    def _leds(self, data: bytes) -> bytes:
        """Front and back LEDs shine to the sides; neither the camera nor the light sensor sees them."""
        if not data or len(data) != 1 + data[0].bit_count():
            raise _RefusedError(commands.BAD_LENGTH)
        if data[0] > _LED_BITS:
            raise _RefusedError(commands.BAD_PARAMETER)
        return b""

    def _matrix_colour(self, data: bytes) -> bytes:
        self._pixels = [tuple(data)] * len(self._pixels)
        self._shine()
        return b""

    def _matrix_pixel(self, data: bytes) -> bytes:
        column, row, *colour = data
        if column >= MATRIX_SIDE or row >= MATRIX_SIDE:
            raise _RefusedError(commands.BAD_PARAMETER)
        self._pixels[row * MATRIX_SIDE + column] = tuple(colour)
        self._shine()
        return b""

    def _shine(self) -> None:
        """What the matrix's pixels add up to, seen from afar."""
        full = 255 * len(self._pixels)
        self.body.led_level = sum(max(pixel) for pixel in self._pixels) / full
        red, green, blue = (sum(parts) / full for parts in zip(*self._pixels, strict=True))
        self.body.led_rgb = red, green, blue

    def _stream(self, data: bytes) -> bytes:
        interval_ms, count, self._primary = struct.unpack(">HBI", data)
        self._stream_setting = data
        self._frames_left = count or math.inf
        self.stream_interval_s = interval_ms / 1000
        self._choose_channels()
        return b""

    def _stream_extended(self, data: bytes) -> bytes:
        (self._extended,) = struct.unpack(">I", data)
        self._choose_channels()
        return b""

    def _choose_channels(self) -> None:
        self._layout = commands.layout_of(self._primary, self._extended)
        if not self._layout.names:
            self._end_stream()
        sources = channels_of(self.body, self._light_lux)
        self._readers = tuple(sources[name] for name in self._layout.names)

    def _collision_setup(self, data: bytes) -> bytes:
        self._collision_method = data[0]
        self._collision_dead_s = data[5] / 100
        return b""

    def _bumped(self, impact: Impact) -> None:
        if not self._collision_method or impact.t_s < self._deaf_until_s or self.asleep:
            return
        self._deaf_until_s = impact.t_s + self._collision_dead_s
        # A glancing touch must still give a direction, hence the least of one unit of 1/64 g.
        size_g = max(1 / 64, impact.speed_cm_s / _CONTACT_S / _G_CM_S2)
        axes = self.profile.collision_axes
        x_g, y_g = collision_acceleration(impact.normal_heading_rad, impact.heading_rad, min(size_g, 7.9), axes)
        axis = (1 if abs(x_g) >= abs(y_g) else 0) | (2 if abs(y_g) >= abs(x_g) else 0)
        units = min(255, round(impact.speed_cm_s / self.profile.cm_s_per_unit))
        power = (round(min(30.0, abs(x_g)) * 1000), round(min(30.0, abs(y_g)) * 1000), 0)
        self.notify(commands.COLLISION, Collision(x_g, y_g, 0.0, axis, power, units, impact.t_s).encode())
