"""A virtual BOLT on a virtual radio: its GATT table, its manners, and the timers that drive its body."""

from __future__ import annotations

import asyncio
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace

from lab.base.errors import RequestError
from robot import commands
from robot.errors import RadioError
from robot.link import ANTI_DOS_UUID, ANTI_DOS_WORDS, COMMANDS_UUID
from robot.packets import Flag, PacketParser
from robot.profile import RobotProfile
from robot.virtual.air import DelayLine
from robot.virtual.body import Body, BodySettings
from robot.virtual.firmware import Firmware, FirmwareSettings
from robot.virtual.radio import CONNECTION_TIMEOUT, GattCharacteristic, GattService, Peripheral, VirtualRadio
from robot.virtual.spells import Spells

_BASE = "-574f-4f20-5370-6865726f2121"
SERVICES = (
    GattService(f"00010001{_BASE}", (GattCharacteristic(COMMANDS_UUID, write=True, notify=True),)),
    GattService(
        f"00020001{_BASE}",
        (
            GattCharacteristic(f"00020002{_BASE}", write=True, notify=True),
            GattCharacteristic(f"00020004{_BASE}", read=True),
            GattCharacteristic(ANTI_DOS_UUID, write=True),
        ),
    ),
)
# A rolling body without a stream is looked at this often, so that it reports its collisions.
_PULSE_S = 0.05
# How long the link holds a stream that is too fast for it.
_CHOKE_S = 1.0
# Timers may fire a clock's resolution early.
_EARLY_S = 1e-6


@dataclass(frozen=True, slots=True)
class BoltSettings:
    """Manners of the virtual BOLT.

    Attributes:
        anti_dos_s: A central that has not said the words within this time is dropped.
        inactivity_s: After this long without a command it announces that it will sleep.
        sleep_notice_s: Time from the announcement to sleep.
        chunk_bytes: Longest piece that a frame is cut into; 0 for what the link's MTU allows.
        firmware: Version.
    """

    anti_dos_s: float = 10.0
    inactivity_s: float = 120.0
    sleep_notice_s: float = 10.0
    chunk_bytes: int = 0
    firmware: tuple[int, int, int] = (6, 0, 46)

    def __post_init__(self) -> None:
        times = (self.anti_dos_s, self.inactivity_s, self.sleep_notice_s)
        if not all(math.isfinite(value) and value > 0 for value in times) or self.chunk_bytes < 0:
            raise RequestError("virtual BOLT: its times must be above 0, `chunk_bytes` 0 or more")


def body_settings(profile: RobotProfile, settings: BodySettings) -> BodySettings:
    """``settings`` with the systematic errors of path and odometer that ``profile`` has."""
    return replace(
        settings, drift_bias_rad_per_cm=profile.drift_rad_per_cm, locator_bias=1.0 / profile.locator_scale - 1.0
    )


def address_of(name: str) -> str:
    """The Bluetooth address of the virtual BOLT called ``name``.

    Raises:
        RequestError: The name is not a BOLT's.
    """
    if not re.fullmatch(r"SB-[0-9A-Fa-f]{4}", name):
        raise RequestError(f"virtual BOLT: {name!r} is no BOLT's name; call it SB- and four hexadecimal digits")
    digits = name[3:].upper()
    # The two top bits set make it a static random address.
    return f"D0:5F:B8:00:{digits[:2]}:{digits[2:]}"


