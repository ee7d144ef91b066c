"""The radio link to one robot: found by name, connected through bleak, asked and answered packet by packet."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Callable
from dataclasses import dataclass
from functools import partial

from bleak import BleakClient, BleakScanner
from bleak.backends.characteristic import BleakGATTCharacteristic
from bleak.backends.client import BaseBleakClient
from bleak.backends.device import BLEDevice
from bleak.backends.scanner import AdvertisementData, BaseBleakScanner
from bleak.exc import BleakBluetoothNotAvailableError, BleakError

from robot import commands
from robot.commands import Request
from robot.errors import (
    BluetoothUnavailableError,
    CommandError,
    LinkLostError,
    NotABoltError,
    NotConnectedError,
    ReplyTimeoutError,
    RobotNotFoundError,
    RobotUnreachableError,
)
from robot.packets import NOTIFICATION_SEQ, Packet, PacketParser, encode
from robot.profile import RobotProfile

COMMANDS_UUID = "00010002-574f-4f20-5370-6865726f2121"
ANTI_DOS_UUID = "00020005-574f-4f20-5370-6865726f2121"
ANTI_DOS_WORDS = b"usetheforce...band"
NAME_PREFIX = "SB-"
_CLOSE_TIMEOUT_S = 5.0
# A command without an answer for this long is sent again; answers take some 0.1 s.
_ASK_AGAIN_S = 1.0


@dataclass(frozen=True, slots=True)
class Heard:
    """A robot that advertises: name, Bluetooth address (a UUID on macOS), signal strength in dBm."""

    name: str
    address: str
    rssi_dbm: int


@contextlib.asynccontextmanager
async def _scanning(
    robot: str,
    heard: Callable[[BLEDevice, AdvertisementData], None],
    backend: type[BaseBleakScanner] | None,
    start_timeout_s: float,
) -> AsyncGenerator[None]:
    """Listen for advertisements in the body. Raises BluetoothUnavailableError when the radio does not start."""
    try:
        scanner = BleakScanner(heard, backend=backend)
        async with asyncio.timeout(start_timeout_s):
            await scanner.start()
    except (BleakError, OSError) as error:
        raise BluetoothUnavailableError(robot, reason_of(error)) from error
    try:
        yield
    finally:
        # A radio that went away meanwhile needs no stopping.
        with contextlib.suppress(BleakError, OSError):
            async with asyncio.timeout(_CLOSE_TIMEOUT_S):
                await scanner.stop()


def reason_of(error: Exception) -> str:
    """One line on what the radio's software said."""
    if isinstance(error, BleakBluetoothNotAvailableError):
        return error.reason.name.lower().replace("_", " ")
    if isinstance(error, FileNotFoundError):
        return "its Bluetooth service is not running"
    if isinstance(error, TimeoutError):
        return "no answer in time"
    return " ".join(str(error).split()) or type(error).__name__


async def _let_go(client: BleakClient) -> None:
    # A link that breaks while it is closed is closed.
    with contextlib.suppress(BleakError, OSError, TimeoutError):
        async with asyncio.timeout(_CLOSE_TIMEOUT_S):
            await client.disconnect()


async def scan(
    timeout_s: float = 5.0, scanner_backend: type[BaseBleakScanner] | None = None, *, prefix: str = NAME_PREFIX
) -> list[Heard]:
    """Listen for ``timeout_s`` and list the robots that advertise, strongest first; BOLTs unless ``prefix`` differs.

    Raises:
        BluetoothUnavailableError: This machine's radio is missing or off.
    """
    found: dict[str, Heard] = {}

    def heard(device: BLEDevice, advertisement: AdvertisementData) -> None:
        name = advertisement.local_name or device.name
        if name and name.upper().startswith(prefix):
            found[device.address] = Heard(name, device.address, advertisement.rssi)

    async with _scanning("robots", heard, scanner_backend, timeout_s + _CLOSE_TIMEOUT_S):
        await asyncio.sleep(timeout_s)
    return sorted(found.values(), key=lambda robot: (-robot.rssi_dbm, robot.name))


