"""An aircraft drafted from what an autopilot's log says about itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.aircraft.pairs import Pair, find_pairs, pulse_channel
from servofd.aircraft.schema import Aircraft
from servofd.aircraft.segment import Segment, cut
from servofd.core.errors import NoMeasurement
from servofd.detection.plausible import PERSISTENCE
from servofd.feedback.advice import what_to_log
from servofd.feedback.fit import RoughFit, fit_roughly
from servofd.feedback.fitted import LONGEST_PERIOD_S, SHORTEST_PERIOD_S, draft_tolerance

if TYPE_CHECKING:
    from logparsers.records import FlightLog
    from servofd.core.evidence import ModelOrigin
    from servofd.feedback.fitted import Drafted

_FULL_NORM_DEG = 25.0
_ANGLES = {"deg", "rad"}


_FEWEST_PULSES, _SAME_COMMAND = 100, 0.9
_REPEATED_AFTER_S = np.arange(0.0, 0.11, 0.01)
"""How much later than its pulse a log may have the angle that a servo was asked for: ArduPlane's driver of Volz servos,
which asks in a thread of its own, has it 20 to 30 ms later."""
_MOST_OUTPUTS = 32
"""Of an ArduPilot; a damaged log may name any other."""


@dataclass(frozen=True, slots=True)
class DraftedSurface:
    """Entries of one surface in an aircraft file, and where they come from."""

    pair: Pair
    fit: RoughFit
    command: dict[str, Any]
    measured: dict[str, Any]
    drafted: Drafted | None = None
    """Tolerances under which this log raises no alarm but where it contradicts itself; None where nothing fits."""

    @property
    def origin(self) -> ModelOrigin:
        """What the model has earned."""
        return self.fit.origin if self.drafted else self.fit.origin.model_copy(update={"origin": "none"})


@dataclass(frozen=True, slots=True)
class Draft:
    """A drafted aircraft."""

    log: FlightLog
    surfaces: tuple[DraftedSurface, ...]

    def aircraft(self) -> Aircraft:
        """The aircraft, ready for an audit."""
        return Aircraft.model_validate(
            {
                "name": self.log.vehicle or self.log.format,
                "servos": {f"{s.pair.surface}-draft": servo_entry(s) for s in self.surfaces},
                "surfaces": {s.pair.surface: surface_entry(s) for s in self.surfaces},
            }
        )


def draft_aircraft(log: FlightLog) -> Draft:
    """Find the servos with feedback in an autopilot's log and fit each one roughly.

    Outputs are paired with positions through the autopilot's parameters; pulses become degrees by the firmware's
    formula, or by a straight line fitted to the position where the servo itself does not repeat its command.
    """
    surfaces = [_draft(log, pair) for pair in find_pairs(log)]
    if not surfaces:
        raise NoMeasurement(f"{log.label}: no measured deflection in this log: {what_to_log(log)}")
    return Draft(log, tuple(surfaces))


def surface_entry(surface: DraftedSurface) -> dict[str, Any]:
    """Entry of a surface in an aircraft file."""
    entry: dict[str, Any] = {"servo": f"{surface.pair.surface}-draft"}
    if 1 <= surface.pair.output.number <= _MOST_OUTPUTS:
        entry["output"] = surface.pair.output.number
    if surface.drafted is not None:
        entry |= {
            "threshold": "interval",
            "threshold_deg": surface.drafted.level_deg,
            "tolerance": surface.drafted.tolerance.model_dump(),
            "persistence": PERSISTENCE,
            "suspicions": False,
        }
    entry["model"] = {key: _short(value) for key, value in surface.origin.model_dump(exclude_none=True).items()}
    if surface.pair.position.alive:
        entry["alive"] = surface.pair.position.alive
    return entry | {"command": surface.command, "measured": surface.measured}


def _short(value: object) -> object:
    return round(value, 4) if isinstance(value, float) else value


def servo_entry(surface: DraftedSurface) -> dict[str, Any]:
    """Entry of the fitted servo in an aircraft file."""
    fit = surface.fit
    entry: dict[str, Any] = {
        "title": f"servo on output {surface.pair.output.number}, fitted roughly to the log",
        "bandwidth_hz": round(fit.bandwidth_hz, 3),
        "damping": round(fit.damping, 3),
        "delay_s": round(fit.delay_s, 4),
        "hold": "zoh",
        "source": "rough fit to one log",
    }
    if np.isfinite(fit.rate_limit_deg_s):
        entry["rate_limit_deg_s"] = round(fit.rate_limit_deg_s, 1)
    return entry


def _draft(log: FlightLog, pair: Pair) -> DraftedSurface:
    """Draft of one surface; with an ordinary servo if its position is no measurement."""
    command_unit = log[pair.command].unit
    angle_command = pair.command == pair.position.command
    command = _command_entry(pair, command_unit, is_angle=angle_command)
    if angle_command and command["unit"] == "deg":
        command |= _as_pulse(log, pair)
    measured_unit = log[pair.position.channel].unit or "deg"
    if measured_unit not in _ANGLES:
        raise NoMeasurement(
            f"{log.label}: {pair.position.channel} is in {measured_unit}, not in deg or rad: "
            "tell in an aircraft file (-c) how to read it"
        )
    measured = {"channel": pair.position.channel, "unit": measured_unit}
    try:
        segment = _cut(log, pair, command, measured)
    except NoMeasurement:
        return DraftedSurface(pair, RoughFit(), command, measured)
    if not SHORTEST_PERIOD_S < segment.period_s < LONGEST_PERIOD_S:
        return DraftedSurface(pair, RoughFit(), command, measured)
    fit = fit_roughly(segment, free_scale=not angle_command)
    if fit.origin.origin != "fitted":
        return DraftedSurface(pair, fit, command, measured)
    if not angle_command:
        command = _rescaled(command, fit)
        fit = fit.of_position
        segment = _cut(log, pair, command, measured)
    return DraftedSurface(pair, fit, command, measured, draft_tolerance(fit.model, segment, until_s=fit.until_s))


def _cut(log: FlightLog, pair: Pair, command: dict[str, Any], measured: dict[str, Any]) -> Segment:
    entry = {"command": command, "measured": measured, "alive": pair.position.alive}
    aircraft = Aircraft.model_validate({"surfaces": {pair.surface: entry}})
    return cut(log, pair.surface, aircraft.surfaces[pair.surface])


def _command_entry(pair: Pair, unit: str, *, is_angle: bool) -> dict[str, Any]:
    if is_angle:
        return {"channel": pair.command, "unit": unit if unit in _ANGLES else "deg"}
    if "actuator_servos" in pair.command:
        return {"channel": pair.command, "unit": "norm", "trim": 0.0, "slope_deg": _FULL_NORM_DEG}
    output = pair.output
    return {
        "channel": pair.command,
        "unit": "us",
        "sign": output.sign,
        "trim_us": output.trim_us,
        "slope_deg_per_us": round(output.slope_deg_per_us, 6),
    }


def _as_pulse(log: FlightLog, pair: Pair) -> dict[str, Any]:
    """The same command as a pulse, if the log has that too: other logs of the aircraft may have nothing else."""
    name = pulse_channel(log.channels, pair.output.number)
    if not name or log[name].unit not in ("us", ""):
        return {}
    pulses, angles = log[name], log[pair.command]
    rows = (pulses.values > 0.0) & np.isfinite(pulses.values)
    sent_us, sent_s = pulses.values[rows], pulses.time_s[rows]
    if sent_us.size < _FEWEST_PULSES or np.ptp(sent_us) < 1.0:
        return {}
    repeated = np.isfinite(angles.values)
    order = np.argsort(angles.time_s[repeated], kind="stable")
    angle_s, angle_deg = angles.time_s[repeated][order], angles.values[repeated][order]
    best, asked_deg = 0.0, np.zeros(0)
    for lag_s in _REPEATED_AFTER_S:
        after = np.searchsorted(angle_s, sent_s + lag_s, side="right") - 1
        held_deg = angle_deg[np.maximum(after, 0)] if angle_deg.size else angle_deg
        if held_deg.size and np.ptp(held_deg) > 0.0:
            alike = abs(np.corrcoef(sent_us, held_deg)[0, 1])
            if alike > best:
                best, asked_deg = alike, held_deg
    if best < _SAME_COMMAND:
        return {}
    slope, offset_deg = np.polyfit(sent_us, asked_deg, 1)
    for _ in range(3):  # pulses that the servo repeats later or never are on another line
        off_deg = np.abs(asked_deg - offset_deg - slope * sent_us)
        near = off_deg <= max(2.0 * np.median(off_deg), 1e-6)
        if np.ptp(sent_us[near]) < 1.0:
            break
        slope, offset_deg = np.polyfit(sent_us[near], asked_deg[near], 1)
    return {"pulse": [round(float(-offset_deg / slope), 2), round(float(slope), 6)]}


def _rescaled(command: dict[str, Any], fit: RoughFit) -> dict[str, Any]:
    """Command entry with the fitted straight line: gain (value - trim) + bias."""
    slope_key, trim_key = ("slope_deg_per_us", "trim_us") if command["unit"] == "us" else ("slope_deg", "trim")
    slope = command[slope_key]
    sign = int(np.sign(fit.gain)) * command.get("sign", 1)
    trim = command[trim_key] - fit.bias_deg / (fit.gain * command.get("sign", 1) * slope)
    return {**command, "sign": sign, trim_key: round(float(trim), 4), slope_key: round(abs(fit.gain) * slope, 6)}
