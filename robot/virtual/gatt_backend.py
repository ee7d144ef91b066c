"""bleak backends on the virtual radio: the real ``BleakClient`` and ``BleakScanner`` run on top of them."""
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# bumble carries py.typed but leaves many signatures bare; nothing of it leaves this package.

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, ClassVar, Protocol
from uuid import UUID

from bleak.args import SizedBuffer
from bleak.assigned_numbers import CharacteristicPropertyName, gatt_char_props_to_strs
from bleak.backends.characteristic import BleakGATTCharacteristic
from bleak.backends.client import BaseBleakClient, NotifyCallback
from bleak.backends.descriptor import BleakGATTDescriptor
from bleak.backends.device import BLEDevice
from bleak.backends.scanner import AdvertisementData, AdvertisementDataCallback, BaseBleakScanner
from bleak.backends.service import BleakGATTService, BleakGATTServiceCollection
from bleak.exc import (
    BleakBluetoothNotAvailableError,
    BleakBluetoothNotAvailableReason,
    BleakDeviceNotFoundError,
    BleakError,
)
from bumble import att, core, hci
from bumble.device import Advertisement, Connection, Peer

from robot.errors import RadioError

_CALL_TIMEOUT_S = 10.0
_DISCONNECT_TIMEOUT_S = 2.0


class Central(Protocol):
    """What the backends need of the antenna that carries them."""

    @property
    def mtu(self) -> int:
        """Largest ATT packet to ask for."""
        ...

    async def listen(self, ear: Callable[[Advertisement], None]) -> None:
        """Begin to hand every advertisement to ``ear``."""
        ...

    async def unlisten(self, ear: Callable[[Advertisement], None]) -> None:
        """Hand no more advertisements to ``ear``."""
        ...

    async def connect(self, address: str, timeout_s: float) -> Connection:
        """Connect to the peripheral at ``address`` once it has been heard. Raises TimeoutError after ``timeout_s``."""
        ...


def client_backend(radio: Central) -> type[BaseBleakClient]:
    """The client backend class that reaches the robots on ``radio``."""
    return type("VirtualClient", (_Client,), {"radio": radio})


def scanner_backend(radio: Central) -> type[BaseBleakScanner]:
    """The scanner backend class that hears the robots on ``radio``."""
    return type("VirtualScanner", (_Scanner,), {"radio": radio})


class _Scanner(BaseBleakScanner):
    radio: ClassVar[Central]

    def __init__(
        self,
        detection_callback: AdvertisementDataCallback | None,
        service_uuids: list[str] | None,
        scanning_mode: str = "active",
        **_: Any,
    ) -> None:
        super().__init__(detection_callback, service_uuids)

    async def start(self) -> None:
        self.seen_devices = {}
        try:
            await self.radio.listen(self._heard)
        except RadioError as error:
            raise _powered_off(error) from error

    async def stop(self) -> None:
        await self.radio.unlisten(self._heard)

    def _heard(self, advertisement: Advertisement) -> None:
        address = advertisement.address.to_string(False)
        name = advertisement.data.get(core.AdvertisingData.COMPLETE_LOCAL_NAME)
        local_name = str(name) if name else None
        data = AdvertisementData(
            local_name=local_name,
            manufacturer_data={},
            service_data={},
            service_uuids=[],
            tx_power=None,
            rssi=advertisement.rssi,
            platform_data=(advertisement,),
        )
        if self.is_allowed_uuid(data.service_uuids):
            device = self.create_or_update_device(address, address, local_name, advertisement, data)
            self.call_detection_callbacks(device, data)


