"""`chordlab watch`: a stored session on the live page, with a slider for the time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lab.cli.completing import sessions
from lab.cli.output import JsonFlag, emit, say
from lab.cli.paging import HostOption, PortOption, TokenOption
from lab.live.server import LOOPBACK, listen


def watch(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A session folder.", autocompletion=sessions)],
    host: HostOption = LOOPBACK,
    port: PortOption = 0,
    token: TokenOption = None,
    as_json: JsonFlag = False,
) -> None:
    """Replay a stored session on a page with a time slider. The page's address is printed first; Ctrl-C ends it.

    Example: chordlab watch data/sessions/eiffel --port 8080
    """
    from lab.store.reader import SessionReader

    SessionReader(folder)  # what is no session is said before anything is served
    address = listen(host, port, token)
    if as_json:
        emit({"url": address.url, "folder": folder})
    else:
        say(address.url)
    from lab.live.page.serve import serve_stored

    serve_stored(folder, address.bound, address.host, address.token)
