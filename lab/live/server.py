"""The page server as its session sees it: a process beside it that may hang or die without harm."""

from __future__ import annotations

import importlib.util
import multiprocessing
import secrets
import socket
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lab.base.errors import RequestError
from lab.base.loopback import is_loopback
from lab.live.channel import Ends, make_channel

if TYPE_CHECKING:
    from multiprocessing.context import SpawnProcess

LOOPBACK = "127.0.0.1"
_LAST_LOOK_S = 4.0


@dataclass(frozen=True, slots=True)
class Address:
    """Where pages are served.

    Attributes:
        bound: the socket, listening.
        host: what it is bound to.
        token: what a page must show; empty on the loopback interface.
        url: what to open in a browser, token and all.
    """

    bound: socket.socket
    host: str
    token: str
    url: str


def check_nicegui() -> None:
    """Raise RequestError where the library that draws the pages is not installed."""
    if importlib.util.find_spec("nicegui") is None:
        raise RequestError("the live page needs NiceGUI; install it: pip install 'chordlab[live]'")


def listen(host: str = LOOPBACK, port: int = 0, token: str | None = None) -> Address:
    """Bind a socket for pages. Port 0: a free one. Beyond the loopback interface a token is made if none is given.

    Raises:
        RequestError: NiceGUI is missing, or the address is taken or not this machine's.
    """
    check_nicegui()
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    bound = socket.socket(family, socket.SOCK_STREAM)
    try:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind((host, port))
        bound.listen(64)
    except (OSError, OverflowError) as error:
        bound.close()
        reason = getattr(error, "strerror", None) or str(error)
        raise RequestError(f"cannot serve a page on {host} port {port} ({reason}); choose another --port") from error
    if token is None:
        token = "" if is_loopback(host) else secrets.token_urlsafe(24)
    return Address(bound, host, token, _url(host, bound.getsockname()[1], token))


def _url(host: str, port: int, token: str) -> str:
    everywhere = host in ("0.0.0.0", "::")
    name = socket.gethostname() if everywhere else f"[{host}]" if ":" in host else host
    return f"http://{name}:{port}/{f'?token={token}' if token else ''}"


@dataclass(frozen=True, slots=True)
class PageServer:
    """A running page server.

    Attributes:
        ends: the session's ends of the channel.
        url: what to open.
        process: the server's.
    """

    ends: Ends
    url: str
    process: SpawnProcess


@contextmanager
def page_server(address: Address) -> Generator[PageServer]:
    """Serve pages beside what is done meanwhile; at the end the pages are given a last look."""
    from lab.live.page.start import start  # noqa: PLC0415 - nothing of the page is loaded before it is wanted

    ours, theirs = make_channel()
    process = multiprocessing.get_context("spawn").Process(
        target=start, args=(theirs, address.bound, address.host, address.token), name="chordlab-page", daemon=True
    )
    process.start()
    theirs.close()
    address.bound.close()
    try:
        yield PageServer(ours, address.url, process)
    finally:
        ours.close()  # tells the server that the session is gone
        process.join(_LAST_LOOK_S)
        if process.is_alive():
            process.kill()
            process.join(_LAST_LOOK_S)
        process.close()
