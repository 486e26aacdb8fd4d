"""What one log has of outputs, sticks and supply: read once, in units that every check shares."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from logparsers.records import FlightLog
from servofd.aircraft.outputs import HALF_TRAVEL_US, WITHOUT_SURFACES, named_outputs, outputs_of, pulse_channel
from servofd.aircraft.series import FLIES_M_S
from servofd.axes.motion import SHARES, Motion, Series, airspeed_of, chosen, series_of
from servofd.axes.px4 import Control, controls_of
from servofd.axes.read import motion_of
from servofd.core.errors import NoMeasurement
from servofd.core.series import stretches
from servofd.core.types import BoolArray, FloatArray
from servofd.flight.change import airborne


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """One flight, as the checks need it.

    `outputs`: those of surfaces; empty if the log does not say which they are. `motion`: on one grid; None if the log
    lacks something for it, `lacking`. `flies`: where the aircraft surely flies, on that grid. `span_s`: from take-off
    to landing, or to the end of the log [s]; NaN if it never flew, or that is not known. `sticks`: what the pilot asked
    of each axis [us]. `supply_v`: of the servos' rail. `left_out`: why a part of the log was not judged.
    """

    outputs: tuple[Control, ...]
    motion: Motion | None
    lacking: str
    flies: BoolArray
    span_s: tuple[float, float]
    sticks: Mapping[str, Series]
    supply_v: Series | None
    left_out: str = ""

    def within(self, begin_s: float, end_s: float) -> Flight:
        """A part of the log."""
        outputs = tuple(one for each in self.outputs if (one := each.within(begin_s, end_s)).time_s.size > 1)
        supply = None if self.supply_v is None else self.supply_v.within(begin_s, end_s)
        flight = replace(self, outputs=outputs, supply_v=supply if supply and supply.values.size else None)
        if self.motion is None:
            return flight
        motion = self.motion.within([(begin_s, end_s)])
        flies, _ = airborne(motion)
        sure_s = motion.time_s[flies]
        span_s = (float(sure_s[0]), float(sure_s[-1])) if sure_s.size else (np.nan, np.nan)
        return replace(flight, motion=motion, flies=flies, span_s=span_s)

    def each(self) -> tuple[Flight, ...]:
        """Every flight by itself, from the landing before it on; and what was not taken for a landing is said.

        On the ground trim and payload change: of 116 pairs of healthy flights of ALFA, each of one day, 27 of the
        second ones look wrong beside the first, none by itself.
        """
        motion, landed_s, since = self.motion, [-np.inf], 0
        if motion is None:
            return (self,)
        said = [self.left_out] if self.left_out else []
        for first, last in stretches(motion.present & (motion.airspeed_m_s <= FLIES_M_S)):
            begin_s, end_s = (float(motion.time_s[place]) for place in (first, last - 1))
            if end_s - begin_s < _LANDED_S or not self.flies[since:first].any():
                continue
            if np.ptp(np.quantile(motion.roll_deg[first:last], (0.1, 0.9))) > _ROCKS_DEG:
                reads = (
                    f"the airspeed reads {np.median(motion.airspeed_m_s[first:last]):.0f} m/s though the aircraft banks"
                )
                said.append(f"from {begin_s:.0f} to {end_s:.0f} s {reads} (a blocked pitot?): nothing there was judged")
            elif self.flies[last:].any():
                landed_s.append(begin_s)
                since = last
        flight = replace(self, left_out="; ".join(said))
        return tuple(flight.within(*part) for part in pairwise([*landed_s, np.inf])) if since else (flight,)

    def at(self, time_s: FloatArray, flags: BoolArray) -> BoolArray:
        """Flags on the grid of `motion` at some times; none outside."""
        if self.motion is None:
            return np.zeros(time_s.size, dtype=bool)
        grid_s = self.motion.time_s
        place = np.clip(np.searchsorted(grid_s, time_s), 0, grid_s.size - 1)
        inside: BoolArray = (time_s >= grid_s[0]) & (time_s <= grid_s[-1])
        inside &= flags[place]
        return inside


_LANDED_S, _ROCKS_DEG = 20.0, 5.0
"""A stall is slow for shorter than that, an aircraft that stands between two flights for longer [s]; and one that
stands keeps its bank."""
_DECIDES = re.compile(r"SERVO\d+_(FUNCTION|REVERSED)|CA_SV_CS\d_(TYPE|TRQ_[RPY])")
"""Settings that decide which surface an output turns, and which way."""
_STICKS = {
    "roll": ("RCMAP_ROLL", 1, "y", "roll", 1.0),
    "pitch": ("RCMAP_PITCH", 2, "x", "pitch", -1.0),
    "yaw": ("RCMAP_YAW", 4, "r", "yaw", 1.0),
}
"""Parameter that names the channel of each stick, and ArduPilot's default; fields of PX4's manual_control_setpoint,
before and since PX4 1.14, and their sign: a pitch stick forward lowers the nose."""


def flight_of(log: FlightLog) -> Flight:
    """Outputs, motion, sticks and supply of a log, as far as it has them."""
    log, (begin_s, end_s), left_out = _as_set(log)
    motion, lacking = None, ""
    try:
        motion = motion_of(log)
    except NoMeasurement as error:
        lacking = str(error).removeprefix(f"{log.label}: ")
    nowhere, never = np.zeros(0, dtype=bool), (np.nan, np.nan)
    whole = Flight(_outputs(log), motion, lacking, nowhere, never, _sticks(log), _supply(log), left_out)
    return whole.within(begin_s, end_s)


def _as_set(log: FlightLog) -> tuple[FlightLog, tuple[float, float], str]:
    """The longest part of a log in which each output turned the same surface, with the settings of that part.

    And what is said of the rest. A trim that the autopilot moves in flight stays the one that its pilot had set.
    """
    first_s, last_s = log.ends_s
    swapped = [one for one in log.changed if _DECIDES.fullmatch(one.name) and first_s < one.time_s < last_s]
    edges_s = [first_s, *(one.time_s for one in swapped), last_s]
    k = int(np.argmax(np.diff(edges_s)))
    begin_s, end_s = (edges_s[k], edges_s[k + 1]) if swapped else (-np.inf, np.inf)
    # Of those that decide, the ones in force there; of a trim that moves in flight, the one before; else the last.
    in_force_s, airborne_s = begin_s if swapped else first_s, _airborne_s(log) if log.changed else np.inf
    settings = dict(log.parameters)
    for one in reversed(log.changed):
        until_s = in_force_s if _DECIDES.fullmatch(one.name) else airborne_s if one.name.endswith("_TRIM") else np.inf
        if one.time_s > until_s:
            settings[one.name] = one.before
    parts = [f"before {begin_s:.0f} s"] * (k > 0) + [f"after {end_s:.0f} s"] * (k < len(swapped))
    names = sorted({one.name for one in swapped})
    which = " and ".join(names) if len(names) < _MANY else f"{names[0]} and {len(names) - 1} more settings"
    said = f"{which} changed while the log ran: nothing {' or '.join(parts)} was judged" if swapped else ""
    return replace(log, parameters=settings), (begin_s, end_s), said


def _airborne_s(log: FlightLog) -> float:
    """When the aircraft first flew [s]; infinite if the log does not show it."""
    try:
        airspeed, _ = airspeed_of(log)
    except NoMeasurement:
        return np.inf
    fast_s = airspeed.time_s[airspeed.values > FLIES_M_S]
    return float(fast_s[0]) if fast_s.size else np.inf


_MANY = 3
"""Names from which on a sentence gives the first and the number of the rest."""


def _outputs(log: FlightLog) -> tuple[Control, ...]:
    if log.format == "ulog":
        return () if log.vehicle in WITHOUT_SURFACES else controls_of(log)
    outputs = outputs_of(log.parameters)
    serving = {number: dict(SHARES[each.function or 0]) for number, each in outputs.items() if each.function in SHARES}
    names = named_outputs(outputs, sorted(serving))
    found = []
    for number in sorted(serving):
        output, series = outputs[number], series_of(log, pulse_channel(log.channels, number))
        if series is None:
            continue
        sent = series.values > 0.0
        span_us = output.max_us - output.min_us
        if np.count_nonzero(sent) < 2 or span_us <= 0.0:
            continue
        middle_us = (output.max_us + output.min_us) / 2.0
        share = 2.0 * output.sign * (series.values[sent] - middle_us) / span_us
        trim = 2.0 * output.sign * (output.trim_us - middle_us) / span_us
        found.append(Control(series.time_s[sent], share, names[number], serving[number], trim, span_us))
    return tuple(found)


def _sticks(log: FlightLog) -> dict[str, Series]:
    found: dict[str, Series] = {}
    for axis, (parameter, usual, *of_px4, way) in _STICKS.items():
        number = int(log.parameters.get(parameter, usual))
        turned = log.parameters.get(f"RC{number}_REVERSED") == 1.0 or log.parameters.get(f"RC{number}_REV") == -1.0
        choices = [([name], -1.0 if turned else 1.0) for name in (f"RC_CHANNELS.chan{number}_raw", f"RCIN.C{number}")]
        choices += [([f"manual_control_setpoint[0].{name}"], way * HALF_TRAVEL_US) for name in of_px4]
        if moved := chosen(log, choices):
            found[axis] = moved[0]
    return found


def _supply(log: FlightLog) -> Series | None:
    for name, scale in (("POWR.VServo", 1.0), ("POWR.Vservo", 1.0), ("POWER_STATUS.Vservo", 1e-3)):
        series = series_of(log, name, scale)
        if series is not None and float(np.median(series.values)) > 1.0:
            return series
    return None