class VirtualBolt:
    """A BOLT that lives in this process.

    Args:
        radio: The radio it advertises on, already started when ``start`` is called.
        body: What rolls and sees.
        name: "SB-" and four hexadecimal digits; its address follows from them.
        settings: Its manners.
        profile: What it is truly like, hidden from whoever drives it: what its commands do, how late it
            moves and sees, how fast a stream its link holds, how it answers. Its drift and the scale of
            its locator are the body's: see ``body_settings``.

    Raises:
        RequestError: The name is not a BOLT's.
    """

    def __init__(
        self,
        radio: VirtualRadio,
        body: Body,
        name: str = "SB-1234",
        settings: BoltSettings | None = None,
        profile: RobotProfile | None = None,
    ) -> None:
        self.name = name
        self.body = body
        self.settings = settings if settings is not None else BoltSettings()
        self.profile = profile if profile is not None else RobotProfile()
        self.address = address_of(name)
        self._radio = radio
        self._peripheral: Peripheral | None = None
        self._parser = PacketParser()
        self._firmware = Firmware(
            body,
            FirmwareSettings(version=self.settings.firmware, mac=self.address.replace(":", "").lower()),
            self.profile,
            self._send,
            self._move,
        )
        self._motions = DelayLine()
        self._spells = Spells()
        self._started_s: float | None = None
        self._trusted = False
        self._pulse: asyncio.TimerHandle | None = None
        self._choke: asyncio.TimerHandle | None = None
        self._next_frame_s = self._next_sense_s = math.inf
        self._guard: asyncio.TimerHandle | None = None
        self._drowsy: asyncio.TimerHandle | None = None
        self._last_activity_s = 0.0
        self._hiding: asyncio.Task[None] | None = None

    @property
    def is_connected(self) -> bool:
        """Whether a host holds the link."""
        return self._peripheral is not None and self._peripheral.is_connected

    @property
    def asleep(self) -> bool:
        """Whether it has gone to sleep."""
        return self._firmware.asleep

    @property
    def started_s(self) -> float:
        """The loop's clock when it was switched on.

        Raises:
            RadioError: It is off.
        """
        if self._started_s is None:
            raise RadioError(f"the virtual robot {self.name} is off: start it first")
        return self._started_s

    async def start(self) -> None:
        """Switch it on: it advertises.

        Raises:
            RequestError: Another robot on the radio has the same address.
        """
        if self._peripheral is not None:
            return
        peripheral = await self._radio.add_peripheral(self.name, self.address, SERVICES)
        peripheral.on_connect = self._connected
        peripheral.on_disconnect = self._disconnected
        peripheral.on_write = self._written
        self._peripheral = peripheral
        self._started_s = asyncio.get_running_loop().time()
        self.body.advance(self._started_s)
        await peripheral.start()

    async def close(self) -> None:
        """Switch it off."""
        self._spells.close()
        peripheral, self._peripheral = self._peripheral, None
        self._forget_host()
        self._motions.cut()
        self._motions = DelayLine()
        self._started_s = None
        if peripheral is not None:
            await peripheral.close()

    @property
    def can_lose(self) -> bool:
        """Whether the radio can lose notifications: it has a random generator to draw them from."""
        return self._radio.can_lose

    def after(self, delay_s: float, action: Callable[[], None]) -> None:
        """Do ``action`` in ``delay_s`` from now, unless it is switched off before."""
        self._spells.after(delay_s, action)

    def drop_link(self, for_s: float = 0.0) -> None:
        """Break the link as if the robot had gone out of range, and advertise again after ``for_s``."""
        if self._peripheral is None:
            return
        self._peripheral.hang_up(CONNECTION_TIMEOUT)
        if for_s > 0:
            self.vanish(for_s)

    def vanish(self, for_s: float) -> None:
        """Neither hear nor be heard for ``for_s``; nobody is told, and in the end it is back and its link gone."""
        if self._peripheral is not None:
            self._peripheral.fall_silent()
            self._spells.begin("vanish", for_s, self._peripheral.come_back)

    def lose(self, share: float, for_s: float) -> None:
        """Lose ``share`` (0 to 1) of the notifications for ``for_s``.

        Raises:
            RequestError: The share is not 0 to 1, or the radio has no random generator to draw from.
        """
        if not 0 <= share <= 1:
            raise RequestError(f"virtual BOLT: the share of lost notifications must be 0 to 1, got {share:g}")
        peripheral = self._peripheral
        if peripheral is not None:
            peripheral.lose(share)
            self._spells.begin("lose", for_s, lambda: peripheral.lose(0.0))

    def stick_sensor(self, for_s: float) -> None:
        """Let the light sensor read for ``for_s`` what it reads now, whatever it sees."""

        def loosen() -> None:
            self.body.stuck_lux = None

        self.body.advance(asyncio.get_running_loop().time())
        self.body.stuck_lux = self.body.light_lux()
        self._spells.begin("stick", for_s, loosen)

    def stall(self, for_s: float) -> None:
        """Hold the wheels for ``for_s``, as a cable under the ball does."""

        def free() -> None:
            self.body.advance(asyncio.get_running_loop().time())
            self.body.held = False
            self._arm()

        self.body.advance(asyncio.get_running_loop().time())
        self.body.held = True
        self._spells.begin("stall", for_s, free)

    def drain(self, charge: float, for_s: float) -> None:
        """Leave ``charge`` (0 to 1) of the battery; after ``for_s`` it has the charge of before again.

        Raises:
            RequestError: The charge is not 0 to 1.
        """
        if not 0 <= charge <= 1:
            raise RequestError(f"virtual BOLT: the battery's charge must be 0 to 1, got {charge:g}")
        body = self.body
        before = body.battery_charge

        def restore() -> None:
            body.battery_charge = before

        body.advance(asyncio.get_running_loop().time())
        body.battery_charge = charge
        self._spells.begin("drain", for_s, restore)

    def _connected(self) -> None:
        loop = asyncio.get_running_loop()
        self._parser = PacketParser()
        self._firmware.boot()
        self._trusted = False
        self._guard = loop.call_later(self.settings.anti_dos_s, self._check_words)
        self._last_activity_s = loop.time()
        self._drowsy = loop.call_later(self.settings.inactivity_s, self._grow_drowsy)

    def _disconnected(self) -> None:
        self.body.advance(asyncio.get_running_loop().time())
        self._forget_host()
        if self._firmware.wants_deep_sleep and self._peripheral is not None:
            self._hiding = asyncio.get_running_loop().create_task(self._peripheral.hide())

    def _forget_host(self) -> None:
        """End the timers; a body that still rolls stops by its own time-out, in ``advance``."""
        for timer in (self._pulse, self._choke, self._guard, self._drowsy):
            if timer is not None:
                timer.cancel()
        self._pulse = self._choke = self._guard = self._drowsy = None
        self._next_frame_s = self._next_sense_s = math.inf

    def _check_words(self) -> None:
        if not self._trusted and self._peripheral is not None:
            self._peripheral.hang_up()

    def _written(self, uuid: str, value: bytes) -> None:
        if uuid == ANTI_DOS_UUID:
            self._trusted = self._trusted or value == ANTI_DOS_WORDS
        elif uuid == COMMANDS_UUID:
            now_s = asyncio.get_running_loop().time()
            self.body.advance(now_s)
            firmware = self._firmware
            for packet in self._parser.feed(value):
                if packet.flags & Flag.ACTIVITY:
                    self._last_activity_s = now_s
                streamed = firmware.stream_interval_s, firmware.streams_light
                firmware.handle(packet)
                if (firmware.stream_interval_s, firmware.streams_light) != streamed:
                    self._restream(now_s)
            if firmware.wants_deep_sleep and self._peripheral is not None:
                # Time for the answer to leave.
                asyncio.get_running_loop().call_later(_PULSE_S, self._peripheral.hang_up)
            self._arm()

    def _restream(self, now_s: float) -> None:
        """Set the instants of the stream that the firmware has begun, changed or ended."""
        interval_s, late_s = self._firmware.stream_interval_s, self.profile.light_latency_s
        if self._choke is not None:
            self._choke.cancel()
            self._choke = None
        self._next_frame_s = self._next_sense_s = math.inf
        self._firmware.forget_light()
        if not interval_s:
            return
        self._next_frame_s = now_s + interval_s
        if self._firmware.streams_light and late_s > 0:
            # At each frame's instant less the latency; for those before the stream, the best there is, is now.
            self._next_sense_s = self._next_frame_s - late_s
        if interval_s < self.profile.least_interval_s - _EARLY_S:
            self._choke = asyncio.get_running_loop().call_later(_CHOKE_S, self.drop_link)

    def _move(self, action: Callable[[], None]) -> None:
        """Let the motors do ``action`` once the robot has got round to it; the body is at the present."""
        if not self.profile.motion_latency_s:
            action()
            return

        def late() -> None:
            self.body.advance(asyncio.get_running_loop().time())
            action()
            self._arm()

        self._motions.put(self.profile.motion_latency_s, late)

    def _arm(self) -> None:
        """Set the timer for whatever is next: a stream frame, or a look at the rolling body."""
        if self._pulse is not None:
            self._pulse.cancel()
            self._pulse = None
        if not self.is_connected:
            return
        loop = asyncio.get_running_loop()
        at_s = min(self._next_frame_s, self._next_sense_s) if self._firmware.stream_interval_s else math.inf
        if self.body.moving:
            at_s = min(at_s, loop.time() + _PULSE_S)
        if at_s < math.inf:
            self._pulse = loop.call_at(at_s, self._beat)

    def _beat(self) -> None:
        self._pulse = None
        now_s = asyncio.get_running_loop().time()
        firmware = self._firmware
        self.body.advance(now_s)
        interval_s = firmware.stream_interval_s
        if interval_s and now_s >= self._next_sense_s - _EARLY_S:
            firmware.sense()
            self._next_sense_s += interval_s * max(1, math.ceil((now_s - self._next_sense_s) / interval_s))
        if interval_s and now_s >= self._next_frame_s - _EARLY_S:
            firmware.stream_frame()
            self._next_frame_s += interval_s
            if self._next_frame_s < now_s:
                self._next_frame_s = now_s + interval_s
        self._arm()

    def _grow_drowsy(self) -> None:
        """Announce sleep after long inactivity, and fall asleep when nothing came of it."""
        loop = asyncio.get_running_loop()
        settings = self.settings
        quiet_s = loop.time() - self._last_activity_s
        if self._firmware.asleep:
            wait_s = settings.inactivity_s
        elif quiet_s < settings.inactivity_s - _EARLY_S:
            wait_s = settings.inactivity_s - quiet_s
        elif quiet_s < settings.inactivity_s + settings.sleep_notice_s - _EARLY_S:
            self._firmware.notify(commands.WILL_SLEEP)
            wait_s = settings.inactivity_s + settings.sleep_notice_s - quiet_s
        else:
            self.body.advance(loop.time())
            self._firmware.fall_asleep()
            wait_s = settings.inactivity_s
        self._drowsy = loop.call_later(wait_s, self._grow_drowsy)

    def _send(self, frame: bytes) -> None:
        peripheral = self._peripheral
        if peripheral is None:
            return
        size = peripheral.payload_bytes
        if self.settings.chunk_bytes:
            size = min(size, self.settings.chunk_bytes)
        if len(frame) <= size:
            peripheral.notify(COMMANDS_UUID, frame)
            return
        for start in range(0, len(frame), size):
            peripheral.notify(COMMANDS_UUID, frame[start : start + size])
