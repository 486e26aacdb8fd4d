"""Other channels of a log, which the reader of a page may lay below a chart: aircraft, air and supply."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.outputs.chart import Chart, Curve, Panel

if TYPE_CHECKING:
    from logparsers.records import FlightLog

MOST = 12
"""Lanes of a page: with `_POINTS` each they are 40 kB of it."""
_POINTS = 500
"""Points of a lane."""
_ROOM = 0.06
"""Room above and below a lane, as a share of its range."""
_SHOWN = re.compile(
    r"(?:ATT\.(?:Roll|Pitch|Yaw)|ARSP(?:\[0\])?\.Airspeed|BAT(?:\[0\])?\.(?:Volt|Curr)|POWR\.V(?:Servo|cc)|MODE\.ModeNum"
    r"|CTUN\.ThO|BARO(?:\[0\])?\.Alt|ATTITUDE\.(?:roll|pitch|yaw)|VFR_HUD\.(?:airspeed|throttle|alt)"
    r"|SYS_STATUS\.(?:voltage|current)_battery|HEARTBEAT\.custom_mode|airspeed\[0\]\.indicated_airspeed_m_s"
    r"|battery_status\[0\]\.(?:voltage_v|current_a)|system_power\[0\]\.voltage5v_v|vehicle_status\[0\]\.nav_state)"
)
"""Of an autopilot's hundreds of channels: attitude, airspeed, supply, throttle, height, mode."""
_OF_SURFACES = re.compile(r".*_(?:cmd|pos)_(?:deg|rad)|d[aefr]\w*|time")


def lanes_of(log: FlightLog) -> list[dict[str, Any]]:
    """Channels that are not those of surfaces: name, unit, outline (as of `Chart.paths`), and the ends of its axes.

    Examples
    --------
    >>> import logparsers
    >>> [lane["name"] for lane in lanes_of(logparsers.read("sample_logs/telemetry_stuck.tlog"))][:3]
    ['HEARTBEAT.custom_mode', 'ATTITUDE.roll', 'ATTITUDE.pitch']
    """
    wanted = [
        name
        for name in log.channels
        if (_SHOWN.fullmatch(name) if log.is_of_autopilot else not _OF_SURFACES.fullmatch(name))
    ]
    lanes = []
    for name in wanted[:MOST]:
        channel = log[name]
        known = channel.values[np.isfinite(channel.values)]
        if channel.time_s.size < 2 or not known.size or channel.time_s[-1] <= channel.time_s[0]:
            continue
        low, high = float(known.min()), float(known.max())
        room = _ROOM * (high - low) or 1.0
        panel = Panel(
            name, channel.unit, (Curve(name, "other", channel.time_s, channel.values),), low - room, high + room
        )
        first_s, last_s = float(channel.time_s[0]), float(channel.time_s[-1])
        ((_, path),) = Chart("", "", first_s, last_s, (panel,), points=_POINTS).paths(panel)
        lanes.append(
            {"name": name, "unit": channel.unit, "low": panel.low, "high": panel.high}
            | {"first": first_s, "last": last_s, "path": path}
        )
    return lanes
