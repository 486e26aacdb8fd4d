"""An aircraft drafted from what an autopilot's log says about itself."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.aircraft import DEFAULT_THRESHOLD_DEG, Aircraft
from servofd.detection.residual import ResidualGenerator
from servofd.errors import NoMeasurement
from servofd.feedback.advice import what_to_log
from servofd.feedback.fit import RoughFit, fit_roughly, typical_error_deg
from servofd.feedback.pairs import Pair, find_pairs
from servofd.segment import Segment, cut

if TYPE_CHECKING:
    from logparsers.records import FlightLog

__all__ = ["Draft", "DraftedSurface", "draft_aircraft"]

_ENOUGH_SURFACES = 4
_THRESHOLD_MARGIN = 1.5
_FALLBACK_MARGIN = 20.0
_FULL_NORM_DEG = 25.0
_FIT_FAILS = 2.5
_ENOUGH_SIBLINGS = 2
_SHORTEST_PERIOD_S, _LONGEST_PERIOD_S = 1e-4, 0.2
_ANGLES = {"deg", "rad"}


@dataclass(frozen=True, slots=True)
class DraftedSurface:
    """Entries of one surface in an aircraft file, and where they come from."""

    pair: Pair
    fit: RoughFit
    command: dict[str, Any]
    measured: dict[str, Any]
    peak_deg: float
    """Largest residual of the fitted model in this log [deg]."""
    median_deg: float


@dataclass(frozen=True, slots=True)
class Draft:
    """A drafted aircraft."""

    log: FlightLog
    surfaces: tuple[DraftedSurface, ...]
    threshold_deg: float

    def aircraft(self) -> Aircraft:
        """The aircraft, ready for an audit."""
        return Aircraft.model_validate(
            {
                "name": self.log.vehicle or self.log.format,
                "servos": {f"{s.pair.surface}-draft": servo_entry(s) for s in self.surfaces},
                "surfaces": {
                    s.pair.surface: {
                        "servo": f"{s.pair.surface}-draft",
                        "threshold_deg": self.threshold_deg,
                        "model": {"origin": "fitted"},
                        "alive": s.pair.position.alive,
                        "command": s.command,
                        "measured": s.measured,
                    }
                    for s in self.surfaces
                },
            }
        )


def draft_aircraft(log: FlightLog) -> Draft:
    """Find the servos with feedback in an autopilot's log and fit each one roughly.

    Outputs are paired with positions through the autopilot's parameters; pulses become degrees by the firmware's
    formula, or by a straight line fitted to the position where the servo itself does not repeat its command.

    Parameters
    ----------
    log : FlightLog
        Log of an autopilot.

    Raises
    ------
    NoMeasurement
        If the log holds no position of a servo; the message says what would have to be logged.
    """
    surfaces = [_draft(log, pair) for pair in find_pairs(log)]
    if not surfaces:
        raise NoMeasurement(f"{log.label}: no measured deflection in this log: {what_to_log(log)}")
    surfaces = _helped_by_siblings(log, surfaces)
    return Draft(log, tuple(surfaces), _threshold_deg(surfaces))


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
    if fit.rate_limit_deg_s < RoughFit().rate_limit_deg_s:
        entry["rate_limit_deg_s"] = round(fit.rate_limit_deg_s, 1)
    return entry


def _draft(log: FlightLog, pair: Pair) -> DraftedSurface:
    """Draft of one surface; with an ordinary servo if its position is no measurement."""
    command_unit = log[pair.command].unit
    angle_command = pair.command == pair.position.command
    command = _command_entry(pair, command_unit, is_angle=angle_command)
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
        return DraftedSurface(pair, RoughFit(), command, measured, 0.0, 0.0)
    if not _SHORTEST_PERIOD_S < segment.period_s < _LONGEST_PERIOD_S:
        return DraftedSurface(pair, RoughFit(), command, measured, 0.0, 0.0)
    fit = fit_roughly(segment, free_scale=not angle_command)
    if not angle_command and np.isfinite(fit.error_deg) and fit.gain != 0.0:
        command = _rescaled(command, fit)
        fit = replace(fit, gain=1.0, bias_deg=0.0)
        segment = _cut(log, pair, command, measured)
    return _with_residual(DraftedSurface(pair, fit, command, measured, 0.0, 0.0), segment)


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


def _rescaled(command: dict[str, Any], fit: RoughFit) -> dict[str, Any]:
    """Command entry with the fitted straight line: gain (value - trim) + bias."""
    slope_key, trim_key = ("slope_deg_per_us", "trim_us") if command["unit"] == "us" else ("slope_deg", "trim")
    slope = command[slope_key]
    sign = int(np.sign(fit.gain)) * command.get("sign", 1)
    trim = command[trim_key] - fit.bias_deg / (fit.gain * command.get("sign", 1) * slope)
    return {**command, "sign": sign, trim_key: round(float(trim), 4), slope_key: round(abs(fit.gain) * slope, 6)}


def _helped_by_siblings(log: FlightLog, surfaces: list[DraftedSurface]) -> list[DraftedSurface]:
    """Give a servo that could not be fitted the numbers of one that could: it may be the faulty one."""
    errors = [s.fit.error_deg for s in surfaces]
    typical_deg = float(np.median(errors))
    sound = [s for s in surfaces if s.fit.error_deg <= _FIT_FAILS * typical_deg]
    if len(sound) == len(surfaces) or len(sound) < _ENOUGH_SIBLINGS or not np.isfinite(typical_deg):
        return surfaces
    return [s if s in sound else _borrowed(log, s, sound) for s in surfaces]


def _borrowed(log: FlightLog, surface: DraftedSurface, sound: list[DraftedSurface]) -> DraftedSurface:
    """Same surface with the sibling's servo, and scale, under which it comes closest most of the time."""
    candidates = []
    for sibling in sound:
        command = dict(surface.command)
        for key in ("slope_deg_per_us", "slope_deg"):
            if key in command and key in sibling.command:
                command |= {key: sibling.command[key], "sign": surface.pair.output.sign}
        if "trim_us" in command:
            command["trim_us"] = surface.pair.output.trim_us
        elif "trim" in command:
            command["trim"] = 0.0
        candidate = replace(surface, fit=sibling.fit, command=command)
        try:
            segment = _cut(log, surface.pair, command, surface.measured)
        except NoMeasurement:
            return surface
        candidates.append((typical_error_deg(sibling.fit, segment), candidate))
    return _measured_draft(log, min(candidates, key=lambda pair: pair[0])[1])


