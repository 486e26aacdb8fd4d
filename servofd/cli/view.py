"""``servofd review --view``: look at a log or a recording."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from servofd.batch.key import Job
from servofd.cli.terminal import print_document, progress
from servofd.feedback.flown import known_aircraft
from servofd.jobs.workflow import audit
from servofd.outputs.audit_report import audit_report
from servofd.outputs.recording import save_recording
from servofd.outputs.recording.read import is_recording
from servofd.outputs.recording.stream import shown
from servofd.outputs.recording.viewer import check_display, open_viewer

if TYPE_CHECKING:
    from servofd.cli.options import Options


def run(options: Options) -> int:
    """Open the viewer, after an audit if need be."""
    path = Path(options.file)
    recorded, whole = is_recording(path), str(path.resolve())
    check_display()
    if recorded and shown(whole) == whole:
        open_viewer(path)
        return 0
    with tempfile.TemporaryDirectory(prefix="servofd-") as folder:
        recording = Path(folder) / f"{shown(path.stem)}.rrd"
        if recorded:
            # The viewer draws the name of the file, and crashes at a letter that its font lacks.
            recording.symlink_to(whole)
        else:
            _audit(options, recording)
        open_viewer(recording)
    return 0


def _audit(options: Options, target: Path) -> None:
    """Write the recording of the first run of a log, and print its verdicts."""
    with progress(Path(options.file).name, 1) as step:
        found = next(audit(options.file, Job(known_aircraft(options.config), options.servo), progress=step))
    save_recording(found, target)
    print_document(audit_report([found]))
