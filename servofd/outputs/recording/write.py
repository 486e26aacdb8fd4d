"""An audit as a Rerun recording; `docs/recordings.md` lists its entities."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np

from servofd.detection.verdict import LogAudit
from servofd.outputs.audit_report import audit_report
from servofd.outputs.document import Bullets, markdown
from servofd.outputs.palette import SERIES
from servofd.outputs.recording.content import Recording, verdicts_of
from servofd.outputs.recording.layout import ALARM_LINE, REPORT, audit_layout
from servofd.outputs.recording.stream import Recorder, application_name, recording_file
from servofd.outputs.recording.surface import send_axis, send_context, send_on_board, send_surface


def save_recording(audit: LogAudit, path: str | Path) -> None:
    """Write everything the audit read and found into one .rrd file, with its layout inside."""
    write_recording(Recording.of(audit), path)


def write_recording(recording: Recording, path: str | Path) -> None:
    """Write a recording into a file, whole or not at all.

    The viewer keeps a layout for each log: that of another flight of the same aircraft says how high other plots reach,
    and would cut a fault off that goes beyond it.
    """
    audit, log = recording.audit, recording.audit.log
    application = application_name(audit.aircraft.name, log.source.stem, log.run)
    with recording_file(path, application, audit_layout(recording), log.start_utc) as recorder:
        fill(recorder, recording)


def fill(recorder: Recorder, recording: Recording) -> None:
    """Send everything; the verdicts first, so that a recording that was cut short has them."""
    log = recording.audit.log
    recorder.properties(log.source.name, verdicts_of(recording))
    report = audit_report([recording.audit])
    recorder.document(REPORT, markdown(replace(report, parts=[Bullets(recording.notes), *report.parts])))
    for surface, tint in zip(recording.audit.surfaces, itertools.cycle(SERIES), strict=False):
        send_surface(recorder, surface, recording.traces.get(surface.surface), recording.start_s, tint)
        if surface.surface in recording.on_board:
            send_on_board(recorder, surface.surface, recording.on_board[surface.surface])
    for axis in recording.audit.axes:
        send_axis(recorder, axis)
    if any(trace.time_s.size for trace in recording.traces.values()):
        recorder.lines(ALARM_LINE, ["threshold"], ["threshold"])
        recorder.scalars(ALARM_LINE, np.array([recording.start_s, recording.end_s]), np.ones(2))
        # All surfaces of a log share it.
        send_context(recorder, next(trace.context for trace in recording.traces.values()))
