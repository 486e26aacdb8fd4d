"""Which channel asks a servo, and which one tells where it is."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from servofd.aircraft.outputs import LoggedOutput, named_outputs, outputs_of

if TYPE_CHECKING:
    from logparsers.records import Channel, FlightLog

_POSITION_PATTERNS = (
    # pattern of the channel's name, field with the command beside it, fields that a living telemetry changes
    (re.compile(r"CSRV\[(\d+)\]\.Pos"), "PosCmd", ("V", "A", "MotT", "PCBT", "Force", "Speed")),
    (re.compile(r"VOLZ\[(\d+)\]\.ang"), "Dang", ("pc", "sc", "pv", "sv", "mt", "pt")),
    (re.compile(r"CVOL\[(\d+)\]\.Pos"), "", ("Cur", "V", "T")),
    (re.compile(r"UMSV\[(\d+)\]\.Pos"), "", ("Curr", "Temp")),
    (re.compile(r"(?:NVF|NVAL)\[(?:SRVP|UMPOS_|SERVO|POS)_?(\d+)\]\.Value"), "", ()),
    (re.compile(r"(?:.*:)?NAMED_VALUE_FLOAT\[(?:SRVP|UMPOS_|SERVO|POS)_?(\d+)\]\.value"), "", ()),
    (re.compile(r"SFD\[(\d+)\]\.Pos"), "Cmd", ()),
    (re.compile(r"debug_key_value\[\d+\]\[(?:SRVP|UMPOS_|SERVO|POS)_?(\d+)\]\.value"), "", ()),
    (re.compile(r"debug_array\[\d+\](?:\[SRVP\])?\.data\[(\d+)\]"), "", ()),
    (re.compile(r"(?:.*:)?DEBUG_FLOAT_ARRAY(?:\[\d+\])?\.data\[(\d+)\]"), "", ()),
    (re.compile(r"(?:(?:.*:)?DEBUG_VECT|debug_vect\[\d+\])\[SRVP_?(\d*)\]\.([xyz])"), "", ()),
)
_ARRAY_ORIGIN = re.compile(r"DEBUG_FLOAT_ARRAY\[SRVP\]\.data\[\d+\]")
"""Of a numbered array its origin tells the name: another one's elements are no positions."""
_MOVES = 1e-9


@dataclass(frozen=True, slots=True)
class Position:
    """A channel that tells where a servo is."""

    channel: str
    id: int
    """Number in its name."""
    command: str
    """Channel in which the servo repeats its command; empty if there is none."""
    alive: tuple[str, ...]
    """Channels that change as long as the telemetry lives."""

    @property
    def group(self) -> str:
        """Message it belongs to; ids of one message share their base."""
        return re.split(r"[\[.]", self.channel.rsplit(":", 1)[-1])[0]


@dataclass(frozen=True, slots=True)
class Pair:
    """One servo: its command and its position."""

    surface: str
    output: LoggedOutput
    command: str
    position: Position


def find_positions(log: FlightLog) -> tuple[Position, ...]:
    """All channels of a log that carry the measured position of a servo, in the order of the log."""
    found = []
    for name in log.channels:
        for pattern, command_field, alive_fields in _POSITION_PATTERNS:
            match = pattern.fullmatch(name)
            if match and _is_told(log, name):
                stem = name.rsplit(".", 1)[0]
                command = f"{stem}.{command_field}"
                alive = tuple(f"{stem}.{field}" for field in alive_fields if f"{stem}.{field}" in log.channels)
                known = command if command_field and command in log.channels else ""
                place = "xyz".index(match[2]) if match.lastindex == 2 else 0
                found.append(Position(name, int(match[1] or 0) + place, known, alive))
    return tuple(found)


def _is_told(log: FlightLog, name: str) -> bool:
    """Whether an array of telemetry is that of positions."""
    return "DEBUG_FLOAT_ARRAY" not in name or _ARRAY_ORIGIN.fullmatch(log[name].origin) is not None


