"""One aircraft file for every log of an aircraft: a surface names its output, and the log says where that is."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from servofd.aircraft.calibration import DegreeCalibration, NormCalibration, PulseCalibration, RadianCalibration
from servofd.aircraft.output import output_of
from servofd.aircraft.outputs import LoggedOutput
from servofd.aircraft.pairs import find_pairs, pulse_channel
from servofd.aircraft.schema import plain_channels

if TYPE_CHECKING:
    from collections.abc import Sequence

    from logparsers.records import FlightLog
    from servofd.aircraft.calibration import Calibration
    from servofd.aircraft.pairs import Pair
    from servofd.aircraft.schema import Aircraft, Surface

_HALF_TRAVEL_US = 500.0
"""Pulses of 1000 to 2000 us are what an autopilot that speaks of -1 to 1 sends by default."""
_OUTPUTS_OF_A_MESSAGE = 16
_OF_A_LOG = re.compile(r"RCOU|RCO[23]|CSRV\[|NVF\[")
"""Channels that autopilots write into their own logs and do not send."""
_OTHER_PATH_S = 0.06
"""On the link of an ArduPlane, from its pulses to the positions that a script sends, six servos on one bus were 45 to
73 ms later than in its log, from the command that a servo repeats to its position (software in the loop)."""


def resolved(log: FlightLog, aircraft: Aircraft) -> Aircraft:
    """Return the same aircraft with the channels of a log, where its own are not in it.

    Parameters
    ----------
    log : FlightLog
        Of an autopilot, or a plain table whose columns bear the names of the surfaces.
    aircraft : Aircraft
        Whose surfaces name their outputs, or channels from which these can be told.

    Examples
    --------
    >>> import logparsers
    >>> from servofd.aircraft.schema import load_aircraft
    >>> log = logparsers.read("sample_logs/ardupilot_volz_stuck.bin")
    >>> rudder = resolved(log, load_aircraft("simulated")).surfaces["rudder"]
    >>> rudder.command.channel, rudder.measured.channel
    ('RCOU.C4', 'CSRV[3].Pos')
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

    Examples
    --------
    >>> from servofd.aircraft.schema import Surface, load_aircraft
    >>> angle = {"channel": "CSRV[3].PosCmd", "unit": "deg", "pulse": [1500.0, 0.2]}
    >>> rudder = Surface.model_validate(
    ...     {"servo": "s9254", "command": angle, "measured": {"channel": "CSRV[3].Pos", "unit": "deg"}}
    ... )
    >>> plane = load_aircraft("simulated").model_copy(update={"surfaces": {"rudder": rudder}})
    >>> rudder = streamed(plane).surfaces["rudder"]
    >>> rudder.command.channel, rudder.command.slope_deg_per_us, rudder.measured.channel
    ('SERVO_OUTPUT_RAW.servo4_raw', 0.2, 'NAMED_VALUE_FLOAT[SRVP4].value')
    """
    surfaces = {name: _streamed(surface, has_card=has_card) for name, surface in aircraft.surfaces.items()}
    return aircraft.model_copy(update={"surfaces": surfaces})


def of_other_messages(names: Sequence[str]) -> str:
    """Say what a calibration on other messages is worth for these surfaces; nothing if there are none.

    Examples
    --------
    >>> of_other_messages(["rudder"])[:73]
    'rudder: calibrated on other messages than these, which have delays of the'
    """
    if not names:
        return ""
    return (
        f"{', '.join(names)}: calibrated on other messages than these, which have delays of their own: judged within "
        "wide tolerances; a file that 'servofd calibrate' makes of such a log would show smaller faults"
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
    """The same command in the words of a log: as pulses if it has them, else as the autopilot gives it."""
    channel = pulse_channel(log.channels, pair.output.number if pair is not None else number)
    if isinstance(known, PulseCalibration):
        if not channel:
            return None
        if log[channel].unit in ("us", "") and "actuator_servos" not in channel:
            return known.model_copy(update={"channel": channel})
        if known.slope_deg_per_us is None:
            return None
        return NormCalibration(
            channel=channel,
            unit="norm",
            sign=known.sign,
            correction=known.correction,
            trim=(known.trim_us - LoggedOutput(number).trim_us) / _HALF_TRAVEL_US,
            slope_deg=known.slope_deg_per_us * _HALF_TRAVEL_US,
        )
    return _angle(log, known, number, pair) if isinstance(known, DegreeCalibration) else None


def _angle(log: FlightLog, known: DegreeCalibration, number: int, pair: Pair | None) -> Calibration | None:
    """A command in degrees: as the servo repeats it, or as the pulse that asks for it."""
    if pair is not None and pair.command == pair.position.command:
        return known.model_copy(update={"channel": pair.command})
    pulse = _pulse(known)
    return _command(log, pulse, number, pair) if pulse is not None else None


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
    if measured is None and surface.output is not None:
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
