"""Rerun's own program: opening its viewer, and what only it can do with files."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

from servofd.core.errors import RecordingError
from servofd.outputs.page import has_display

_WITH_ITS_EXIT_CODE = "import sys; from rerun_cli.__main__ import main; sys.exit(main())"
"""``python -m rerun_cli`` always ends with 0."""


def run_rerun(*words: str) -> subprocess.CompletedProcess[str]:
    """Run it to its end, and keep what it says.

    It reports each of its calls to its makers, except on machines that test software: a variable says that this is one.
    """
    command = [*_program(), *words]
    quiet = {**os.environ, "CI": "1", "RUST_BACKTRACE": "0"}
    return subprocess.run(command, capture_output=True, text=True, errors="replace", check=False, env=quiet)  # noqa: S603 - fixed program, paths as arguments


def _program() -> list[str]:
    """The program itself, where its package has it; starting it through Python takes more than twice the time."""
    package = find_spec("rerun_cli")
    if package is not None and package.origin and "RERUN_CLI_PATH" not in os.environ:
        bundled = Path(package.origin).with_name("rerun")
        if bundled.is_file():
            return [str(bundled)]
    return [sys.executable, "-c", _WITH_ITS_EXIT_CODE]


_OTHER_WAYS = "'servofd audit LOG --rrd FILE' keeps the recording for another machine"


def check_display() -> None:
    """Refuse to open a window where there is none."""
    if not has_display():
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
