"""``servofd audit``: the verdict on logs; ``servofd LOG``: the same in a few lines, with the page opened."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from servofd.aircraft.schema import UNKNOWN_SERVO, check_servo
from servofd.batch.find import kind_of
from servofd.batch.key import Job
from servofd.cli.options import Options
from servofd.cli.terminal import (
    check_targets,
    complain,
    give_json,
    one_line,
    print_document,
    progress,
    say,
    worst,
    write_page,
)
from servofd.core.errors import ConfigError, needs
from servofd.core.files import distinct_file_names, make_folder
from servofd.detection.verdict import LogAudit
from servofd.feedback.flown import known_aircraft
from servofd.jobs.workflow import FailedLog, judged
from servofd.outputs.audit_report import audit_report
from servofd.outputs.document import Document
from servofd.outputs.page import FLEET_PAGE, is_page_of, open_page
from servofd.outputs.sentence import LEAST_CLEARED, answers, whole_sentence
from servofd.outputs.sentence import worst as worst_of

_A_FEW = 16
"""Logs up to which each has a table of its own."""
_PACKED = (".gz", ".zip", ".bz2", ".xz")
_SOME = 8
"""Runs that are named in a line."""


def run(options: Options) -> int:
    """Audit all logs, then write all outputs, then print."""
    _check(options)
    if _is_fleet(options):
        return _many(options)
    results = _judged_logs(options)
    report = audit_report(results)
    audits = [result for result in results if not isinstance(result, FailedLog)]
    _write(options, audits, report)
    page = Path(options.html) if options.html else None
    if page is None and (options.looks or options.output):
        page = _page_of(options, report)
    if options.json != "-" and options.looks:
        for line in _closing_lines(audits, report.sentence, page):
            say(one_line(line))
    elif options.json != "-" and audits:
        few = audits if len(audits) <= _A_FEW else []  # of cycles of a bench one table and one sentence
        for document in [audit_report([audit]) for audit in few] or [replace(report, parts=report.parts[:1])]:
            print_document(document)
    if page and options.looks and not options.no_open:
        open_page(page.resolve().as_uri())
    return _exit_code(results, audits)


def _is_fleet(options: Options) -> bool:
    """Whether there may be more logs than one looks at one by one."""
    several = any(kind_of(log) != "file" for log in options.logs)
    return several or bool(options.workers) or len(options.logs) > (1 if options.looks else _A_FEW)


def _many(options: Options) -> int:
    """Judge many logs; ``servofd LOGS`` puts their pages into a folder, with one that links to them."""
    from servofd.cli.fleet import run_fleet

    if not options.looks:
        return run_fleet(options, _job_of(options))
    first = Path(options.logs[0])
    beside = first if first.is_dir() else first.parent
    folder = Path(options.output or (beside if os.access(beside, os.W_OK) else Path()) / "servofd")
    options.output, options.pages = None, str(folder)
    code = run_fleet(options, _job_of(options))
    if not options.no_open:
        open_page((folder / FLEET_PAGE).resolve().as_uri())
    return code


def _closing_lines(audits: Sequence[LogAudit], sentence: str, page: Path | None) -> list[str]:
    """What happened, what to do, what is well, and where the page is: one line a surface."""
    where = f" → {page}" if page else ""
    if not audits:
        return [f"{sentence}{where}"]
    shown = min(audits, key=lambda audit: LEAST_CLEARED.index(worst_of((*audit.surfaces, *audit.axes))))
    run_name = f"Run {shown.log.run}: " if shown.log.run else ""
    lines = [f"{run_name}{whole_sentence(shown)}{where}"]
    if len(audits) > 1:
        clear = sum(worst_of((*audit.surfaces, *audit.axes)) == "healthy" for audit in audits)
        lines.append(f"{clear} of {len(audits)} runs are healthy; this one is the worst.")
    return lines + answers(shown)


def _job_of(options: Options) -> Job:
    aircraft = known_aircraft(options.config)
    return Job(aircraft, options.servo, options.threshold_deg, options.threshold, tuple(options.surface))


def _check(options: Options) -> None:
    """Refuse what cannot be, before the work starts."""
    if options.threshold == "interval" and options.threshold_deg is not None:
        raise ConfigError("--threshold-deg gives a constant threshold; leave it out, or leave out --threshold interval")
    if "" in options.logs:  # which pathlib takes for this folder and everything below it
        raise ConfigError("a log without a name; give a file, a folder or a pattern")
    if options.servo not in (None, UNKNOWN_SERVO):
        check_servo(options.servo)
    if options.rrd:
        needs("rerun")
    outputs = (options.rrd, options.json, options.html)
    check_targets(outputs, {"a log": options.logs, "the aircraft file": [options.config]}, folder=options.output)


def _judged_logs(options: Options) -> list[LogAudit | FailedLog]:
    """Every run of every log that was named; what cannot be read does not stop the others."""
    job = _job_of(options)
    results: list[LogAudit | FailedLog] = []
    for path in options.logs:
        with progress(Path(path).name, len(job.aircraft.surfaces) or 1 if job.aircraft else 1) as step:
            results += judged(path, job, progress=step)
    return results


def _exit_code(results: list[LogAudit | FailedLog], audits: Sequence[LogAudit]) -> int:
    """The worst of all logs; why there is no verdict goes to stderr, a line a log, or one for many runs of a file."""
    for result in results:
        if isinstance(result, FailedLog):
            complain(result.error)
    for source in dict.fromkeys(audit.log.source for audit in audits):
        runs = [audit for audit in audits if audit.log.source == source]
        dark = [audit for audit in runs if not audit.has_fault and audit.not_judged]
        if len(audits) > _A_FEW and dark:
            which = ", ".join(audit.log.run for audit in dark[:_SOME]) + (", ..." if len(dark) > _SOME else "")
            complain(f"{len(dark)} of {len(runs)} runs ({which}); the first {dark[0].not_judged}", one_line(source))
        else:
            for audit in dark:
                complain(audit.not_judged, one_line(audit.log.label))
    codes = [1 if audit.has_fault else 2 if audit.not_judged else 0 for audit in audits]
    return worst([*codes, *(2 for _ in range(len(results) - len(audits)))])


def _write(options: Options, audits: list[LogAudit], report: Document) -> None:
    """Write the files that were asked for, and JSON to stdout if that was."""
    if options.rrd and len(audits) > 1:
        raise ConfigError(f"{options.rrd}: --rrd takes one log at a time; -o DIR writes a recording for each")
    give_json(options.json, report.data)
    if options.html:
        write_page(report, options.html)
    if options.rrd and audits:
        from servofd.outputs.recording.write import save_recording

        save_recording(audits[0], options.rrd)
    if options.output:
        _write_folder(options, audits, report.data)


def _page_of(options: Options, report: Document) -> Path | None:
    """The page, written into ``-o``, else beside the log, else where the user is; None if there is nothing to show."""
    if not report.parts:
        return None
    log = Path(options.logs[0])
    folder = Path(options.output) if options.output else log.parent if os.access(log.parent, os.W_OK) else Path()
    bare = Path(log.stem).stem if log.suffix in _PACKED else log.stem
    for stem in distinct_file_names([bare, log.name, f"{log.name}.servofd"]):
        target = folder / f"{stem}.html"
        if not target.exists() or is_page_of(target, log.name):
            break
    write_page(report, target)
    return target


def _write_folder(options: Options, audits: list[LogAudit], document: Mapping[str, Any]) -> None:
    folder = Path(options.output)
    make_folder(folder)
    give_json(str(folder / "audit.json"), document)
    try:
        needs("matplotlib", "rerun")
    except ConfigError as error:
        complain(f"no figures, no recording: {error}")
        return
    from servofd.outputs.figure import save_figure
    from servofd.outputs.recording.write import save_recording

    stems = [one.log.source.stem + (f"-{one.log.run}" if one.log.run else "") for one in audits]
    for audit, stem in zip(audits, distinct_file_names(stems), strict=True):
        names = distinct_file_names([surface.surface for surface in audit.surfaces])
        for surface, name in zip(audit.surfaces, names, strict=True):
            if surface.threshold is not None:
                save_figure(surface, folder / f"{stem}-{name}.png", audit.log.source.name)
        save_recording(audit, folder / f"{stem}.rrd")
