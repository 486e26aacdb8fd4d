"""What is done in a process of its own and left in a folder: a log judged, some calibrated, followed or explained."""

from __future__ import annotations

import io
import json
import re
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from logparsers import LogError
from servofd.aircraft.axes import motion_to_toml
from servofd.aircraft.schema import Aircraft
from servofd.batch.key import Job
from servofd.calibrating.result import calibration_to_toml
from servofd.core.errors import NoMeasurement, ServofdError
from servofd.core.files import make_folder, write_whole
from servofd.detection.verdict import LogAudit
from servofd.jobs.explaining import explain_logs
from servofd.jobs.workflow import FailedLog, calibrate, calibrate_axes, judged
from servofd.outputs.audit_report import audit_report
from servofd.outputs.calibrate_report import calibrate_report, motion_report
from servofd.outputs.compare_report import Track, track_of
from servofd.outputs.document import Document
from servofd.outputs.explain_report import explain_report
from servofd.outputs.json_report import to_json, worst_outline
from servofd.outputs.page import html_page
from servofd.outputs.sentence import LEAST_CLEARED, spoken, whole_sentence, worst
from servofd.outputs.trend_report import trend_report
from servofd.serve.preview import preview, what_it_is

AUDIT, PAGE, RECORDING = "audit.json", "page.html", "recording.rrd"
SUMMARY, TASK = "summary.json", "task.json"
"""What the folder of a flight or a task holds; these two are written last."""
PROGRESS, _CURVES = "progress.txt", "curves.npz"
_POINTS = 2400
"""Of the curves of a surface that two flights are compared by: twice what a page draws."""
_NAMED = 6
"""Columns of a table that its row in the list names."""
_MOST_RECORDED = 3_000_000
"""Positions of a recording that a browser shows: 90 bytes each, and its memory ends at 2 GB (Rerun keeps copies)."""


@dataclass(frozen=True, slots=True)
class Summary:
    """A judged log in the list of flights."""

    status: str
    sentence: str
    duration_s: float | None = None
    start_utc: str | None = None
    surface: str = ""
    outline: tuple[float | None, ...] = ()
    key: str = ""
    """Of the `servofd.batch.key.Job` that judged it."""
    too_long: bool = False
    """For a recording that a browser can show."""
    surfaces: tuple[str, ...] = ()
    """Those that were judged or looked for."""
    table: bool = False
    """Whether it is a table, whose columns may be chosen."""


Verb = Literal["calibrate", "trend", "explain"]


@dataclass(frozen=True, slots=True)
class Task:
    """What is done with several flights, or one surface, at a click; `id` names its folder."""

    id: str
    verb: Verb
    title: str
    state: str = "waiting"
    status: str = ""
    sentence: str = ""
    wrote: str = ""
    """Aircraft file of the folder that a calibration wrote."""
    flights: tuple[str, ...] = ()
    """Digests of the logs."""


Kept = TypeVar("Kept")


def kept(kind: Callable[..., Kept], path: Path) -> Kept | None:
    """A summary or a task as it was left in a file; None if there is none that can be read."""
    with suppress(OSError, ValueError, TypeError, AttributeError):
        known = json.loads(path.read_text(encoding="utf-8"))
        return kind(**{name: tuple(one) if isinstance(one, list) else one for name, one in known.items()})
    return None


def judge(log: str, folder: str, job: Job) -> Summary:
    """Judge a log, and write what was found; what is wrong with the log is part of the result."""
    target = Path(folder)
    make_folder(target)
    (target / PAGE).unlink(missing_ok=True)  # of an earlier choice, if this one cannot be judged
    # Flights are judged side by side already.
    results = list(judged(log, job, threads=1, progress=so_far(target, "Judged")))
    report = audit_report(results)
    document = json.loads(to_json(report.data).replace(json.dumps(log)[1:-1], json.dumps(Path(log).name)[1:-1]))
    audits = [result for result in results if not isinstance(result, FailedLog)]
    segments = [surface.segment for audit in audits[:1] for surface in audit.surfaces]
    too_long = sum(segment.measured_s.size for segment in segments if segment is not None) > _MOST_RECORDED
    summary = replace(_summary(results, document["logs"], report.sentence, job), too_long=too_long)
    if not audits:
        summary = _unread(Path(log), results, summary)
        if summary.table or summary.status == "not_a_log":
            report = replace(report, sentence=summary.sentence, facts=Path(log).name)
    elif document["logs"][0]["format"] == "table":
        summary = replace(summary, table=True)
    write_whole(target / AUDIT, (json.dumps(document, indent=2) + "\n").encode())
    write_whole(target / PAGE, html_page(report).encode())
    if audits:
        write_whole(target / _CURVES, _curves(audits[0]))
    if audits and not too_long and find_spec("rerun") is not None:
        from servofd.outputs.recording.write import save_recording

        save_recording(audits[0], target / RECORDING)
    write_whole(target / SUMMARY, json.dumps(asdict(summary)).encode())
    (target / PROGRESS).unlink(missing_ok=True)
    return summary


def _curves(audit: LogAudit) -> bytes:
    """What each surface did, as arrays of a file that is read without running anything."""
    tracks = {one.surface: track for one in audit.surfaces if (track := track_of(one, _POINTS)) is not None}
    content = io.BytesIO()
    np.savez_compressed(content, *map(np.array, tracks.values()), names=np.array(list(tracks), dtype=str))
    return content.getvalue()


