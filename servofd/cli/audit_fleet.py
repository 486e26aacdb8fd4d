"""``servofd audit`` of many logs: folders, patterns, addresses, or more files than one looks at one by one."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servofd.cli.exit_codes import worst
from servofd.cli.parser import whole

if TYPE_CHECKING:
    import argparse

    from servofd.batch.find import Found, LogSource
    from servofd.batch.key import Job
    from servofd.fleet.judge import JudgedLog
    from servofd.fleet.overview import Overview
    from servofd.fleet.store import FleetStore

_A_FEW = 16
_SHOWN = 3
PAGE = "fleet.html"
_WORKERS = whole("a number of processes from 1 to 1024", 1, 1024)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare how many logs are worked on."""
    parser.add_argument("--workers", type=_WORKERS, metavar="N", help="processes for many logs (default: one per core)")
    parser.add_argument("--cluster", metavar="tcp://HOST:8786", help="judge many logs on this Dask cluster")


def is_fleet(options: argparse.Namespace) -> bool:
    """Whether there may be more logs than one looks at one by one."""
    from servofd.batch.find import is_address, is_folder, is_pattern

    several = any(is_address(log) or is_pattern(log) or is_folder(log) for log in options.logs)
    return several or bool(options.cluster or options.workers) or len(options.logs) > _A_FEW


def run_fleet(options: argparse.Namespace) -> int:
    """Judge all logs, each printed as it is done; then the overview, and what was asked for."""
    from servofd.batch.find import find_logs
    from servofd.batch.key import Job
    from servofd.cli.tables import one_line
    from servofd.cli.targets import give_json
    from servofd.core.errors import ConfigError
    from servofd.feedback.flown import known_aircraft, layout_of
    from servofd.fleet.store import FleetStore

    if options.rrd:
        raise ConfigError(f"{options.rrd}: --rrd takes one log; judge the one you want to see by itself")
    aircraft = known_aircraft(options.config)
    folder = options.output or options.pages
    job = Job(
        aircraft,
        options.servo,
        options.threshold_deg,
        options.threshold,
        tuple(options.surface),
        pages=folder is not None,
    )
    found = find_logs(options.logs, layout_of(aircraft))
    _say_what_was_skipped(found)
    with FleetStore(Path(options.output), job.key) if options.output else nullcontext() as store:
        judged = _judged(found, job, store, options)
    logs = _stored(Path(options.output)) if options.output else _in_memory(judged)
    seen = _overview(logs)
    for page in filter(None, (options.html, str(Path(folder, PAGE)) if folder else None)):
        write_page(seen, page)
    printed = give_json(options.json, {"schema": "servofd.audit/1", "logs": [log["document"] for log in logs]})
    if options.pages and not printed:
        _print_closing(seen, Path(options.pages, PAGE))
    elif not printed:
        print_overview(seen)
    for problem in (*found.problems, *(one["reason"] for one in seen.not_judged)):
        print(f"servofd: {one_line(problem)}", file=sys.stderr)
    return worst([seen.exit_code, *(2 for _ in found.problems)])


def _judged(found: Found, job: Job, store: FleetStore | None, options: argparse.Namespace) -> list[JudgedLog]:
    """Judge what is not done, and print it; kept in memory only if there is no folder for it."""
    from servofd.cli.tables import progress_with_estimate
    from servofd.core.files import make_folder
    from servofd.fleet.run import audit_fleet

    kept = []
    to_do = _to_do(found.logs, store)
    if not to_do:
        return []
    folder = options.output or options.pages
    if folder:
        make_folder(Path(folder))
    with progress_with_estimate("audit", len(found.logs), len(found.logs) - len(to_do)) as step:
        for result in audit_fleet(to_do, job, cluster=options.cluster, workers=options.workers):
            judged = _with_page(result, Path(folder)) if folder else result
            if store is None:
                kept.append(judged)
            elif not store.add(judged):
                print(f"servofd: {judged.source.path}: the same bytes as another log; counted once", file=sys.stderr)
            if options.json != "-" and not options.pages:
                print(_line(judged), flush=True)
            step()
    return kept


def _with_page(judged: JudgedLog, folder: Path) -> JudgedLog:
    """Write the page of a log, and keep it no longer."""
    from servofd.batch.key import page_name
    from servofd.core.files import write_whole

    if judged.page:
        write_whole(folder / page_name(judged.source.path, judged.content), judged.page.encode())
    return replace(judged, page="")


