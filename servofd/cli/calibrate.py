"""``servofd calibrate``: fit an aircraft to flights that are known to be good."""

from __future__ import annotations

from math import exp
from pathlib import Path
from typing import TYPE_CHECKING

from servofd.aircraft.axes import motion_to_toml
from servofd.aircraft.axis_names import SURFACE_AXES
from servofd.aircraft.schema import load_aircraft
from servofd.calibrating.result import calibration_to_toml
from servofd.cli.terminal import check_targets, print_table, progress
from servofd.core.errors import ConfigError, NoMeasurement
from servofd.core.files import write_whole
from servofd.feedback.flown import logs_of, surfaces_of
from servofd.jobs.workflow import calibrate, calibrate_axes, drafted_aircraft

if TYPE_CHECKING:
    from collections.abc import Iterable

    from servofd.aircraft.axes import MotionModel
    from servofd.calibrating.result import CalibratedSurface, Calibration
    from servofd.cli.options import Options

_MILLI = 1e3
_NOT_REACHED = 0.5
"""Deviation of the logarithm of the largest speed from which on flights do not tell it."""
_PER_HOUR = 1.0
_BY_DAYS = {1: "17", 2: "6", 3: "1.5"}


def run(options: Options) -> int:
    """Calibrate, write, then print."""
    check_targets([options.output], {"a log": options.logs})
    if options.config is not None:
        aircraft = load_aircraft(options.config)
    elif options.motion or not _has_feedback(options.logs):
        return _run_axes(options)
    else:
        aircraft = drafted_aircraft(options.logs)
    if not aircraft.surfaces:
        raise ConfigError(f"{options.config}: no surface in it to calibrate; leave -c out to calibrate motion anew")
    with progress("calibrate", len(options.surface or aircraft.surfaces)) as step:
        calibration = calibrate(
            options.logs,
            aircraft,
            surfaces=tuple(options.surface),
            spans=_spans(options),
            runs=tuple(options.runs),
            force=options.force,
            progress=step,
        )
    text = calibration_to_toml(calibration)
    write_whole(options.output, text.encode())
    _print(calibration, options)
    return _run_axes(options, text) if options.motion else 0


def _spans(options: Options) -> tuple[tuple[float, float], ...]:
    until = [] if options.until is None else [(float("-inf"), options.until)]
    return (*options.between, *until)


def _print(calibration: Calibration, options: Options) -> None:
    headings = ["surface", "delay (ms)", "bandwidth (rad/s)", "speed (deg/s)", "noise (deg)", "held out (deg)"]
    rows = [_row(one) for one in calibration.surfaces]
    print_table(headings, rows, "fitted, with 95% intervals; error on what the fit had not seen")
    headings = ["surface", "offset (deg)", "speed left", "travel lost", "play (deg)", "oscillation (deg)"]
    kinds = {
        "bias_deg": ".2g",
        "slow_share": ".0%",
        "loss_share": ".0%",
        "deadband_deg": ".2g",
        "oscillation_deg": ".2g",
    }
    rows = []
    for one in calibration.surfaces:
        sizes = ((getattr(one.detectable, kind), form) for kind, form in kinds.items())
        rows.append([one.surface, *("none" if size is None else format(size, form) for size, form in sizes)])
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


def _has_feedback(paths: list[str]) -> bool:
    """Whether any of the logs tells where a surface was."""
    for log in logs_of(paths):
        try:
            surfaces_of(log)
        except NoMeasurement:
            continue
        return True
    return False


def _run_axes(options: Options, text: str = "") -> int:
    """Calibrate what motion tells of axes, write it after what is known already, then print."""
    per_hour = _PER_HOUR if options.false_alarms_per_hour is None else options.false_alarms_per_hour
    model = calibrate_axes(
        options.logs, false_alarms_per_hour=per_hour, spans=_spans(options), own_days=options.own_days
    )
    head = text or f'name = "{Path(options.output).stem}"\n'
    write_whole(options.output, f"{head.rstrip()}\n\n{motion_to_toml(model)}".encode())
    _print_axes(model, options.output)
    return 0


def _print_axes(model: MotionModel, output: str) -> None:
    rows = [
        [
            name,
            axis.form.replace("_", " "),
            f"{axis.explained:.0%}",
            f"{axis.delay_s:.2f}",
            f"{axis.spreads[-1].loss_var ** 0.5:.2f}",
            f"{axis.spreads[-1].offset_var_us2 ** 0.5:.1f}",
            f"{axis.suspect:.2g}",
            "never" if axis.fault is None else f"{axis.fault:.2g}",
            f"{axis.false_alarms_per_hour:.2g}",
        ]
        for name, axis in model.axes.items()
    ]
    headings = [
        "axis",
        "form",
        "explained",
        "delay (s)",
        "lost share ±",
        "offset ± (us)",
        "suspect",
        "fault",
        "false/h",
    ]
    days = "1 day" if model.days == 1 else f"{model.days} days"
    print_table(headings, rows, f"{model.flights} flights, {model.hours:.2f} h, {days}")
    print(
        "explained: share of the command's effect, on days that the model had not seen; ±: how far healthy windows "
        "stray; suspect, fault: from which multiple of the largest value in these flights on"
    )
    low, high = model.regime.airspeed_low_m_s, model.regime.airspeed_high_m_s
    print(f"judged between {low:.0f} and {high:.0f} m/s, with at least {model.regime.throttle_low:.0%} throttle")
    for name in SURFACE_AXES:
        if name not in model.axes:
            print(f"{name}: not judged: its command is not logged, or explains nothing of the motion of other days")
    for name, axis in model.axes.items():
        if not axis.own_command:
            print(f"{name}: its command never moved on its own: fly a wiggle of it alone to have it judged")
    if model.days in _BY_DAYS:
        print(
            f"flights of {days} tell little of other days: thresholds allow for {_BY_DAYS[model.days]} times the false "
            "alarms of four days, and fall with each day more"
        )
    if model.days == model.flights > 1:
        print(
            "each flight counts as a day of its own; several of one day are told by the date in a log, or in its name"
        )
    print(f"wrote {output}; next: servofd FLIGHT -c {output}")
