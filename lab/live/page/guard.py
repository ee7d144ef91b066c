"""Who may look: a token where the page is not on the loopback interface alone, and no pages of other names."""

from __future__ import annotations

import ipaddress
import secrets
import socket
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qsl, urlencode

from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketClose

_LOOPBACK = ("localhost", "127.0.0.1", "[::1]")
_POLICY = {
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class Guard:
    """An ASGI application that lets only those through to another who may.

    A name in the Host header that is not this machine's is refused: another site's page, made to resolve to this
    address, would send its own. So is a request that another origin's page makes.

    Args:
        app: what is guarded.
        host: what the server was bound to.
        port: its port.
        token: what must be shown, once in the address and then as a cookie; empty: nothing.
    """

    def __init__(self, app: ASGIApp, *, host: str, port: int, token: str) -> None:
        self._app = app
        self._token = token
        self._cookie = f"chordlab-{port}"
        self._names = {*_LOOPBACK, host, _bracketed(host)}
        self._open = bool(token)
        if self._open:
            self._names.add(socket.gethostname().lower())

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or hand on."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        refusal = self._judge(scope)
        if refusal is None:
            await self._app(scope, receive, _with_policy(send))
        elif scope["type"] == "websocket":
            await WebSocketClose(code=1008)(scope, receive, send)
        else:
            await refusal(scope, receive, send)

    def _judge(self, scope: Scope) -> Response | None:
        """What to answer instead; None to let through."""
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        if not self._is_ours(host):
            return PlainTextResponse("This name is not this machine's. Open the address as it was printed.", 421)
        origin = headers.get("origin")
        if origin is not None and origin.partition("://")[2] != host:
            return PlainTextResponse("Another site's page may not ask here.", 403)
        if not self._token:
            return None
        query = parse_qsl(scope.get("query_string", b"").decode("latin-1"), keep_blank_values=True)
        shown = next((value for name, value in query if name == "token"), None)
        if shown is not None and self._fits(shown):
            rest = urlencode([(name, value) for name, value in query if name != "token"])
            answer = RedirectResponse(f"{scope['path']}{'?' if rest else ''}{rest}", 303, _POLICY)
            answer.set_cookie(self._cookie, self._token, httponly=True, samesite="strict", path="/")
            return answer
        if self._fits(_cookie(headers.get("cookie", ""), self._cookie)):
            return None
        return PlainTextResponse("A token is needed: open the whole address that chordlab printed.", 401)

    def _fits(self, shown: str) -> bool:
        return secrets.compare_digest(shown.encode(), self._token.encode())

    def _is_ours(self, host: str) -> bool:
        name = host.rpartition(":")[0] if ":" in host and not host.endswith("]") else host
        if name.lower() in self._names:
            return True
        if not self._open:
            return False
        try:  # an address is no name that could be made to resolve elsewhere
            ipaddress.ip_address(name.strip("[]"))
        except ValueError:
            return False
        return True


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host.lower()


def _cookie(header: str, name: str) -> str:
    try:
        found = SimpleCookie(header).get(name)
    except CookieError:
        return ""
    return "" if found is None else found.value


def _with_policy(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            held = [(name.lower().encode(), value.encode()) for name, value in _POLICY.items()]
            message = {**message, "headers": [*message.get("headers", []), *held]}
        await send(message)

    return sending