async def find(
    name: str,
    timeout_s: float,
    scanner_backend: type[BaseBleakScanner] | None = None,
    *,
    prefix: str = NAME_PREFIX,
) -> BLEDevice:
    """Wait until a robot called ``name`` (in any case) advertises; its like have names that begin with ``prefix``.

    Raises:
        BluetoothUnavailableError: This machine's radio is missing or off.
        RobotNotFoundError: It does not within ``timeout_s``; lists the robots that do.
    """
    arrived: asyncio.Future[BLEDevice] = asyncio.get_running_loop().create_future()
    seen: set[str] = set()

    def heard(device: BLEDevice, advertisement: AdvertisementData) -> None:
        called = advertisement.local_name or device.name or ""
        if called.lower() == name.lower():
            if not arrived.done():
                arrived.set_result(device)
        elif called.upper().startswith(prefix):
            seen.add(called)

    async with _scanning(name, heard, scanner_backend, timeout_s):
        try:
            async with asyncio.timeout(timeout_s):
                return await arrived
        except TimeoutError as error:
            raise RobotNotFoundError(name, timeout_s=timeout_s, seen=sorted(seen)) from error


class Link:
    """Asks one robot and hands on what it says of itself.

    Args:
        name: Advertised name.
        profile: Pacing and time-outs.
        backend: bleak client backend; None is the platform's own.
        scanner_backend: bleak scanner backend; None is the platform's own.

    Attributes:
        on_notification: Called with each packet that answers no request.
        on_lost: Called once, with the reason, when the link breaks unasked.
        parser: The parser of what arrives, with its counts of bad frames.
        reply_flags: Flags byte of the last answer to a command that names its target; None before the first.
    """

    def __init__(
        self,
        name: str,
        profile: RobotProfile,
        *,
        backend: type[BaseBleakClient] | None = None,
        scanner_backend: type[BaseBleakScanner] | None = None,
    ) -> None:
        self.name = name
        self.profile = profile
        self.on_notification: Callable[[Packet], None] | None = None
        self.on_lost: Callable[[str], None] | None = None
        self.parser = PacketParser()
        self.reply_flags: int | None = None
        self._backend = backend
        self._scanner_backend = scanner_backend
        self._client: BleakClient | None = None
        self._inbox: BleakGATTCharacteristic | None = None
        self._pending: dict[tuple[int, int, int], asyncio.Future[Packet]] = {}
        self._seq = 0
        self._turn = asyncio.Lock()
        self._next_write_s = 0.0
        self._last_write_s = 0.0

    @property
    def is_open(self) -> bool:
        """Whether commands can be sent."""
        return self._inbox is not None

    @property
    def address(self) -> str:
        """Bluetooth address of the robot (a UUID on macOS); empty before ``open``."""
        return self._client.address if self._client else ""

    @property
    def last_write_s(self) -> float:
        """Loop time of the last write."""
        return self._last_write_s

    async def open(self) -> None:
        """Find the robot, connect, and say the words that keep it from dropping the link.

        Raises:
            BluetoothUnavailableError: This machine's radio is missing or off.
            RobotNotFoundError: No such name is heard.
            RobotUnreachableError: It is heard but does not connect.
            NotABoltError: What connects is something else.
            LinkLostError: It was closed meanwhile.
        """
        profile = self.profile
        device = await find(self.name, profile.scan_timeout_s, self._scanner_backend)
        client = BleakClient(device, self._disconnected, timeout=profile.connect_timeout_s, backend=self._backend)
        self._client = client
        self.parser = PacketParser()
        try:
            async with asyncio.timeout(profile.connect_timeout_s):
                await client.connect()
                inbox, guard = (self._characteristic(client, uuid) for uuid in (COMMANDS_UUID, ANTI_DOS_UUID))
                await client.write_gatt_char(guard, ANTI_DOS_WORDS, response=True)
                await client.start_notify(inbox, partial(self._received, client))
            if self._client is not client:
                raise LinkLostError(self.name, "it was let go meanwhile")
        except BaseException as error:
            # Also when cancelled, and when ``close`` came before there was a connection to close.
            await _let_go(client)
            await self.close()
            if isinstance(error, BleakBluetoothNotAvailableError):
                raise BluetoothUnavailableError(self.name, reason_of(error)) from error
            if isinstance(error, (BleakError, OSError, TimeoutError)):
                raise RobotUnreachableError(self.name, address=device.address, reason=reason_of(error)) from error
            raise
        self._inbox = inbox

    def _characteristic(self, client: BleakClient, uuid: str) -> BleakGATTCharacteristic:
        characteristic = client.services.get_characteristic(uuid)
        if characteristic is None:
            raise NotABoltError(self.name, address=client.address, missing=uuid)
        return characteristic

    async def close(self) -> None:
        """Let the robot go; does nothing when the link is gone already. Raises nothing."""
        self._inbox = None
        self._fail_pending("it was closed")
        client, self._client = self._client, None
        if client is not None:
            await _let_go(client)

    def fail(self, reason: str) -> None:
        """Take the link for lost: whoever waits for an answer gets LinkLostError, ``on_lost`` is called."""
        if self._inbox is None:
            return
        self._inbox = None
        self._fail_pending(reason)
        if self.on_lost is not None:
            self.on_lost(reason)

    async def ask(
        self, request: Request, *, timeout_s: float | None = None, wanted: Callable[[], bool] | None = None
    ) -> bytes:
        """Send ``request`` and return the payload of its answer; asked again now and then while none comes.

        Every command sets or reads a state, so a robot that hears one twice is none the worse.

        Args:
            request: What to send.
            timeout_s: How long an answer is awaited; the profile's ``reply_timeout_s`` when that is less.
            wanted: It is asked again only while this holds; once it does not, an answer that has not come yet
                is awaited no longer.

        Raises:
            NotConnectedError: The link is not open.
            LinkLostError: It broke meanwhile.
            ReplyTimeoutError: No answer.
            CommandError: The robot refused.
        """
        name, limit_s = request.command.name, self.profile.reply_timeout_s
        loop = asyncio.get_running_loop()
        begun_s = loop.time()
        answer: asyncio.Future[Packet] = loop.create_future()
        key: tuple[int, int, int] | None = None
        try:
            # The time-out covers the wait for one's turn too, so no caller waits unbounded.
            async with asyncio.timeout(limit_s if timeout_s is None else min(timeout_s, limit_s)):
                while not answer.done():
                    if key is not None and wanted is not None and not wanted():
                        raise TimeoutError
                    async with self._turn:
                        wait_s = self._next_write_s - loop.time()
                        if wait_s > 0:
                            await asyncio.sleep(wait_s)
                        if key is None:
                            key = (*request.command.key, self._number(request.command.key))
                            self._pending[key] = answer
                        await self._write(name, encode(request.packet(key[2])))
                    await asyncio.wait((answer,), timeout=_ASK_AGAIN_S)
            reply = answer.result()
        except TimeoutError as error:
            raise ReplyTimeoutError(self.name, name, timeout_s=loop.time() - begun_s) from error
        finally:
            if key is not None:
                self._pending.pop(key, None)
            # A link lost during the write has failed the answer too; nobody else will look at it.
            if not answer.cancel() and not answer.cancelled():
                answer.exception()
        if request.command.target is not None:
            self.reply_flags = reply.flags
        code = reply.error or commands.OK
        if code != commands.OK:
            raise CommandError(self.name, name, code=code, meaning=commands.ERRORS.get(code, "unknown error"))
        return reply.data

    async def _write(self, name: str, frame: bytes) -> None:
        client, inbox = self._client, self._inbox
        if client is None or inbox is None:
            raise NotConnectedError(self.name, name)
        loop = asyncio.get_running_loop()
        try:
            await client.write_gatt_char(inbox, frame, response=self.profile.write_with_response)
        except (BleakError, OSError) as error:
            self.fail(reason_of(error))
            raise LinkLostError(self.name, reason_of(error)) from error
        self._last_write_s = loop.time()
        self._next_write_s = self._last_write_s + self.profile.command_pacing_s

    def _number(self, key: tuple[int, int]) -> int:
        """The next sequence number that no answer to the same command is awaited by; never that of notifications."""
        for _ in range(NOTIFICATION_SEQ):
            self._seq = (self._seq + 1) % NOTIFICATION_SEQ
            if (*key, self._seq) not in self._pending:
                break
        return self._seq

    def _received(self, client: BleakClient, _: BleakGATTCharacteristic, chunk: bytearray) -> None:
        # A link that was taken for lost may still deliver: its robot is gone for whoever was told so.
        if client is not self._client or self._inbox is None:
            return
        for packet in self.parser.feed(chunk):
            if packet.is_response:
                answer = self._pending.get((packet.did, packet.cid, packet.seq))
                if answer is not None and not answer.done():
                    answer.set_result(packet)
            elif self.on_notification is not None:
                self.on_notification(packet)

    def _disconnected(self, client: BleakClient) -> None:
        if client is self._client:
            self.fail("it disconnected")

    def _fail_pending(self, reason: str) -> None:
        for answer in self._pending.values():
            if not answer.done():
                answer.set_exception(LinkLostError(self.name, reason))
