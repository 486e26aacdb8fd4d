"""Rerun's own program: its viewer, and what only it can do with files."""

from __future__ import annotations

import os
import subprocess
import sys

__all__ = ["run_rerun"]

_WITH_ITS_EXIT_CODE = "import sys; from rerun_cli.__main__ import main; sys.exit(main())"
"""``python -m rerun_cli`` always ends with 0."""


def run_rerun(*words: str) -> subprocess.CompletedProcess[str]:
    """Run it to its end, and keep what it says.

    It reports each of its calls to its makers, except on machines that test software: it is told that this is one.
    """
    command = [sys.executable, "-c", _WITH_ITS_EXIT_CODE, *words]
    quiet = {**os.environ, "CI": "1", "RUST_BACKTRACE": "0"}
    return subprocess.run(command, capture_output=True, text=True, errors="replace", check=False, env=quiet)  # noqa: S603 - fixed program, paths as arguments
