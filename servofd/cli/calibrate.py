"""``servofd calibrate``: fit an aircraft to flights that are known to be good."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from servofd.aircraft.axes import motion_to_toml
from servofd.aircraft.outputs import is_numbered
from servofd.aircraft.schema import load_aircraft
from servofd.calibrating.result import calibration_to_toml
from servofd.cli.options import Options
from servofd.cli.terminal import check_targets, print_document, progress, say
from servofd.core.errors import ConfigError, NoMeasurement
from servofd.core.files import write_whole
from servofd.jobs.workflow import calibrate, calibrate_axes, drafted_aircraft
from servofd.outputs.calibrate_report import calibrate_report, motion_report

_PER_HOUR = 1.0


def run(options: Options) -> int:
    """Calibrate, write, then print."""
    check_targets([options.output], {"a log": options.logs})
    if options.config is not None:
        aircraft = load_aircraft(options.config)
    elif options.motion:
        return _run_axes(options)
    else:
        try:
            aircraft = drafted_aircraft(options.logs, tuple(options.between))
        except NoMeasurement:  # no log tells where a surface was
            return _run_axes(options)
    if not aircraft.surfaces:
        raise ConfigError(f"{options.config}: no surface in it to calibrate; leave -c out to calibrate motion anew")
    with progress("calibrate", len(options.surface or aircraft.surfaces)) as step:
        parts: dict[str, Any] = {"spans": tuple(options.between), "runs": tuple(options.runs)}
        wanted = tuple(options.surface)
        calibration = calibrate(options.logs, aircraft, surfaces=wanted, **parts, force=options.force, progress=step)
    text = calibration_to_toml(calibration)
    write_whole(options.output, text.encode())
    print_document(calibrate_report(calibration, options.false_alarms_per_hour))
    say(f"wrote {options.output}")
    if options.config is None and any(is_numbered(name) for name in aircraft.surfaces):
        say("no log says what the outputs turn (SERVOn_FUNCTION); -c FILE, or a log that does, names the surfaces")
    return _run_axes(options, text) if options.motion else 0


def _run_axes(options: Options, text: str = "") -> int:
    """Calibrate what motion tells of axes, write it after what is known already, then print."""
    per_hour = _PER_HOUR if options.false_alarms_per_hour is None else options.false_alarms_per_hour
    model = calibrate_axes(options.logs, false_alarms_per_hour=per_hour, spans=tuple(options.between))
    head = text or f'name = "{Path(options.output).stem}"\n'
    write_whole(options.output, f"{head.rstrip()}\n\n{motion_to_toml(model)}".encode())
    print_document(motion_report(model))
    say(f"wrote {options.output}; next: servofd FLIGHT -c {options.output}")
    return 0
