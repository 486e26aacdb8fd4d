"""ArduPlane's DataFlash log (``.bin``) of an aeroplane whose servos report nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from logparsers.dataflash.encode import encode
from logparsers.units import US_PER_S
from servofd.servo.context import AIR_KG_M3
from servofd.simulation.dataflash_writer import pulses, rows, words
from servofd.simulation.pulses import THROTTLE, THROTTLE_FUNCTION, banner, functions_of

if TYPE_CHECKING:
    from servofd.simulation.airframe import AirframeFlight

_VERSION: Final = "4.6.0"


def airframe_parameters(flight: AirframeFlight) -> dict[str, float]:
    """What the autopilot knows of its outputs."""
    functions = functions_of(flight.mixer.names)
    turned: dict[int, int] = {number: functions[name] for number, (name, _) in flight.mixer.outputs.items()}
    found: dict[str, float] = {}
    for number, function in sorted((turned | {THROTTLE: THROTTLE_FUNCTION}).items()):
        low, high = (1000.0, 2000.0) if number == THROTTLE else (1050.0, 1950.0)
        found |= {
            f"SERVO{number}_FUNCTION": float(function),
            f"SERVO{number}_TRIM": 1500.0,
            f"SERVO{number}_REVERSED": 0.0,
        }
        found |= {f"SERVO{number}_MIN": low, f"SERVO{number}_MAX": high}
    return found


def airframe_log(flight: AirframeFlight) -> bytes:
    """Content of a ``.bin`` file: commands, gyros, accelerometers, attitude and airspeed.

    Examples
    --------
    >>> from servofd.simulation.airframe import fly_airframe
    >>> airframe_log(fly_airframe(1, duration_s=10.0))[:2].hex()
    'a395'
    """
    stamps = np.round(US_PER_S * (flight.time_s + 5.0)).astype(np.int64)
    sent = dict(zip(flight.mixer.outputs, flight.pulses_us.T, strict=True))
    p, q, r = np.radians(flight.rates_deg_s)
    ax, ay, az = flight.accelerations_m_s2
    pressure_pa = 0.5 * AIR_KG_M3 * flight.airspeed_m_s**2
    pitot = {"Airspeed": flight.airspeed_m_s, "DiffPress": pressure_pa, "RawPress": pressure_pa}
    return encode(
        [
            *words(stamps[:1], airframe_parameters(flight), banner(_VERSION)),
            pulses(stamps, sent | {THROTTLE: np.round(1000.0 + 1000.0 * flight.throttle)}),
            rows("IMU", stamps, GyrX=p, GyrY=q, GyrZ=r, AccX=ax, AccY=ay, AccZ=az, T=30.0, GH=1, AH=1),
            rows("ATT", stamps, Roll=flight.roll_deg, Pitch=flight.pitch_deg, AEKF=3),
            rows("ARSP", stamps, **pitot, Temp=18.5, U=1, H=1, Hp=1),
        ]
    )
