"""``servofd info``: what is in a log, and whether it can be audited."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from typing import Any

from servofd.cli.options import Options
from servofd.cli.terminal import print_document, say
from servofd.jobs.survey import survey
from servofd.outputs.document import Bullets, Document, Part, Table

_SHOWN = 3
"""Alarms of another program whose times are listed."""
_ON_BOARD = (
    "in flight: `servofd onboard AIRCRAFT.toml -o servofd.lua` writes the script that watches these servos on the "
    "autopilot; copy it to APM/scripts, set SCR_ENABLE = 1"
)
_BY_CURRENT_ALONE = (
    "in flight: `servofd calibrate GOOD... -o AIRCRAFT.toml` learns what they draw, `servofd onboard AIRCRAFT.toml "
    "--stream-only -o servofd.lua` writes the script that sends it, and `servofd monitor` watches them"
)


def run(options: Options) -> int:
    """Survey the log and print."""
    surveys = survey(options.log, options.config, every_channel=options.channels)
    if options.json:
        say(json.dumps({"schema": "servofd.info/1", "logs": surveys}, indent=2))
    else:
        for _, alike in itertools.groupby(surveys, lambda found: (found["path"], *_of(found))):
            print_document(_report(list(alike)))
    return 0


def _report(alike: Sequence[Mapping[str, Any]]) -> Document:
    """What runs of one log hold that are all alike, but for their lengths."""
    first, last = alike[0], alike[-1]
    runs = f" (run {first['run']})" if first["run"] else ""
    label = first["path"] + (f" (runs {first['run']} to {last['run']})" if len(alike) > 1 else runs)
    format_, count, parts = _of(first)
    seconds = dict.fromkeys(f"{side(found['duration_s'] for found in alike):.1f}" for side in (min, max))
    facts = f"{label}: {format_}, {' to '.join(seconds)} s, {count}"
    return Document(title=label, status="no_data", sentence="", facts=facts, parts=parts)


def _of(found: Mapping[str, Any]) -> tuple[str, str, list[Part]]:
    """Format, how many channels, and what is printed of a run below its first line."""
    about = {name: found[name] for name in ("vehicle", "firmware")}
    about["booted"] = (found["start_utc"] or "").replace("T", " ")
    lines = [f"{name}: {value}" for name, value in about.items() if value]
    lines += [f"damage: {damage['kind']}: {damage['note']}" for damage in found["damage"]]
    advice = [found[name] for name in ("by_current", "rails") if found[name]]
    advice += [f"to audit this aircraft: {found['advice']}"] if found["advice"] else []
    if not found["on_board"] and found["format"] in ("dataflash", "tlog") and found["surfaces"]:
        has_position = any(surface["position_hz"] for surface in found["surfaces"])
        alone = bool(found["by_current"]) and not has_position
        advice.insert(bool(found["by_current"]), _BY_CURRENT_ALONE if alone else _ON_BOARD)
    surfaces, channels, on_board = [], [], []
    for s in found["surfaces"]:
        names = ", ".join(filter(None, (s["command"], s["position"], s["current"])))
        surfaces.append((s["name"], s["verdict"], _rate(s["position_hz"]), _rate(s["command_hz"]), names))
    for c in found["channel_details"]:
        gaps = (str(c["gaps"]), f"{c['longest_gap_s']:.2f}")
        channels.append((c["name"], c["unit"], str(c["samples"]), _rate(c["rate_hz"]), *gaps))
    for seen in found["on_board"]:
        alarms_s, peak = seen["alarms_s"], seen["peak_share"]
        times = ", ".join(f"{time_s:.2f}" for time_s in alarms_s[:_SHOWN])
        more = f", and {len(alarms_s) - _SHOWN} more" if len(alarms_s) > _SHOWN else ""
        share = "not judged" if peak is None else f"{peak:.2f}"
        on_board.append((seen["name"], str(seen["samples"]), share, f"{times}{more}" or "never"))
    count = f"{found['channels']} channel{'' if found['channels'] == 1 else 's'}"
    parts: list[Part] = [
        Bullets(lines),
        Table("", ("surface", "can be audited", "position [Hz]", "command [Hz]", "channels"), surfaces),
        Table("", ("channel", "unit", "samples", "rate [Hz]", "gaps", "longest gap [s]"), channels),
        Table("", ("seen on board", "positions", "largest residual / threshold", "over it at [s]"), on_board),
        Bullets(advice),
    ]
    return found["format"], count, parts


def _rate(rate_hz: float | None) -> str:
    return "-" if rate_hz is None else f"{rate_hz:.1f}"
