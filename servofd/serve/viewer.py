"""Rerun's viewer for browsers, as its package ships it: taken out once, and served from here like any other file."""

from __future__ import annotations

import re
import socket
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

from servofd.core.files import make_folder, write_whole
from servofd.outputs.recording.viewer import quiet, rerun_program

FILES = {
    "index.html": "text/html; charset=utf-8",
    "re_viewer.js": "text/javascript",
    "re_viewer_bg.wasm": "application/wasm",
    "favicon.ico": "image/x-icon",
}
_STRANGERS = re.compile(rb"<link[^>]*(?:fonts\.googleapis|fonts\.gstatic)[^>]*>", re.DOTALL)
"""Fonts that the viewer's page would load from the network; it does without."""
_PATIENCE_S, _AGAIN_S = 20.0, 0.1
"""How long a start of the viewer may take, and how often it is tried [s]."""


def viewer_files(results: Path) -> Path | None:
    """Folder with the files of the viewer, which are taken out of its program if they are not there.

    The program would serve them itself, but to everybody and without end: it runs on this machine's own address for the
    seconds that this takes.
    """
    program = rerun_program()
    if program is None:
        return None
    folder = results / f"viewer-{version('rerun-sdk')}"
    if all((folder / name).is_file() for name in FILES):
        return folder
    make_folder(folder)
    with _served_by(program) as address:
        for name in FILES:
            content = _fetched(f"{address}/{name}")
            if content is None:
                return None
            write_whole(folder / name, _STRANGERS.sub(b"", content) if name == "index.html" else content)
    return folder


@contextmanager
def _served_by(program: Path) -> Iterator[str]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    # A recording that it need not read keeps it from opening a second port.
    words = ("--serve-web", "--bind", "127.0.0.1", "--web-viewer-port", str(port), "http://127.0.0.1:1/none.rrd")
    nothing = subprocess.DEVNULL
    command = [str(program), *words]
    with subprocess.Popen(command, env=quiet(), stdout=nothing, stderr=nothing) as running:  # noqa: S603 - fixed words
        try:
            yield f"http://127.0.0.1:{port}"
        finally:
            running.kill()


def _fetched(address: str) -> bytes | None:
    """What is at an address of this machine, as soon as anybody answers there."""
    deadline = time.monotonic() + _PATIENCE_S
    while True:
        try:
            with urllib.request.urlopen(address, timeout=_PATIENCE_S) as answer:  # noqa: S310 - this machine's own
                content: bytes = answer.read()
                return content
        except OSError:
            if time.monotonic() > deadline:
                return None
            time.sleep(_AGAIN_S)
