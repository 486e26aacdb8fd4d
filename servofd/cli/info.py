"""``servofd info``: what is in a log, and whether it can be audited."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from servofd.cli.terminal import print_table
from servofd.jobs.survey import survey

if TYPE_CHECKING:
    from servofd.cli.options import Options
    from servofd.jobs.survey import Survey


def run(options: Options) -> int:
    """Survey the log and print."""
    surveys = survey(options.log, options.config, every_channel=options.channels)
    if options.json:
        print(json.dumps({"schema": "servofd.info/1", "logs": [s.as_dict() for s in surveys]}, indent=2))
    else:
        for found in surveys:
            _print(found)
    return 0


def _print(found: Survey) -> None:
    log = found.log
    many = "" if len(log.channels) == 1 else "s"
    print(f"{log.label}: {log.format}, {log.duration_s:.1f} s, {len(log.channels)} channel{many}")
    for label, value in (("vehicle", log.vehicle), ("firmware", log.firmware), ("booted", log.start_utc)):
        if value:
            print(f"  {label}: {value}")
    for damage in log.damage_summary:
        print(f"  damage: {damage.kind}: {damage.note}")
    if found.surfaces:
        print_table(
            ["surface", "can be audited", "position [Hz]", "command [Hz]", "channels"],
            [
                [s.name, s.verdict, _rate(s.position_hz), _rate(s.command_hz), f"{s.command}, {s.position}"]
                for s in found.surfaces
            ],
        )
    if found.channels:
        print_table(
            ["channel", "unit", "samples", "rate [Hz]", "gaps", "longest gap [s]"],
            [
                [c.name, c.unit, str(c.samples), _rate(c.rate_hz), str(c.gaps), f"{c.longest_gap_s:.2f}"]
                for c in found.channels
            ],
        )
    if found.on_board:
        print_table(
            ["seen on board", "positions", "largest residual / threshold", "over it at [s]"],
            [[s.name, str(s.samples), _share(s.peak_share), _times(s.alarms_s)] for s in found.on_board],
        )
    elif log.format in ("dataflash", "tlog") and found.surfaces:
        print(
            "  in flight: `servofd onboard AIRCRAFT.toml -o servofd.lua` writes the script that watches these servos "
            "on the autopilot; copy it to APM/scripts, set SCR_ENABLE = 1"
        )
    if found.advice:
        print(f"  to audit this aircraft: {found.advice}")


def _share(share: float | None) -> str:
    return "not judged" if share is None else f"{share:.2f}"


def _times(times_s: tuple[float, ...]) -> str:
    shown = ", ".join(f"{time_s:.2f}" for time_s in times_s[:3])
    return f"{shown}, and {len(times_s) - 3} more" if len(times_s) > 3 else shown or "never"


def _rate(rate_hz: float | None) -> str:
    return "-" if rate_hz is None else f"{rate_hz:.1f}"
