"""The Rerun viewer without a window: open a recording, look at each tab, report what it complains about."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

__all__ = ["VIEWER", "Viewer", "cannot_render", "viewer"]

VIEWER = shutil.which("rerun", path=str(Path(sys.executable).parent))
_ENVIRONMENT = {"CI": "1", "RUST_LOG": "error"}
"""No analytics; no notices over the picture."""


class Viewer:
    """One headless viewer."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self._blueprint: dict[str, Any] = {}
        self._root = ""

    def open(self, path: Path) -> list[str]:
        """Names of the tabs of a recording, once it is loaded."""
        before = self._tabs_id()
        self._client.open(str(path))
        for _ in range(200):
            if self._tabs_id() not in ("", before):
                break
            time.sleep(0.05)  # a poll of another program, bounded to ten seconds
        self._root = self._tabs_id()
        return self._contents()

    def tabs(self) -> list[str]:
        """Blueprint paths of the tabs, in order."""
        return self._contents()

    def picture(self, tab: str, size: int = 1400) -> bytes:
        """PNG of one tab, once two in a row are the same."""
        self._blueprint[self._root]["ContainerBlueprint"]["active_tab"] = tab
        self._client.set_blueprint(self._blueprint, "recording")
        last = b""
        for _ in range(60):
            shot: bytes = self._client.take_screenshot(max_size=size)
            if shot == last:
                return shot
            last = shot
            time.sleep(0.15)
        return last

    def set_time(self, time_s: float) -> None:
        """Move the time cursor."""
        self._client.set_time("time_boot", duration=time_s, play_state="paused")

    def complaints(self) -> list[str]:
        """Reports of the views, and what the viewer logged above INFO."""
        state = self._client.get_state()
        reports = [str(report) for view in state.views for report in view.reports]
        logs = [entry for entry in self._client.get_logs() if str(entry.level).upper() in ("WARN", "ERROR")]
        noted = [str(entry) for entry in logs if "oftware rasterizer" not in str(entry)]
        return reports + noted

    def _tabs_id(self) -> str:
        try:
            self._blueprint = self._client.get_blueprint("recording").blueprint
        except Exception:
            return ""
        kinds = {k: v.get("ContainerBlueprint", {}).get("container_kind") for k, v in self._blueprint.items()}
        return next((key for key, kind in kinds.items() if kind == "Tabs"), "")

    def _contents(self) -> list[str]:
        return list(self._blueprint[self._root]["ContainerBlueprint"]["contents"])


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def cannot_render(recording: Path, folder: Path) -> str:
    """Why pictures cannot be made here, or nothing."""
    if VIEWER is None:
        return "the rerun command is not installed"
    command = [VIEWER, "--headless", "--bind", "127.0.0.1", "--port", str(free_port()), "--hide-welcome-screen"]
    command += ["--window-size", "400x300", "--screenshot-to", str(folder / "probe.png"), str(recording)]
    import os

    shot = subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=120, env={**os.environ, **_ENVIRONMENT}
    )
    return "" if shot.returncode == 0 else "no software renderer (Debian: mesa-vulkan-drivers)"


@contextmanager
def viewer() -> Iterator[Viewer]:
    """A headless viewer that ends with the block; set CI and RUST_LOG first."""
    from rerun.experimental import ViewerClient

    client = ViewerClient.spawn(headless=True, port=free_port(), executable_path=VIEWER, hide_welcome_screen=True)
    try:
        yield Viewer(client)
    finally:
        client.quit()
