"""PX4 log (``.ulg``) of a simulated flight: commands as controls, positions as a debug array."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from logparsers.protocol import Kind
from logparsers.records import Text
from logparsers.ulog.encode import Topic, encode
from servofd.aircraft.outputs import PX4_FIRST_SERVO, PX4_MOST_SERVOS, PX4_TYPES, SURFACE_FUNCTIONS
from servofd.aircraft.schema import Aircraft
from servofd.core.errors import ConfigError
from servofd.simulation.ardupilot import reporting
from servofd.simulation.flight import SimulatedFlight
from servofd.simulation.pulses import THROTTLE, THROTTLE_US, Output
from servofd.simulation.surroundings import EPOCH_US, microseconds, sparse, surroundings
from servofd.simulation.telemetry_writer import ARRAY_SIZE

Columns = dict[str, NDArray[Any]]

_RELEASE: Final = 0x010F00FF
"""Version 1.15.0, a release, as PX4 packs it into four bytes."""
_MOTOR_1 = 101
"""Function of the first motor (PX4, PWM_MAIN_FUNCn)."""
_OUTPUT_SLOTS = 16
"""Outputs of actuator_outputs."""
_TYPE_OF: Final = {name: kind for kind, name in PX4_TYPES.items()}
"""CA_SV_CSk_TYPE by what it turns."""


def ulog_log(flight: SimulatedFlight, aircraft: Aircraft) -> bytes:
    """Content of a ``.ulg`` file."""
    said = Text(float(flight.time_s[0]), "[servofd] simulated flight", 6)
    information: dict[str, int | str] = {"sys_name": "PX4", "ver_hw": "SIMULATED", "ver_sw_release": _RELEASE}
    topics = ulog_topics(flight, aircraft)
    return encode(topics, parameters=ulog_parameters(flight), information=information, texts=[said])


def ulog_topics(flight: SimulatedFlight, aircraft: Aircraft) -> list[Topic]:
    """Samples of each topic.

    `flight`: with outputs. Result: ``actuator_servos`` (``control[k]``: -1 to 1 is the whole travel of servo k + 1, the
    surfaces in order) and ``debug_array`` named SRVP (``data[k]``: arm of the same servo [deg]; NaN: it reports
    nothing) at the rate of the flight; ``actuator_outputs`` (pulses [us] by output), ``airspeed``, ``system_power`` and
    ``vehicle_gps_position`` more seldom.
    """
    measured = reporting(flight, aircraft)
    if len(flight.outputs) > PX4_MOST_SERVOS:
        raise ConfigError(
            f"{len(flight.outputs)} surfaces: a PX4 log has room for {PX4_MOST_SERVOS}; write a .bin instead"
        )
    stamps = microseconds(flight.time_s).astype(np.uint64)
    control = np.full((stamps.size, PX4_MOST_SERVOS), np.nan, np.float32)
    data = np.full((stamps.size, ARRAY_SIZE), np.nan, np.float32)
    for k, output in enumerate(flight.outputs):
        control[:, k] = flight.command_deg[:, k] / output.travel_deg
    for k, output in measured:
        data[:, k] = output.arm_deg(flight.measured_deg[:, k])
    positions: Columns = {
        "timestamp": stamps,
        "data": data,
        "id": np.ones(stamps.size, np.uint16),
        "name": np.full(stamps.size, b"SRVP", "S10"),
    }
    return [
        Topic("actuator_servos", {"timestamp": stamps, "timestamp_sample": stamps, "control": control}),
        Topic("debug_array", positions),
        _pulses(flight),
        *_air(flight),
    ]


def ulog_parameters(flight: SimulatedFlight) -> dict[str, int | float]:
    """Settings of a PX4 that flies these outputs, by name."""
    known: dict[str, int | float] = {
        "MAV_TYPE": int(Kind.FIXED_WING),
        "CA_AIRFRAME": 1,
        "CA_SV_CS_COUNT": len(flight.outputs),
    }
    known |= {"SDLOG_PROFILE": 1 | 16 | 32}  # default, high rate, debug
    for k, output in enumerate(flight.outputs):
        known |= {f"CA_SV_CS{k}_TYPE": _type(output), f"CA_SV_CS{k}_TRIM": 0.0}
        n = output.number
        known |= {f"PWM_MAIN_FUNC{n}": PX4_FIRST_SERVO + k, f"PWM_MAIN_DIS{n}": output.trim_us}
        known |= {f"PWM_MAIN_MIN{n}": output.min_us, f"PWM_MAIN_MAX{n}": output.max_us}
    known.setdefault(f"PWM_MAIN_FUNC{THROTTLE}", _MOTOR_1)
    known["PWM_MAIN_REV"] = sum(1 << (o.number - 1) for o in flight.outputs if o.reversed)
    return known


def _type(output: Output) -> int:
    """CA_SV_CSk_TYPE; ailerons and flaps have sides that ArduPilot does not tell apart."""
    kind, name = SURFACE_FUNCTIONS.get(output.function, "any"), output.surface.lower()
    side = "right" if "right" in name or name.endswith("_r") else "left"
    has_side = side == "right" or "left" in name or name.endswith("_l")
    word = {"flap": "flap_left", "flaperon_left": "aileron_left", "flaperon_right": "aileron_right"}.get(kind, kind)
    sided = f"{word.partition('_')[0]}_{side}"
    return _TYPE_OF.get(sided if has_side else word, _TYPE_OF.get(word, _TYPE_OF["any"]))


def _pulses(flight: SimulatedFlight) -> Topic:
    rows = sparse(flight.time_s, 10.0)
    pulses = np.zeros((rows.size, _OUTPUT_SLOTS), np.float32)
    pulses[:, THROTTLE - 1] = THROTTLE_US
    for k, output in enumerate(flight.outputs):
        pulses[:, output.number - 1] = flight.pulse_us[rows, k]
    columns: Columns = {"timestamp": microseconds(flight.time_s[rows]).astype(np.uint64), "output": pulses}
    columns["noutputs"] = np.full(rows.size, max(THROTTLE, *(o.number for o in flight.outputs)), np.uint32)
    return Topic("actuator_outputs", columns)


def _air(flight: SimulatedFlight) -> list[Topic]:
    at_s = flight.time_s[sparse(flight.time_s, 5.0)]
    air, stamps = surroundings(at_s, flight.seed), microseconds(at_s).astype(np.uint64)
    speed: Columns = {"timestamp": stamps, "indicated_airspeed_m_s": air.airspeed_m_s.astype(np.float32)}
    power: Columns = {"timestamp": stamps, "voltage5v_v": air.board_v.astype(np.float32)}
    power["servo_valid"] = np.ones(stamps.size, np.uint8)
    fix: Columns = {"timestamp": stamps, "time_utc_usec": stamps + np.uint64(EPOCH_US)}
    fix |= {"lat": np.rint(air.latitude_deg * 1e7).astype(np.int32)}
    fix |= {"lon": np.rint(air.longitude_deg * 1e7).astype(np.int32), "fix_type": np.full(stamps.size, 3, np.uint8)}
    return [Topic("airspeed", speed), Topic("system_power", power), Topic("vehicle_gps_position", fix)]
