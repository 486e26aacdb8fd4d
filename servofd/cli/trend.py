"""``servofd trend``: one aircraft over many flights."""

from __future__ import annotations

from functools import partial

from servofd.cli.options import Options
from servofd.cli.terminal import check_targets, complain, progress, show, worst
from servofd.outputs.page import beside
from servofd.outputs.trend_report import trend_report
from servofd.wear.trend import trend_document, trend_logs

_SHOWN = 5
"""Logs that could not be used and are listed by name."""


def run(options: Options) -> int:
    """Follow, write what was asked for, print."""
    check_targets((options.json, options.html), {"a log": options.logs, "the aircraft file": [options.config]})
    shown, surfaces = partial(progress, "trend"), tuple(options.surface)
    seen = trend_logs(options.logs, options.config, surfaces=surfaces, workers=options.workers, progress=shown)
    pages = beside(options.html)[1] if options.html else {}
    show(trend_report(trend_document(seen), pages), json=options.json, html=options.html)
    for problem in seen.problems[:_SHOWN]:
        complain(problem)
    if len(seen.problems) > _SHOWN:
        complain(f"and {len(seen.problems) - _SHOWN} more like these")
    return worst([int(seen.has_alarm), 2 if seen.not_judged else 0])
