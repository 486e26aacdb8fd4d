"""``servofd calibrate``: fit an aircraft to flights that are known to be good."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from servofd.calibrating.result import CalibratedSurface, Calibration
    from servofd.detection.bank.explanation import Estimate

__all__ = ["add_parser", "run"]

_MILLI = 1e3
_PER_HOUR = 1e-3


def add_parser(verbs: argparse._SubParsersAction[Any]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "calibrate",
        help="fit an aircraft file to flights that are known to be good",
        description="Fits each servo (scale, offset, delay, bandwidth, rate limit as far as the flights show it), how "
        "far it strays, and its threshold to flights that are known to be good, and writes a new aircraft file. "
        "Flights that look faulty are refused. Exit code 0: written; 2: not.",
        epilog="Example: servofd calibrate good_flight.bin -c my_plane.toml -o calibrated.toml",
    )
    parser.add_argument("logs", nargs="+", metavar="LOG", help="flights of one aircraft, all of them good")
    parser.add_argument(
        "-c", "--config", metavar="AIRCRAFT.toml", help="what is known of it so far; not needed for motion alone"
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
        type=_rate,
        metavar="X",
        help="of the whole aircraft (default: 0.001; of motion alone: 1)",
    )
    parser.add_argument("-s", "--surface", action="append", default=[], metavar="NAME", help="calibrate only this one")
    parser.add_argument("--until", type=_seconds, metavar="S", help="use each log up to this time [s] only")
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
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Calibrate, write, then print."""
    from servofd.aircraft import load_aircraft
    from servofd.calibrating.toml import calibration_to_toml
    from servofd.cli.calibrate_axes import has_feedback, run_axes
    from servofd.cli.tables import progress_bar
    from servofd.errors import ConfigError
    from servofd.outputs.files import write_whole
    from servofd.workflow import calibrate

    _check_output(options)
    if options.config is None:
        if options.motion or not has_feedback(options.logs):
            return run_axes(options)
        raise ConfigError(
            "-c AIRCRAFT.toml is needed where servos report their positions: servofd config LOG drafts it; or --motion "
            "for what the aircraft's motion tells alone"
        )
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
            false_alarms_per_hour=_PER_HOUR if options.false_alarms_per_hour is None else options.false_alarms_per_hour,
            surfaces=tuple(options.surface),
            spans=spans,
            runs=tuple(options.runs),
            progress=step,
        )
    text = calibration_to_toml(calibration)
    write_whole(options.output, text.encode())
    _print(calibration, options.output)
    if options.motion:
        return run_axes(options, text)
    return 0


def _check_output(options: argparse.Namespace) -> None:
    """Refuse to overwrite what the numbers come from."""
    from servofd.errors import ConfigError

    target = Path(options.output).resolve()
    if not target.parent.is_dir():
        raise ConfigError(f"{options.output}: the folder {target.parent} does not exist")
    if target in {Path(log).resolve() for log in options.logs}:
        raise ConfigError(f"{options.output}: is a log already; choose another file for the calibrated aircraft")


def _print(calibration: Calibration, output: str) -> None:
    from servofd.cli.tables import print_table

    rows = [_row(one) for one in calibration.surfaces]
    headings = ["surface", "scale", "offset (deg)", "delay (ms)", "bandwidth (Hz)", "rate limit (deg/s)", "noise (deg)"]
    print_table(headings, rows, "fitted, with 95 % intervals; (kept) means as in the aircraft file before")
    headings = ["surface", "residual std (deg)", "threshold (deg)", "gain", "delay (ms)", "bandwidth", "bias (deg)"]
    rows = [_tolerance_row(one) for one in calibration.surfaces]
    print_table(headings, rows, "before and after; how far this servo may stray")
    for one in calibration.surfaces:
        for number, reason in one.fit.kept.items():
            print(f"{one.surface}: {number} kept: {reason}")
        for note in one.notes:
            print(f"{one.surface}: note: {note}")
        if one.levels.extrapolated:
            print(
                f"{one.surface}: {calibration.false_alarms_per_hour:g} false alarms per hour is an extrapolation from "
                f"{60.0 * one.levels.hours:.1f} min, for Gaussian noise"
            )
    for name, reason in calibration.kept.items():
        print(f"{name}: not calibrated: {reason}")
    print(f"wrote {output}")


def _row(one: CalibratedSurface) -> list[str]:
    fit = one.fit
    return [
        one.surface,
        _interval(fit.gain, 3),
        _interval(fit.offset_deg, 2),
        _number(one, "delay_s", 1, _MILLI),
        _number(one, "bandwidth_hz", 2),
        _number(one, "rate_limit_deg_s", 0),
        f"{fit.noise_deg:.2g}",
    ]


def _number(one: CalibratedSurface, name: str, digits: int, scale: float = 1.0) -> str:
    if name in one.fit.numbers:
        return _interval(one.fit.numbers[name], digits, scale)
    value = getattr(one.fit.servo, name)
    return "none" if value is None else f"{scale * value:.{digits}f} (kept)"


def _interval(estimate: Estimate, digits: int, scale: float = 1.0) -> str:
    value, low, high = (scale * x for x in estimate)
    return f"{value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def _tolerance_row(one: CalibratedSurface) -> list[str]:
    levels, tolerance = one.levels, one.levels.tolerance
    return [
        one.surface,
        f"{one.before.residual_std_deg:.3g} -> {levels.residual_std_deg:.3g}",
        f"{one.before.threshold_deg:.3g} -> {levels.interval_deg:.2g} (interval)",
        f"{tolerance.gain:.1%}",
        f"{_MILLI * tolerance.delay_s:.1f}",
        f"{tolerance.bandwidth:.1%}",
        f"{tolerance.bias_deg:.2g}",
    ]


def _rate(text: str) -> float:
    return _between(text, 1e-12, 1e3, "a number of false alarms per hour between 1e-12 and 1000")


def _seconds(text: str) -> float:
    return _between(text, -1e12, 1e12, "a time in seconds")


def _span(text: str) -> tuple[float, float]:
    first, colon, last = text.partition(":")
    if not colon:
        raise argparse.ArgumentTypeError(f"must be two times in seconds such as 10:93.5, not {text}")
    from_s, to_s = _seconds(first), _seconds(last)
    if not from_s < to_s:
        raise argparse.ArgumentTypeError(f"must be an earlier and a later time such as 10:93.5, not {text}")
    return from_s, to_s


def _between(text: str, low: float, high: float, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not low <= value <= high:
        raise argparse.ArgumentTypeError(f"must be {what}, not {text}")
    return value
