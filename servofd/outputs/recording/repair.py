"""Saving what is whole of a recording that a killed process left behind."""

from __future__ import annotations

from pathlib import Path

from servofd.errors import RecordingError
from servofd.outputs.files import whole_file
from servofd.outputs.recording.program import run_rerun
from servofd.outputs.recording.read import check_is_recording

__all__ = ["repair_recording"]


def repair_recording(path: str | Path, target: str | Path) -> None:
    """Copy all whole chunks of a recording into a new one, with the index that a finished one has."""
    source = Path(path)
    check_is_recording(source)
    with whole_file(target) as temporary:
        # Only the viewer's own program may go on after an error; its Python interface stops at it.
        done = run_rerun("rrd", "optimize", "--continue-on-error", str(source.resolve()), "-o", str(temporary))
        if done.returncode != 0:
            raise RecordingError(f"{path}: nothing of it can be saved: {_last_line(done.stderr)}")


def _last_line(text: str) -> str:
    lines = [line for line in text.splitlines() if line.strip()]
    return lines[-1].strip()[:160] if lines else "the rerun program failed"
