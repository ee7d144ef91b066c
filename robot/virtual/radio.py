"""A radio without air: bumble controllers on one in-process link, a central for us, a peripheral a robot.

Everything above the antenna is the real thing: HCI, L2CAP, ATT and GATT are bumble's, the client is
bleak's. What the air would do (delay, lost notifications, a broken link) is asked for by name.
"""
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false
# bumble carries py.typed but leaves many signatures bare; nothing of it leaves this file and gatt_backend.

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable
from dataclasses import dataclass

from bumble import att
from bumble.device import Connection, Device
from bumble.gatt import Characteristic, CharacteristicValue, Service
from numpy.random import Generator

from lab.base.errors import RequestError
from robot.errors import RadioError
from robot.virtual.air import CONNECTION_TIMEOUT, NOTIFICATION, Air, QuietController, QuietHost
from robot.virtual.antenna import ATT_DEFAULT_MTU, AirSettings, Antenna, device_on

__all__ = [
    "CONNECTION_TIMEOUT",
    "REMOTE_USER_TERMINATED",
    "AirSettings",
    "GattCharacteristic",
    "GattService",
    "Peripheral",
    "VirtualRadio",
]

_ATT_CID = 4
_CENTRAL_ADDRESS = "F0:F0:F0:00:00:01"
_CALL_TIMEOUT_S = 5.0
REMOTE_USER_TERMINATED = 0x13


@dataclass(frozen=True, slots=True)
class GattCharacteristic:
    """One characteristic of a peripheral: its uuid and what may be done with it."""

    uuid: str
    write: bool = False
    notify: bool = False
    read: bool = False


@dataclass(frozen=True, slots=True)
class GattService:
    """One service of a peripheral."""

    uuid: str
    characteristics: tuple[GattCharacteristic, ...]


class Peripheral:
    """The radio side of a virtual robot: it advertises, is connected to, written to, and notifies.

    Attributes:
        on_connect: Called when a central has connected.
        on_disconnect: Called when it has gone.
        on_write: Called with the characteristic's uuid and the bytes written to it.
        on_read: Called with the characteristic's uuid, returns what it reads as; nothing while there is none.
    """

    def __init__(self, radio: VirtualRadio, name: str, address: str, services: tuple[GattService, ...]) -> None:
        self.name = name
        self.address = address
        self.on_connect: Callable[[], None] | None = None
        self.on_disconnect: Callable[[], None] | None = None
        self.on_write: Callable[[str, bytes], None] | None = None
        self.on_read: Callable[[str], bytes] | None = None
        self._radio = radio
        self._device = radio.make_device(name, address)
        self._connection: Connection | None = None
        self._visible = False
        self._changing = asyncio.Lock()
        self._showing: set[asyncio.Task[None]] = set()
        self._characteristics: dict[str, Characteristic[bytes]] = {}
        for service in services:
            made = [self._make(characteristic) for characteristic in service.characteristics]
            self._device.add_service(Service(service.uuid, made))
        self._device.on(Device.EVENT_CONNECTION, self._connected)

    def _make(self, described: GattCharacteristic) -> Characteristic[bytes]:
        allowed = Characteristic.Properties(0)
        permissions = att.Attribute.Permissions(0)
        if described.write:
            allowed |= Characteristic.Properties.WRITE | Characteristic.Properties.WRITE_WITHOUT_RESPONSE
            permissions |= att.Attribute.Permissions.WRITEABLE
        if described.notify:
            allowed |= Characteristic.Properties.NOTIFY
        if described.read:
            allowed |= Characteristic.Properties.READ
            permissions |= att.Attribute.Permissions.READABLE

        def written(_: Connection, value: bytes) -> None:
            if self.on_write is not None:
                self.on_write(described.uuid, bytes(value))

        def read(_: Connection) -> bytes:
            return self.on_read(described.uuid) if self.on_read is not None else b""

        value = CharacteristicValue[bytes](read=read, write=written)
        made = Characteristic[bytes](described.uuid, allowed, permissions, value)
        self._characteristics[described.uuid] = made
        return made

    async def start(self) -> None:
        """Power on and advertise; it advertises again whenever it has been let go."""
        async with asyncio.timeout(_CALL_TIMEOUT_S):
            await self._device.power_on()
        await self.advertise()

    async def advertise(self) -> None:
        """Be seen until somebody connects, and again afterwards."""
        self._visible = True
        await self._show()

    async def hide(self) -> None:
        """Advertise no more."""
        self._visible = False
        await self._show()

    async def close(self) -> None:
        """Hang up and power off."""
        if self._connection is not None:
            self.hang_up(REMOTE_USER_TERMINATED)
            # Two turns of the loop carry the news to both ends before the power goes.
            await asyncio.sleep(0.01)
        await self.hide()
        async with asyncio.timeout(_CALL_TIMEOUT_S):
            await self._device.power_off()
        self._radio.forget(self)

    async def _show(self) -> None:
        """Advertise or not, as wished; one change at a time, or bumble removes one advertisement twice."""
        async with asyncio.timeout(_CALL_TIMEOUT_S), self._changing:
            if self._visible and self._connection is None:
                await self._device.start_advertising()
            else:
                await self._device.stop_advertising()

    @property
    def controller(self) -> QuietController:
        """Its end of the air."""
        return self._radio.controller_of(self._device)

    @property
    def is_connected(self) -> bool:
        """Whether a central holds the link."""
        return self._connection is not None

    @property
    def payload_bytes(self) -> int:
        """Most bytes that one notification carries: the link's MTU less 3."""
        return (self._connection.att_mtu if self._connection is not None else ATT_DEFAULT_MTU) - 3

    def notify(self, uuid: str, value: bytes) -> None:
        """Notify the central, when there is one that has subscribed. ``value`` must fit ``payload_bytes``."""
        connection = self._connection
        if connection is None:
            return
        handle = self._characteristics[uuid].handle
        subscribed = self._device.gatt_server.subscribers.get(connection, {}).get(handle)
        if not subscribed or not subscribed[0] & 1:
            return
        if len(value) > connection.att_mtu - 3:
            raise RequestError(f"virtual radio: {len(value)} bytes do not fit one notification")
        # Straight to L2CAP: the GATT server would do the same, but after formatting log lines nobody reads.
        pdu = bytes((NOTIFICATION, handle & 0xFF, handle >> 8)) + value
        self._device.send_l2cap_pdu(connection.handle, _ATT_CID, pdu)

    def hang_up(self, reason: int = REMOTE_USER_TERMINATED) -> None:
        """Break the link; both ends are told ``reason``, 0x08 for a link that went out of range."""
        if self._connection is not None:
            self.controller.break_links(reason)

    def fall_silent(self) -> None:
        """Neither hear nor be heard, until ``come_back``; nobody is told, and no link ends."""
        self._radio.air.silence(self.controller)

    def come_back(self) -> None:
        """Be heard again. A link of the time before has timed out: both ends are told so."""
        self._radio.air.readmit(self.controller)

    def lose(self, share: float) -> None:
        """Lose ``share`` of the notifications from now on, besides what the air loses anyway.

        Raises:
            RequestError: The radio has no random generator to draw them from.
        """
        self._radio.air.lose(self.controller, share)

    def _connected(self, connection: Connection) -> None:
        self._connection = connection
        connection.on(Connection.EVENT_DISCONNECTION, self._disconnected)
        if self.on_connect is not None:
            self.on_connect()

    def _disconnected(self, _: int) -> None:
        self._connection = None
        if self.on_disconnect is not None:
            self.on_disconnect()
        showing = asyncio.get_running_loop().create_task(self._show())
        self._showing.add(showing)
        showing.add_done_callback(self._showing.discard)


