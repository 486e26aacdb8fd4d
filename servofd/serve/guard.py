"""Who may talk to the page, what browsers may do with it, and the server, open before its address is shown."""

from __future__ import annotations

import re
import socket
from contextlib import suppress
from http import HTTPStatus
from urllib.parse import urlsplit

import uvicorn
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from servofd.outputs.page import open_page

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
    """Lets this machine in, by its own names; other sites can neither read nor write."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or refuse."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def sent(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_HEADERS)
            await send(message)

        await (_refused(Headers(scope=scope)) or self._app)(scope, receive, sent)


def _refused(headers: Headers) -> PlainTextResponse | None:
    host = headers.get("host", "")
    if not _OWN.fullmatch(host):
        # A name of another host that was led to this machine.
        return PlainTextResponse("open this page as http://127.0.0.1", HTTPStatus.MISDIRECTED_REQUEST)
    asker = headers.get("origin")
    if asker is not None and urlsplit(asker).netloc != host:
        return PlainTextResponse("another site may not ask this", HTTPStatus.FORBIDDEN)
    return None


def serve(app: ASGIApp, listening_socket: socket.socket, link: str = "") -> None:
    """Answer until Ctrl-C or termination."""
    config = uvicorn.Config(
        app, log_level="error", access_log=False, server_header=False, timeout_graceful_shutdown=1, lifespan="off"
    )
    if link:
        open_page(link)
    with suppress(KeyboardInterrupt):
        uvicorn.Server(config).run([listening_socket])
