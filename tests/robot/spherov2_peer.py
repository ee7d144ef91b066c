"""An independent client on the virtual air: spherov2, unmodified, with only its radio exchanged.

spherov2 opens an event loop for each scan and one for each connection, in threads of its own, so it is
given what another program would be given: HCI over TCP. The virtual robot lives on a third loop.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections.abc import Callable, Coroutine, Iterator
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeVar

import bleak
import pytest
import spherov2.adapter.bleak_adapter
from spherov2.controls.v2 import Packet as TheirPacket

from robot.link import COMMANDS_UUID
from robot.packets import Flag, Packet, PacketParser
from robot.virtual.body import Body
from robot.virtual.bolt import BoltSettings, VirtualBolt
from robot.virtual.hci_client import HciRadio
from robot.virtual.hci_server import HciServer
from robot.virtual.radio import VirtualRadio

T = TypeVar("T")
_CALL_TIMEOUT_S = 20.0


def ours(packet: TheirPacket) -> Packet:
    """Our record of a packet of theirs. Theirs says "success" where a frame has no error field."""
    error = int(packet.err) if packet.flags & Flag.RESPONSE else None
    return Packet(
        int(packet.flags), packet.did, packet.cid, packet.seq, bytes(packet.data), packet.tid, packet.sid, error
    )


def theirs(packet: Packet) -> TheirPacket:
    """Their record of a packet of ours."""
    error = TheirPacket.Error.success if packet.error is None else packet.error
    return TheirPacket(
        packet.flags, packet.did, packet.cid, packet.seq, packet.target, packet.source, bytearray(packet.data), error
    )


class Asked(NamedTuple):
    """A packet that spherov2 wrote; the robot got it between the two instants of the monotonic clock."""

    packet: Packet
    earliest_s: float
    latest_s: float


class Wire:
    """What went over the commands characteristic, as spherov2 wrote and heard it."""

    def __init__(self) -> None:
        self.asked: list[Asked] = []
        self.heard: list[bytes] = []
        self._parser = PacketParser()

    def written(self, data: bytes, earliest_s: float) -> None:
        latest_s = time.monotonic()
        self.asked += [Asked(packet, earliest_s, latest_s) for packet in self._parser.feed(data)]

    def answers(self) -> list[Packet]:
        """The answers of the robot, notifications left out."""
        parser = PacketParser()
        packets = [packet for piece in tuple(self.heard) for packet in parser.feed(piece)]
        return [packet for packet in packets if packet.is_response]


def use_hci(patch: pytest.MonkeyPatch, endpoint: str) -> Wire:
    """Point spherov2's `bleak` at the air that is served at ``endpoint``."""
    wire = Wire()

    @contextlib.asynccontextmanager
    async def radio():
        antenna = HciRadio(endpoint)
        await antenna.start()
        try:
            yield antenna
        finally:
            await antenna.close()

    class Scanner:
        @staticmethod
        async def discover(timeout: float) -> list[Any]:
            async with radio() as antenna:
                return await bleak.BleakScanner.discover(timeout, backend=antenna.scanner_backend)

        @staticmethod
        async def find_device_by_filter(wanted: Callable[..., bool], timeout: float) -> Any:
            async with radio() as antenna:
                backend = antenna.scanner_backend
                return await bleak.BleakScanner.find_device_by_filter(wanted, timeout, backend=backend)

    class Client(bleak.BleakClient):
        def __init__(self, address: str, timeout: float) -> None:
            self._antenna = HciRadio(endpoint)
            super().__init__(address, timeout=timeout, backend=self._antenna.client_backend)

        async def connect(self, **options: Any) -> None:
            await self._antenna.start()
            await super().connect(**options)

        async def disconnect(self) -> None:
            await super().disconnect()
            await self._antenna.close()

        async def write_gatt_char(self, uuid: Any, data: Any, response: bool | None = None) -> None:
            earliest_s = time.monotonic()
            await super().write_gatt_char(uuid, data, response)
            if uuid == COMMANDS_UUID:
                wire.written(bytes(data), earliest_s)

        async def start_notify(self, uuid: Any, callback: Callable[..., None], **options: Any) -> None:
            def heard(characteristic: Any, data: bytearray) -> None:
                wire.heard.append(bytes(data))
                callback(characteristic, data)

            await super().start_notify(uuid, heard, **options)

    patched = SimpleNamespace(BleakScanner=Scanner, BleakClient=Client)
    patch.setattr(spherov2.adapter.bleak_adapter, "bleak", patched)
    return wire


class ServedBolt:
    """A virtual BOLT on an event loop of its own, in real time."""

    def __init__(self, loop: asyncio.AbstractEventLoop, robot: VirtualBolt, endpoint: str) -> None:
        self._loop = loop
        self.robot = robot
        self.endpoint = endpoint

    def look(self, see: Callable[[Body], T]) -> T:
        """What ``see`` makes of the body at this instant."""

        async def now() -> T:
            self.robot.body.advance(self._loop.time())
            return see(self.robot.body)

        return _on(self._loop, now())


def _on(loop: asyncio.AbstractEventLoop, coroutine: Coroutine[Any, Any, T]) -> T:
    return asyncio.run_coroutine_threadsafe(coroutine, loop).result(_CALL_TIMEOUT_S)


@contextlib.contextmanager
def served(body: Body, name: str, manners: BoltSettings | None = None) -> Iterator[ServedBolt]:
    """Serve a virtual BOLT over HCI on a free port of this machine."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, name="virtual BOLT")
    thread.start()
    ends = contextlib.AsyncExitStack()

    async def open_() -> ServedBolt:
        radio = VirtualRadio()
        await radio.start()
        ends.push_async_callback(radio.close)
        robot = VirtualBolt(radio, body, name, manners)
        await robot.start()
        ends.push_async_callback(robot.close)
        server = HciServer(radio, "127.0.0.1", 0)
        await server.start()
        ends.push_async_callback(server.close)
        return ServedBolt(loop, robot, server.endpoint)

    try:
        try:
            yield _on(loop, open_())
        finally:
            _on(loop, ends.aclose())
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join(_CALL_TIMEOUT_S)
        loop.close()
