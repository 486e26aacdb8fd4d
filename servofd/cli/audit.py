"""``servofd audit``: the verdict on one or more logs."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servofd.cli.audit_fleet import add_options as add_options_of_many
from servofd.cli.audit_fleet import is_fleet, run_fleet
from servofd.cli.exit_codes import worst
from servofd.cli.parser import LARGEST, SMALLEST, number

if TYPE_CHECKING:
    from servofd.aircraft.schema import Aircraft
    from servofd.detection.verdict import LogAudit
    from servofd.outputs.json_report import FailedLog


DEGREES = number("a positive number of degrees", SMALLEST, LARGEST)


def add_parser(verbs: argparse._SubParsersAction[Any]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "audit",
        help="judge every surface of a flight log",
        description="Judges every surface of one or more flight logs. Exit code 0: healthy; 1: a fault was found; "
        "2: could not tell.",
        epilog="Example: servofd audit flight.mat -c configs/faser.toml -o report/",
    )
    add_options(parser)
    parser.set_defaults(run=run)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare what to judge, how, and what to write."""
    parser.add_argument(
        "logs",
        nargs="+",
        metavar="LOG",
        help="flight log, recognised by its content; or many of them: folders, patterns, addresses such as s3://bucket/logs",
    )
    parser.add_argument("-c", "--config", metavar="AIRCRAFT.toml", help="aircraft file, or the name of a shipped one")
    parser.add_argument(
        "--servo",
        metavar="NAME",
        help="servo of all surfaces: of the library, FILE.toml, or unknown (fitted)",
    )
    parser.add_argument("-s", "--surface", action="append", default=[], metavar="NAME", help="judge only this surface")
    parser.add_argument("--threshold-deg", type=DEGREES, metavar="X", help="alarm level [deg] (default: 1.5)")
    parser.add_argument("--threshold", choices=["constant", "interval"], help="kind (default: constant)")
    parser.add_argument("--json", metavar="FILE", help="write the result as JSON; - prints it instead of the table")
    parser.add_argument("--html", metavar="FILE", help="write a page that can be sent by mail")
    parser.add_argument("--plot", action="store_true", help="draw each residual against its threshold in the terminal")
    parser.add_argument("--rrd", metavar="FILE", help="write a Rerun recording (of one log)")
    parser.add_argument("--include-position", action="store_true", help="tell in the recording where it flew")
    parser.add_argument("--map", action="store_true", help="show it there on a map from openstreetmap.org")
    parser.add_argument(
        "-o",
        "--output",
        metavar="DIR",
        help="write figures, recordings and audit.json to a folder; "
        "of many logs, tables (Parquet) and a page, to which the next call adds what is new",
    )
    add_options_of_many(parser)
    parser.set_defaults(pages=None)


def run(options: argparse.Namespace) -> int:
    """Audit all logs, then write all outputs, then print."""
    check(options)
    if is_fleet(options):
        return run_fleet(options)
    results = judged(options)
    write(options, results)
    if options.json == "-":
        print_json(results)
    else:
        _print(results)
        if options.plot:
            _plot(results)
    return exit_code(results)


def _plot(results: list[LogAudit | FailedLog]) -> None:
    """A line for each surface and axis: how near it came to its threshold over the flight."""
    import numpy as np

    from servofd.cli.tables import one_line
    from servofd.detection.verdict import outline
    from servofd.outputs.json_report import FailedLog
    from servofd.outputs.sparkline import sparkline

    for result in results:
        if isinstance(result, FailedLog):
            continue
        lines = []
        for one in result.surfaces:
            if one.residuals is not None and one.threshold is not None:
                residuals = one.residuals
                residual_deg = np.where(residuals.settled, residuals.residual_deg, np.nan)
                lines.append((one.surface, outline(residuals.time_s, residual_deg, one.threshold.level_deg)))
        lines += [(axis.axis, axis.outline) for axis in result.axes]
        width = max((len(one_line(name)) for name, _ in lines), default=0)
        for name, shares in lines:
            print(f"{one_line(name):{width}}  {sparkline(shares)}")
        if lines:
            print("residual over threshold: ▁▂▃▄ below, ▅▆▇█ above it; a dot where nothing was judged")


def check(options: argparse.Namespace) -> None:
    """Refuse what cannot be, before the work starts."""
    from servofd.aircraft.schema import UNKNOWN_SERVO
    from servofd.cli.targets import check_targets
    from servofd.core.errors import ConfigError, needs
    from servofd.servo.library import find_servo

    if options.threshold == "interval" and options.threshold_deg is not None:
        raise ConfigError("--threshold-deg gives a constant threshold; leave it out, or leave out --threshold interval")
    if "" in options.logs:  # which pathlib takes for this folder and everything below it
        raise ConfigError("a log without a name; give a file, a folder or a pattern")
    if options.servo not in (None, UNKNOWN_SERVO):
        find_servo(options.servo)
    if options.rrd:
        needs("rerun")
    outputs = (options.rrd, options.json, options.html)
    check_targets(outputs, {"a log": options.logs, "the aircraft file": [options.config]}, folder=options.output)