def _measured_draft(log: FlightLog, surface: DraftedSurface) -> DraftedSurface:
    """Same surface with the size of its residual."""
    try:
        segment = _cut(log, surface.pair, surface.command, surface.measured)
    except NoMeasurement:
        return surface
    return _with_residual(surface, segment)


def _with_residual(surface: DraftedSurface, segment: Segment) -> DraftedSurface:
    residuals = ResidualGenerator.fitting(surface.fit.model, segment).run(segment)
    size_deg = np.abs(residuals.residual_deg[residuals.settled])
    if size_deg.size == 0:
        return surface
    return replace(surface, peak_deg=float(size_deg.max()), median_deg=float(np.median(size_deg)))


def _threshold_deg(surfaces: list[DraftedSurface]) -> float:
    """Threshold that most surfaces of this log would have passed.

    With four surfaces or more a faulty one does not move the median of their largest residuals; with fewer,
    a multiple of the median residual has to do.
    """
    if len(surfaces) >= _ENOUGH_SURFACES:
        wanted_deg = _THRESHOLD_MARGIN * float(np.median([s.peak_deg for s in surfaces]))
    else:
        wanted_deg = _FALLBACK_MARGIN * float(np.median([s.median_deg for s in surfaces]))
    return max(DEFAULT_THRESHOLD_DEG, round(wanted_deg, 1))
