"""Virtual robots for other processes: a virtual radio's air, served as HCI over TCP.

Each TCP connection is a Bluetooth controller of its own in the air. When it ends, for whatever
reason, the controller goes off the air and its links break, as when a phone's battery dies.
"""
# pyright: reportUnknownMemberType=false
# bumble carries py.typed but leaves many signatures bare.

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import struct
from typing import cast

from bumble import core
from bumble.transport.common import PacketParser

from lab.base.errors import RequestError
from lab.base.loopback import is_loopback
from robot.errors import RadioError
from robot.virtual.air import QuietController
from robot.virtual.radio import VirtualRadio

DEFAULT_ENDPOINT = "127.0.0.1:6402"
_CALL_TIMEOUT_S = 5.0
_MOST_CLIENTS = 32
# A client that does not read for so long that this much waits for it is as good as gone.
_MOST_WAITING_BYTES = 1 << 18
# What bumble raises on packets that are not what they say they are.
_MALFORMED = (core.BaseBumbleError, struct.error, LookupError, ValueError, TypeError, AssertionError)

_log = logging.getLogger(__name__)


def parse_endpoint(text: str) -> tuple[str, int]:
    """Host and port of "HOST:PORT"; an IPv6 address stands in brackets.

    Raises:
        RequestError: It is something else.
    """
    host, colon, port = text.strip().rpartition(":")
    host = host.removeprefix("[").removesuffix("]") if host.startswith("[") else host
    whole = bool(colon and host) and port.isascii() and port.isdecimal() and int(port) <= 0xFFFF
    # A bare IPv6 address has colons too, but says no port.
    if not whole or (":" in host and not text.strip().startswith("[")):
        raise RequestError(f"{text!r} is no HOST:PORT; write it like {DEFAULT_ENDPOINT}, port 0 to 65535")
    return host, int(port)


def format_endpoint(host: str, port: int) -> str:
    """The "HOST:PORT" that ``parse_endpoint`` reads."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


class HciServer:
    """Serves the air of a started radio.

    Args:
        radio: The radio, on the same event loop; its robots are what clients find.
        host: Address to listen on.
        port: Port to listen on; 0 for any that is free.
        anywhere: Allow a host that other machines reach. HCI knows no password: whoever connects drives.

    Raises:
        RequestError: ``host`` is not this machine alone, and ``anywhere`` is not set.
    """

    def __init__(self, radio: VirtualRadio, host: str, port: int, *, anywhere: bool = False) -> None:
        if not anywhere and not is_loopback(host):
            raise RequestError(
                f"serving on {host} would let other machines drive the robot: serve on 127.0.0.1, "
                "or allow it (`--allow-remote`)"
            )
        self.radio = radio
        self.host = host
        self._wanted_port = port
        self._server: asyncio.Server | None = None
        self._guests: set[_Guest] = set()
        self._empty = asyncio.Event()
        self._empty.set()

    @property
    def port(self) -> int:
        """The port it listens on.

        Raises:
            RadioError: It is not started.
        """
        if self._server is None:
            raise RadioError("the HCI server is off: start it first")
        return int(self._server.sockets[0].getsockname()[1])

    @property
    def endpoint(self) -> str:
        """Where clients connect to, "HOST:PORT"."""
        return format_endpoint(self.host, self.port)

    @property
    def clients(self) -> int:
        """How many clients are connected now."""
        return len(self._guests)

    async def start(self) -> None:
        """Listen; does nothing when it does already.

        Raises:
            RequestError: The port is taken, or the host is not this machine's.
        """
        if self._server is not None:
            return
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(_CALL_TIMEOUT_S):
                self._server = await loop.create_server(lambda: _Guest(self), self.host, self._wanted_port)
        except (OSError, TimeoutError) as error:
            code = error.errno
            reason = os.strerror(code) if code and code > 0 else error.strerror or "no answer in time"
            raise RequestError(
                f"cannot serve on {format_endpoint(self.host, self._wanted_port)} ({reason}): "
                "choose another HOST:PORT; port 0 takes any that is free"
            ) from error

    async def close(self) -> None:
        """Send every client away and listen no more."""
        server, self._server = self._server, None
        if server is None:
            return
        server.close()
        for guest in tuple(self._guests):
            guest.leave()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_CALL_TIMEOUT_S):
                await server.wait_closed()
                await self._empty.wait()

    def welcome(self, guest: _Guest) -> QuietController | None:
        """A controller for a new client; None when there are too many, or the server is closing."""
        if self._server is None or len(self._guests) >= _MOST_CLIENTS:
            return None
        controller = self.radio.admit()
        self._guests.add(guest)
        self._empty.clear()
        return controller

    def goodbye(self, guest: _Guest, controller: QuietController) -> None:
        """Take a client's controller off the air."""
        self._guests.discard(guest)
        if not self._guests:
            self._empty.set()
        self.radio.dismiss(controller)


class _Guest(asyncio.Protocol):
    """One TCP connection: packets from its host to its controller, and back."""

    def __init__(self, server: HciServer) -> None:
        self._server = server
        self._parser = PacketParser(_Inbox(self))
        self._wire: asyncio.Transport | None = None
        self.controller: QuietController | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._wire = cast("asyncio.Transport", transport)
        self.controller = self._server.welcome(self)
        if self.controller is None:
            _log.warning("sent an HCI client away: %d are connected already", self._server.clients)
            self.leave()
        else:
            self.controller.host = self

    def data_received(self, data: bytes) -> None:
        try:
            self._parser.feed_data(data)
        except core.InvalidPacketError as error:
            self.refuse(error)

    def connection_lost(self, exc: Exception | None) -> None:
        self._wire = None
        controller, self.controller = self.controller, None
        if controller is not None:
            self._server.goodbye(self, controller)

    def on_packet(self, packet: bytes) -> None:
        """Send the host a packet from its controller."""
        wire = self._wire
        if wire is None or wire.is_closing():
            return
        if wire.get_write_buffer_size() > _MOST_WAITING_BYTES:
            _log.warning("cut off an HCI client that has stopped reading")
            wire.abort()
        else:
            wire.write(packet)

    def refuse(self, error: Exception) -> None:
        """Cut off a client that does not speak HCI."""
        reason = " ".join(str(error).split()) or type(error).__name__
        _log.warning("cut off a client that does not speak HCI (%s)", reason)
        self.leave()

    def leave(self) -> None:
        """Close the connection; the rest follows in ``connection_lost``."""
        if self._wire is not None:
            self._wire.abort()


class _Inbox:
    """Takes the whole packets that a client has sent."""

    def __init__(self, guest: _Guest) -> None:
        self._guest = guest

    def on_packet(self, packet: bytes) -> None:
        controller = self._guest.controller
        if controller is None:
            return
        try:
            controller.on_packet(packet)
        except _MALFORMED as error:
            self._guest.refuse(error)
