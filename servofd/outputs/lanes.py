"""What else a log tells of a flight, beside its charts: channels to lay below them, flight modes, and messages."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from logparsers.modes import modes_of
from servofd.outputs.chart import Chart, Curve, Panel
from servofd.outputs.sentence import clock

if TYPE_CHECKING:
    from logparsers.records import FlightLog

MOST = 12
"""Lanes of a page: with `_POINTS` each they are 20 kB of it."""
_POINTS = 300
"""Points of a lane."""
_SHOWN = re.compile(
    r"(?:ATT\.(?:Roll|Pitch|Yaw)|ARSP(?:\[0\])?\.Airspeed|BAT(?:\[0\])?\.(?:Volt|Curr)|POWR\.V(?:Servo|cc)"
    r"|CTUN\.ThO|BARO(?:\[0\])?\.Alt|ATTITUDE\.(?:roll|pitch|yaw)|VFR_HUD\.(?:airspeed|throttle|alt)"
    r"|SYS_STATUS\.(?:voltage|current)_battery|airspeed\[0\]\.indicated_airspeed_m_s"
    r"|battery_status\[0\]\.(?:voltage_v|current_a)|system_power\[0\]\.voltage5v_v)"
)
"""Of an autopilot's hundreds of channels: attitude, airspeed, supply, throttle, height; modes have a band."""
_OF_SURFACES = re.compile(r".*_(?:cmd|pos)_(?:deg|rad)|d[aefr]\w*|time")


def lanes_of(log: FlightLog) -> list[dict[str, Any]]:
    """Channels that are not those of surfaces: name, unit, outline (as of `Chart.paths`), and the ends of its axes.

    Examples
    --------
    >>> import logparsers
    >>> [lane["name"] for lane in lanes_of(logparsers.read("sample_logs/telemetry_stuck.tlog"))][:3]
    ['ATTITUDE.roll', 'ATTITUDE.pitch', 'ATTITUDE.yaw']
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
        steady = 1.0 if np.ptp(known) == 0.0 else 1e-9
        panel = Panel.around(name, channel.unit, [Curve(name, "other", channel.time_s, channel.values)], steady)
        first_s, last_s = float(channel.time_s[0]), float(channel.time_s[-1])
        ((_, path),) = Chart("", "", first_s, last_s, (panel,), points=_POINTS).paths(panel)
        lanes.append(
            {"name": name, "unit": channel.unit, "low": panel.low, "high": panel.high}
            | {"first": first_s, "last": last_s, "path": path}
        )
    return lanes


MOST_SAID = 80
"""Messages of a page: the gravest of a log that has more."""
_OF_ITS_PLACE = re.compile(r"\d\.\d{4,}|[0-9A-Fa-f]{8}")
"""Coordinates, and the numbers of boards and builds: a page shows neither the place nor the hardware of a flight."""
_LEAST_GRAVE = 8
"""Severity of a message without one: below the least grave of MAVLink, 7."""


def said(log: FlightLog) -> list[tuple[float, str]]:
    """Time [s] and text of the autopilot's messages in a log.

    Examples
    --------
    >>> from pathlib import Path
    >>> from logparsers.records import FlightLog, Text
    >>> texts = (Text(3.0, "Throttle armed"), Text(float("nan"), "no time"), Text(4.0, "Home -35.36326 149.16523"))
    >>> said(FlightLog(Path("a.bin"), "dataflash", {}, texts=texts))
    [(3.0, 'Throttle armed')]
    """
    messages = [one for one in log.texts if np.isfinite(one.time_s) and one.text and not _OF_ITS_PLACE.search(one.text)]
    gravest = sorted(messages, key=lambda one: _LEAST_GRAVE if one.severity is None else one.severity)[:MOST_SAID]
    return sorted({(one.time_s, one.text) for one in gravest})


def beside(log: FlightLog) -> dict[str, Any]:
    """What the script of a page lays beside its charts: channels, modes and messages, each with its time [s]."""
    return {"lanes": lanes_of(log), "modes": modes_of(log), "said": said(log)}


def diary(log: FlightLog) -> list[tuple[str, str]]:
    """Rows of a table: when an autopilot changed its mode or sent a message, and which."""
    changes = [(at_s, f"mode: {mode}") for at_s, mode in modes_of(log)]
    return [(clock(at_s), words) for at_s, words in sorted([*changes, *said(log)])]
