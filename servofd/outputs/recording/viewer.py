"""Opening the Rerun viewer."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

from servofd.core.errors import RecordingError
from servofd.outputs.recording.program import run_rerun

if TYPE_CHECKING:
    from pathlib import Path

_OTHER_WAYS = "'servofd audit LOG --rrd FILE' keeps the recording for another machine"


def check_display() -> None:
    """Refuse to open a window where there is none."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise RecordingError(f"no display to open the viewer on (DISPLAY is not set): {_OTHER_WAYS}")


def open_viewer(path: Path) -> None:
    """Show a recording until its window is closed."""
    # It listens for more recordings, by itself to the whole network.
    done = run_rerun("--bind", "127.0.0.1", str(path.resolve()))
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("Error")]
    # Its own exit code is 0 even if it found no display.
    if done.returncode != 0 or errors:
        reason = (errors or lines or ["it gave no reason"])[-1]
        raise RecordingError(f"the Rerun viewer could not be opened: {reason[:160]}; {_OTHER_WAYS}")
