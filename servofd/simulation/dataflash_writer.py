"""ArduPlane's DataFlash log (``.bin``) of a simulated flight, in both generations of servo telemetry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from logparsers.dataflash.encode import Message, encode
from servofd.servo.context import AIR_KG_M3
from servofd.simulation.ardupilot import banner, outputs_needed, parameters
from servofd.simulation.pulses import MOST_OUTPUTS, THROTTLE, THROTTLE_US
from servofd.simulation.surroundings import EPOCH_US, microseconds, servo_state, sparse, surroundings

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike

    from servofd.aircraft.schema import Aircraft
    from servofd.simulation.flight import SimulatedFlight

_CONTEXT_HZ: Final = 10.0
"""Rate of attitude, airspeed and supply in the log [Hz]."""
_GPS_HZ: Final = 5.0
"""Rate of GPS in the log [Hz]."""
_GPS_EPOCH_US: Final = 315_964_800_000_000 - 18_000_000
"""6 January 1980 in Unix time, less the 18 leap seconds since [us]: GPS time begins then."""
_WEEK_US: Final = 7 * 86_400_000_000
"""A week of GPS time [us]."""
_CSRV: Final = ["TimeUS", "Id", "Pos", "Force", "Speed", "Pow", "PosCmd", "V", "A", "MotT", "PCBT", "Err"]


@dataclass(frozen=True, slots=True)
class Generation:
    """How an ArduPilot release logs what servos report (message CSRV)."""

    name: str
    version: str
    first_id: int
    """Id of the servo on output 1."""
    units: str
    """Unit ids of CSRV in FMTU."""
    multipliers: str


VOLZ: Final = Generation("volz", "4.7.0-dev", 0, "s#dtk%dvAOO-", "F-000000000-")
"""From 4.7 on: Volz servos on a serial line; degrees in steps of the servo's converter, the angle sent beside it."""
DRONECAN: Final = Generation("dronecan", "4.6.0", 1, "s#---%dvAOO-", "F----000000-")
"""Up to 4.6: DroneCAN servos; radians in half precision without a unit, the command not logged beside it."""
GENERATIONS: Final[Mapping[str, Generation]] = {g.name: g for g in (VOLZ, DRONECAN)}
"""By the name that the command line uses."""

_VOLZ_STEP_DEG: Final = 200.0 / 3840.0
"""Step of a Volz servo's position [deg]."""


def dataflash_log(flight: SimulatedFlight, aircraft: Aircraft, generation: Generation = VOLZ) -> bytes:
    """Content of a ``.bin`` file."""
    return encode(dataflash_messages(flight, aircraft, generation))


def dataflash_messages(
    flight: SimulatedFlight,
    aircraft: Aircraft,
    generation: Generation = VOLZ,
    *,
    settings: Mapping[str, float] | None = None,
) -> list[Message]:
    """Rows of each message, in the units a reader shall see.

    `flight`: with outputs; flight time 0 is when the autopilot was booted. `aircraft`: a surface without a measured
    channel has a servo that reports nothing. `generation`: one of `GENERATIONS`. `settings`: the vehicle's parameters;
    those of `servofd.simulation.ardupilot.parameters` if left out. Result: RCOU and one CSRV row per reporting servo
    at the rate of the flight; ARSP, ATT, POWR and GPS more seldom.
    """
    outputs_needed(flight)
    known = parameters(flight, aircraft, generation.name) if settings is None else settings
    return [*_words(flight, known, generation), _rcou(flight), *_csrv(flight, aircraft, generation), *_air(flight)]


def _words(flight: SimulatedFlight, known: Mapping[str, float], generation: Generation) -> list[Message]:
    """Parameters and what the autopilot says, all at the beginning."""
    start_us = int(microseconds(flight.time_s[:1])[0])
    values = list(known.values())
    parm: Mapping[str, ArrayLike] = {
        "TimeUS": [start_us] * len(known),
        "Name": list(known),
        "Value": values,
        "Default": values,
    }
    said = [banner(generation.version), "Throttle armed"]
    spoken: Mapping[str, ArrayLike] = {"TimeUS": [start_us] * len(said), "Message": said}
    return [Message("PARM", "QNff", parm, "s---", "F---"), Message("MSG", "QZ", spoken, "s-", "F-")]


def _rcou(flight: SimulatedFlight) -> Message:
    columns: dict[str, ArrayLike] = {"TimeUS": microseconds(flight.time_s)}
    columns |= {f"C{n}": np.zeros(flight.time_s.size, np.int64) for n in range(1, MOST_OUTPUTS + 1)}
    columns[f"C{THROTTLE}"] = np.full(flight.time_s.size, THROTTLE_US)
    columns |= {f"C{o.number}": flight.pulse_us[:, i] for i, o in enumerate(flight.outputs)}
    return Message("RCOU", "Q" + "H" * MOST_OUTPUTS, columns, "s" + "Y" * MOST_OUTPUTS, "F" + "-" * MOST_OUTPUTS)


