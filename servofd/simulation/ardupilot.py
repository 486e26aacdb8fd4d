"""What ArduPlane says about itself in every kind of log: its parameters and its name."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from servofd.aircraft.schema import Aircraft
from servofd.core.errors import ConfigError
from servofd.simulation.pulses import THROTTLE, THROTTLE_FUNCTION

if TYPE_CHECKING:
    from servofd.simulation.flight import SimulatedFlight


def banner(version: str) -> str:
    """First thing the firmware says."""
    return f"ArduPlane V{version} (simulated by servofd)"


def outputs_needed(flight: SimulatedFlight) -> None:
    """Refuse a flight without pulses."""
    if not flight.outputs:
        raise ConfigError("this flight has no pulses to log: simulate it with outputs=outputs_of(aircraft)")


def rate_hz(flight: SimulatedFlight) -> float:
    """Sample rate of a flight [Hz]."""
    return (flight.time_s.size - 1) / float(flight.time_s[-1] - flight.time_s[0])


def parameters(flight: SimulatedFlight, aircraft: Aircraft, feedback: str) -> dict[str, float]:
    """Settings of an ArduPlane that flies these outputs.

    `feedback`: how: ``"volz"``, ``"dronecan"`` or ``"script"``.
    """
    loop_hz = float(max(50, math.ceil(rate_hz(flight) / 0.8 - 1e-6)))  # a message is sent at 0.8 of it at most
    known = {
        "LOG_BACKEND_TYPE": 1.0, "LOG_BITMASK": 65535.0, "LOG_DISARMED": 0.0, "LOG_FILE_RATEMAX": 0.0,
        "LOG_REPLAY": 0.0, "SCHED_LOOP_RATE": loop_hz, "SERVO_AUTO_TRIM": 0.0, "SERVO_RATE": loop_hz,
    }  # fmt: skip
    reporting = [o for o in flight.outputs if aircraft.surfaces[o.surface].measured is not None]
    mask = float(sum(1 << (o.number - 1) for o in reporting))
    if feedback == "volz":
        range_deg = 2.0 * max(o.travel_deg for o in flight.outputs)
        known |= {"SERIAL4_PROTOCOL": 14.0, "SERVO_VOLZ_MASK": mask, "SERVO_VOLZ_RANGE": range_deg}
    elif feedback == "dronecan":
        known |= {"CAN_P1_DRIVER": 1.0, "CAN_D1_PROTOCOL": 1.0, "CAN_D1_UC_SRV_BM": mask, "CAN_D1_UC_SRV_RT": loop_hz}
    else:
        known |= {"SCR_ENABLE": 1.0}
    rows = {o.number: (o.function, o.min_us, o.max_us, o.trim_us, int(o.reversed)) for o in flight.outputs}
    rows.setdefault(THROTTLE, (THROTTLE_FUNCTION, 1100, 1900, 1100, 0))
    for number in sorted(rows):
        values = zip(("FUNCTION", "MIN", "MAX", "TRIM", "REVERSED"), rows[number], strict=True)
        known |= {f"SERVO{number}_{key}": float(value) for key, value in values}
    return known
