"""The page server: NiceGUI on a socket that is bound already, in whatever process it is called."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import sys
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import uvicorn
from fastapi import FastAPI
from nicegui import app as nicegui_app
from nicegui import ui

from lab.live.channel import Ends
from lab.live.page.guard import Guard
from lab.live.page.source import Source
from lab.live.page.view import build

_REFRESH_EVERY_S = 0.2
_LAST_LOOK_S = 2.0
_NICENESS = 5


def serve_beside(ends: Ends, bound: socket.socket, host: str, token: str) -> None:
    """The life of a page server's process beside a running session: until the session is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the session's; it ends this process after its own end
    if sys.platform != "win32":
        os.nice(_NICENESS)  # the session first
    # What NiceGUI takes for its own tests; a session in somebody's test is none of them.
    for name in ("PYTEST_CURRENT_TEST", "NICEGUI_SCREEN_TEST_PORT"):
        os.environ.pop(name, None)
    ends.commands.setblocking(True)
    ends.news.setblocking(True)
    serve(Source(ends), bound, host=host, token=token)


def serve_stored(folder: Path, bound: socket.socket, host: str, token: str) -> None:
    """Serve a stored session until Ctrl-C."""
    serve(Source(folder=folder), bound, host=host, token=token)


def serve(source: Source, bound: socket.socket, *, host: str, token: str) -> None:
    """Serve the pages of a source, on a socket that listens already."""
    build(source)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncGenerator[None]:
        following = asyncio.create_task(_follow(source, server))
        yield
        following.cancel()
        await asyncio.gather(following, return_exceptions=True)

    outer = FastAPI(lifespan=lifespan, docs_url=None, redoc_url=None, openapi_url=None)
    run_with: Any = ui.run_with  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
    run_with(outer, title="chordlab", show_welcome_message=False, language="en-US", tailwind=False)
    nicegui_app.config.socket_io_js_transports = ["websocket", "polling"]
    guarded = Guard(outer, host=host, port=int(bound.getsockname()[1]), token=token)
    config = uvicorn.Config(
        guarded, log_level="error", access_log=False, timeout_graceful_shutdown=1, ws="websockets-sansio"
    )
    server = uvicorn.Server(config)
    with contextlib.suppress(KeyboardInterrupt):
        server.run(sockets=[bound])


async def _follow(source: Source, server: uvicorn.Server) -> None:
    """Keep the source fresh; when the session is gone, let the pages take a last look and end."""
    while not source.session_gone.is_set():
        await asyncio.to_thread(source.refresh)
        await asyncio.sleep(_REFRESH_EVERY_S)
    await asyncio.to_thread(source.refresh)
    await asyncio.sleep(_LAST_LOOK_S)
    server.should_exit = True