def curves_in(folder: Path) -> dict[str, Track]:
    """What each surface of a flight did; empty if not known."""
    try:
        with np.load(folder / _CURVES, allow_pickle=False) as known:
            return {str(name): Track(*known[f"arr_{k}"]) for k, name in enumerate(known["names"])}
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile):
        return {}


def text_in(path: Path) -> str:
    """What stands in a file of results: how far the work is, or its page; empty where there is none."""
    try:
        return path.read_text(encoding="utf-8")
    except OSError:
        return ""


def so_far(folder: Path, words: str) -> Callable[[str], None]:
    """Something to call with the name of what is done, which leaves word of it in a folder."""
    done: list[str] = []
    write_whole(folder / PROGRESS, b"Being read.")

    def tell(one: str) -> None:
        done.append(spoken(one))
        write_whole(folder / PROGRESS, f"{words} so far: {', '.join(dict.fromkeys(done))}.".encode())

    return tell


def _unread(log: Path, results: list[LogAudit | FailedLog], summary: Summary) -> Summary:
    """What was not judged: a table whose columns are to be chosen, no log at all, or a log that was not read."""
    known = preview(log)
    if known is not None and known.is_table:
        said = f"A table of numbers ({', '.join(known.names[:_NAMED])}): choose its columns."
        return replace(summary, sentence=said, table=True)
    failure, what = results[0], what_it_is(log)
    if isinstance(failure, FailedLog) and failure.log is None and (what or not failure.is_log):
        why = what or failure.error.partition(": ")[2].rstrip(".")
        why = f"it {why}" if why.startswith("is ") else why
        return replace(summary, status="not_a_log", sentence=f"Not a log: {why}{'' if why.endswith('?') else '.'}")
    return summary


def _summary(results: list[LogAudit | FailedLog], documents: list[dict[str, Any]], sentence: str, job: Job) -> Summary:
    """Of several runs the status of the worst and the sentence of the page; of one log, judged or not, its own."""
    judged = [
        (LEAST_CLEARED.index(worst((*result.surfaces, *result.axes))), result, document)
        for result, document in zip(results, documents, strict=True)
        if not isinstance(result, FailedLog)
    ]
    if not judged:
        first, (known, *_) = results[0], documents
        error = str(known["error"])
        said = f"Could not be read: {error.partition(': ')[2] or error}"
        if isinstance(first, FailedLog) and (first.log is not None or first.flight is not None):
            said = sentence
        return Summary("unknown", said, known.get("duration_s"), known.get("start_utc"), key=job.key)
    _, shown, document = min(judged, key=lambda one: one[0])
    name, outline = worst_outline(document)
    return Summary(
        worst((*shown.surfaces, *shown.axes)),
        whole_sentence(shown) if len(results) == 1 else sentence,
        sum(one["duration_s"] or 0.0 for one in documents),
        document["start_utc"],
        name,
        tuple(outline),
        job.key,
        surfaces=tuple(surface.surface for surface in shown.surfaces),
    )


_OPTION = re.compile(r" \(--?[a-z][a-z-]*\)")
"""Of the command line, in a sentence."""


def do(task: Task, folder: str, logs: list[str], aircraft: Aircraft | None, surface: str, output: str) -> Task:
    """Do it; page and result go into the folder, an aircraft file to `output`; what is wrong is part of the result."""
    target = Path(folder)
    make_folder(target)
    wrote = ""
    try:
        if task.verb == "calibrate":
            report, wrote = _calibrated(logs, aircraft, Path(output), so_far(target, "Calibrated"))
        elif task.verb == "trend":
            from servofd.wear.trend import trend_document, trend_logs

            if aircraft is None:
                choose = "choose its file, or calibrate one from good flights first"
                raise NoMeasurement(f"a trend follows one aircraft: {choose}")
            pages = {Path(log).name: f"/flights/{flight}" for log, flight in zip(logs, task.flights, strict=True)}
            report = trend_report(trend_document(trend_logs(logs, aircraft, workers=0)), pages)
        else:
            wanted, tried = (surface,) if surface else (), so_far(target, "Tried")
            found = explain_logs(logs, aircraft, surfaces=wanted, alone=bool(surface), progress=tried)
            if not found.explanations:
                raise NoMeasurement("; ".join(found.failures))
            report = explain_report(found.explanations, ", ".join(Path(log).name for log in logs), found.failures)
    except (LogError, ServofdError) as error:
        text = _OPTION.sub("", str(error))
        for log in logs:
            text = text.replace(log, Path(log).name)
        report = Document(task.title, "unknown", f"Could not {task.verb}.", text)
    write_whole(target / PAGE, html_page(report).encode())
    said = f"{report.sentence} {report.facts if report.status == 'unknown' else ''}".strip()
    done = replace(task, state="done", status=report.status, sentence=said, wrote=wrote)
    write_whole(target / TASK, json.dumps(asdict(done)).encode())
    return done


def _calibrated(
    logs: list[str], aircraft: Aircraft | None, output: Path, progress: Callable[[str], None]
) -> tuple[Document, str]:
    """An aircraft from good flights; of flights without feedback from its motion."""
    try:
        found = calibrate(logs, aircraft, progress=progress)
    except NoMeasurement:
        model = calibrate_axes(logs)
        text, report = f'name = "{output.stem}"\n\n{motion_to_toml(model)}', motion_report(model)
    else:
        text, report = calibration_to_toml(found), calibrate_report(found)
    write_whole(output, text.encode())
    return report, output.name
