"""Outputs of an autopilot: which turns which surface, and which channels tell what was asked of it and where it was."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from logparsers.records import Channel, FlightLog
from servofd.aircraft.calibration import (
    Calibration,
    DegreeCalibration,
    NormCalibration,
    PulseCalibration,
    RadianCalibration,
)
from servofd.aircraft.current import CurrentSource
from servofd.aircraft.schema import Aircraft, Surface, plain_channels

_COMMANDS_OF_OUTPUT = re.compile(r"(?:.*:)?(?:RCOU\.C|RCO2\.C|RCO3\.C|SERVO_OUTPUT_RAW\.servo)(\d+)(?:_raw)?")
COMMANDS_OF_SERVO = re.compile(r"CSRV\[(\d+)\]\.PosCmd")
POSITIONS_FROM_0 = re.compile(r"CSRV\[(\d+)\]\.Pos")
POSITIONS_FROM_1 = re.compile(r"(?:.*:)?(?:NAMED_VALUE_FLOAT|NVF|NVAL)\[SRVP(\d+)\]\.[vV]alue")


def output_of(surface: Surface) -> int | None:
    """Number of the output that turns a surface, from 1, as it says or its channels tell; None if they do not.

    Examples
    --------
    >>> from servofd.aircraft.schema import load_aircraft
    >>> output_of(load_aircraft("simulated").surfaces["rudder"]), output_of(load_aircraft("faser").surfaces["rudder"])
    (4, None)
    """
    if surface.output is not None:
        return surface.output
    places = [(_COMMANDS_OF_OUTPUT, surface.command.channel, 0), (COMMANDS_OF_SERVO, surface.command.channel, 1)]
    if surface.measured is not None:
        places += [(POSITIONS_FROM_0, surface.measured.channel, 1), (POSITIONS_FROM_1, surface.measured.channel, 0)]
    for pattern, channel, base in places:
        match = pattern.fullmatch(channel)
        if match:
            return int(match[1]) + base
    return None


ROTORCRAFT = {
    **dict.fromkeys(
        ("multirotor", "quadrotor", "hexarotor", "octorotor", "tricopter", "decarotor", "dodecarotor", "coaxial"),
        "turn motors",
    ),
    "helicopter": "tilt a swash plate",
}
"""What the outputs of aircraft do that motors or rotors carry."""
WITHOUT_SURFACES = {
    **ROTORCRAFT,
    "submarine": "turn thrusters",
    "ground rover": "steer and drive wheels",
    "surface boat": "steer and drive a boat",
    "antenna tracker": "turn an antenna",
}
"""What the outputs of vehicles do that have no control surfaces."""

SURFACE_FUNCTIONS = {
    2: "flap", 3: "flap", 4: "aileron", 16: "spoiler_left", 17: "spoiler_right", 19: "elevator", 21: "rudder",
    24: "flaperon_left", 25: "flaperon_right", 26: "ground_steering", 41: "tilt", 45: "tilt_rear_left",
    46: "tilt_rear_right", 47: "tilt_rear", 75: "tilt_left", 76: "tilt_right", 77: "elevon_left",
    78: "elevon_right", 79: "vtail_left", 80: "vtail_right", 86: "spoiler_left_2", 87: "spoiler_right_2",
    110: "airbrake",
}  # fmt: skip
"""ArduPilot's SERVOn_FUNCTION numbers of outputs that turn something."""
_OF_PX4 = (
    "aileron_left aileron_right elevator rudder elevon_left elevon_right vtail_left vtail_right flap_left flap_right "
    "airbrake any atail_left atail_right aileron steering spoiler_left spoiler_right"
)
PX4_TYPES = dict(enumerate(_OF_PX4.split(), start=1))
"""PX4's CA_SV_CSk_TYPE of surfaces."""
PX4_MOST_SERVOS: Final = 8
"""Surfaces that PX4's control allocation knows at most (CA_SV_CSk), and controls of the topic actuator_servos."""
PX4_FIRST_SERVO: Final = 201
"""PWM_MAIN_FUNCn or PWM_AUX_FUNCn of the first surface."""

