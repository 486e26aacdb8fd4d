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
    """Run it to its end, and keep what it says; through Python, which takes twice the time, where it is not here."""
    bundled = None if "RERUN_CLI_PATH" in os.environ else rerun_program()
    command = [str(bundled)] if bundled else [sys.executable, "-c", _WITH_ITS_EXIT_CODE]
    return subprocess.run(  # noqa: S603 - fixed program, paths as arguments
        [*command, *words], capture_output=True, text=True, errors="replace", check=False, env=quiet()
    )


def quiet() -> dict[str, str]:
    """Variables with which it does not report each of its calls to its makers: as on machines that test software."""
    return {**os.environ, "CI": "1", "RUST_BACKTRACE": "0"}


def rerun_program() -> Path | None:
    """The program itself, where its package has it."""
    package = find_spec("rerun_cli")
    bundled = Path(package.origin).with_name("rerun") if package is not None and package.origin else Path()
    return bundled if bundled.is_file() else None


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
