"""ArduPlane's DataFlash log (``.bin``) of an aeroplane whose servos report nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from logparsers.dataflash.encode import Message, encode
from logparsers.units import US_PER_S
from servofd.servo.context import AIR_KG_M3
from servofd.simulation.ardupilot import banner
from servofd.simulation.pulses import THROTTLE

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike

    from servofd.simulation.airframe import AirframeFlight

_OUTPUTS: Final = 14
"""Outputs of an RCOU record."""
_VERSION: Final = "4.6.0"


def airframe_parameters(flight: AirframeFlight) -> dict[str, float]:
    """What the autopilot knows of its outputs."""
    functions = {number: float(function) for number, (function, _, _) in flight.mixer.outputs.items()}
    found: dict[str, float] = {}
    for number, function in sorted((functions | {THROTTLE: 70.0}).items()):
        low, high = (1000.0, 2000.0) if number == THROTTLE else (1050.0, 1950.0)
        found |= {f"SERVO{number}_FUNCTION": function, f"SERVO{number}_TRIM": 1500.0, f"SERVO{number}_REVERSED": 0.0}
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
    n = stamps.size
    known = airframe_parameters(flight)
    first = [int(stamps[0])] * len(known)
    values = list(known.values())
    settings: Mapping[str, ArrayLike] = {"TimeUS": first, "Name": list(known), "Value": values, "Default": values}
    said: Mapping[str, ArrayLike] = {"TimeUS": first[:1], "Message": [banner(_VERSION)]}
    outputs: dict[str, ArrayLike] = {"TimeUS": stamps}
    outputs |= {f"C{number}": np.zeros(n, np.int64) for number in range(1, _OUTPUTS + 1)}
    outputs |= {f"C{number}": flight.pulses_us[:, k] for k, number in enumerate(flight.mixer.outputs)}
    outputs[f"C{THROTTLE}"] = np.round(1000.0 + 1000.0 * flight.throttle)
    p, q, r = np.radians(flight.rates_deg_s)
    ax, ay, az = flight.accelerations_m_s2
    zeros, ones = np.zeros(n), np.ones(n)
    imu: Mapping[str, ArrayLike] = {
        "TimeUS": stamps, "I": zeros, "GyrX": p, "GyrY": q, "GyrZ": r, "AccX": ax, "AccY": ay, "AccZ": az, "EG": zeros,
        "EA": zeros, "T": 30.0 * ones, "GH": ones, "AH": ones, "GHz": zeros, "AHz": zeros,
    }  # fmt: skip
    att: Mapping[str, ArrayLike] = {
        "TimeUS": stamps, "DesRoll": zeros, "Roll": flight.roll_deg, "DesPitch": zeros, "Pitch": flight.pitch_deg,
        "DesYaw": zeros, "Yaw": zeros, "AEKF": 3 * ones,
    }  # fmt: skip
    pressure_pa = 0.5 * AIR_KG_M3 * flight.airspeed_m_s**2
    arsp: Mapping[str, ArrayLike] = {
        "TimeUS": stamps, "I": zeros, "Airspeed": flight.airspeed_m_s, "DiffPress": pressure_pa, "Temp": 18.5 * ones,
        "RawPress": pressure_pa, "Offset": zeros, "U": ones, "H": ones, "Hp": ones, "TR": zeros, "Pri": zeros,
    }  # fmt: skip
    return encode(
        [
            Message("PARM", "QNff", settings, "s---", "F---"),
            Message("MSG", "QZ", said, "s-", "F-"),
            Message("RCOU", "Q" + "H" * _OUTPUTS, outputs, "s" + "Y" * _OUTPUTS, "F" + "-" * _OUTPUTS),
            Message("IMU", "QBffffffIIfBBHH", imu, "s#EEEooo--O--zz", "F-000000-----00"),
            Message("ATT", "QffffffB", att, "sddddhh-", "F000000-"),
            Message("ARSP", "QBffcffBBffB", arsp, "s#nPOPP-----", "F-00B00-----"),
        ]
    )
