"""What the page server's process begins with; it loads NiceGUI only there."""

from __future__ import annotations

import socket

from lab.live.channel import Ends


def start(ends: Ends, bound: socket.socket, host: str, token: str) -> None:
    """Serve pages until the session is gone."""
    from lab.live.page.serve import serve_beside  # noqa: PLC0415 - not in the session's process

    serve_beside(ends, bound, host, token)