FULL_TRAVEL_DEG: Final = 45.0
"""ArduPilot scales angle outputs to +-4500 centidegrees at SERVOn_MIN and _MAX; what that turns, neither it nor a log
knows."""


@dataclass(frozen=True, slots=True)
class LoggedOutput:
    """One servo output.

    `number`: from 1, as printed on the autopilot. `function`: SERVOn_FUNCTION; None if the log does not tell.
    `trim_us`, `min_us`, `max_us`: pulse widths at neutral and at the ends [us]. `reversed`: SERVOn_REVERSED.
    """

    number: int
    function: int | None = None
    trim_us: float = 1500.0
    min_us: float = 1000.0
    max_us: float = 2000.0
    reversed: bool = False

    @property
    def slope_deg_per_us(self) -> float:
        """Angle per pulse width by the firmware's own formula, mean of both sides [deg/us]."""
        span_us = max(self.max_us - self.min_us, 1.0)
        return 2.0 * FULL_TRAVEL_DEG / span_us

    @property
    def sign(self) -> int:
        """-1 for a reversed output."""
        return -1 if self.reversed else 1

    @property
    def turns_something(self) -> bool:
        """False for motors, relays and outputs without a function."""
        return self.function is None or self.function in SURFACE_FUNCTIONS


def outputs_of(parameters: Mapping[str, float]) -> dict[int, LoggedOutput]:
    """Servo outputs that a log's parameters describe, by number."""
    outputs = {}
    for number in range(1, 33):
        function = parameters.get(f"SERVO{number}_FUNCTION")
        if function is not None and function != 0.0 and math.isfinite(function):
            outputs[number] = LoggedOutput(
                number,
                int(function),
                trim_us=parameters.get(f"SERVO{number}_TRIM", 1500.0),
                min_us=parameters.get(f"SERVO{number}_MIN", 1000.0),
                max_us=parameters.get(f"SERVO{number}_MAX", 2000.0),
                reversed=bool(parameters.get(f"SERVO{number}_REVERSED", 0.0)),
            )
    return outputs


_NUMBERED: Final = "servo"
"""What an output turns that has no name."""


def named_outputs(outputs: Mapping[int, LoggedOutput], numbers: list[int]) -> dict[int, str]:
    """Name a surface for each output; functions that several outputs share get the output's number.

    Examples
    --------
    >>> named_outputs({1: LoggedOutput(1, 4), 2: LoggedOutput(2, 19), 9: LoggedOutput(9, 4)}, [1, 2, 9])
    {1: 'aileron_1', 2: 'elevator', 9: 'aileron_9'}
    """
    plain = {}
    for number in numbers:
        function = outputs[number].function if number in outputs else None
        plain[number] = SURFACE_FUNCTIONS.get(function or 0, _NUMBERED)
    shared = {name for name in plain.values() if name == _NUMBERED or list(plain.values()).count(name) > 1}
    return {number: f"{name}_{number}" if name in shared else name for number, name in plain.items()}


def is_numbered(name: str) -> bool:
    """Whether a surface is called by its output alone, because nothing says what that turns."""
    return name.startswith(f"{_NUMBERED}_")


