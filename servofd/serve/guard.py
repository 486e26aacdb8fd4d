"""Who may talk to the page, what browsers may do with it, and the server, open before its address is shown."""

from __future__ import annotations

import hmac
import os
import re
import socket
import sys
import webbrowser
from contextlib import suppress
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import TYPE_CHECKING
from urllib.parse import parse_qsl, urlencode, urlsplit

import uvicorn
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

_COOKIE = "servofd_token"
_OWN = re.compile(r"(?:127\.0\.0\.1|localhost|\[::1\])(?::[0-9]{1,5})?", re.IGNORECASE)
"""Names of this machine in a request, with a port or without."""
_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; worker-src 'self' blob:; frame-ancestors 'self'; base-uri 'none'; form-action 'self'"
)
_HEADERS = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",  # with no-referrer a form of the page itself would come from "null"
    "Cross-Origin-Opener-Policy": "same-origin",
}


class Guard:
    """Lets this machine in, or whoever has the token; other sites can neither read nor write.

    Parameters
    ----------
    app : ASGI application
        What is guarded.
    token : str
        What colleagues must bring, in the link that they were given and then in a cookie; empty: the page is this
        machine's own, and only its own names lead to it.
    """

    def __init__(self, app: ASGIApp, token: str = "") -> None:
        self._app, self._token = app, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or refuse."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        answer = self._refused(scope, headers)
        await (answer or self._app)(scope, receive, _with_headers(send))

    def _refused(self, scope: Scope, headers: Headers) -> PlainTextResponse | RedirectResponse | None:
        host = headers.get("host", "")
        if not self._token and not _OWN.fullmatch(host):
            # A name of another host that was led to this machine.
            return PlainTextResponse("open this page as http://127.0.0.1", HTTPStatus.MISDIRECTED_REQUEST)
        asker = headers.get("origin")
        if asker is not None and urlsplit(asker).netloc != host:
            return PlainTextResponse("another site may not ask this", HTTPStatus.FORBIDDEN)
        if not self._token:
            return None
        words = parse_qsl(scope.get("query_string", b"").decode("latin-1"))
        given = dict(words).get("token")
        if given is not None and self._fits(given):
            rest = urlencode([(name, value) for name, value in words if name != "token"])
            answer = RedirectResponse(scope["path"] + (f"?{rest}" if rest else ""), HTTPStatus.SEE_OTHER)
            answer.set_cookie(_COOKIE, self._token, httponly=True, samesite="strict")
            return answer
        if self._fits(_cookie(headers.get("cookie", ""))):
            return None
        needed = "this page needs the whole link that servofd printed, with its token"
        return PlainTextResponse(needed, HTTPStatus.UNAUTHORIZED)

    def _fits(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(), self._token.encode())


def _cookie(text: str) -> str:
    try:
        found = SimpleCookie(text).get(_COOKIE)
    except CookieError:
        return ""
    return found.value if found is not None else ""


def _with_headers(send: Send) -> Send:
    async def sent(message: Message) -> None:
        if message["type"] == "http.response.start":
            MutableHeaders(scope=message).update(_HEADERS)
        await send(message)

    return sent


def listening(host: str, port: int) -> socket.socket:
    """A socket that listens."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    return socket.create_server((host, port), family=family)


def serve(app: ASGIApp, listening_socket: socket.socket, link: str = "") -> None:
    """Answer until Ctrl-C or termination."""
    config = uvicorn.Config(
        app, log_level="error", access_log=False, server_header=False, timeout_graceful_shutdown=1, lifespan="off"
    )
    display = not sys.platform.startswith("linux") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if link and display and sys.stdout.isatty():
        webbrowser.open(link)
    with suppress(KeyboardInterrupt):
        uvicorn.Server(config).run([listening_socket])