def find_pairs(log: FlightLog) -> tuple[Pair, ...]:
    """Pair each position with the command of its output.

    Ids start at 0 or at 1, depending on the servo's bus. Parameters tell which (the bit masks of the drivers);
    without them the base is the one under which positions go with the commands.

    Returns
    -------
    tuple of Pair
        By output number; motors are left out.
    """
    outputs = outputs_of(log.parameters)
    numbered: dict[int, Position] = {}
    positions = find_positions(log)
    # What a script on board saw is what the servos said before.
    for group in sorted(dict.fromkeys(position.group for position in positions), key="SFD".__eq__):
        members = [position for position in positions if position.group == group]
        base = _first_output(log, members)
        for position in members:
            number = position.id + base
            if (outputs.get(number) or LoggedOutput(number)).turns_something:
                numbered.setdefault(number, position)
    names = named_outputs(outputs, sorted(numbered))
    pairs = []
    for number in sorted(numbered):
        position = numbered[number]
        command = _command_channel(log, number, position)
        if command and _says_something(log[command]) and _says_something(log[position.channel]):
            pairs.append(Pair(names[number], outputs.get(number, LoggedOutput(number)), command, position))
    return tuple(pairs)


def _says_something(channel: Channel) -> bool:
    """False for the unused places of an array: no value at all, or zero throughout."""
    finite = channel.values[np.isfinite(channel.values)]
    return bool(finite.size and np.any(finite != 0.0))


def _first_output(log: FlightLog, members: list[Position]) -> int:
    """LoggedOutput number of id 0: 1 where ids start at 0, and 0 where they start at 1."""
    ids = {position.id for position in members}
    if members[0].group == "SFD":
        return 0
    if 0 in ids:
        return 1
    volz = int(np.nan_to_num(log.parameters.get("SERVO_VOLZ_MASK", 0.0)))
    if members[0].group == "CSRV" and volz and all(volz >> i & 1 for i in ids):
        return 1
    dronecan = 0
    for name, value in log.parameters.items():
        if re.fullmatch(r"CAN_D\d_UC_SRV_BM", name):
            dronecan |= int(value)
    if dronecan and all(dronecan >> (i - 1) & 1 for i in ids):
        return 0
    return max((0, 1), key=lambda base: (_agreement(log, members, base), -base))


def _agreement(log: FlightLog, members: list[Position], base: int) -> float:
    """Mean correlation of positions with the pulses of the outputs that this base gives them."""
    values = []
    for position in members:
        pulses = pulse_channel(log.channels, position.id + base)
        if pulses:
            values.append(_correlation(log[pulses], log[position.channel]))
    return float(np.mean(values)) if values else -1.0


def _correlation(command: Channel, position: Channel) -> float:
    good = np.isfinite(position.values)
    if command.time_s.size < 3 or np.count_nonzero(good) < 3:
        return 0.0
    asked = np.interp(position.time_s[good], command.time_s, np.nan_to_num(command.values))
    reported = position.values[good]
    with np.errstate(over="ignore", invalid="ignore"):
        spread = np.array([np.std(asked), np.std(reported)])
    if not np.all(np.isfinite(spread)) or spread.min() < _MOVES:  # squares of forged numbers are none
        return 0.0
    return float(abs(np.corrcoef(asked, reported)[0, 1]))


def _command_channel(log: FlightLog, number: int, position: Position) -> str:
    """The command as the servo repeats it, if it does; else the pulse on its output."""
    if position.command:
        repeated = log[position.command]
        if np.any(np.isfinite(repeated.values)) and not repeated.is_constant:
            return position.command
    return pulse_channel(log.channels, number)


def pulse_channel(channels: Mapping[str, object], number: int) -> str:
    """Channel with the command of an output, in whatever message this log has it; empty if nowhere."""
    names = (
        f"RCOU.C{number}",
        f"RCO2.C{number}",
        f"RCO3.C{number}",
        f"SERVO_OUTPUT_RAW.servo{number}_raw",
        f"SERVO_OUTPUT_RAW[1].servo{number - 16}_raw",
        f"1/1:SERVO_OUTPUT_RAW.servo{number}_raw",
        f"actuator_servos[0].control[{number - 1}]",
        f"actuator_servos.control[{number - 1}]",
        f"actuator_outputs[0].output[{number - 1}]",
    )
    return next((name for name in names if name in channels), "")
