"""The web server: uvicorn on a socket that is open before its address is printed."""

from __future__ import annotations

import os
import socket
import sys
import webbrowser
from contextlib import suppress
from typing import TYPE_CHECKING

import uvicorn

if TYPE_CHECKING:
    from starlette.types import ASGIApp


def listening(host: str, port: int) -> socket.socket:
    """A socket that listens."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    return socket.create_server((host, port), family=family)


def serve(app: ASGIApp, listening_socket: socket.socket, link: str = "") -> None:
    """Answer until Ctrl-C or termination.

    Parameters
    ----------
    link : str
        What to open in a browser, where there is a display; nothing if empty.
    """
    config = uvicorn.Config(
        app, log_level="error", access_log=False, server_header=False, timeout_graceful_shutdown=1, lifespan="off"
    )
    display = not sys.platform.startswith("linux") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if link and display and sys.stdout.isatty():
        webbrowser.open(link)
    with suppress(KeyboardInterrupt):
        uvicorn.Server(config).run([listening_socket])
