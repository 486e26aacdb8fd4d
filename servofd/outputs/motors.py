"""What a multirotor or a helicopter asked of its motors: an aircraft without control surfaces has no servo to judge."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.axes.mixers import LIFT_MOTORS
from servofd.outputs.chart import Chart, Curve, Panel

if TYPE_CHECKING:
    from collections.abc import Mapping

    from logparsers.records import FlightLog

_NO_SURFACES = frozenset(
    {
        *("multirotor", "quadrotor", "hexarotor", "octorotor", "tricopter", "decarotor", "dodecarotor", "coaxial"),
        "helicopter",
    }
)
_OUTPUT = re.compile(r"(?:RCOU|RCO2|SERVO_OUTPUT_RAW)\.(?:C|Ch|servo)(\d+)(?:_raw)?")
_LEAST_US, _MOST_US = 900.0, 2200.0
_LOWEST_US, _HIGHEST_US = 1000.0, 2000.0
_AT_LIMIT_US = 5.0
"""Nearer to its end an output is saturated: nothing is left for control."""
_RUNS_SHARE = 0.05


def motors_of(log: FlightLog) -> dict[str, Any] | None:
    """Commands and saturation of the motors, for a page; None if the aircraft is none without surfaces.

    Examples
    --------
    >>> from pathlib import Path
    >>> from logparsers import FlightLog
    >>> motors_of(FlightLog(Path("a.bin"), "dataflash", {}, vehicle="fixed wing")) is None
    True
    """
    if log.vehicle not in _NO_SURFACES:
        return None
    names = {int(found[1]): name for name in log.channels if (found := _OUTPUT.fullmatch(name))}
    functions = {number: log.parameters.get(f"SERVO{number}_FUNCTION") for number in names}
    motors = [number for number in sorted(names) if functions[number] is None or functions[number] in LIFT_MOTORS]
    pulses = {}
    for number in motors:
        channel = log[names[number]]
        good = (channel.values > _LEAST_US) & (channel.values < _MOST_US)
        if np.count_nonzero(good) > 1 and np.ptp(channel.values[good]) > 0.0:
            pulses[number] = (channel.time_s[good], channel.values[good])
    if not pulses:
        return {"kind": log.vehicle, "rows": [], "chart": None}
    low, high = _range_us(log.parameters)
    rows, running = [], []
    for number, (_, values) in pulses.items():
        runs = values > low + _RUNS_SHARE * (high - low)
        flown = values[runs] if runs.any() else values
        running.append(float(np.mean(flown)))
        top, bottom = np.mean(flown > high - _AT_LIMIT_US), np.mean(flown < low + _AT_LIMIT_US)
        rows.append((f"output {number}", f"{np.mean(flown):.0f}", f"{flown.max():.0f}", f"{top:.1%}", f"{bottom:.1%}"))
    return {
        "kind": log.vehicle,
        "rows": rows,
        "chart": _chart(pulses, low, high),
        "uneven_us": f"{np.ptp(running):.0f}",
    }


def _range_us(parameters: Mapping[str, float]) -> tuple[float, float]:
    low, high = parameters.get("MOT_PWM_MIN", 0.0), parameters.get("MOT_PWM_MAX", 0.0)
    return (low, high) if 0.0 < low < high else (_LOWEST_US, _HIGHEST_US)


def _chart(pulses: Mapping[int, tuple[Any, Any]], low: float, high: float) -> Chart:
    time_s = next(iter(pulses.values()))[0]
    every = np.array([np.interp(time_s, *one) for one in pulses.values()])
    panel = Panel(
        "motor commands",
        "us",
        (
            Curve("the most of any motor", "measured", time_s, every.max(axis=0)),
            Curve("mean", "simulated", time_s, every.mean(axis=0)),
            Curve("the least of any motor", "command", time_s, every.min(axis=0)),
            Curve("full", "threshold", time_s[[0, -1]], np.full(2, high)),
        ),
        low - 50.0,
        high + 50.0,
    )
    text = "Where the upper line reaches its end, a motor has nothing left to hold the attitude with."
    return Chart("What was asked of the motors", text, float(time_s[0]), float(time_s[-1]), (panel,))