_NAMED_VALUES = r"(?:NVF|NVAL|(?:.*:)?NAMED_VALUE_FLOAT|debug_key_value\[\d+\])"
_POSITION_PATTERNS = (
    # pattern of the channel's name, field with the command beside it, fields that a living telemetry changes
    (re.compile(r"CSRV\[(\d+)\]\.Pos"), "PosCmd", ("V", "A", "MotT", "PCBT", "Force", "Speed")),
    (re.compile(r"VOLZ\[(\d+)\]\.ang"), "Dang", ("pc", "sc", "pv", "sv", "mt", "pt")),
    (re.compile(r"CVOL\[(\d+)\]\.Pos"), "", ("Cur", "V", "T")),
    (re.compile(r"UMSV\[(\d+)\]\.Pos"), "", ("Curr", "Temp")),
    (re.compile(rf"{_NAMED_VALUES}\[(?:SRVP|UMPOS_|SERVO|POS)_?(\d+)\]\.[vV]alue"), "", ()),
    (re.compile(r"SFD\[(\d+)\]\.Pos"), "Cmd", ()),
    (re.compile(r"(?:debug_array|(?:.*:)?DEBUG_FLOAT_ARRAY)(?:\[\d+\])?(?:\[SRVP\])?\.data\[(\d+)\]"), "", ()),
    (re.compile(r"(?:(?:.*:)?DEBUG_VECT|debug_vect\[\d+\])\[SRVP_?(\d*)\]\.([xyz])"), "", ()),
)
_ARRAY_ORIGIN = re.compile(r"DEBUG_FLOAT_ARRAY\[SRVP\]\.data\[\d+\]")
"""Of a numbered array its origin tells the name: another one's elements are no positions."""
_MOVES = 1e-9
"""Smaller spreads are rounding: nothing moves."""


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
        if "DEBUG_FLOAT_ARRAY" in name and not _ARRAY_ORIGIN.fullmatch(log[name].origin):
            continue
        for pattern, command_field, alive_fields in _POSITION_PATTERNS:
            match = pattern.fullmatch(name)
            if match:
                stem = name.rsplit(".", 1)[0]
                command = f"{stem}.{command_field}"
                alive = tuple(f"{stem}.{field}" for field in alive_fields if f"{stem}.{field}" in log.channels)
                known = command if command_field and command in log.channels else ""
                place = "xyz".index(match[2]) if match.lastindex == 2 else 0
                found.append(Position(name, int(match[1] or 0) + place, known, alive))
    return tuple(found)


