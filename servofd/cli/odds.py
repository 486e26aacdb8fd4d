"""``servofd odds``: how often noise alone raises an alarm, and which faults are seen how soon."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servofd.cli.parser import LARGEST, SMALLEST, number

if TYPE_CHECKING:
    from servofd.aircraft.schema import Aircraft
    from servofd.detection.odds import SurfaceOdds, Wish
    from servofd.jobs.odds import LeftOut, Part

_PLAIN_SURFACE = "surface"


_POSITIVE = number("a positive number", SMALLEST, LARGEST)


def add_parser(verbs: argparse._SubParsersAction[Any]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "odds",
        help="false alarms per flight hour, missed faults, delays",
        description="Tells how often noise alone would raise an alarm, which faults are seen how soon, and which "
        "threshold gives a wanted rate of false alarms: from the design alone, or from healthy flights. "
        "Exit code 0: done; 2: could not tell.",
        epilog="Example: servofd odds -c faser --log flight1.mat flight2.mat --false-alarms-per-hour 1e-3 -o odds/",
    )
    parser.add_argument("-c", "--config", metavar="AIRCRAFT.toml", help="aircraft file, or the name of a shipped one")
    parser.add_argument("--log", nargs="+", action="extend", default=[], metavar="LOG", help="healthy flights")
    parser.add_argument("--servo", metavar="NAME", help="library servo of all surfaces; unknown: fitted to the flights")
    parser.add_argument("-s", "--surface", action="append", default=[], metavar="NAME", help="only this surface")
    parser.add_argument(
        "--false-alarms-per-hour", type=_POSITIVE, default=1e-3, metavar="X", help="wanted rate (default: 1e-3)"
    )
    parser.add_argument(
        "--fault-deg",
        type=_POSITIVE,
        default=2.0,
        metavar="X",
        help="bias whose delay is printed [deg] (default: 2)",
    )
    parser.add_argument(
        "--noise-deg", type=_POSITIVE, metavar="X", help="noise of the position [deg], without logs (default: 0.1)"
    )
    parser.add_argument(
        "--rate-hz", type=_POSITIVE, metavar="HZ", help="sample rate of the position, without logs (default: 100)"
    )
    parser.add_argument("--json", metavar="FILE", help="write the result as JSON; - prints it instead of the table")
    parser.add_argument("-o", "--output", metavar="DIR", help="write a figure per surface and odds.json to a folder")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Work out the odds, write what was asked for, and print."""
    from servofd.cli.targets import give_json
    from servofd.core.errors import ConfigError
    from servofd.detection.odds import Wish
    from servofd.outputs.odds_report import odds_document

    wish = Wish(options.false_alarms_per_hour, options.fault_deg)
    if options.log and (options.noise_deg or options.rate_hz):
        raise ConfigError("--noise-deg and --rate-hz describe a design; with --log both are measured: leave them out")
    odds, left_out, failed = _from_logs(options, wish) if options.log else (_from_design(options, wish), [], {})
    missing = failed | {part.surface: part.reason for part in left_out}
    document = odds_document(odds, missing)
    if odds and options.output:
        _write_folder(Path(options.output), odds, document)
    if not ((odds or options.json == "-") and give_json(options.json, document)):
        _print(odds, left_out)
    return _exit_code(odds, left_out, failed)


def _from_design(options: argparse.Namespace, wish: Wish) -> list[SurfaceOdds]:
    from servofd.aircraft.schema import UNKNOWN_SERVO, plain_aircraft
    from servofd.core.errors import ConfigError
    from servofd.jobs.odds import odds_from_design

    aircraft = _aircraft(options)
    if aircraft is None:
        if options.servo in (None, UNKNOWN_SERVO):
            raise ConfigError(
                "odds of what? give an aircraft (-c faser), a servo (--servo NAME) or flights (--log LOG)"
            )
        aircraft = plain_aircraft(options.surface or [_PLAIN_SURFACE], options.servo)
    _check_surfaces(options, aircraft)
    return odds_from_design(
        aircraft,
        wish,
        noise_deg=options.noise_deg or 0.1,
        rate_hz=options.rate_hz or 100.0,
        surfaces=tuple(options.surface),
    )


