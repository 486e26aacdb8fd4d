"""ArduPlane's DataFlash log (``.bin``) of a simulated flight, in both generations of servo telemetry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from logparsers.dataflash.encode import Message, encode
from servofd.aircraft.schema import Aircraft
from servofd.core.types import IntArray
from servofd.servo.context import pressure_pa
from servofd.simulation.ardupilot import banner, parameters, reporting
from servofd.simulation.flight import SimulatedFlight
from servofd.simulation.pulses import MOST_OUTPUTS, THROTTLE, THROTTLE_US
from servofd.simulation.surroundings import EPOCH_US, RAIL_V, current_a, microseconds, sparse, stalled_a, surroundings

_CONTEXT_HZ: Final = 10.0
"""Rate of attitude, airspeed and supply in the log [Hz]."""
_GPS_HZ: Final = 5.0
"""Rate of GPS in the log [Hz]."""
_GPS_EPOCH_US: Final = 315_964_800_000_000 - 18_000_000
"""6 January 1980 in Unix time, less the 18 leap seconds since [us]: GPS time begins then."""
_WEEK_US: Final = 7 * 86_400_000_000
"""A week of GPS time [us]."""
_EACH_OUTPUT: Final = tuple(f"C{n}" for n in range(1, MOST_OUTPUTS + 1))
_MESSAGES: Final[Mapping[str, tuple[str, str, str, str]]] = {
    "PARM": ("TimeUS Name Value Default", "QNff", "s---", "F---"),
    "MSG": ("TimeUS Message", "QZ", "s-", "F-"),
    "RCOU": (
        f"TimeUS {' '.join(_EACH_OUTPUT)}",
        f"Q{'H' * MOST_OUTPUTS}", f"s{'Y' * MOST_OUTPUTS}", f"F{'-' * MOST_OUTPUTS}",
    ),
    "CSRV": ("TimeUS Id Pos Force Speed Pow PosCmd V A MotT PCBT Err", "QBfffBfffffB", "", ""),
    "IMU": (
        "TimeUS I GyrX GyrY GyrZ AccX AccY AccZ EG EA T GH AH GHz AHz",
        "QBffffffIIfBBHH", "s#EEEooo--O--zz", "F-000000-----00",
    ),
    "ARSP": (
        "TimeUS I Airspeed DiffPress Temp RawPress Offset U H Hp TR Pri", "QBffcffBBffB", "s#nPOPP-----", "F-00B00-----"
    ),
    "ATT": ("TimeUS DesRoll Roll DesPitch Pitch DesYaw Yaw AEKF", "QffffffB", "sddddhh-", "F000000-"),
    "POWR": ("TimeUS Vcc VServo Flags AccFlags Safety", "QffHHB", "svv---", "F00---"),
    "GPS": (
        "TimeUS I Status GMS GWk NSats HDop Lat Lng Alt Spd GCrs VZ Yaw U",
        "QBBIHBcLLeffffB", "s#-s-S-DUmnhnh-", "F--C-0BGGB000--",
    ),
}  # fmt: skip
"""Of each message its columns, their formats, units and multipliers."""


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

    `flight`: with outputs. `settings`: the vehicle's parameters, if others than the usual ones. Result: RCOU and one
    CSRV row per reporting servo at the rate of the flight; ARSP, ATT, POWR and GPS more seldom.
    """
    known = parameters(flight, aircraft, generation.name) if settings is None else settings
    stamps_us = microseconds(flight.time_s)
    sent = {THROTTLE: THROTTLE_US} | {o.number: flight.pulse_us[:, i] for i, o in enumerate(flight.outputs)}
    return [
        *words(stamps_us[:1], known, banner(generation.version), "Throttle armed"),
        pulses(stamps_us, sent),
        *_csrv(flight, aircraft, generation),
        *_air(flight),
    ]


def rows(name: str, stamps_us: IntArray, **given: ArrayLike) -> Message:
    """Rows of a message; what is not given is 0."""
    columns, kinds, units, multipliers = _MESSAGES[name]
    known = {"TimeUS": stamps_us} | given
    whole = {column: np.broadcast_to(known.get(column, 0), stamps_us.shape) for column in columns.split()}
    return Message(name, kinds, whole, units, multipliers)


def words(start_us: IntArray, known: Mapping[str, float], *said: str) -> list[Message]:
    """Parameters and what the autopilot says, all at the beginning."""
    values = list(known.values())
    parm = rows("PARM", np.repeat(start_us, len(known)), Name=list(known), Value=values, Default=values)
    return [parm, rows("MSG", np.repeat(start_us, len(said)), Message=said)]


