"""A radio without air: bumble controllers on one in-process link, a central for us, a peripheral a robot.

Everything above the antenna is the real thing: HCI, L2CAP, ATT and GATT are bumble's, the client is
bleak's. What the air would do (delay, lost notifications, a broken link) is asked for by name.
"""
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false
# bumble carries py.typed but leaves many signatures bare; nothing of it leaves this file and gatt_backend.

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Callable
from dataclasses import dataclass, field

from bleak.backends.client import BaseBleakClient
from bleak.backends.scanner import BaseBleakScanner
from bumble import att, core, hci
from bumble.data_types import CompleteLocalName
from bumble.device import Advertisement, Connection, Device, DeviceConfiguration
from bumble.gatt import Characteristic, CharacteristicValue, Service
from numpy.random import Generator

from lab.base.errors import RequestError
from robot.errors import RadioError
from robot.virtual.air import NOTIFICATION, Air, QuietController, QuietDevice, QuietHost
from robot.virtual.gatt_backend import client_backend, scanner_backend

ATT_DEFAULT_MTU = 23
_ATT_CID = 4
_CENTRAL_ADDRESS = "F0:F0:F0:00:00:01"
_CALL_TIMEOUT_S = 5.0
_ADVERTISING_INTERVAL_MS = 200.0
CONNECTION_TIMEOUT = 0x08
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


@dataclass(frozen=True, slots=True)
class AirSettings:
    """What the air does.

    Attributes:
        mtu: Largest ATT packet that the central asks for; 23 is the least, and forces fragments.
        latency_s: Delay of every packet.
        lost_share: Share of the notifications that never arrive.
    """

    mtu: int = 185
    latency_s: float = 0.0
    lost_share: float = 0.0

    def __post_init__(self) -> None:
        if not ATT_DEFAULT_MTU <= self.mtu <= 247:
            raise RequestError(f"virtual radio: `mtu` must be 23 to 247, got {self.mtu}")
        if not (self.latency_s >= 0 and 0 <= self.lost_share <= 1):
            raise RequestError("virtual radio: `latency_s` must not be negative, `lost_share` 0 to 1")


class Peripheral:
    """The radio side of a virtual robot: it advertises, is connected to, written to, and notifies.

    Attributes:
        on_connect: Called when a central has connected.
        on_disconnect: Called when it has gone.
        on_write: Called with the characteristic's uuid and the bytes written to it.
    """

    def __init__(self, radio: VirtualRadio, name: str, address: str, services: tuple[GattService, ...]) -> None:
        self.name = name
        self.address = address
        self.on_connect: Callable[[], None] | None = None
        self.on_disconnect: Callable[[], None] | None = None
        self.on_write: Callable[[str, bytes], None] | None = None
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

        value = CharacteristicValue[bytes](read=lambda _: b"", write=written)
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


@dataclass(slots=True)
class _Listening:
    """Who listens for advertisements."""

    ears: list[Callable[[Advertisement], None]] = field(default_factory=list[Callable[[Advertisement], None]])
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)


