"""``servofd calibrate``: fit an aircraft to flights that are known to be good."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servofd.cli.parser import number

if TYPE_CHECKING:
    from collections.abc import Iterable

    from servofd.calibrating.result import CalibratedSurface, Calibration

_MILLI = 1e3
_NOT_REACHED = 0.5
"""Deviation of the logarithm of the largest speed from which on flights do not tell it."""


_RATE = number("a number of false alarms per hour between 1e-12 and 1000", 1e-12, 1e3)
_SECONDS = number("a time in seconds", -1e12, 1e12)


def add_parser(verbs: argparse._SubParsersAction[Any]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "calibrate",
        help="fit an aircraft file to flights that are known to be good",
        description="Fits each servo with its effects (scale, offset, delay, bandwidth, largest speed, dead band, "
        "friction, play, load of the air) to flights that are known to be good, and what it may differ by between "
        "flights, and writes a new aircraft file. Flights that look faulty are refused. Exit code 0: written; 2: not.",
        epilog="Example: servofd calibrate good1.bin good2.bin -o plane.toml",
    )
    parser.add_argument("logs", nargs="+", metavar="LOG", help="flights of one aircraft, all of them good")
    parser.add_argument(
        "-c", "--config", metavar="AIRCRAFT.toml", help="what is known of it so far (default: drafted from the logs)"
    )
    parser.add_argument(
        "--motion",
        action="store_true",
        help="calibrate what the aircraft's motion tells of its axes (which is what happens where no servo reports)",
    )
    parser.add_argument(
        "--own-days",
        action="store_true",
        help="of motion: flights of one date differ as days do, in payload, trim or wind",
    )
    parser.add_argument("-o", "--output", required=True, metavar="CALIBRATED.toml", help="aircraft file to write")
    parser.add_argument(
        "--false-alarms-per-hour",
        type=_RATE,
        metavar="X",
        help="wanted of all axes together, where motion is calibrated (default: 1); of servos that report their "
        "position the measured rate is told",
    )
    parser.add_argument("-s", "--surface", action="append", default=[], metavar="NAME", help="calibrate only this one")
    parser.add_argument("--until", type=_SECONDS, metavar="S", help="use each log up to this time [s] only")
    parser.add_argument(
        "--between",
        type=_span,
        action="append",
        default=[],
        metavar="A:B",
        help="use this part [s] only; may be repeated",
    )
    parser.add_argument(
        "--run",
        dest="runs",
        action="append",
        default=[],
        metavar="NAME",
        help="of a table of several runs, use only this",
    )
    parser.add_argument(
        "--force",
        action="store_true",
        help="calibrate also where the loss of a third of travel and of two thirds of speed would not show",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Calibrate, write, then print."""
    from servofd.aircraft.schema import load_aircraft
    from servofd.calibrating.result import calibration_to_toml
    from servofd.cli.calibrate_axes import has_feedback, run_axes
    from servofd.cli.tables import progress_bar
    from servofd.core.errors import ConfigError
    from servofd.core.files import write_whole
    from servofd.jobs.workflow import calibrate, drafted_aircraft

    _check_output(options)
    if options.config is None:
        if options.motion or not has_feedback(options.logs):
            return run_axes(options)
        aircraft = drafted_aircraft(options.logs)
    else:
        aircraft = load_aircraft(options.config)
    if not aircraft.surfaces:
        raise ConfigError(f"{options.config}: no surface in it to calibrate; leave -c out to calibrate motion anew")
    spans = tuple(options.between)
    if options.until is not None:
        spans = (*spans, (float("-inf"), options.until))
    with progress_bar("calibrate", len(options.surface or aircraft.surfaces)) as step:
        calibration = calibrate(
            options.logs,
            aircraft,
            surfaces=tuple(options.surface),
            spans=spans,
            runs=tuple(options.runs),
            force=options.force,
            progress=step,
        )
    text = calibration_to_toml(calibration)
    write_whole(options.output, text.encode())
    _print(calibration, options)
    if options.motion:
        return run_axes(options, text)
    return 0