def _from_logs(options: argparse.Namespace, wish: Wish) -> tuple[list[SurfaceOdds], list[LeftOut], dict[str, str]]:
    """Odds of the surfaces, surfaces without, and logs that could not be read."""
    from logparsers import LogError
    from servofd.cli.tables import progress_bar
    from servofd.core.errors import NoMeasurement, UnknownName
    from servofd.jobs.odds import LeftOut, odds_from_logs, parts_of
    from servofd.jobs.workflow import audit

    aircraft = _aircraft(options, with_servo=False)
    parts: list[Part | LeftOut] = []
    failed: dict[str, str] = {}
    with progress_bar("odds", len(options.log)) as step:
        for path in options.log:
            try:
                for result in audit(path, aircraft, servo=options.servo, surfaces=tuple(options.surface)):
                    parts += parts_of(result)
            except (LogError, NoMeasurement, UnknownName) as error:
                failed[path] = str(error)
            step(Path(path).name)
    results = odds_from_logs(parts, wish)
    left_out = [result for result in results if isinstance(result, LeftOut)]
    return [result for result in results if not isinstance(result, LeftOut)], left_out, failed


def _aircraft(options: argparse.Namespace, *, with_servo: bool = True) -> Aircraft | None:
    from servofd.aircraft.schema import UNKNOWN_SERVO, load_aircraft
    from servofd.servo.library import servo_named

    aircraft = load_aircraft(options.config) if options.config else None
    if options.servo in (None, UNKNOWN_SERVO):
        return aircraft
    servo_named(options.servo)
    return aircraft.with_servo(options.servo) if aircraft and with_servo else aircraft


def _check_surfaces(options: argparse.Namespace, aircraft: Aircraft) -> None:
    from servofd.core.errors import NoMeasurement

    aircraft.check_names(options.surface)
    if not options.surface and all(surface.measured is None for surface in aircraft.surfaces.values()):
        raise NoMeasurement(f"{options.config}: names no measured channel for any surface")


def _write_folder(folder: Path, odds: list[SurfaceOdds], document: dict[str, Any]) -> None:
    from servofd.cli.tables import progress_bar
    from servofd.cli.targets import give_json
    from servofd.core.files import distinct_file_names, make_folder
    from servofd.outputs.odds_figure import save_odds_figure

    make_folder(folder)
    with progress_bar("figures", len(odds)) as step:
        for surface, name in zip(odds, distinct_file_names([o.surface for o in odds]), strict=True):
            save_odds_figure(surface, folder / f"odds-{name}.png")
            step(surface.surface)
    give_json(str(folder / "odds.json"), document)


def _print(odds: list[SurfaceOdds], left_out: list[LeftOut]) -> None:
    from servofd.cli.tables import one_line, print_table
    from servofd.outputs.odds_report import odds_rows

    if odds:
        print_table(["", *(o.surface for o in odds)], odds_rows(odds))
    for surface in odds:
        for note in surface.notes:
            print(f"  {surface.surface}: {one_line(note)}")
    for part in left_out:
        print(f"  {part.surface}: nothing healthy to learn from: {one_line(part.reason)}")


def _exit_code(odds: list[SurfaceOdds], left_out: list[LeftOut], failed: dict[str, str]) -> int:
    """2 if a file could not be read, or no surface could be judged; the reason goes to stderr."""
    from servofd.cli.tables import one_line

    for error in failed.values():
        print(f"servofd: {one_line(error)}", file=sys.stderr)
    if not odds and not failed:
        why = "; ".join(f"{part.surface}: {part.reason}" for part in left_out) or "no surface is measured"
        print(f"servofd: no healthy surface to learn the odds from: {one_line(why)}", file=sys.stderr)
    return 2 if failed or not odds else 0
