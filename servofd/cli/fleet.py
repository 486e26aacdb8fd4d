"""Many logs: ``servofd audit`` of folders, patterns and addresses, and ``servofd fleet``, which shows what it found."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

from servofd.batch.find import Found, LogSource, find_logs
from servofd.batch.key import Job, page_name
from servofd.cli.options import Options
from servofd.cli.terminal import complain, give_json, print_document, print_lines, progress, say, worst, write_page
from servofd.core.errors import ConfigError
from servofd.core.files import make_folder, write_whole
from servofd.detection.kinds import KINDS
from servofd.feedback.flown import layout_of
from servofd.fleets.overview import Overview, overview
from servofd.fleets.run import JudgedLog, audit_fleet
from servofd.fleets.store import FleetStore, read_logs
from servofd.outputs.fleet_report import fleet_report, flight_name
from servofd.outputs.page import FLEET_PAGE
from servofd.outputs.sentence import gravity_of, spoken

_SHOWN = 3
"""Files passed over that are listed by name."""
_MOST = 100
"""Flights in a table on a terminal."""


def run(options: Options) -> int:
    """Read a folder of results, write the page, print."""
    seen = overview(read_logs(Path(options.folder)))
    target = options.html or str(Path(options.folder, FLEET_PAGE))
    _write_page(seen, target)
    if not give_json(options.json, seen.document()):
        print_document(replace(fleet_report(seen.document()), sentence=""))
        _print(seen, target)
    return seen.exit_code


def run_fleet(options: Options, job: Job) -> int:
    """Judge all logs, write what was asked for, then print a line for each flight, the worst first."""
    if options.rrd:
        raise ConfigError(f"{options.rrd}: --rrd takes one log; judge the one you want to see by itself")
    folder = options.output or options.pages
    job = replace(job, pages=folder is not None)
    found = find_logs(options.logs, layout_of(job.aircraft))
    if found.skipped:
        count, some = len(found.skipped), "; ".join(f"{one.path}: {one.reason}" for one in found.skipped[:_SHOWN])
        more = f"; and {count - _SHOWN} more" if count > _SHOWN else ""
        what = "1 file that is no log" if count == 1 else f"{count} files that are no logs"
        complain(f"passed over {what}: {some}{more}")
    with FleetStore(Path(options.output), job.key) if options.output else nullcontext() as store:
        judged = _judged(found, job, store, options)
    logs = read_logs(Path(options.output)) if options.output else [row for one in judged for row in one.rows]
    seen = overview(logs)
    pages = [str(Path(folder, FLEET_PAGE))] if folder else []
    for page in filter(None, (*pages, options.html)):
        _write_page(seen, page)
    documents = sorted((log["document"] for log in logs), key=lambda one: (one["path"], one.get("run") or ""))
    if not give_json(options.json, {"schema": "servofd.audit/1", "logs": documents}):
        _print(seen, *pages[:1])
    for problem in (*found.problems, *(one["reason"] for one in seen.not_judged)):
        complain(problem)
    return worst([seen.exit_code, *(2 for _ in found.problems)])


def _print(seen: Overview, page: str = "") -> None:
    """Print what they come to, and a line for each flight, the worst first."""
    document = seen.document()
    say(f"{fleet_report(document).sentence}{f' → {page}' if page else ''}")
    print_lines([_brief(one, document["faults"]) for one in document["flights"][:_MOST]])
    if len(seen.flights) > _MOST:
        say(f"and {len(seen.flights) - _MOST} more{', on the page' if page else ''}")


def _brief(flight: dict[str, Any], faults: Sequence[dict[str, Any]]) -> tuple[str, str, tuple[str, ...]]:
    """Status, name and sentence of a flight; and where there is no room for that, its faults without their numbers."""
    said = flight["sentence"].replace(" Do not fly.", "")
    mine = [one for one in faults if (one["path"], one["run"]) == (flight["path"], flight["run"])]
    states: dict[str, list[str]] = {}
    for one in sorted(mine, key=lambda one: gravity_of([one["kind"]])):
        states.setdefault(spoken(one["surface"]).upper(), []).append(KINDS[one["kind"]].state)
    short = [f"{name} {', '.join(dict.fromkeys(each))}" for name, each in states.items()]
    return spoken(flight["status"]), flight_name(flight), (said, "; ".join(short)) if len(mine) > 1 else (said,)


def _judged(found: Found, job: Job, store: FleetStore | None, options: Options) -> list[JudgedLog]:
    """Judge what is not done; kept in memory only if there is no folder for it."""
    kept = []
    to_do = list(found.logs) if store is None else _to_do(found.logs, store)
    folder = options.output or options.pages
    if to_do and folder:
        make_folder(Path(folder))
    with progress("audit", len(found.logs), len(found.logs) - len(to_do)) as step:
        for judged in audit_fleet(to_do, job, workers=options.workers):
            if folder and judged.page:
                target = Path(folder) / page_name(judged.source.path, judged.content)
                write_whole(target, judged.page.encode())
            if store is None:
                kept.append(replace(judged, page=""))
            elif not store.add(judged):
                complain("the same bytes as another log; counted once", judged.source.path)
            step()
    return kept


def _to_do(logs: tuple[LogSource, ...], store: FleetStore) -> list[LogSource]:
    if store.set_aside:
        otherwise = f"{store.set_aside} logs were judged with another aircraft file, other options or another version"
        complain(f"{otherwise}; they are in {store.folder / 'earlier'} now, and judged again", store.folder)
    store.forget_not_judged()
    to_do = [log for log in logs if not store.done(log)]
    if len(to_do) < len(logs):
        complain(f"{len(logs) - len(to_do)} of {len(logs)} logs are done already")
    return to_do


def _write_page(seen: Overview, target: str) -> None:
    """Write the page of a fleet, with links to the pages of its flights that stand beside it."""
    pages = frozenset(path.name for path in Path(target).parent.glob("*.html"))
    write_page(fleet_report(seen.document(), pages), target)