class _Client(BaseBleakClient):
    radio: ClassVar[Central]

    def __init__(
        self,
        address_or_ble_device: BLEDevice | str,
        *,
        disconnected_callback: Callable[[], None] | None,
        timeout: float,
        **_: Any,
    ) -> None:
        super().__init__(address_or_ble_device, disconnected_callback=disconnected_callback, timeout=timeout)
        known = address_or_ble_device.name if isinstance(address_or_ble_device, BLEDevice) else None
        self._name = known or self.address.replace(":", "-")
        self._connection: Connection | None = None
        self._peer: Peer | None = None
        self._gone = asyncio.Event()
        self._subscribers: dict[int, Callable[[bytes], None]] = {}

    @property
    def name(self) -> str:
        return self._name

    @property
    def mtu_size(self) -> int:
        return self._connection.att_mtu if self._connection else att.ATT_DEFAULT_MTU

    @property
    def is_connected(self) -> bool:
        return self._connection is not None

    async def connect(self, pair: bool, **_: Any) -> None:
        if pair:
            raise BleakError("a virtual robot does not pair")
        try:
            self._connection = await self.radio.connect(self.address, self._timeout)
        except RadioError as error:
            raise _powered_off(error) from error
        except TimeoutError as error:
            raise BleakDeviceNotFoundError(self.address, "it no longer advertises") from error
        except (core.BaseBumbleError, hci.HCI_Error) as error:
            raise BleakError(f"the virtual radio did not connect: {error}") from error
        self._gone.clear()
        self._connection.on(Connection.EVENT_DISCONNECTION, self._disconnected)
        self._peer = Peer(self._connection)
        self.services = await self._bounded(self._discover(self._peer))

    async def _discover(self, peer: Peer) -> BleakGATTServiceCollection:
        await peer.request_mtu(self.radio.mtu)
        await peer.discover_all()
        collection = BleakGATTServiceCollection()
        for found in peer.services:
            service = BleakGATTService(found, found.handle, _uuid(found.uuid))
            collection.add_service(service)
            for each in found.characteristics:
                properties: list[CharacteristicPropertyName] = list(gatt_char_props_to_strs(int(each.properties)))
                characteristic = BleakGATTCharacteristic(
                    each, each.handle, _uuid(each.uuid), properties, lambda: self.mtu_size - 3, service
                )
                collection.add_characteristic(characteristic)
                for one in each.descriptors:
                    collection.add_descriptor(BleakGATTDescriptor(one, one.handle, _uuid(one.type), characteristic))
        return collection

    async def disconnect(self) -> None:
        if self._connection is not None:
            try:
                async with asyncio.timeout(_DISCONNECT_TIMEOUT_S):
                    await self._connection.disconnect()
                    await self._gone.wait()
            except (core.BaseBumbleError, hci.HCI_Error, TimeoutError) as error:
                raise BleakError(f"the virtual radio did not disconnect: {error}") from error

    async def pair(self, *args: Any, **kwargs: Any) -> None:
        raise BleakError("a virtual robot does not pair")

    async def unpair(self) -> None:
        raise BleakError("a virtual robot does not pair")

    async def read_gatt_char(
        self, characteristic: BleakGATTCharacteristic, *, use_cached: bool = False, **_: Any
    ) -> bytearray:
        return bytearray(await self._bounded(characteristic.obj.read_value()))

    async def read_gatt_descriptor(
        self, descriptor: BleakGATTDescriptor, *, use_cached: bool = False, **_: Any
    ) -> bytearray:
        return bytearray(await self._bounded(descriptor.obj.read_value()))

    async def write_gatt_char(self, characteristic: BleakGATTCharacteristic, data: SizedBuffer, response: bool) -> None:
        await self._bounded(characteristic.obj.write_value(bytes(data), with_response=response))

    async def write_gatt_descriptor(self, descriptor: BleakGATTDescriptor, data: SizedBuffer) -> None:
        await self._bounded(descriptor.obj.write_value(bytes(data), with_response=True))

    async def start_notify(self, characteristic: BleakGATTCharacteristic, callback: NotifyCallback, **_: Any) -> None:
        def notified(value: bytes) -> None:
            callback(bytearray(value))

        self._subscribers[characteristic.handle] = notified
        await self._bounded(characteristic.obj.subscribe(notified))

    async def stop_notify(self, characteristic: BleakGATTCharacteristic) -> None:
        subscriber = self._subscribers.pop(characteristic.handle, None)
        await self._bounded(characteristic.obj.unsubscribe(subscriber))

    async def _bounded(self, call: Any) -> Any:
        """Await a GATT call; a link that breaks meanwhile ends it at once instead of after bumble's 30 s."""
        if self._connection is None:
            call.close()
            raise BleakError("not connected")
        task = asyncio.ensure_future(call)
        gone = asyncio.ensure_future(self._gone.wait())
        try:
            await asyncio.wait([task, gone], timeout=_CALL_TIMEOUT_S, return_when=asyncio.FIRST_COMPLETED)
            if not task.done():
                reason = "the link broke" if gone.done() else f"no answer within {_CALL_TIMEOUT_S:g} s"
                raise BleakError(reason)
            return task.result()
        except asyncio.CancelledError:
            # bumble cancels what is under way when the link goes; a cancelled caller must stay cancelled.
            if not task.cancelled():
                raise
            raise BleakError("the link broke") from None
        except (core.BaseBumbleError, hci.HCI_Error) as error:
            raise BleakError(f"the virtual robot refused: {error}") from error
        finally:
            task.cancel()
            gone.cancel()

    def _disconnected(self, _: int) -> None:
        self._connection = None
        self._gone.set()
        if self._disconnected_callback is not None:
            self._disconnected_callback()


def _powered_off(error: RadioError) -> BleakBluetoothNotAvailableError:
    return BleakBluetoothNotAvailableError(str(error), BleakBluetoothNotAvailableReason.POWERED_OFF)


def _uuid(uuid: core.UUID) -> str:
    """The 128-bit form in lower case; bumble keeps it least byte first."""
    return str(UUID(bytes=bytes(reversed(uuid.uuid_128_bytes))))