def judged(options: argparse.Namespace) -> list[LogAudit | FailedLog]:
    """Every run of every log that was named."""
    from servofd.batch.find import flights_joined
    from servofd.feedback.flown import known_aircraft, layout_of

    aircraft = known_aircraft(options.config)
    logs = options.logs if layout_of(aircraft) else flights_joined(options.logs)
    return [result for path in logs for result in _audit(path, aircraft, options)]


def _audit(path: str, aircraft: Aircraft | None, options: argparse.Namespace) -> list[LogAudit | FailedLog]:
    """Audit one file; what cannot be read is reported and does not stop the others."""
    from logparsers import LogError
    from servofd.cli.tables import progress_bar
    from servofd.core.errors import NoMeasurement, UnknownName
    from servofd.jobs.workflow import audit
    from servofd.outputs.json_report import FailedLog

    total = len(aircraft.surfaces) if aircraft else None
    results: list[LogAudit | FailedLog] = []
    try:
        with progress_bar(Path(path).name, total or 1) as step:
            results.extend(
                audit(
                    path,
                    aircraft,
                    servo=options.servo,
                    threshold_deg=options.threshold_deg,
                    threshold=options.threshold,
                    surfaces=tuple(options.surface),
                    progress=step,
                )
            )
    except (LogError, NoMeasurement, UnknownName) as error:
        results.append(FailedLog(path, str(error), getattr(error, "log", None)))
    return results


def exit_code(results: list[LogAudit | FailedLog]) -> int:
    """The worst of all logs; why a log gave no verdict goes to stderr, in a line each."""
    return worst(_exit_codes(results))


def _exit_codes(results: list[LogAudit | FailedLog]) -> list[int]:
    """One exit code per log; the reason for each 2 goes to stderr."""
    from servofd.cli.tables import one_line
    from servofd.outputs.json_report import FailedLog

    codes = []
    for result in results:
        if isinstance(result, FailedLog):
            print(f"servofd: {one_line(result.error)}", file=sys.stderr)
            codes.append(2)
        elif result.has_fault:
            codes.append(1)
        elif result.not_judged:
            print(f"servofd: {one_line(result.log.label)}: {one_line(result.not_judged)}", file=sys.stderr)
            codes.append(2)
        else:
            codes.append(0)
    return codes


def write(options: argparse.Namespace, results: list[LogAudit | FailedLog]) -> None:
    """Write the files that were asked for."""
    from servofd.cli.targets import give_json
    from servofd.core.errors import ConfigError
    from servofd.core.files import write_whole
    from servofd.outputs.json_report import FailedLog, audit_document

    audits = [result for result in results if not isinstance(result, FailedLog)]
    if options.rrd and len(audits) > 1:
        raise ConfigError(f"{options.rrd}: --rrd takes one log at a time; -o DIR writes a recording for each")
    document = audit_document(results) if options.json or options.output else {}
    if options.json != "-":
        give_json(options.json, document)
    if options.html:
        from servofd.outputs.audit_page import audit_page

        write_whole(options.html, audit_page(results).encode())
    if options.rrd and audits:
        from servofd.outputs.recording import save_recording

        save_recording(audits[0], options.rrd, include_position=options.include_position, online_map=options.map)
    if options.output:
        _write_folder(Path(options.output), audits, document, where=options.include_position, on_map=options.map)


def _write_folder(folder: Path, audits: list[LogAudit], document: dict[str, Any], *, where: bool, on_map: bool) -> None:
    from servofd.cli.targets import give_json
    from servofd.core.errors import ConfigError, needs
    from servofd.core.files import distinct_file_names, make_folder
    from servofd.outputs.figure import save_figure
    from servofd.outputs.recording import save_recording

    make_folder(folder)
    give_json(str(folder / "audit.json"), document)
    try:
        needs("matplotlib", "rerun")
    except ConfigError as error:
        print(f"servofd: no figures, no recording: {error}", file=sys.stderr)
        return
    for audit, stem in zip(audits, distinct_file_names([_stem(audit) for audit in audits]), strict=True):
        names = distinct_file_names([surface.surface for surface in audit.surfaces])
        for surface, name in zip(audit.surfaces, names, strict=True):
            if surface.threshold is not None:
                save_figure(surface, folder / f"{stem}-{name}.png", audit.log.source.name)
        save_recording(audit, folder / f"{stem}.rrd", include_position=where, online_map=on_map)


def _stem(audit: LogAudit) -> str:
    return audit.log.source.stem + (f"-{audit.log.run}" if audit.log.run else "")


def print_json(results: list[LogAudit | FailedLog]) -> None:
    """Print the result as JSON."""
    from servofd.cli.targets import give_json
    from servofd.outputs.json_report import audit_document

    give_json("-", audit_document(results))


def _print(results: list[LogAudit | FailedLog]) -> None:
    from servofd.cli.tables import print_verdicts
    from servofd.outputs.json_report import FailedLog

    for result in results:
        if not isinstance(result, FailedLog):
            print_verdicts(result)