class VirtualRadio:
    """The air, and this machine's antenna in it.

    Args:
        settings: What the air does.
        rng: Source of the losses; needed when ``lost_share`` is not 0.

    Raises:
        RequestError: ``lost_share`` is given without ``rng``.
    """

    def __init__(self, settings: AirSettings | None = None, *, rng: Generator | None = None) -> None:
        self.settings = settings if settings is not None else AirSettings()
        if self.settings.lost_share and rng is None:
            raise RequestError("virtual radio: losing notifications needs a random generator; hand one in")
        self._rng = rng
        self._air: Air | None = None
        self._central: Device | None = None
        self._listening = _Listening()
        self._peripherals: list[Peripheral] = []
        self._controllers: dict[Device, QuietController] = {}
        self._connecting = asyncio.Lock()

    @property
    def client_backend(self) -> type[BaseBleakClient]:
        """What bleak's ``BleakClient(backend=...)`` takes."""
        return client_backend(self)

    @property
    def scanner_backend(self) -> type[BaseBleakScanner]:
        """What bleak's ``BleakScanner(backend=...)`` takes."""
        return scanner_backend(self)

    @property
    def central(self) -> Device:
        """This machine's radio.

        Raises:
            RadioError: The radio is not started.
        """
        if self._central is None:
            raise RadioError("the virtual radio is off: start it first")
        return self._central

    async def start(self) -> None:
        """Switch this machine's radio on."""
        if self._central is not None:
            return
        settings = self.settings
        self._air = Air(settings.latency_s, settings.lost_share, self._rng)
        central = self.make_device("host", _CENTRAL_ADDRESS)
        async with asyncio.timeout(_CALL_TIMEOUT_S):
            await central.power_on()
        central.on(Device.EVENT_ADVERTISEMENT, self._heard)
        self._central = central

    async def close(self) -> None:
        """Switch everything off."""
        for peripheral in tuple(self._peripherals):
            await peripheral.close()
        central, self._central = self._central, None
        if central is not None:
            with contextlib.suppress(core.BaseBumbleError, hci.HCI_Error, TimeoutError):
                async with asyncio.timeout(_CALL_TIMEOUT_S):
                    await central.power_off()
        self._controllers.clear()
        self._air = None

    def make_device(self, name: str, address: str) -> Device:
        """A bumble device with a controller of its own in this air.

        Raises:
            RadioError: The radio is not started.
        """
        if self._air is None:
            raise RadioError("the virtual radio is off: start it first")
        controller = QuietController(name, self._air)
        host = QuietHost(controller)
        configuration = DeviceConfiguration(
            name=name,
            address=hci.Address(address),
            advertising_interval_min=_ADVERTISING_INTERVAL_MS,
            advertising_interval_max=_ADVERTISING_INTERVAL_MS,
            advertising_data=bytes(core.AdvertisingData([CompleteLocalName(name)])),
        )
        device = QuietDevice(config=configuration, host=host)
        self._controllers[device] = controller
        return device

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

    @contextlib.asynccontextmanager
    async def listening(self, ear: Callable[[Advertisement], None]) -> AsyncGenerator[None]:
        """Hand every advertisement to ``ear`` in the body."""
        await self.listen(ear)
        try:
            yield
        finally:
            await self.unlisten(ear)

    async def listen(self, ear: Callable[[Advertisement], None]) -> None:
        """Begin to hand every advertisement to ``ear``."""
        async with asyncio.timeout(_CALL_TIMEOUT_S), self._listening.lock:
            central = self.central
            if not self._listening.ears:
                await central.start_scanning(filter_duplicates=False)
            self._listening.ears.append(ear)

    async def unlisten(self, ear: Callable[[Advertisement], None]) -> None:
        """Hand no more advertisements to ``ear``."""
        async with asyncio.timeout(_CALL_TIMEOUT_S), self._listening.lock:
            if ear in self._listening.ears:
                self._listening.ears.remove(ear)
            if not self._listening.ears and self._central is not None:
                await self._central.stop_scanning()

    async def connect(self, address: str, timeout_s: float) -> Connection:
        """Connect the central to a peripheral once it has been heard.

        A connection request to somebody who is not there would stay with the controller for ever.

        Raises:
            TimeoutError: It is not heard, or does not answer, within ``timeout_s``.
            RadioError: The radio is not started.
        """
        heard = asyncio.Event()

        def ear(advertisement: Advertisement) -> None:
            if advertisement.address.to_string(False).lower() == address.lower():
                heard.set()

        async with asyncio.timeout(timeout_s), self._connecting:
            async with self.listening(ear):
                await heard.wait()
            central = self.central
            try:
                return await central.connect_le(hci.Address(address), timeout=None)
            except BaseException:
                # Out of time or cancelled: nobody may find this request in the way.
                self.controller_of(central).give_up_connecting()
                raise

    def _heard(self, advertisement: Advertisement) -> None:
        for ear in tuple(self._listening.ears):
            ear(advertisement)
