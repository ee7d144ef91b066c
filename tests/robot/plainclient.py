"""A plain bleak client that speaks to a virtual BOLT in frames, with none of the driver."""

import asyncio
import contextlib

from bleak import BleakClient, BleakScanner

from lab.clock import run
from robot.commands import Request
from robot.link import ANTI_DOS_UUID, ANTI_DOS_WORDS, COMMANDS_UUID
from robot.packets import Packet, PacketParser, encode


class Client:
    """A plain bleak client that speaks frames."""

    def __init__(self, bench) -> None:
        self.bench = bench
        self.packets: list[Packet] = []
        self.pieces: list[bytes] = []
        self.parser = PacketParser()
        self.gone = asyncio.Event()
        self.seq = 0

    @contextlib.asynccontextmanager
    async def open(self, *, words: bool = True):
        radio = self.bench.radio
        device = await BleakScanner.find_device_by_name("SB-1234", backend=radio.scanner_backend)
        async with BleakClient(device, lambda _: self.gone.set(), backend=radio.client_backend) as self.client:
            if words:
                await self.client.write_gatt_char(ANTI_DOS_UUID, ANTI_DOS_WORDS, response=True)
            await self.client.start_notify(COMMANDS_UUID, self._received)
            yield self

    def _received(self, _, chunk: bytearray) -> None:
        self.pieces.append(bytes(chunk))
        self.packets += self.parser.feed(chunk)

    async def ask(self, request: Request, *, response: bool = True) -> Packet:
        self.seq += 1
        return await self.send(request.packet(self.seq), response=response)

    async def send(self, packet: Packet, *, response: bool = True) -> Packet:
        await self.client.write_gatt_char(COMMANDS_UUID, encode(packet), response=response)
        async with asyncio.timeout(1.0):
            while True:
                for answer in self.packets:
                    if answer.is_response and answer.seq == packet.seq:
                        self.packets.remove(answer)
                        return answer
                await asyncio.sleep(0.001)


def session(bench, script, **options) -> None:
    async def main() -> None:
        async with bench(connect=False, **options) as b, Client(b).open() as client:
            await script(b, client)

    run(main(), virtual=True)
