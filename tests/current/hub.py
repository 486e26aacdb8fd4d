"""Logs of an aircraft with ordinary servos on a hub that reports what they draw, and no position."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from logparsers.dataflash import encode as dataflash
from logparsers.protocol import Autopilot, Kind, ParameterType, State
from logparsers.telemetry import encode as telemetry
from logparsers.ulog import encode as ulog
from servofd.simulation.dataflash_writer import pulses, rows, words
from servofd.simulation.surroundings import EPOCH_US, microseconds

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from servofd.core.types import IntArray
    from tests.current.motor import Flown

KNOWN = {"SERVO1_FUNCTION": 4.0, "CAN_D1_UC_SRV_BM": 1.0}
"""An aileron on output 1, which the hub on the bus turns."""
US_PER_DEG = 1.0 / 0.09
"""ArduPilot's: 1000 to 2000 us are 90 deg."""


def dataflash_of(flight: Flown, message: str = "CSRV") -> bytes:
    """What the autopilot writes on its card; the current as that of a servo, a circuit, or a battery beside another."""
    asked_us, read_us = microseconds(flight.command_s), microseconds(flight.current_s)
    if message == "CSRV":
        drawn = rows("CSRV", read_us, Id=1, Pos=np.nan, Force=np.nan, Speed=np.nan, PosCmd=np.nan, A=flight.current_a)
    else:
        twice, main_a = np.repeat(read_us, 2), np.full(read_us.size, 12.0)
        current_a = np.column_stack([main_a, flight.current_a]).ravel()
        columns: dict[str, ArrayLike] = {"TimeUS": twice, "Inst": np.tile([0, 1], read_us.size)}
        columns |= {"Volt": np.full(twice.size, 6.0), "Curr": current_a}
        drawn = dataflash.Message(message, "QBff", columns, "s#vA", "F-00")
    sent = pulses(asked_us, {1: 1500.0 + US_PER_DEG * flight.command_deg})
    return dataflash.encode([*words(asked_us[:1], KNOWN, "ArduPlane V4.7.0-dev (simulated)"), sent, drawn])


def ulog_of(flight: Flown) -> bytes:
    """What a fork of PX4 logs that takes the telemetry of servos: pulses, and `servo_status`, eight currents [A]."""
    asked_us, read_us = (microseconds(each).astype(np.uint64) for each in (flight.command_s, flight.current_s))
    pulses_us, currents_a = np.full((asked_us.size, 16), np.nan, np.float32), np.zeros((read_us.size, 8), np.float32)
    pulses_us[:, 0], currents_a[:, 0] = 1500.0 + US_PER_DEG * flight.command_deg, flight.current_a
    columns = {
        "actuator_outputs": (asked_us, "output", pulses_us),
        "servo_status": (read_us, "servo_current", currents_a),
    }
    return ulog.encode([ulog.Topic(name, {"timestamp": at, of: each}) for name, (at, of, each) in columns.items()])


def telemetry_of(flight: Flown, *, battery: bool = False) -> bytes:
    """What a ground station receives: pulses, and by a script ``SRVA1``, what the servo on output 1 draws [A].

    Or that as the current of a second battery [0.01 A].
    """
    asked_us, read_us = microseconds(flight.command_s), microseconds(flight.current_s)
    seconds_us = np.arange(asked_us[0], asked_us[-1], 1_000_000)
    beat = {"type": Kind.FIXED_WING, "autopilot": Autopilot.ARDUPILOTMEGA, "system_status": State.ACTIVE}
    known: dict[str, ArrayLike] = {
        "param_id": list(KNOWN),
        "param_value": list(KNOWN.values()),
        "param_count": [2, 2],
        "param_index": [0, 1],
    }
    messages: list[tuple[str, IntArray, dict[str, ArrayLike]]] = [
        ("HEARTBEAT", seconds_us, {name: np.full(seconds_us.size, value) for name, value in beat.items()}),
        ("SYSTEM_TIME", seconds_us, {"time_unix_usec": EPOCH_US + seconds_us, "time_boot_ms": seconds_us // 1000}),
        ("PARAM_VALUE", asked_us[:1].repeat(2), known | {"param_type": np.full(2, ParameterType.REAL32)}),
        (
            "SERVO_OUTPUT_RAW",
            asked_us,
            {"time_usec": asked_us, "servo1_raw": np.round(1500.0 + US_PER_DEG * flight.command_deg)},
        ),
        (
            "NAMED_VALUE_FLOAT",
            read_us,
            {"time_boot_ms": read_us // 1000, "name": ["SRVA1"] * read_us.size, "value": flight.current_a},
        ),
    ]
    if battery:
        drawn = {"id": 1, "current_battery": np.round(100.0 * flight.current_a)}
        messages[-1] = ("BATTERY_STATUS", read_us, {name: np.full(read_us.size, one) for name, one in drawn.items()})
    return telemetry.encode([telemetry.Message(name, EPOCH_US + at_us, fields) for name, at_us, fields in messages])