def _csrv(flight: SimulatedFlight, aircraft: Aircraft, generation: Generation) -> list[Message]:
    """One message per servo: rows of equal time stay in the order of the outputs."""
    found = []
    for i in sorted(range(len(flight.outputs)), key=lambda i: flight.outputs[i].number):
        output = flight.outputs[i]
        if aircraft.surfaces[output.surface].measured is None:
            continue
        rng = np.random.default_rng([flight.seed, i, 1001])
        state = servo_state(flight.time_s, flight.command_deg[:, i], flight.measured_deg[:, i], rng)
        arm_deg = output.arm_deg(flight.measured_deg[:, i])
        rows: dict[str, ArrayLike] = dict.fromkeys(_CSRV, np.zeros(flight.time_s.size))
        rows["TimeUS"] = microseconds(flight.time_s)
        rows["Id"] = np.full(flight.time_s.size, output.number - 1 + generation.first_id)
        if generation is VOLZ:  # what the driver does not know is NaN, or 0 in a whole number
            unknown = np.full(flight.time_s.size, np.nan)
            rows |= {"Force": unknown, "Speed": unknown}
            rows["Pos"] = _VOLZ_STEP_DEG * np.round(arm_deg / _VOLZ_STEP_DEG)
            rows["PosCmd"] = output.arm_deg(flight.command_deg[:, i])
            rows |= {"V": state.voltage_v, "A": state.current_a, "MotT": state.motor_degc, "PCBT": state.board_degc}
        else:  # what actuator.Status does not hold is 0
            rows["Pos"] = np.radians(arm_deg).astype(np.float16)
            rows["Force"] = (0.4 * state.current_a).astype(np.float16)
            rows["Speed"] = np.radians(output.arm_deg(state.speed_deg_s)).astype(np.float16)
            rows["Pow"] = np.round(np.clip(60.0 * state.current_a, 0.0, 100.0))
        found.append(Message("CSRV", "QBfffBfffffB", rows, generation.units, generation.multipliers))
    return [_joined(found)] if found else []


def _joined(messages: list[Message]) -> Message:
    """All rows of messages that share a name, sorted by time."""
    first = messages[0]
    columns = {name: np.concatenate([np.asarray(m.columns[name]) for m in messages]) for name in first.columns}
    order = np.argsort(columns["TimeUS"], kind="stable")
    rows = {name: values[order] for name, values in columns.items()}
    return Message(first.name, first.format, rows, first.units, first.multipliers)


def _air(flight: SimulatedFlight) -> list[Message]:
    """Context, seldom."""
    at_s = flight.time_s[sparse(flight.time_s, _CONTEXT_HZ)]
    air = surroundings(at_s, flight.seed)
    stamps, ones, zeros = microseconds(at_s), np.ones(at_s.size), np.zeros(at_s.size)
    pressure_pa = 0.5 * AIR_KG_M3 * air.airspeed_m_s**2
    arsp: Mapping[str, ArrayLike] = {
        "TimeUS": stamps, "I": zeros, "Airspeed": air.airspeed_m_s, "DiffPress": pressure_pa,
        "Temp": np.full(at_s.size, 18.5), "RawPress": pressure_pa + 2.0, "Offset": np.full(at_s.size, 2.0),
        "U": ones, "H": ones, "Hp": ones, "TR": zeros, "Pri": zeros,
    }  # fmt: skip
    att: Mapping[str, ArrayLike] = {
        "TimeUS": stamps, "DesRoll": 28.0 * ones, "Roll": air.roll_deg, "DesPitch": 3.0 * ones,
        "Pitch": air.pitch_deg, "DesYaw": air.yaw_deg, "Yaw": air.yaw_deg, "AEKF": 3 * ones,
    }  # fmt: skip
    powr: Mapping[str, ArrayLike] = {
        "TimeUS": stamps, "Vcc": air.board_v, "VServo": air.rail_v, "Flags": 3 * ones, "AccFlags": 3 * ones,
        "Safety": 2 * ones,
    }  # fmt: skip
    return [
        Message("ARSP", "QBffcffBBffB", arsp, "s#nPOPP-----", "F-00B00-----"),
        Message("ATT", "QffffffB", att, "sddddhh-", "F000000-"),
        Message("POWR", "QffHHB", powr, "svv---", "F00---"),
        _gps(flight),
    ]


def _gps(flight: SimulatedFlight) -> Message:
    at_s = flight.time_s[sparse(flight.time_s, _GPS_HZ)]
    air = surroundings(at_s, flight.seed)
    stamps, ones, zeros = microseconds(at_s), np.ones(at_s.size), np.zeros(at_s.size)
    gps_us = EPOCH_US - _GPS_EPOCH_US + stamps
    gps: Mapping[str, ArrayLike] = {
        "TimeUS": stamps, "I": zeros, "Status": 3 * ones, "GMS": gps_us % _WEEK_US // 1000, "GWk": gps_us // _WEEK_US,
        "NSats": 14 * ones, "HDop": 0.8 * ones, "Lat": air.latitude_deg, "Lng": air.longitude_deg,
        "Alt": air.altitude_m, "Spd": air.airspeed_m_s, "GCrs": air.yaw_deg, "VZ": zeros, "Yaw": zeros, "U": ones,
    }  # fmt: skip
    return Message("GPS", "QBBIHBcLLeffffB", gps, "s#-s-S-DUmnhnh-", "F--C-0BGGB000--")
