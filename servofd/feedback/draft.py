"""An aircraft drafted from what an autopilot's log says about itself."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.aircraft.calibrated import calibrated_to_toml
from servofd.aircraft.current_source import hub_outputs, rails_of
from servofd.aircraft.outputs import (
    WITHOUT_SURFACES,
    LoggedOutput,
    Pair,
    Position,
    find_pairs,
    named_outputs,
    outputs_of,
    pulse_channel,
)
from servofd.aircraft.schema import Aircraft, Surface
from servofd.core.errors import NoMeasurement
from servofd.core.series import latest
from servofd.core.toml_text import toml_comment, toml_key, toml_lines, toml_value
from servofd.feedback.fitted import fitted_aircraft

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from logparsers.records import FlightLog

BY_DAYS = "`servofd calibrate DAY1 DAY2 DAY3 DAY4 -o plane.toml`, then `servofd FLIGHT -c plane.toml`"
"""How an aircraft without feedback is judged, in words of the command line."""
_MOTION = f"healthy flights of four days show what each axis loses: {BY_DAYS}; "
_WINGED = ("fixed wing", "QuadPlane", "vtol fixedrotor", "vtol tiltrotor", "vtol tiltwing")
"""Vehicles whose motion is judged: a tailsitter's axes change places."""


def what_to_log(log: FlightLog) -> str:
    """One sentence: how this kind of autopilot gets servo positions into its logs.

    Examples
    --------
    >>> from pathlib import Path
    >>> from logparsers import FlightLog
    >>> what_to_log(FlightLog(Path("a.ulg"), "ulog", {}))[:30]
    'for a verdict on each servo se'
    """
    if log.vehicle in WITHOUT_SURFACES:
        return f"it is of a {log.vehicle}, which has no control surfaces: its outputs {WITHOUT_SURFACES[log.vehicle]}"
    motion = (_MOTION if log.vehicle in _WINGED else "") + "for a verdict on each servo "
    if log.format == "ulog":
        return motion + (
            "send the positions as DEBUG_FLOAT_ARRAY (name SRVP) and log debug topics (SDLOG_PROFILE bit 5); "
            "actuator_outputs and actuator_servos are commands"
        )
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
"""Deflection for a normalised command of 1, where nothing says how far it goes [deg]."""
_ANGLES = {"deg", "rad"}


_FEWEST_PULSES, _SAME_COMMAND = 100, 0.9
"""Commands that a comparison with pulses needs, and the correlation that it has to reach."""
_REPEATED_AFTER_S = np.arange(0.0, 0.11, 0.01)
"""How much later than its pulse a log may have the angle that a servo was asked for: ArduPlane's driver of Volz servos,
which asks in a thread of its own, has it 20 to 30 ms later."""
_MOST_OUTPUTS = 32
"""Of an ArduPilot; a damaged log may name any other."""


def draft_aircraft(log: FlightLog, only: Collection[str] = ()) -> Aircraft:
    """Find the servos with feedback in an autopilot's log and fit each one to it.

    Outputs are paired with positions through the autopilot's parameters; pulses become degrees by the firmware's
    formula, or by a straight line fitted to the position where the servo itself does not repeat its command. `only`
    those surfaces are fitted; all if empty.
    """
    plain = described_aircraft(log)
    measured = [name for name, surface in plain.surfaces.items() if surface.measured is not None]
    return fitted_aircraft(log, plain, [name for name in measured if not only or name in only], is_draft=True)


def described_aircraft(log: FlightLog) -> Aircraft:
    """Surfaces of an autopilot's log, of whose servos nothing is said; some tell what they draw alone."""
    pairs = find_pairs(log)
    by_current = _by_current(log, pairs)
    if not pairs and not by_current:
        advice = "; ".join(filter(None, (rails_of(log), what_to_log(log))))
        raise NoMeasurement(f"{log.label}: no measured deflection in this log: {advice}")
    plain = {pair.surface: Surface.model_validate(surface_entry(log, pair)) for pair in pairs}
    return Aircraft(name=log.vehicle or log.format, surfaces=plain | by_current)


