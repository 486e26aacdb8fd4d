"""What a log holds, and what can be done with it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from logparsers import Channel, FlightLog
from servofd.aircraft.current_source import current_sources, rails_of, read_current
from servofd.aircraft.outputs import output_of
from servofd.aircraft.pace import SLOWEST_RATE_HZ
from servofd.aircraft.schema import Aircraft
from servofd.aircraft.series import asked, channel_of, cut
from servofd.core.errors import NoMeasurement
from servofd.feedback.draft import what_to_log
from servofd.feedback.flown import known_aircraft, logs_of, surfaces_of
from servofd.onboard.seen import seen_on_board

_GAP_PERIODS = 5.0
"""Longer than so many sample periods is a gap."""
_RATE_PER_BANDWIDTH = 10.0
"""Samples that a period of the fastest motion needs, so that a residual filter can follow it."""
_BY_CURRENT = (
    "by its current: whether a servo is blocked or has no power, and once calibrated whether it binds or wears"
)


def survey(
    path: str | Path, aircraft: str | Path | None = None, *, every_channel: bool = False
) -> list[dict[str, Any]]:
    """Look into a log; what each run holds, and what can be done with it, as plain dictionaries and lists.

    `aircraft`: aircraft file; left out, the log's own description is used as far as there is one. `every_channel`:
    survey all channels, not only those of surfaces.

    Examples
    --------
    >>> (found,) = survey("sample_logs/faser_stuck_flight.mat")
    >>> round(found["surfaces"][0]["position_hz"])
    100
    """
    known = known_aircraft(aircraft)
    return [_survey(log, known, every_channel) for log in logs_of(path, known)]


def _survey(log: FlightLog, known: Aircraft | None, every_channel: bool) -> dict[str, Any]:
    why, aircraft = "", None
    try:
        aircraft = surfaces_of(log, known)
    except NoMeasurement as reason:
        why = str(reason).removeprefix(f"{log.label}: ")
    surfaces = list(_with_currents(log, aircraft)) if aircraft else []
    unfit = not surfaces or any(not surface["verdict"].startswith("yes") for surface in surfaces)
    return {
        "path": str(log.source),
        "run": log.run or None,
        "format": log.format,
        "duration_s": log.duration_s,
        "vehicle": log.vehicle or None,
        "firmware": log.firmware or None,
        "start_utc": log.start_utc.isoformat() if log.start_utc else None,
        "channels": len(log.channels),
        "damage": [asdict(damage) for damage in log.damage_summary],
        "surfaces": surfaces,
        "by_current": _BY_CURRENT if any(surface["current_hz"] for surface in surfaces) else None,
        "rails": rails_of(log, [surface["current"] for surface in surfaces]) or None,
        "on_board": _on_board(log, aircraft),
        "channel_details": [_channel(log[name]) for name in log.channels] if every_channel else [],
        "advice": (what_to_log(log) if unfit and log.is_of_autopilot else why) or None,
    }


def _with_currents(log: FlightLog, aircraft: Aircraft) -> Iterator[dict[str, Any]]:
    """Each surface, with what its current allows beside its position, or instead of it."""
    sources, unfit = current_sources(log, aircraft)
    for name in aircraft.surfaces:
        found, source = _surface(log, aircraft, name), sources.get(name)
        found["verdict"] += f"; {unfit[name]}" if name in unfit else ""
        if source is not None:
            found["current"], can = source.channel, found["verdict"]
            try:
                asked(aircraft.surfaces[name], channel_of(log, found["command"], "command"))
                found["current_hz"] = _rate(read_current(log, source).time_s)
                found["verdict"] = f"{can}; and by its current" if can.startswith("yes") else "yes, by its current"
                found["position"] = found["position"] if found["position"] in log.channels else "-"
            except NoMeasurement as reason:
                found["verdict"] += f"; {reason}"
        yield found


def _surface(log: FlightLog, aircraft: Aircraft, name: str) -> dict[str, Any]:
    """Its channels with their rates [Hz], and the verdict: "yes", with what the rate allows; or why not."""
    surface = aircraft.surfaces[name]
    found: dict[str, Any] = {
        "name": name,
        "command": surface.command.channel,
        "position": surface.measured.channel if surface.measured else "-",
        **dict.fromkeys(("command_hz", "position_hz")),
        "current": "",
        "current_hz": None,
    }
    try:
        segment = cut(log, name, aircraft)
    except NoMeasurement as reason:
        return found | {"verdict": f"no: {reason}"}
    position_hz = round(1.0 / segment.period_s, 3) if segment.period_s > 0.0 else None
    if position_hz is None:
        verdict = "no: fewer than two positions"
    elif position_hz < SLOWEST_RATE_HZ:
        verdict = f"no: {position_hz:.1f} Hz is too slow, {SLOWEST_RATE_HZ:g} Hz are needed"
    else:
        verdict = f"yes, servos of up to {position_hz / _RATE_PER_BANDWIDTH:.1f} Hz bandwidth"
    return found | {"command_hz": _rate(segment.command_s), "position_hz": position_hz, "verdict": verdict}


def _on_board(log: FlightLog, aircraft: Aircraft | None) -> list[dict[str, Any]]:
    """What a script on board saw of each surface; of the output, if the aircraft does not know it."""
    names = {output_of(surface): name for name, surface in aircraft.surfaces.items()} if aircraft else {}
    return [
        {
            "name": names.get(seen.output, f"output {seen.output}"),
            "output": seen.output,
            "samples": seen.time_s.size,
            "peak_share": None if np.isnan(seen.peak_share) else round(seen.peak_share, 3),
            "alarms_s": np.round(seen.crossed_s, 3).tolist(),
        }
        for seen in seen_on_board(log)
    ]


def _channel(channel: Channel) -> dict[str, Any]:
    steps_s = np.diff(channel.time_s)
    period_s = float(np.median(steps_s)) if steps_s.size else 0.0
    return {
        "name": channel.name,
        "unit": channel.unit,
        "samples": channel.time_s.size,
        "rate_hz": _rate(channel.time_s),
        "gaps": int(np.count_nonzero(steps_s > _GAP_PERIODS * period_s)) if period_s > 0.0 else 0,
        "longest_gap_s": float(steps_s.max()) if steps_s.size else 0.0,
    }


def _rate(time_s: np.ndarray[Any, Any]) -> float | None:
    """Median rate [Hz]; None for fewer than two samples."""
    return None if time_s.size < 2 else round(1.0 / float(np.median(np.diff(time_s))), 3)