def _print_closing(seen: Overview, page: Path) -> None:
    """What many logs come to, the worst of them, and where the page is."""
    from servofd.cli.tables import one_line
    from servofd.outputs.fleet_page import fleet_sentence, flight_name

    print(f"{fleet_sentence(seen.document())} → {page}")
    for flight in [flight for flight in seen.flights if flight["status"] in ("fault", "suspect")][:_SHOWN]:
        print(f"{one_line(flight_name(flight))}: {one_line(flight['sentence'])}")


def _to_do(logs: tuple[LogSource, ...], store: FleetStore | None) -> list[LogSource]:
    if store is None:
        return list(logs)
    if store.set_aside:
        print(
            f"servofd: {store.folder}: {store.set_aside} logs were judged with another aircraft file, other options or "
            f"another version; they are in {store.folder / 'earlier'} now, and judged again",
            file=sys.stderr,
        )
    store.forget_not_judged()
    to_do = [log for log in logs if not store.done(log)]
    if len(to_do) < len(logs):
        print(f"servofd: {len(logs) - len(to_do)} of {len(logs)} logs are done already", file=sys.stderr)
    return to_do


def _say_what_was_skipped(found: Found) -> None:
    from servofd.cli.tables import one_line

    if found.skipped:
        some = "; ".join(f"{one.path}: {one.reason}" for one in found.skipped[:_SHOWN])
        more = f"; and {len(found.skipped) - _SHOWN} more" if len(found.skipped) > _SHOWN else ""
        what = "1 file that is no log" if len(found.skipped) == 1 else f"{len(found.skipped)} files that are no logs"
        print(f"servofd: passed over {what}: {one_line(some)}{more}", file=sys.stderr)


def _line(judged: JudgedLog) -> str:
    """One line per run: worst status, name, and what is not as it should be."""
    from servofd.cli.tables import one_line
    from servofd.fleet.overview import log_status

    lines = []
    for run in judged.runs:
        document = run.document
        name = document["path"] + (f" (run {document['run']})" if document.get("run") else "")
        bad = [
            f"{name} {', '.join(fault['kind'] for fault in entry.get('faults', ())) or entry['status']}"
            for name, entry in (document["surfaces"] | document.get("axes", {})).items()
            if entry["status"] != "healthy"
        ]
        status = log_status({"document": document, "not_judged": run.not_judged})
        lines.append(f"{status:<9}{one_line(name)}{': ' + '; '.join(bad) if bad else ''}")
    return "\n".join(lines)


def _in_memory(judged: list[JudgedLog]) -> list[dict[str, Any]]:
    every = [
        {"document": run.document, "not_judged": run.not_judged, "content": one.content}
        for one in judged
        for run in one.runs
    ]
    return sorted(every, key=lambda log: (log["document"]["path"], log["document"].get("run") or ""))


def _stored(folder: Path) -> list[dict[str, Any]]:
    from servofd.fleet.store import read_logs

    return read_logs(folder)


def _overview(logs: list[dict[str, Any]]) -> Overview:
    from servofd.fleet.overview import overview

    return overview(logs)


def write_page(seen: Overview, target: str) -> None:
    """Write the page of a fleet, with links to the pages of its flights that stand beside it."""
    from servofd.core.files import write_whole
    from servofd.outputs.fleet_page import fleet_page

    pages = frozenset(path.name for path in Path(target).parent.glob("*.html"))
    write_whole(target, fleet_page(seen.document(), pages).encode())


def print_overview(seen: Overview) -> None:
    """Print what many logs say together."""
    from servofd.cli.tables import print_table
    from servofd.outputs.fleet_page import effect_left, logs_by_status

    counts = ", ".join(f"{number} {status}" for status, number in sorted(seen.statuses.items()))
    rows = [
        [
            count.surface,
            *logs_by_status(count.logs),
            ", ".join(f"{kind} {number}" for kind, number in count.kinds.items()),
            "" if count.largest_share is None else f"{count.largest_share:.0%}",
        ]
        for count in seen.surfaces
    ]
    headings = ["surface", "healthy", "suspect", "fault", "not judged", "faults", "largest residual / threshold"]
    title = f"{seen.logs} logs, {seen.hours:.1f} h: {counts}"
    if rows or not seen.axes:
        print_table(headings, rows, title)
        title = ""
    if seen.axes:
        moved = [[axis.axis, *logs_by_status(axis.logs), effect_left(asdict(axis))] for axis in seen.axes]
        print_table(["axis", "healthy", "suspect", "fault", "not judged", "effect left, where healthy"], moved, title)
