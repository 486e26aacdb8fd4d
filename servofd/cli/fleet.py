"""Many logs: ``servofd audit`` of folders, patterns and addresses, and ``servofd fleet``, which shows what it found."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servofd.batch.find import find_logs
from servofd.batch.key import page_name
from servofd.cli.terminal import (
    complain,
    give_json,
    one_line,
    print_document,
    print_lines,
    progress,
    say,
    worst,
    write_page,
)
from servofd.core.errors import ConfigError
from servofd.core.files import make_folder, write_whole
from servofd.feedback.flown import layout_of
from servofd.fleets.overview import Overview, log_status, overview
from servofd.fleets.run import audit_fleet
from servofd.fleets.store import FleetStore, by_path, read_logs
from servofd.outputs.fleet_report import fleet_report, flight_name
from servofd.outputs.page import FLEET_PAGE
from servofd.outputs.sentence import spoken

if TYPE_CHECKING:
    from servofd.batch.find import Found, LogSource
    from servofd.batch.key import Job
    from servofd.cli.options import Options
    from servofd.fleets.run import JudgedLog

_SHOWN = 3
"""Files passed over that are listed by name."""
_MOST = 100
"""Flights in a table on a terminal."""


def run(options: Options) -> int:
    """Read a folder of results, write the page, print."""
    seen = overview(read_logs(Path(options.folder)))
    target = options.html or str(Path(options.folder, FLEET_PAGE))
    _write_page(seen, target)
    if give_json(options.json, seen.document()):
        return seen.exit_code
    print_document(fleet_report(seen.document()))
    for fault in seen.faults:
        say(f"{fault['path']}: {fault['surface']}: {fault['kind']} from {fault['start_s']:.1f} s")
    for one in seen.not_judged:
        say(f"{one['path']}: {one['reason'].removeprefix(one['path'] + ': ')}")
    say(f"wrote {target}")
    return seen.exit_code


def run_fleet(options: Options, job: Job) -> int:
    """Judge all logs, each printed as it is done; then the overview, and what was asked for."""
    if options.rrd:
        raise ConfigError(f"{options.rrd}: --rrd takes one log; judge the one you want to see by itself")
    folder = options.output or options.pages
    job = replace(job, pages=folder is not None)
    found = find_logs(options.logs, layout_of(job.aircraft))
    _say_what_was_skipped(found)
    with FleetStore(Path(options.output), job.key) if options.output else nullcontext() as store:
        judged = _judged(found, job, store, options)
    kept = [run.row | {"content": one.content} for one in judged for run in one.runs]
    logs = read_logs(Path(options.output)) if options.output else by_path(kept)
    seen = overview(logs)
    for page in filter(None, (options.html, str(Path(folder, FLEET_PAGE)) if folder else None)):
        _write_page(seen, page)
    printed = give_json(options.json, {"schema": "servofd.audit/1", "logs": [log["document"] for log in logs]})
    flights = seen.document()["flights"]
    if options.pages and not printed:
        say(f"{fleet_report(seen.document()).sentence} → {Path(options.pages, FLEET_PAGE)}")
        print_lines([_brief(one) for one in flights[:_MOST]])
        if len(flights) > _MOST:
            say(f"and {len(flights) - _MOST} more, on the page")
    elif not printed:
        print_document(fleet_report(seen.document()))
    for problem in (*found.problems, *(one["reason"] for one in seen.not_judged)):
        complain(problem)
    return worst([seen.exit_code, *(2 for _ in found.problems)])


def _brief(flight: dict[str, Any]) -> tuple[str, str, str]:
    """Status, name and sentence of a flight."""
    said = flight["sentence"].replace(" Do not fly.", "")
    return spoken(flight["status"]), one_line(flight_name(flight)), one_line(said)


def _judged(found: Found, job: Job, store: FleetStore | None, options: Options) -> list[JudgedLog]:
    """Judge what is not done, and print it; kept in memory only if there is no folder for it."""
    kept = []
    to_do = list(found.logs) if store is None else _to_do(found.logs, store)
    if not to_do:
        return []
    folder = options.output or options.pages
    if folder:
        make_folder(Path(folder))
    with progress("audit", len(found.logs), len(found.logs) - len(to_do)) as step:
        for judged in audit_fleet(to_do, job, cluster=options.cluster, workers=options.workers):
            if folder and judged.page:
                target = Path(folder) / page_name(judged.source.path, judged.content)
                write_whole(target, judged.page.encode())
            if store is None:
                kept.append(replace(judged, page=""))
            elif not store.add(judged):
                complain("the same bytes as another log; counted once", judged.source.path)
            if options.json != "-" and not options.pages:
                for run in judged.runs:
                    say(_line(run.row))
            step()
    return kept


def _to_do(logs: tuple[LogSource, ...], store: FleetStore) -> list[LogSource]:
    if store.set_aside:
        complain(
            f"{store.set_aside} logs were judged with another aircraft file, other options or "
            f"another version; they are in {store.folder / 'earlier'} now, and judged again",
            store.folder,
        )
    store.forget_not_judged()
    to_do = [log for log in logs if not store.done(log)]
    if len(to_do) < len(logs):
        complain(f"{len(logs) - len(to_do)} of {len(logs)} logs are done already")
    return to_do


def _say_what_was_skipped(found: Found) -> None:
    if found.skipped:
        some = "; ".join(f"{one.path}: {one.reason}" for one in found.skipped[:_SHOWN])
        more = f"; and {len(found.skipped) - _SHOWN} more" if len(found.skipped) > _SHOWN else ""
        what = "1 file that is no log" if len(found.skipped) == 1 else f"{len(found.skipped)} files that are no logs"
        complain(f"passed over {what}: {some}{more}")


def _line(log: dict[str, Any]) -> str:
    """One run: worst status, name, and what is not as it should be."""
    document = log["document"]
    name = document["path"] + (f" (run {document['run']})" if document.get("run") else "")
    bad = [
        f"{name} {', '.join(fault['kind'] for fault in entry.get('faults', ())) or entry['status']}"
        for name, entry in (document["surfaces"] | document.get("axes", {})).items()
        if entry["status"] != "healthy"
    ]
    return f"{log_status(log):<9}{one_line(name)}{': ' + '; '.join(bad) if bad else ''}"


def _write_page(seen: Overview, target: str) -> None:
    """Write the page of a fleet, with links to the pages of its flights that stand beside it."""
    pages = frozenset(path.name for path in Path(target).parent.glob("*.html"))
    write_page(fleet_report(seen.document(), pages), target)
