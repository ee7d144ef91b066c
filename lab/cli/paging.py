"""How the sessions of one command are shown on a page and paced."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from lab.base.errors import RequestError
from lab.live.server import LOOPBACK, listen, page_server

if TYPE_CHECKING:
    from lab.live.channel import Ends
    from lab.live.live import Live
    from lab.settings.settings import Settings


FOLLOWED_SPEED = 20.0
"""How many times real time a virtual bench goes while somebody looks, so that a person can follow it."""

LiveFlag = Annotated[bool, typer.Option("--live", help="Serve a page that shows the session and takes its commands.")]
HostOption = Annotated[
    str, typer.Option("--host", help="Address to serve the page on; others than this machine's own need the token.")
]
PortOption = Annotated[int, typer.Option("--port", min=0, max=65535, help="Port of the page; 0: a free one.")]
TokenOption = Annotated[
    str | None, typer.Option("--token", help="What opens the page; none: made where --host is not this machine alone.")
]
SpeedOption = Annotated[
    float | None,
    typer.Option(
        "--speed", help=f"Pace the virtual bench at so many times real time; none: {FOLLOWED_SPEED:g} with --live."
    ),
]


class Paging:
    """What the sessions of a command have of its page server, if there is one.

    Args:
        ends: the command's ends of the channel to it.
        speed: the pace that was asked for.
    """

    def __init__(self, ends: Ends | None = None, speed: float | None = None) -> None:
        self._ends = ends
        self._speed = speed
        self._last: Live | None = None

    @property
    def stopped(self) -> bool:
        """Whether the last session was stopped by hand, and no next one is wanted."""
        return self._last is not None and self._last.controls.stop_asked and not self._last.controls.wants_next

    def live(self, settings: Settings, say: Callable[[str], None], *, next_shape: str = "") -> Live:
        """A session's end of the page.

        Raises:
            RequestError: a pace is asked for of a real bench.
        """
        from lab.live.live import Live

        if self._speed is not None and not settings.is_virtual:
            raise RequestError("--speed is for the virtual bench: a real one goes at its own; leave it out")
        speed = self._speed
        if speed is None and self._ends is not None and settings.is_virtual:
            speed = FOLLOWED_SPEED
        can_pause = not settings.robots[0].startswith("onboard:")
        self._last = Live(self._ends, speed=speed, can_pause=can_pause, next_shape=next_shape, say=say)
        return self._last


@contextmanager
def paging(
    *, live: bool, host: str, port: int, token: str | None, speed: float | None, tell: Callable[[str], None]
) -> Generator[Paging]:
    """Serve pages meanwhile, if ``live``; their address is told once.

    Raises:
        RequestError: the pace is none, an option is for ``--live`` alone, or no page can be served.
    """
    if speed is not None and not 0 < speed <= 1e6:
        raise RequestError(f"--speed {speed:g}: give a number above 0, as 20")
    if not live:
        if host != LOOPBACK or port or token is not None:
            raise RequestError("--host, --port and --token are for --live; add it or leave them out")
        yield Paging(speed=speed)
        return
    with page_server(listen(host, port, token)) as server:
        tell(server.url)
        yield Paging(server.ends, speed)
