"""Between a session and its page server: what is new goes one way and may be lost, commands come the other.

Two pairs of sockets, made before the server is spawned. Datagrams take what is new: they are written without ever
waiting, and a full buffer, or a server that hangs or is dead, drops them. A stream brings the commands, one JSON
object a line; its end tells the session that the server is gone, and the server that the session is.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, cast

from lab.base.given import json_of

LARGEST_BYTES = 60_000  # a datagram's limit is 65507
_BUFFER_BYTES = 1 << 18
_LONGEST_COMMAND = 1 << 14
Command = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Ends:
    """One side's two sockets."""

    news: socket.socket
    commands: socket.socket

    def close(self) -> None:
        """Close both."""
        self.news.close()
        self.commands.close()


def make_channel() -> tuple[Ends, Ends]:
    """The session's ends and the page server's."""
    here, there = _datagrams()
    ours, theirs = socket.socketpair()
    here.setblocking(False)
    ours.setblocking(False)
    return Ends(here, ours), Ends(there, theirs)


def _datagrams() -> tuple[socket.socket, socket.socket]:
    """Two sockets on the loopback interface, each bound to the other: the system drops what others send them."""
    pair = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for one in pair:
        one.bind(("127.0.0.1", 0))
        for option in (socket.SO_SNDBUF, socket.SO_RCVBUF):
            one.setsockopt(socket.SOL_SOCKET, option, _BUFFER_BYTES)
    first, second = pair
    first.connect(second.getsockname())
    second.connect(first.getsockname())
    return first, second


def send_news(ends: Ends, head: Mapping[str, Any], body: bytes = b"") -> bool:
    """Send what is new, now or never: a JSON object, and bytes after it. Whether it was taken."""
    message = json.dumps(head, allow_nan=False).encode() + b"\n" + body
    if len(message) > LARGEST_BYTES:
        return False
    try:
        ends.news.send(message)
    except OSError:  # full, or nobody there
        return False
    return True


def read_news(message: bytes) -> tuple[dict[str, Any], bytes]:
    """A datagram's object and the bytes after it. Raises ValueError when it is none."""
    head, _, body = message.partition(b"\n")
    data: Any = json_of(head)
    if not isinstance(data, dict):
        raise ValueError("no object")
    return cast("dict[str, Any]", data), body


async def take_commands(ends: Ends, take: Callable[[Command], None]) -> None:
    """Hand on the page's commands as they come; returns when the page server is gone."""
    # its own handle: the next session's loop needs the socket too
    reader, writer = await asyncio.open_connection(sock=ends.commands.dup(), limit=_LONGEST_COMMAND)
    try:
        while line := await reader.readline():  # the server's whole life; no time-out has a meaning
            with contextlib.suppress(ValueError):
                command: Any = json_of(line)
                if isinstance(command, dict):
                    take(cast("Command", command))
    except (OSError, ValueError):  # it broke, or sends what is no line
        return
    finally:
        writer.close()


def send_command(ends: Ends, command: Command) -> bool:
    """Send a command to the session, by the page server. Whether the session is still there to take it."""
    try:
        ends.commands.sendall(json.dumps(command).encode() + b"\n")
    except OSError:
        return False
    return True
