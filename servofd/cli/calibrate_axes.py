"""``servofd calibrate`` where servos report nothing: what the motion of good flights tells."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import argparse

    from servofd.aircraft.axes import MotionModel

_PER_HOUR = 1.0
_BY_DAYS = {1: "17", 2: "6", 3: "1.5"}


def has_feedback(paths: list[str]) -> bool:
    """Whether any of the logs tells where a surface was."""
    from servofd.core.errors import NoMeasurement
    from servofd.feedback.flown import logs_of, surfaces_of

    for log in logs_of(paths):
        try:
            surfaces_of(log)
        except NoMeasurement:
            continue
        return True
    return False


def run_axes(options: argparse.Namespace, text: str = "") -> int:
    """Calibrate axes, write them after what is known already, then print.

    Parameters
    ----------
    options : Namespace
        Of ``servofd calibrate``.
    """
    from servofd.aircraft.axes import motion_to_toml
    from servofd.core.files import write_whole
    from servofd.jobs.workflow import calibrate_axes

    spans = tuple(options.between)
    if options.until is not None:
        spans = (*spans, (float("-inf"), options.until))
    per_hour = _PER_HOUR if options.false_alarms_per_hour is None else options.false_alarms_per_hour
    model = calibrate_axes(options.logs, false_alarms_per_hour=per_hour, spans=spans, own_days=options.own_days)
    head = text or f'name = "{Path(options.output).stem}"\n'
    write_whole(options.output, f"{head.rstrip()}\n\n{motion_to_toml(model)}".encode())
    _print(model, options.output)
    return 0


def _print(model: MotionModel, output: str) -> None:
    from servofd.aircraft.axis_names import SURFACE_AXES
    from servofd.cli.tables import print_table

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
