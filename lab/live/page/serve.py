"""The page server: NiceGUI on a socket that is bound already, in whatever process it is called."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import sys
import time
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, cast

import uvicorn
from fastapi import FastAPI
from nicegui import app as nicegui_app
from nicegui import ui

from lab.live.channel import Ends
from lab.live.page.guard import Guard
from lab.live.page.source import Source
from lab.live.page.view import build, is_looked_at

_REFRESH_EVERY_S = 0.2
_LOOK_EVERY_S = 1.0
_LAST_LOOKS = 12
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
    quasar = cast("dict[str, dict[str, Any]]", nicegui_app.config.quasar_config)  # pyright: ignore[reportUnknownMemberType]
    quasar["loadingBar"]["skipHijack"] = True  # a bar without a name, at every request
    guarded = Guard(outer, host=host, port=int(bound.getsockname()[1]), token=token)
    config = uvicorn.Config(
        guarded, log_level="error", access_log=False, timeout_graceful_shutdown=1, ws="websockets-sansio"
    )
    server = uvicorn.Server(config)
    with contextlib.suppress(KeyboardInterrupt):
        server.run(sockets=[bound])


async def _follow(source: Source, server: uvicorn.Server) -> None:
    """Keep the source fresh, and tell the session while somebody looks; when it is gone, let the pages part and end."""
    next_look_s = 0.0
    while not source.session_gone.is_set():
        if time.monotonic() > next_look_s and is_looked_at():
            next_look_s = time.monotonic() + _LOOK_EVERY_S
            source.command({"do": "look"})
        await asyncio.to_thread(source.refresh)
        await asyncio.sleep(_REFRESH_EVERY_S)
    await asyncio.to_thread(source.refresh)
    for _ in range(_LAST_LOOKS):
        if not is_looked_at():
            break
        await asyncio.sleep(_REFRESH_EVERY_S)
    server.should_exit = True