def _by_current(log: FlightLog, pairs: Sequence[Pair]) -> dict[str, Surface]:
    """Surfaces on outputs of which a log holds the current and no position."""
    outputs = outputs_of(log.parameters)
    measured = {pair.output.number for pair in pairs}
    numbers = [
        number
        for number in sorted(hub_outputs(log))
        if number not in measured
        and (outputs.get(number) or LoggedOutput(number)).turns_something
        and pulse_channel(log.channels, number)
    ]
    names = named_outputs(outputs, sorted({*numbers, *measured}))
    found = {}
    for number in numbers:
        output = outputs.get(number, LoggedOutput(number))
        pair = Pair(names[number], output, pulse_channel(log.channels, number), Position("", 0, "", ()))
        command = _command_entry(pair, log[pair.command].unit, is_angle=False)
        found[pair.surface] = Surface.model_validate({"command": command, "output": number})
    return found


def surface_entry(log: FlightLog, pair: Pair) -> dict[str, Any]:
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
            "say in an aircraft file (-c) how to read it"
        )
    measured = {"channel": pair.position.channel, "unit": measured_unit}
    entry = {"command": command, "measured": measured, "alive": pair.position.alive}
    return entry | ({"output": pair.output.number} if 1 <= pair.output.number <= _MOST_OUTPUTS else {})


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
        held_deg = latest(angle_s, angle_deg, sent_s + lag_s) if angle_deg.size else angle_deg
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


_ON_BOARD = (
    "# Once calibrated, `servofd onboard THIS_FILE.toml -o servofd.lua` makes the autopilot watch these servos",
    "# itself: copy the script to APM/scripts on its SD card and set SCR_ENABLE = 1.",
    "#",
)
_ENTRIES = ("servo", "output", "threshold", "threshold_deg", "tolerance", "model")


def draft_to_toml(log: FlightLog, aircraft: Aircraft | None = None) -> str:
    """Text of an aircraft file with servos that were fitted to a log, which `servofd audit -c` accepts as it is."""
    aircraft = aircraft or draft_aircraft(log)
    heads = {pair.surface: _paired(pair) for pair in find_pairs(log)} if log.is_of_autopilot else {}
    named = toml_comment(log.source.name)
    lines = [
        f"# Drafted from {named}: each servo is fitted to a part of this one log, a starting point and no",
        "# calibration. Check names and signs, and calibrate on flights that you know to be good: if a servo was",
        "# faulty throughout this log, its numbers are wrong.",
        *(_ON_BOARD if log.format in ("dataflash", "tlog") else ()),
        "",
        f"name = {toml_value(aircraft.name or log.source.stem)}",
    ]
    for name, surface in aircraft.surfaces.items():
        entry = _rounded(surface.model_dump(exclude_defaults=True, exclude_none=True, mode="json"))
        known = entry.pop("calibrated", None)
        order = {key: entry[key] for key in _ENTRIES if key in entry} | entry
        lines += ["", f"[surfaces.{toml_key(name)}]{heads.get(name, '')}", *toml_lines(order)]
        if known is not None:
            lines += calibrated_to_toml(name, known, {})
    for key, servo in aircraft.servos.items():
        table = servo.model_dump(exclude_defaults=True, exclude_none=True, mode="json")
        lines += ["", f"[servos.{toml_key(key)}]", *toml_lines(table)]
    return "\n".join(lines) + "\n"


def _paired(pair: Pair) -> str:
    """Which output turns a surface, behind its heading."""
    output = pair.output
    function = "function unknown" if output.function is None else f"SERVO{output.number}_FUNCTION = {output.function}"
    scale = f", pulses of {output.min_us:g} to {output.max_us:g} us; scale fitted"
    return f"  # output {output.number}, {function}{'' if pair.command == pair.position.command else scale}"


def _rounded(value: Any) -> Any:  # noqa: ANN401 - whatever a TOML file holds
    """Numbers with six digits."""
    if isinstance(value, dict):
        return {key: _rounded(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_rounded(each) for each in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value