def _check_output(options: argparse.Namespace) -> None:
    """Refuse to overwrite what the numbers come from."""
    from servofd.core.errors import ConfigError

    target = Path(options.output).resolve()
    if not target.parent.is_dir():
        raise ConfigError(f"{options.output}: the folder {target.parent} does not exist")
    if target in {Path(log).resolve() for log in options.logs}:
        raise ConfigError(f"{options.output}: is a log already; choose another file for the calibrated aircraft")


def _print(calibration: Calibration, options: argparse.Namespace) -> None:
    from servofd.cli.tables import print_table

    headings = ["surface", "delay (ms)", "bandwidth (rad/s)", "speed (deg/s)", "noise (deg)", "held out (deg)"]
    rows = [_row(one) for one in calibration.surfaces]
    print_table(headings, rows, "fitted, with 95% intervals; error on what the fit had not seen")
    headings = ["surface", "offset (deg)", "speed left", "travel lost", "play (deg)", "oscillation (deg)"]
    rows = [_detectable_row(one) for one in calibration.surfaces]
    print_table(headings, rows, "smallest faults that flights like these show, 19 times in 20")
    for one in calibration.surfaces:
        print(f"{one.surface}: {', '.join(one.effects) or 'no effect beyond a linear servo pays'}")
        for note in (*one.notes, one.sharper):
            print(f"{one.surface}: note: {note}")
    for name, reason in calibration.kept.items():
        print(f"{name}: not calibrated: {reason}")
    print(_rate(calibration, options.false_alarms_per_hour))
    print(f"wrote {options.output}")


def _rate(calibration: Calibration, wanted: float | None) -> str:
    """False alarms to expect; a lower rate than was measured is not promised."""
    per_hour, surfaces = calibration.false_alarms_per_hour, calibration.surfaces
    of = "this surface" if len(surfaces) == 1 else f"these {len(surfaces)} surfaces"
    text = f"false alarms to expect: about {per_hour:.2g} an hour of {of}, as measured on simulated aircraft"
    if not any(one.known.airspeed_m_s for one in surfaces):
        text += "; more in flight, for these logs tell no airspeed"
    refused = wanted is not None and wanted < per_hour
    return f"{text}; {wanted:g} cannot be promised" if refused else text


def _row(one: CalibratedSurface) -> list[str]:
    from math import exp

    delay, bandwidth, rate = (one.estimates[key] for key in ("delay_s", "ln_bandwidth", "ln_rate"))
    return [
        one.surface,
        _interval(delay, 0, _MILLI),
        _interval((exp(x) for x in bandwidth), 0),
        _interval((exp(x) for x in rate), 0) if rate.deviation < _NOT_REACHED else "not reached",
        f"{one.known.noise.still_deg:.2g}",
        f"{one.held_out_rms_deg:.2g}",
    ]


def _interval(estimate: Iterable[float], digits: int, scale: float = 1.0) -> str:
    value, low, high = (scale * x for x in estimate)
    return f"{value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def _detectable_row(one: CalibratedSurface) -> list[str]:
    sizes = one.detectable

    def shown(value: float | None, form: str) -> str:
        return "none" if value is None else format(value, form)

    return [
        one.surface,
        shown(sizes.bias_deg, ".2g"),
        shown(sizes.slow_share, ".0%"),
        shown(sizes.loss_share, ".0%"),
        shown(sizes.deadband_deg, ".2g"),
        shown(sizes.oscillation_deg, ".2g"),
    ]


def _span(text: str) -> tuple[float, float]:
    first, colon, last = text.partition(":")
    if not colon:
        raise argparse.ArgumentTypeError(f"must be two times in seconds such as 10:93.5, not {text}")
    from_s, to_s = _SECONDS(first), _SECONDS(last)
    if not from_s < to_s:
        raise argparse.ArgumentTypeError(f"must be an earlier and a later time such as 10:93.5, not {text}")
    return from_s, to_s
