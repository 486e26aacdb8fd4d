"""An aircraft drafted from what an autopilot's log says about itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.aircraft.outputs import WITHOUT_SURFACES, Pair, find_pairs, pulse_channel
from servofd.aircraft.schema import Aircraft
from servofd.aircraft.series import Series, bus_of, cut
from servofd.core.errors import NoMeasurement
from servofd.core.toml_text import toml_key, toml_lines, toml_value
from servofd.feedback.fitted import (
    LONGEST_PERIOD_S,
    PERSISTENCE,
    SHORTEST_PERIOD_S,
    RoughFit,
    draft_tolerance,
    fit_roughly,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from logparsers.records import FlightLog
    from servofd.core.evidence import ModelOrigin
    from servofd.core.types import Marks
    from servofd.feedback.fitted import Drafted

_MOTION = (
    "healthy flights of four days tell what each axis loses: `servofd calibrate DAY1 DAY2 DAY3 DAY4 -o plane.toml`, "
    "then `servofd FLIGHT -c plane.toml`; for a verdict on each servo "
)


def what_to_log(log: FlightLog) -> str:
    """One sentence: how this kind of autopilot gets servo positions into its logs.

    Examples
    --------
    >>> from pathlib import Path
    >>> from logparsers import FlightLog
    >>> what_to_log(FlightLog(Path("a.ulg"), "ulog", {}))[:30]
    'send the positions as DEBUG_FL'
    """
    if log.vehicle in WITHOUT_SURFACES:
        return f"it is of a {log.vehicle}, which has no control surfaces: its outputs {WITHOUT_SURFACES[log.vehicle]}"
    if log.format == "ulog":
        return (
            "send the positions as DEBUG_FLOAT_ARRAY (name SRVP) and log debug topics (SDLOG_PROFILE bit 5); "
            "actuator_outputs and actuator_servos are commands"
        )
    motion = _MOTION if log.vehicle in ("fixed wing", "QuadPlane") else ""
    if log.format == "tlog":
        return motion + (
            "send the positions as NAMED_VALUE_FLOAT SRVP1, SRVP2, ... in degrees: `servofd onboard --stream-only -o "
            "servofd.lua` writes the script, copy it to APM/scripts and set SCR_ENABLE = 1; or audit the autopilot's "
            "own .bin log; SERVO_OUTPUT_RAW is a command"
        )
    return motion + (
        "log its position: RCOU is a command; servos with feedback write CSRV: Volz (SERIALn_PROTOCOL = 14, "
        "SERVO_VOLZ_MASK) or DroneCAN (CAN_D1_PROTOCOL = 1, CAN_D1_UC_SRV_BM), with LOG_BITMASK including RC output"
    )


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
    pairs = find_pairs(log)
    if not pairs:
        raise NoMeasurement(f"{log.label}: no measured deflection in this log: {what_to_log(log)}")
    entries = {pair.surface: _entries(log, pair) for pair in pairs}
    bus = bus_of(log, Aircraft.model_validate({"surfaces": entries}))
    surfaces = [_draft(log, pair, entries[pair.surface], bus) for pair in pairs]
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


def _entries(log: FlightLog, pair: Pair) -> dict[str, Any]:
    """How command and position of a pair are read, before anything is fitted."""
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
    return {"command": command, "measured": measured, "alive": pair.position.alive}


def _draft(log: FlightLog, pair: Pair, entry: dict[str, Any], bus: Mapping[str, Marks]) -> DraftedSurface:
    """Draft of one surface; with an ordinary servo if its position is no measurement."""
    command, measured = entry["command"], entry["measured"]
    angle_command = pair.command == pair.position.command
    try:
        segment = _cut(log, pair, entry, bus)
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
        segment = _cut(log, pair, entry | {"command": command}, bus)
    return DraftedSurface(pair, fit, command, measured, draft_tolerance(fit.model, segment, until_s=fit.until_s))


def _cut(log: FlightLog, pair: Pair, entry: dict[str, Any], bus: Mapping[str, Marks]) -> Series:
    return cut(log, pair.surface, Aircraft.model_validate({"surfaces": {pair.surface: entry}}), bus)


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


_ENTRIES = ("servo", "output", "threshold", "threshold_deg", "tolerance", "persistence", "suspicions", "model")


def draft_to_toml(draft: Draft) -> str:
    """Text of an aircraft file that `servofd audit -c` accepts as it is."""
    log = draft.log
    lines = [
        f"# Drafted from {log.source.name} ({', '.join(filter(None, (log.firmware, log.vehicle)))}).",
        "# The servos below were fitted roughly to this one log: a starting point, no calibration. Check the names and",
        "# signs, replace the servos by identified ones (`servofd servos` lists known types), and set thresholds from",
        "# flights that you know to be good. If this flight had a faulty servo, its numbers are wrong.",
        "#",
        *_on_board(log.format),
        "# Tolerances are so wide that this log raises no alarm, but where it contradicts any servo.",
        "",
        f"name = {toml_value(log.vehicle or log.format)}",
    ]
    for surface in draft.surfaces:
        lines += ["", *_surface_lines(surface)]
    return "\n".join(lines) + "\n"


def fitted_to_toml(log: FlightLog, aircraft: Aircraft) -> str:
    """Text of an aircraft file with the servos that were fitted to a table.

    Examples
    --------
    >>> from servofd.feedback.flown import flown_aircraft, one_log
    >>> log = one_log("sample_logs/table_three_faults.csv")
    >>> fitted_to_toml(log, flown_aircraft(log)).splitlines()[6]
    '[surfaces.aileron]'
    """
    lines = [
        f"# Drafted from {log.source.name}: each servo is fitted to this one log, a starting point and no calibration.",
        "# If a servo was faulty in it, its numbers are wrong: calibrate on flights that you know to be good.",
        "# Tolerances are so wide that this log raises no alarm, but where it contradicts any servo.",
        "",
        f"name = {toml_value(aircraft.name or log.source.stem)}",
    ]
    for name, surface in aircraft.surfaces.items():
        servo = aircraft.servos[surface.servo].model_copy(update={"source": f"fitted to {log.source.name}"})
        entry = _rounded(surface.model_dump(exclude_defaults=True, exclude_none=True, mode="json"))
        order = {key: entry[key] for key in _ENTRIES if key in entry} | entry
        lines += ["", f"[surfaces.{toml_key(name)}]", *toml_lines(order)]
        servo_table = servo.model_dump(exclude_defaults=True, exclude_none=True, mode="json")
        lines += ["", f"[servos.{toml_key(surface.servo)}]", *toml_lines(servo_table)]
    return "\n".join(lines) + "\n"


def _rounded(value: Any) -> Any:  # noqa: ANN401 - whatever a TOML file holds
    """Numbers with six digits."""
    if isinstance(value, dict):
        return {key: _rounded(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_rounded(each) for each in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _on_board(format_name: str) -> list[str]:
    """How an ArduPilot watches these servos itself."""
    if format_name not in ("dataflash", "tlog"):
        return []
    return [
        "# Once calibrated, `servofd onboard THIS_FILE.toml -o servofd.lua` makes the autopilot watch these servos",
        "# itself: copy the script to APM/scripts on its SD card and set SCR_ENABLE = 1.",
        "#",
    ]


def _surface_lines(surface: DraftedSurface) -> list[str]:
    pair, output, key = surface.pair, surface.pair.output, toml_key(surface.pair.surface)
    function = "function unknown" if output.function is None else f"SERVO{output.number}_FUNCTION = {output.function}"
    scale = (
        ""
        if pair.command == pair.position.command
        else f"output {output.number}: pulses of {output.min_us:g} to {output.max_us:g} us; scale fitted"
    )
    entry, drafted = surface_entry(surface), surface.drafted
    table = {name: entry[name] for name in _ENTRIES if name in entry}
    if pair.position.alive:
        table["alive"] = list(pair.position.alive)
    table |= {"command": surface.command, "measured": surface.measured}
    notes = {
        "threshold_deg": f"largest residual in this log: {drafted.peak_deg:.1f} deg" if drafted else "",
        "model": "" if drafted else "no servo predicts what this surface did",
        "alive": "all still, and the position too: dead telemetry",
        "command": scale,
    }
    return [
        f"[surfaces.{key}]  # output {output.number}, {function}",
        *toml_lines(table, notes),
        "",
        f"[servos.{toml_key(f'{pair.surface}-draft')}]",
        *toml_lines(servo_entry(surface)),
    ]
