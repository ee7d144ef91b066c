"""This machine's antenna in a virtual air: it listens, connects, and carries bleak's client and scanner."""
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# bumble carries py.typed but leaves many signatures bare; nothing of it leaves this package.

from __future__ import annotations

import asyncio
import contextlib
import math
from abc import ABC, abstractmethod
from collections.abc import AsyncGenerator, Callable
from dataclasses import dataclass, field

from bleak.backends.client import BaseBleakClient
from bleak.backends.scanner import BaseBleakScanner
from bumble import core, hci
from bumble.data_types import CompleteLocalName
from bumble.device import Advertisement, Connection, Device, DeviceConfiguration

from lab.base.errors import RequestError
from robot.errors import RadioError
from robot.virtual.air import QuietDevice, QuietHost
from robot.virtual.gatt_backend import client_backend, scanner_backend

ATT_DEFAULT_MTU = 23
_CALL_TIMEOUT_S = 5.0
# A link whose request was taken back too late is known to its host within this time.
_LATE_S = 0.01
_ADVERTISING_INTERVAL_MS = 200.0


@dataclass(frozen=True, slots=True)
class AirSettings:
    """What the air does.

    Attributes:
        mtu: Largest ATT packet that the central asks for; 23 is the least, and forces fragments.
        latency_s: Least delay of every packet.
        jitter_s: Most that is added to it, evenly drawn; packets of one link keep their order.
        lost_share: Share of the notifications that never arrive.
    """

    mtu: int = 185
    latency_s: float = 0.0
    lost_share: float = 0.0
    jitter_s: float = 0.0

    def __post_init__(self) -> None:
        if not ATT_DEFAULT_MTU <= self.mtu <= 247:
            raise RequestError(f"virtual radio: `mtu` must be 23 to 247, got {self.mtu}")
        if not (0 <= self.latency_s < math.inf and 0 <= self.jitter_s < math.inf and 0 <= self.lost_share <= 1):
            raise RequestError("virtual radio: `latency_s` and `jitter_s` must not be negative, `lost_share` 0 to 1")


def device_on(host: QuietHost, name: str, address: str) -> Device:
    """A bumble device on ``host`` that would advertise as ``name`` from the static random ``address``."""
    configuration = DeviceConfiguration(
        name=name,
        address=hci.Address(address),
        advertising_interval_min=_ADVERTISING_INTERVAL_MS,
        advertising_interval_max=_ADVERTISING_INTERVAL_MS,
        advertising_data=bytes(core.AdvertisingData([CompleteLocalName(name)])),
    )
    return QuietDevice(config=configuration, host=host)


@dataclass(slots=True)
class _Listening:
    """Who listens for advertisements."""

    ears: list[Callable[[Advertisement], None]] = field(default_factory=list[Callable[[Advertisement], None]])
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)


class Antenna(ABC):
    """The central of a virtual air.

    Args:
        settings: What the air does; of a remote one only ``mtu`` is in this end's hands.
    """

    _off = "the virtual radio is off: start it first"

    def __init__(self, settings: AirSettings | None = None) -> None:
        self.settings = settings if settings is not None else AirSettings()
        self._central: Device | None = None
        self._listening = _Listening()
        self._connecting = asyncio.Lock()

    @property
    def mtu(self) -> int:
        """Largest ATT packet that it asks for."""
        return self.settings.mtu

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
            raise RadioError(self._off)
        return self._central

    @abstractmethod
    async def _withdraw(self, central: Device) -> None:
        """Make the controller forget the connection request that is under way."""

    async def _switch_on(self, central: Device) -> None:
        async with asyncio.timeout(_CALL_TIMEOUT_S):
            await central.power_on()
        central.on(Device.EVENT_ADVERTISEMENT, self._heard)
        self._central = central

    async def _switch_off(self) -> None:
        central, self._central = self._central, None
        if central is not None:
            with contextlib.suppress(core.BaseBumbleError, hci.HCI_Error, TimeoutError):
                async with asyncio.timeout(_CALL_TIMEOUT_S):
                    await central.power_off()

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
            connecting = asyncio.ensure_future(central.connect_le(hci.Address(address), timeout=None))
            try:
                # Shielded: bumble does not know a link whose request it has dropped in the same turn of the loop.
                connection = await asyncio.shield(connecting)
            except BaseException:
                # Out of time or cancelled: nobody may find this request in the way.
                await self._abandon(central, connecting)
                raise
            if central.connections.get(connection.handle) is not connection:
                # Gone before anybody could listen for its end: somebody else was quicker.
                raise TimeoutError
            return connection

    async def _abandon(self, central: Device, connecting: asyncio.Task[Connection]) -> None:
        """Take a connection request back, and let go of a link that has come of it meanwhile."""
        await self._withdraw(central)
        done, _ = await asyncio.wait((connecting,), timeout=_LATE_S)
        connecting.cancel()
        if done and not connecting.cancelled() and connecting.exception() is None:
            with contextlib.suppress(core.BaseBumbleError, hci.HCI_Error, TimeoutError):
                async with asyncio.timeout(_CALL_TIMEOUT_S):
                    await connecting.result().disconnect()

    def _heard(self, advertisement: Advertisement) -> None:
        for ear in tuple(self._listening.ears):
            ear(advertisement)
