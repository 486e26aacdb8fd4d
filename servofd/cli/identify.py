"""``servofd identify``: from bench tests to a servo."""

from __future__ import annotations

from pathlib import Path

from servofd.cli.options import Options
from servofd.cli.terminal import check_targets, complain, progress, show
from servofd.core.files import write_whole
from servofd.feedback.flown import known_aircraft
from servofd.jobs.bench import identify
from servofd.outputs.identify_report import identify_report
from servofd.outputs.model_file import servo_file

_STEPS = 3
"""That `identify` tells of."""


def run(options: Options) -> int:
    """Identify, then write all outputs, then print."""
    outputs = (options.json, options.save, options.html)
    check_targets(outputs, {"a log": options.logs, "the aircraft file": [options.config]})
    aircraft = known_aircraft(options.config)
    with progress("identify", _STEPS) as step:
        found = identify(options.logs, aircraft, surface=options.surface, order=options.order, progress=step)
    source = ", ".join(Path(log).name for log in options.logs)
    report = identify_report(found, source)
    if options.save and not found.not_told:
        write_whole(options.save, servo_file(found, Path(options.save).stem, source).encode())
    show(report, json=options.json, html=options.html)
    if found.not_told and options.save:
        complain(f"{options.save} was not written: a servo that a test does not tell is no model")
    return 2 if found.not_told else 0
