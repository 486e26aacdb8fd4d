"""What one log has of outputs, sticks and supply: read once, in units that every check shares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from servofd.aircraft.outputs import WITHOUT_SURFACES, named_outputs, outputs_of, pulse_channel
from servofd.axes.motion import SHARES, Series, series_of
from servofd.axes.px4 import controls_of
from servofd.axes.read import motion_of
from servofd.core.errors import NoMeasurement
from servofd.flight.change import airborne

if TYPE_CHECKING:
    from collections.abc import Mapping

    from logparsers.records import FlightLog
    from servofd.axes.motion import Motion
    from servofd.core.types import BoolArray, FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Output:
    """One output that turns a surface.

    Parameters
    ----------
    name : str
        Of the surface.
    axes : mapping of str to float
        Axes that it serves, with its sign in each.
    time_s, share : ndarray, shape (n,)
        What was asked of it: -1 at the MIN of its output, 1 at MAX, reversed outputs turned round.
    trim_share : float
        Its trim in the same unit.
    span_us : float
        From MIN to MAX [us].
    """

    name: str
    axes: Mapping[str, float]
    time_s: FloatArray
    share: FloatArray
    trim_share: float
    span_us: float


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """One flight, as the checks need it.

    Parameters
    ----------
    outputs : tuple of Output
        Those of surfaces; empty if the log does not say which they are.
    motion : Motion or None
        On one grid; None if the log lacks something for it.
    lacking : str
        What it lacks.
    flies : ndarray of bool
        Where the aircraft surely flies, on the grid of `motion`.
    span_s : tuple of float
        From take-off to landing, or to the end of the log [s]; NaN if it never flew, or that is not known.
    sticks : mapping of str to Series
        What the pilot asked of each axis [us].
    supply_v : Series or None
        Voltage of the servos' rail.
    """

    outputs: tuple[Output, ...]
    motion: Motion | None
    lacking: str
    flies: BoolArray
    span_s: tuple[float, float]
    sticks: Mapping[str, Series]
    supply_v: Series | None


_STICKS = {"roll": ("RCMAP_ROLL", 1), "pitch": ("RCMAP_PITCH", 2), "yaw": ("RCMAP_YAW", 4)}
"""Parameter that names the channel of each stick, and ArduPilot's default."""


def flight_of(log: FlightLog) -> Flight:
    """Outputs, motion, sticks and supply of a log, as far as it has them."""
    motion, lacking = None, ""
    try:
        motion = motion_of(log)
    except NoMeasurement as error:
        lacking = str(error).removeprefix(f"{log.label}: ")
    flies, span_s = np.zeros(0, dtype=bool), (np.nan, np.nan)
    if motion is not None:
        flies, _ = airborne(motion)
        if flies.any():
            sure_s = motion.time_s[flies]
            span_s = (float(sure_s[0]), float(sure_s[-1]))
    return Flight(_outputs(log), motion, lacking, flies, span_s, _sticks(log), _supply(log))


def _outputs(log: FlightLog) -> tuple[Output, ...]:
    if log.format == "ulog":
        controls = () if log.vehicle in WITHOUT_SURFACES else controls_of(log)
        return tuple(
            Output(one.name, one.axes, one.series.time_s, one.series.values, one.trim, one.span_us) for one in controls
        )
    outputs = outputs_of(log.parameters)
    serving = {number: dict(SHARES[each.function or 0]) for number, each in outputs.items() if each.function in SHARES}
    names = named_outputs(outputs, sorted(serving))
    found = []
    for number in sorted(serving):
        output, name = outputs[number], pulse_channel(log.channels, number)
        if not name:
            continue
        series = Series.of(log[name])
        sent = series.values > 0.0
        span_us = output.max_us - output.min_us
        if np.count_nonzero(sent) < 2 or span_us <= 0.0:
            continue
        middle_us = (output.max_us + output.min_us) / 2.0
        share = 2.0 * output.sign * (series.values[sent] - middle_us) / span_us
        trim = 2.0 * output.sign * (output.trim_us - middle_us) / span_us
        found.append(Output(names[number], serving[number], series.time_s[sent], share, trim, span_us))
    return tuple(found)


_STICKS_OF_PX4 = {"roll": ("roll", "y", 1.0), "pitch": ("pitch", "x", -1.0), "yaw": ("yaw", "r", 1.0)}
"""Fields of manual_control_setpoint, since and before PX4 1.14; a pitch stick forward lowers the nose."""
_STICK_US = 500.0
"""What 1 of a stick is as a pulse [us]."""


def _sticks(log: FlightLog) -> dict[str, Series]:
    found = {}
    for axis, (now, before, sign) in _STICKS_OF_PX4.items():
        for field in (now, before):
            moved = series_of(log, f"manual_control_setpoint[0].{field}", sign * _STICK_US)
            if moved is not None:
                found[axis] = moved
    for axis, (parameter, usual) in _STICKS.items():
        number = int(log.parameters.get(parameter, usual))
        turned = log.parameters.get(f"RC{number}_REVERSED") == 1.0 or log.parameters.get(f"RC{number}_REV") == -1.0
        sign = -1.0 if turned else 1.0
        for name in (f"RCIN.C{number}", f"RC_CHANNELS.chan{number}_raw"):
            moved = series_of(log, name, sign)
            if moved is not None:
                found[axis] = moved
    return found


def _supply(log: FlightLog) -> Series | None:
    for name, scale in (("POWR.VServo", 1.0), ("POWR.Vservo", 1.0), ("POWER_STATUS.Vservo", 1e-3)):
        series = series_of(log, name, scale)
        if series is not None and float(np.median(series.values)) > 1.0:
            return series
    return None