def find_pairs(log: FlightLog) -> tuple[Pair, ...]:
    """Pair each position with the command of its output.

    Ids start at 0 or at 1, depending on the servo's bus. Parameters tell which (the bit masks of the drivers);
    without them the base is the one under which positions go with the commands.

    Result: by output number; motors are left out.
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
    if counts_from_1(log.parameters, ids):
        return 0
    return max((0, 1), key=lambda base: (_agreement(log, members, base), -base))


def counts_from_1(parameters: Mapping[str, float], ids: Collection[int]) -> bool:
    """Whether a DroneCAN bus numbers these servos from 1, by the bit masks of its drivers."""
    mask = 0
    for name, value in parameters.items():
        if re.fullmatch(r"CAN_D\d_UC_SRV_BM", name) and math.isfinite(value):
            mask |= int(value)
    return bool(mask) and 0 not in ids and all(mask >> (number - 1) & 1 for number in ids)


def _agreement(log: FlightLog, members: list[Position], base: int) -> float:
    """Mean correlation of positions with the pulses of the outputs that this base gives them."""
    values = [
        _correlation(log[pulses], log[position.channel])
        for position in members
        if (pulses := pulse_channel(log.channels, position.id + base))
    ]
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


HALF_TRAVEL_US = 500.0
"""Pulses of 1000 to 2000 us are what an autopilot that speaks of -1 to 1 sends by default."""
_OUTPUTS_OF_A_MESSAGE = 16
"""SERVO_OUTPUT_RAW of MAVLink 2 holds so many; a second message holds the next ones."""
_OF_A_LOG = re.compile(r"RCOU|RCO[23]|CSRV\[|NVF\[")
"""Channels that autopilots write into their own logs and do not send."""
_OTHER_PATH_S = 0.06
"""On the link of an ArduPlane, from its pulses to the positions that a script sends, six servos on one bus were 45 to
73 ms later than in its log, from the command that a servo repeats to its position (software in the loop)."""


def resolved(log: FlightLog, aircraft: Aircraft) -> Aircraft:
    """Return the same aircraft with the channels of a log, where its own are not in it.

    `log`: of an autopilot, or a plain table whose columns bear the names of the surfaces. `aircraft`: whose surfaces
    name their outputs, or channels from which these follow.
    """
    if all(_is_there(log, surface) for surface in aircraft.surfaces.values()):
        return aircraft
    if log.is_of_autopilot:
        pairs = _by_output(log, aircraft)
        surfaces = {name: _resolved(log, surface, pairs) for name, surface in aircraft.surfaces.items()}
    else:
        surfaces = {name: _of_table(log, name, surface) for name, surface in aircraft.surfaces.items()}
    return aircraft.model_copy(update={"surfaces": surfaces})


def streamed(aircraft: Aircraft, *, has_card: bool = False) -> Aircraft:
    """Return the same aircraft with the channels of telemetry, where a surface names its output or channels of a log.

    A command that servos repeat in degrees becomes the pulse that asks for it; without that pulse it stays. Where the
    log on the card comes as well (`has_card`), its channels stay.
    """
    surfaces = {name: _streamed(surface, has_card=has_card) for name, surface in aircraft.surfaces.items()}
    return aircraft.model_copy(update={"surfaces": surfaces})


def of_other_messages(names: Sequence[str]) -> str:
    """Say what a calibration on other messages is worth for these surfaces; nothing if there are none."""
    if not names:
        return ""
    return (
        f"{', '.join(names)}: calibrated on other messages than these, which have delays of their own: judged within "
        "wide tolerances; a file that 'servofd calibrate' makes of this log would show smaller faults"
    )


def _by_output(log: FlightLog, aircraft: Aircraft) -> dict[int, Pair]:
    """What a log has of each output of the aircraft.

    PX4 numbers its servos one after the other, whatever the outputs that they are on.
    """
    found = {pair.output.number: pair for pair in find_pairs(log)}
    numbers = sorted(n for n in map(output_of, aircraft.surfaces.values()) if n is not None)
    if log.format == "ulog" and len(numbers) == len(found) and not set(numbers) <= set(found):
        return dict(zip(numbers, (found[number] for number in sorted(found)), strict=True))
    return found


def _is_there(log: FlightLog, surface: Surface) -> bool:
    """Whether a log holds the channels of a surface."""
    if surface.measured is None and surface.output is None:
        return True
    return surface.measured is not None and {surface.command.channel, surface.measured.channel} <= set(log.channels)


def _resolved(log: FlightLog, surface: Surface, pairs: dict[int, Pair]) -> Surface:
    number = output_of(surface)
    if number is None or _is_there(log, surface):
        return surface
    pair = pairs.get(number)
    change: dict[str, object] = {}
    if surface.command.channel not in log.channels:
        command = _command(log, surface.command, number, pair)
        if command is not None:
            change["command"] = command
    if pair is not None and (surface.measured is None or surface.measured.channel not in log.channels):
        change["measured"] = _measured(log, surface.measured, pair)
        change["alive"] = pair.position.alive
    return _changed(surface, change)


def _of_table(log: FlightLog, name: str, surface: Surface) -> Surface:
    """The same surface in the columns of a plain table, with what calibration found about command and sensor."""
    command, measured = (
        DegreeCalibration(channel=channel, unit="deg", correction=known.correction if known else (1.0, 0.0))
        for channel, known in zip(plain_channels(name), (surface.command, surface.measured), strict=True)
    )
    own = {known.channel for known in (surface.command, surface.measured) if known}
    if own & set(log.channels) or not {command.channel, measured.channel} <= set(log.channels):
        return surface
    return _changed(surface, {"command": command, "measured": measured, "alive": ()})


def _command(log: FlightLog, known: Calibration, number: int, pair: Pair | None) -> Calibration | None:
    """The same command in the words of a log: in degrees as the servo repeats it, as pulses, or as -1 to 1."""
    if isinstance(known, DegreeCalibration) and pair is not None and pair.command == pair.position.command:
        return known.model_copy(update={"channel": pair.command})
    pulse = _pulse(known) if isinstance(known, DegreeCalibration) else known
    channel = pulse_channel(log.channels, pair.output.number if pair is not None else number)
    if not isinstance(pulse, PulseCalibration) or not channel:
        return None
    if log[channel].unit in ("us", "") and "actuator_servos" not in channel:
        return pulse.model_copy(update={"channel": channel})
    if pulse.slope_deg_per_us is None:
        return None
    return NormCalibration(
        channel=channel,
        unit="norm",
        sign=pulse.sign,
        correction=pulse.correction,
        trim=(pulse.trim_us - LoggedOutput(number).trim_us) / HALF_TRAVEL_US,
        slope_deg=pulse.slope_deg_per_us * HALF_TRAVEL_US,
    )


def _pulse(known: DegreeCalibration) -> PulseCalibration | None:
    """The pulse that asks for a command in degrees, if it is known."""
    if known.pulse is None or not known.pulse[1]:
        return None
    zero_us, slope = known.pulse
    return PulseCalibration(
        channel="pulse",
        unit="us",
        sign=known.sign if slope > 0.0 else -known.sign,
        correction=known.correction,
        trim_us=zero_us + known.trim_deg / slope,
        slope_deg_per_us=abs(slope),
    )


def _measured(log: FlightLog, known: Calibration | None, pair: Pair) -> Calibration:
    """The position that a log has of an output, with what calibration found about the sensor."""
    channel = pair.position.channel
    correction = known.correction if known is not None else (1.0, 0.0)
    sign = known.sign if known is not None else 1
    if log[channel].unit == "rad":
        return RadianCalibration(channel=channel, unit="rad", sign=sign, correction=correction)
    trim_deg = known.trim_deg if isinstance(known, DegreeCalibration) else 0.0
    return DegreeCalibration(channel=channel, unit="deg", sign=sign, correction=correction, trim_deg=trim_deg)


def _streamed(surface: Surface, *, has_card: bool) -> Surface:
    number = output_of(surface)
    if number is None:
        return surface
    command, measured = surface.command, surface.measured
    change: dict[str, object] = {}
    if not command.channel or (not has_card and _OF_A_LOG.match(command.channel)):
        pulse = _pulse(command) if isinstance(command, DegreeCalibration) else command
        if pulse is not None:
            message, rest = divmod(number - 1, _OUTPUTS_OF_A_MESSAGE)
            name = "SERVO_OUTPUT_RAW" + (f"[{message}]" if message else "")
            change["command"] = pulse.model_copy(update={"channel": f"{name}.servo{rest + 1}_raw"})
    channel = f"NAMED_VALUE_FLOAT[SRVP{number}].value"
    is_of_log = surface.current is None or _OF_A_LOG.match(surface.current.channel)
    if surface.healthy_current is not None and is_of_log and not has_card:
        drawn = CurrentSource(channel=f"NAMED_VALUE_FLOAT[SRVA{number}].value", unit="A")
        surface = surface.model_copy(update={"current": drawn})
    if measured is None and surface.output is not None and not surface.is_told_by_current:
        change["measured"] = DegreeCalibration(channel=channel, unit="deg")
    elif not has_card and isinstance(measured, DegreeCalibration) and _OF_A_LOG.match(measured.channel):
        change["measured"] = measured.model_copy(update={"channel": channel})
        change["alive"] = ()
    return _changed(surface, change)


def _changed(surface: Surface, change: dict[str, object]) -> Surface:
    """The same surface by other messages, which tell of the same motion at times of their own.

    What its good flights were like says nothing of these times: its linear servo judges it, within wide tolerances.
    """
    if change and surface.calibrated is not None:
        known = surface.tolerances
        change |= {"calibrated": None, "by_other_messages": True, "suspicions": False}
        change["tolerance"] = known.model_copy(update={"delay_s": known.delay_s + _OTHER_PATH_S})
    return surface.model_copy(update=change)
