"""The Rerun viewer without a window: open a recording, look at each tab, hear what it complains about."""

from __future__ import annotations

import io
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

__all__ = ["VIEWER", "Viewer", "pixels", "share_of", "viewer", "why_not"]

VIEWER = shutil.which("rerun", path=str(Path(sys.executable).parent))
QUIET = {"CI": "1", "RUST_LOG": "error"}
"""No analytics; no notices over the picture."""


class Viewer:
    """One headless viewer."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self._blueprint: dict[str, Any] = {}
        self._root = ""

    def open(self, path: Path) -> list[str]:
        """Open a recording, and give its tabs once it is loaded."""
        before = self._tabs()
        self._client.open(str(path))
        for _ in range(200):
            if self._tabs() not in ("", before):
                break
            time.sleep(0.05)  # a poll of another program, bounded to ten seconds
        self._root = self._tabs()
        return list(self._blueprint[self._root]["ContainerBlueprint"]["contents"])

    def picture(self, tab: str, size: int = 1400) -> bytes:
        """PNG of one tab, once two in a row are the same."""
        self._blueprint[self._root]["ContainerBlueprint"]["active_tab"] = tab
        self._client.set_blueprint(self._blueprint, "recording")
        last = b""
        for _ in range(60):
            shot: bytes = self._client.take_screenshot(max_size=size)
            if shot == last:
                break
            last = shot
            time.sleep(0.1)
        return last

    def set_time(self, time_s: float) -> None:
        """Move the time cursor."""
        self._client.set_time("time_boot", duration=time_s, play_state="paused")

    def complaints(self) -> list[str]:
        """Reports of the views, and what the viewer logged above INFO."""
        reports = [str(report) for view in self._client.get_state().views for report in view.reports]
        logs = [str(e) for e in self._client.get_logs() if str(e.level).upper() in ("WARN", "ERROR")]
        return reports + [entry for entry in logs if "oftware rasterizer" not in entry]

    def _tabs(self) -> str:
        """Name of the container of the tabs; empty as long as nothing is loaded."""
        try:
            self._blueprint = self._client.get_blueprint("recording").blueprint
        except (ConnectionError, RuntimeError):
            return ""
        kinds = {k: v.get("ContainerBlueprint", {}).get("container_kind") for k, v in self._blueprint.items()}
        return next((key for key, kind in kinds.items() if kind == "Tabs"), "")


def why_not(recording: Path, folder: Path) -> str:
    """Why no picture can be made here, or nothing."""
    if VIEWER is None:
        return "the rerun command is not installed"
    command = [VIEWER, "--headless", "--bind", "127.0.0.1", "--port", str(_free_port()), "--hide-welcome-screen"]
    command += ["--window-size", "400x300", "--screenshot-to", str(folder / "probe.png"), str(recording)]
    environment = {**os.environ, **QUIET}
    shot = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120, env=environment)
    return "" if shot.returncode == 0 else "no software renderer (Debian: mesa-vulkan-drivers)"


@contextmanager
def viewer() -> Iterator[Viewer]:
    """Start a headless viewer; it ends with the block."""
    from rerun.experimental import ViewerClient

    with pytest.MonkeyPatch.context() as patch:
        for name, value in QUIET.items():
            patch.setenv(name, value)
        port = _free_port()
        client = ViewerClient.spawn(headless=True, port=port, executable_path=VIEWER, hide_welcome_screen=True)
    try:
        yield Viewer(client)
    finally:
        client.quit()


def pixels(png: bytes) -> NDArray[np.float64]:
    """Colours of a picture, of shape (height, width, 3), from 0 to 1."""
    from matplotlib.image import imread

    return np.asarray(imread(io.BytesIO(png)), dtype=float)[:, :, :3]


def share_of(picture: NDArray[np.float64], colour: str, tolerance: float = 0.2) -> float:
    """Share of pixels close to a colour: thin lines on black, scaled down, never quite reach it."""
    from matplotlib.colors import to_rgb

    return float(np.mean(np.max(np.abs(picture - np.array(to_rgb(colour))), axis=2) < tolerance))


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