def pulses(stamps_us: IntArray, pulses_us: Mapping[int, ArrayLike]) -> Message:
    """Pulses of outputs, by their numbers."""
    return rows("RCOU", stamps_us, **{_EACH_OUTPUT[number - 1]: values for number, values in pulses_us.items()})


def _csrv(flight: SimulatedFlight, aircraft: Aircraft, generation: Generation) -> list[Message]:
    """One message per servo: rows of equal time stay in the order of the outputs."""
    time_s, found = flight.time_s, []
    for i, output in sorted(reporting(flight, aircraft), key=lambda each: each[1].number):
        rng, measured_deg = np.random.default_rng([flight.seed, i, 1001]), flight.measured_deg[:, i]
        arm_deg, speed_deg_s = output.arm_deg(measured_deg), np.gradient(measured_deg, time_s)
        # It draws current as it turns or is held back from what it asks for.
        drawn_a = current_a(speed_deg_s, rng) + stalled_a(time_s, flight.received_deg[:, i], measured_deg)
        servo: dict[str, ArrayLike] = {"Id": output.number - 1 + generation.first_id}
        if generation is VOLZ:  # what the driver does not know is NaN, or 0 in a whole number
            servo |= {"Force": np.nan, "Speed": np.nan, "PosCmd": output.arm_deg(flight.command_deg[:, i])}
            warm = 1.0 - np.exp(-(time_s - time_s[0]) / 300.0)
            servo |= {"V": RAIL_V - 0.15 * drawn_a + 0.01 * rng.standard_normal(time_s.size), "A": drawn_a}
            servo["MotT"] = np.round(25.0 + 12.0 * warm + 0.2 * rng.standard_normal(time_s.size))
            servo["PCBT"] = np.round(27.0 + 6.0 * warm + 0.2 * rng.standard_normal(time_s.size))
            servo["Pos"] = _VOLZ_STEP_DEG * np.round(arm_deg / _VOLZ_STEP_DEG)
        else:  # what actuator.Status does not hold is 0
            servo["Pos"] = np.radians(arm_deg).astype(np.float16)
            servo["Force"] = (0.4 * drawn_a).astype(np.float16)
            servo["Speed"] = np.radians(output.arm_deg(speed_deg_s)).astype(np.float16)
            servo["Pow"] = np.round(np.clip(60.0 * drawn_a, 0.0, 100.0))
        made = rows("CSRV", microseconds(time_s), **servo)
        found.append(replace(made, units=generation.units, multipliers=generation.multipliers))
    return [_joined(found)] if found else []


def _joined(messages: list[Message]) -> Message:
    """All rows of messages that share a name, sorted by time."""
    first = messages[0]
    columns = {name: np.concatenate([np.asarray(m.columns[name]) for m in messages]) for name in first.columns}
    order = np.argsort(columns["TimeUS"], kind="stable")
    return replace(first, columns={name: values[order] for name, values in columns.items()})


def _air(flight: SimulatedFlight) -> list[Message]:
    """Context, seldom."""
    at_s = flight.time_s[sparse(flight.time_s, _CONTEXT_HZ)]
    air = surroundings(at_s, flight.seed)
    stamps, pushed_pa = microseconds(at_s), pressure_pa(air.airspeed_m_s)
    pitot = {"Airspeed": air.airspeed_m_s, "DiffPress": pushed_pa, "RawPress": pushed_pa + 2.0}
    turned = {"Roll": air.roll_deg, "Pitch": air.pitch_deg, "DesYaw": air.yaw_deg, "Yaw": air.yaw_deg}
    return [
        rows("ARSP", stamps, **pitot, Temp=18.5, Offset=2.0, U=1, H=1, Hp=1),
        rows("ATT", stamps, **turned, DesRoll=28.0, DesPitch=3.0, AEKF=3),
        rows("POWR", stamps, Vcc=air.board_v, VServo=air.rail_v, Flags=3, AccFlags=3, Safety=2),
        _gps(flight),
    ]


def _gps(flight: SimulatedFlight) -> Message:
    at_s = flight.time_s[sparse(flight.time_s, _GPS_HZ)]
    air, stamps = surroundings(at_s, flight.seed), microseconds(at_s)
    gps_us = EPOCH_US - _GPS_EPOCH_US + stamps
    place = {"Lat": air.latitude_deg, "Lng": air.longitude_deg, "Alt": air.altitude_m}
    way = {"Spd": air.airspeed_m_s, "GCrs": air.yaw_deg}
    week = {"GMS": gps_us % _WEEK_US // 1000, "GWk": gps_us // _WEEK_US}
    return rows("GPS", stamps, Status=3, NSats=14, HDop=0.8, U=1, **week, **place, **way)
