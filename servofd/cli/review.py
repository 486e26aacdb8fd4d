"""``servofd review``: recordings read back without their logs; ``--view``: shown in the viewer."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from servofd.batch.key import Job
from servofd.cli.options import Options
from servofd.cli.terminal import (
    check_targets,
    complain,
    give_json,
    print_document,
    print_lines,
    progress,
    say,
    show,
    worst,
)
from servofd.core.errors import ConfigError, RecordingError
from servofd.feedback.flown import known_aircraft
from servofd.jobs.workflow import FailedLog, audit
from servofd.outputs.audit_report import audit_report
from servofd.outputs.compare_report import compare_report
from servofd.outputs.document import Bullets
from servofd.outputs.json_report import audit_document
from servofd.outputs.recording.content import LIVE, Recording
from servofd.outputs.recording.read import contradictions, is_recording, read_recording, rejudged
from servofd.outputs.recording.stream import shown
from servofd.outputs.recording.surface import events
from servofd.outputs.recording.viewer import check_display, open_viewer
from servofd.outputs.recording.write import save_recording
from servofd.outputs.sentence import STATUSES, whole_sentence
from servofd.outputs.sentence import worst as worst_of


def run(options: Options) -> int:
    """Read, write what was asked for, print."""
    paths = _paths(options.recordings)
    if options.compare and len(paths) > 1:
        raise ConfigError("--compare takes one recording at a time")
    check_targets((options.json,), {"a recording": [str(path) for path in paths]})
    if options.compare:  # two recordings beside each other; a fault in either of them is one
        both = [paths[0], Path(options.compare)]
        audits = [_read(path).audit for path in both]
        report = compare_report([path.name for path in both], [audit_document([audit]) for audit in audits])
        show(report, json=options.json)
        return int(any(audit.has_fault for audit in audits))
    found, failed = [], []
    for path in paths:
        try:
            found.append((path, _read(path)))
        except RecordingError as error:
            failed.append((path, str(error)))
    for path, recording in found:
        for sentence in contradictions(recording):
            complain(sentence, path)
        if recording.audit.not_judged:
            complain(recording.audit.not_judged, path)
    for _, reason in failed:
        complain(reason)
    if not give_json(options.json, _document(found, failed)) and found:
        _print(found)
    audited = [recording.audit for _, recording in found]
    codes = (1 if one.has_fault else 2 if one.not_judged else 0 for one in audited)
    return worst([*codes, *(2 for _ in failed)])


def _paths(given: list[str]) -> list[Path]:
    """All recordings, those of folders in alphabetical order."""
    paths = []
    for name in given:
        folder = Path(name)
        inside = sorted(folder.rglob("*.rrd")) if folder.is_dir() else [folder]
        if not inside:
            hint = "'servofd audit LOG... -o DIR' writes them"
            raise RecordingError(f"{name}: no recording (.rrd) in this folder; {hint}")
        paths += inside
    return paths


def _read(path: Path) -> Recording:
    """Read one recording; what a monitor recorded is judged as an audit of the log would."""
    recording = read_recording(path)
    return rejudged(recording) if LIVE in recording.notes else recording


def _events(recording: Recording) -> list[tuple[float, str, str]]:
    """When [s], level and words of what happened to all surfaces."""
    traces, surfaces = recording.traces, recording.audit.surfaces
    return sorted(line for s in surfaces for line in events(traces.get(s.surface), s, recording.start_s))


def _document(found: list[tuple[Path, Recording]], failed: list[tuple[Path, str]]) -> dict[str, Any]:
    """Schema servofd.audit/1, as the audit wrote it, and which recording it was read from."""
    document = audit_document([*(r.audit for _, r in found), *(FailedLog(str(p), e) for p, e in failed)])
    for entry, (path, recording) in zip(document["logs"], found, strict=False):
        entry["recording"] = str(path)
        entry["notes"] = list(recording.notes)
        entry["events"] = [{"time_s": t, "level": level, "text": text} for t, level, text in _events(recording)]
    return document


def _print(found: list[tuple[Path, Recording]]) -> None:
    """Print a recording as the audit prints its log, with what happened when; of several, a line for each."""
    report = audit_report([recording.audit for _, recording in found])
    if len(found) > 1:
        audits = [(path.name, recording.audit) for path, recording in found]
        rows = [(worst_of(audit.surfaces), name, (whole_sentence(audit),)) for name, audit in audits]
        say(report.sentence)
        print_lines(sorted(rows, key=lambda row: (STATUSES.index(row[0]), row[1])))
        return
    ((path, recording),) = found
    lines = [f"{time_s:10.2f} s  {level:5}  {text}" for time_s, level, text in _events(recording)]
    lines += [f"note: {note}" for note in recording.notes]
    print_document(replace(report, facts=f"{path}: {report.facts}", parts=[*report.parts, Bullets(lines)]))


def run_view(options: Options) -> int:
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
            with progress(path.name, 1) as step:  # the first run of a log
                found = next(audit(options.file, Job(known_aircraft(options.config), options.servo), progress=step))
            save_recording(found, recording)
            print_document(audit_report([found]))
        open_viewer(recording)
    return 0
