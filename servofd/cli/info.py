"""``servofd info``: what is in a log, and whether it can be audited."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from servofd.cli.terminal import print_document, say
from servofd.jobs.survey import survey
from servofd.outputs.document import Bullets, Document, Table

if TYPE_CHECKING:
    from servofd.cli.options import Options
    from servofd.jobs.survey import Survey

_SHOWN = 3
"""Alarms of another program whose times are listed."""
_ON_BOARD = (
    "in flight: `servofd onboard AIRCRAFT.toml -o servofd.lua` writes the script that watches these servos on the "
    "autopilot; copy it to APM/scripts, set SCR_ENABLE = 1"
)


def run(options: Options) -> int:
    """Survey the log and print."""
    surveys = survey(options.log, options.config, every_channel=options.channels)
    if options.json:
        say(json.dumps({"schema": "servofd.info/1", "logs": [s.as_dict() for s in surveys]}, indent=2))
    else:
        for found in surveys:
            print_document(_report(found))
    return 0


def _report(found: Survey) -> Document:
    log = found.log
    about = (("vehicle", log.vehicle), ("firmware", log.firmware), ("booted", log.start_utc))
    lines = [f"{label}: {value}" for label, value in about if value]
    lines += [f"damage: {damage.kind}: {damage.note}" for damage in log.damage_summary]
    advice = [f"to audit this aircraft: {found.advice}"] if found.advice else []
    if not found.on_board and log.format in ("dataflash", "tlog") and found.surfaces:
        advice.insert(0, _ON_BOARD)
    surfaces = [
        (
            s.name,
            s.verdict,
            _rate(s.position_hz),
            _rate(s.command_hz),
            ", ".join(filter(None, (s.command, s.position, s.current))),
        )
        for s in found.surfaces
    ]
    channels = [
        (c.name, c.unit, str(c.samples), _rate(c.rate_hz), str(c.gaps), f"{c.longest_gap_s:.2f}")
        for c in found.channels
    ]
    on_board = []
    for seen in found.on_board:
        times = ", ".join(f"{time_s:.2f}" for time_s in seen.alarms_s[:_SHOWN])
        more = f", and {len(seen.alarms_s) - _SHOWN} more" if len(seen.alarms_s) > _SHOWN else ""
        share = "not judged" if seen.peak_share is None else f"{seen.peak_share:.2f}"
        on_board.append((seen.name, str(seen.samples), share, f"{times}{more}" or "never"))
    count = f"{len(log.channels)} channel{'' if len(log.channels) == 1 else 's'}"
    return Document(
        title=log.label,
        status="no_data",
        sentence="",
        facts=f"{log.label}: {log.format}, {log.duration_s:.1f} s, {count}",
        parts=[
            Bullets(lines),
            Table("", ("surface", "can be audited", "position [Hz]", "command [Hz]", "channels"), surfaces),
            Table("", ("channel", "unit", "samples", "rate [Hz]", "gaps", "longest gap [s]"), channels),
            Table("", ("seen on board", "positions", "largest residual / threshold", "over it at [s]"), on_board),
            Bullets(advice),
        ],
    )


def _rate(rate_hz: float | None) -> str:
    return "-" if rate_hz is None else f"{rate_hz:.1f}"
