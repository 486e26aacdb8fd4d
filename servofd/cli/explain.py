"""``servofd explain``: where simulation and measurement disagree, and which effect is missing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from servofd.cli.options import Options
from servofd.cli.terminal import check_targets, complain, one_line, progress, show
from servofd.core.errors import ConfigError
from servofd.core.files import write_whole
from servofd.discrepancy.explanation import KEEP
from servofd.jobs.explaining import explain_logs
from servofd.outputs.explain_report import explain_report
from servofd.outputs.model_file import model_file

_STEPS = 30
"""Effects in the catalogue, for the progress bar."""


def run(options: Options) -> int:
    """Explain, write what was asked for, print."""
    logs = [*options.logs, *options.also]
    inputs = {"a log": logs, "the aircraft file": [options.config], "an effect": [options.effect]}
    check_targets((options.json, options.save, options.rrd, options.html), inputs)
    with progress("explain", _STEPS) as step:
        asked: dict[str, Any] = {"servo": options.servo, "also": options.also, "own": options.effect}
        surfaces = tuple(options.surface)
        found = explain_logs(options.logs, options.config, surfaces=surfaces, **asked, progress=step)
    if found.explanations:
        if options.rrd and len(found.explanations) > 1:
            raise ConfigError(f"{options.rrd}: --rrd takes one surface at a time: choose it with -s")
        names = ", ".join(Path(log).name for log in options.logs)  # what leaves the machine tells nothing of it
        if options.rrd:
            from servofd.outputs.explain_recording import save_explanation

            save_explanation(found.explanations[0], options.rrd, names)
        report = explain_report(found.explanations, names, found.failures)
        report = replace(report, sentence=report.sentence.replace(KEEP, f"{KEEP} with --save"))
        show(report, json=options.json, html=options.html)
    for failure in found.failures:
        complain(failure)
    if found.explanations and options.save:
        text, kept = model_file(found.explanations, found.aircraft, found.source, found.logs)
        for surface, reason in kept.items():
            complain(f"{options.save}: {surface} stays as it was: {one_line(reason)}")
        if text:
            write_whole(options.save, text.encode())
        else:
            complain(f"{options.save} was not written: no surface has a better model that a file can hold")
    left = ("partly_explained", "unexplained")
    is_left = any(one.conclusion in left or one.fault_s is not None for one in found.explanations)
    return 2 if found.failures else int(is_left)
