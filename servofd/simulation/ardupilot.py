"""What ArduPlane says about itself in every kind of log: its parameters and its name.

The flight time 0 of a simulated flight is when its autopilot was booted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from servofd.aircraft.schema import Aircraft
from servofd.core.errors import ConfigError
from servofd.simulation.flight import SimulatedFlight
from servofd.simulation.pulses import THROTTLE, THROTTLE_FUNCTION, Output


def banner(version: str) -> str:
    """First thing the firmware says."""
    return f"ArduPlane V{version} (simulated by servofd)"


def reporting(flight: SimulatedFlight, aircraft: Aircraft) -> list[tuple[int, Output]]:
    """Outputs whose servos report where they are, with their place in the flight: surfaces with a measured channel.

    Raises `ConfigError` for a flight without pulses, which no autopilot can have logged.
    """
    if not flight.outputs:
        raise ConfigError("this flight has no pulses to log: simulate it with outputs=outputs_of(aircraft)")
    return [(i, o) for i, o in enumerate(flight.outputs) if aircraft.surfaces[o.surface].measured is not None]


def rate_hz(flight: SimulatedFlight) -> float:
    """Sample rate of a flight [Hz]."""
    return (flight.time_s.size - 1) / float(flight.time_s[-1] - flight.time_s[0])


def parameters(flight: SimulatedFlight, aircraft: Aircraft, feedback: str) -> dict[str, float]:
    """Settings of an ArduPlane that flies these outputs; `feedback` is ``"volz"``, ``"dronecan"`` or ``"script"``."""
    loop_hz = float(max(50, math.ceil(rate_hz(flight) / 0.8 - 1e-6)))  # a message is sent at 0.8 of it at most
    known = {
        "LOG_BACKEND_TYPE": 1.0, "LOG_BITMASK": 65535.0, "LOG_DISARMED": 0.0, "LOG_FILE_RATEMAX": 0.0,
        "LOG_REPLAY": 0.0, "SCHED_LOOP_RATE": loop_hz, "SERVO_AUTO_TRIM": 0.0, "SERVO_RATE": loop_hz,
    }  # fmt: skip
    mask = float(sum(1 << (output.number - 1) for _, output in reporting(flight, aircraft)))
    if feedback == "volz":
        range_deg = 2.0 * max(o.travel_deg for o in flight.outputs)
        known |= {"SERIAL4_PROTOCOL": 14.0, "SERVO_VOLZ_MASK": mask, "SERVO_VOLZ_RANGE": range_deg}
    elif feedback == "dronecan":
        known |= {"CAN_P1_DRIVER": 1.0, "CAN_D1_PROTOCOL": 1.0, "CAN_D1_UC_SRV_BM": mask, "CAN_D1_UC_SRV_RT": loop_hz}
    else:
        known |= {"SCR_ENABLE": 1.0}
    rows = {o.number: (o.function, o.min_us, o.max_us, o.trim_us, int(o.reversed)) for o in flight.outputs}
    rows.setdefault(THROTTLE, (THROTTLE_FUNCTION, 1100, 1900, 1100, 0))
    keys = ("FUNCTION", "MIN", "MAX", "TRIM", "REVERSED")
    return known | output_parameters({n: dict(zip(keys, rows[n], strict=True)) for n in sorted(rows)})


def output_parameters(outputs: Mapping[int, Mapping[str, float]]) -> dict[str, float]:
    """Parameters SERVOn_* of outputs, by their numbers."""
    return {f"SERVO{number}_{key}": float(value) for number, one in outputs.items() for key, value in one.items()}