class VirtualRadio(Antenna):
    """The air, and this machine's antenna in it.

    Args:
        settings: What the air does.
        rng: Source of losses and jitter; needed when ``lost_share`` or ``jitter_s`` is not 0, and by a
            robot that is told to ``lose`` notifications.

    Raises:
        RequestError: ``lost_share`` or ``jitter_s`` is given without ``rng``.
    """

    def __init__(self, settings: AirSettings | None = None, *, rng: Generator | None = None) -> None:
        super().__init__(settings)
        if (self.settings.lost_share or self.settings.jitter_s) and rng is None:
            raise RequestError("virtual radio: losing notifications and jitter need a random generator; hand one in")
        self._rng = rng
        self._air: Air | None = None
        self._peripherals: list[Peripheral] = []
        self._controllers: dict[Device, QuietController] = {}
        self._guests = itertools.count(1)

    async def start(self) -> None:
        """Switch this machine's radio on."""
        if self._central is not None:
            return
        settings = self.settings
        self._air = Air(settings.latency_s, settings.jitter_s, settings.lost_share, self._rng)
        await self._switch_on(self.make_device("host", _CENTRAL_ADDRESS))

    async def close(self) -> None:
        """Switch everything off."""
        for peripheral in tuple(self._peripherals):
            await peripheral.close()
        await self._switch_off()
        self._controllers.clear()
        self._air = None

    @property
    def can_lose(self) -> bool:
        """Whether there is a random generator to draw losses from."""
        return self._rng is not None

    @property
    def air(self) -> Air:
        """The air itself.

        Raises:
            RadioError: The radio is not started.
        """
        if self._air is None:
            raise RadioError(self._off)
        return self._air

    def make_device(self, name: str, address: str) -> Device:
        """A bumble device with a controller of its own in this air.

        Raises:
            RadioError: The radio is not started.
        """
        controller = QuietController(name, self.air)
        host = QuietHost(controller)
        controller.host = host
        device = device_on(host, name, address)
        self._controllers[device] = controller
        return device

    def admit(self) -> QuietController:
        """A controller in this air for a host of somebody else's, who sets its ``host``; ``dismiss`` it in the end.

        Raises:
            RadioError: The radio is not started.
        """
        air = self.air
        number = next(self._guests) % 0x10000
        # Public addresses of their own, for hosts that do not set a random one.
        address = f"00:5F:B8:01:{number >> 8:02X}:{number & 0xFF:02X}"
        return QuietController(f"guest {number}", air, public_address=address)

    def dismiss(self, controller: QuietController) -> None:
        """Take the controller of a host that is gone off the air; its peers find that they hear nothing."""
        controller.host = None
        controller.vanish()
        if self._air is not None:
            self._air.remove_controller(controller)

    async def _withdraw(self, central: Device) -> None:
        self.controller_of(central).give_up_connecting()

    def controller_of(self, device: Device) -> QuietController:
        """The controller of a device made by ``make_device``."""
        return self._controllers[device]

    async def add_peripheral(self, name: str, address: str, services: tuple[GattService, ...]) -> Peripheral:
        """Put a peripheral on the air, off the air until its ``start``.

        Raises:
            RequestError: The address is taken.
        """
        if any(other.address.lower() == address.lower() for other in self._peripherals):
            raise RequestError(f"virtual radio: the address {address} is taken; give each robot its own name")
        peripheral = Peripheral(self, name, address, services)
        self._peripherals.append(peripheral)
        return peripheral

    def forget(self, peripheral: Peripheral) -> None:
        """Take a closed peripheral off the air."""
        if peripheral in self._peripherals:
            self._peripherals.remove(peripheral)
