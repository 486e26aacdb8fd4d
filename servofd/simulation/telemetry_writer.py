"""MAVLink telemetry log (``.tlog``) of a simulated flight: commands, and positions as named values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from logparsers.protocol import Autopilot, Kind, ParameterType, State
from logparsers.telemetry.encode import Message, encode
from servofd.aircraft.schema import Aircraft
from servofd.core.types import IntArray
from servofd.simulation.ardupilot import banner, parameters, reporting
from servofd.simulation.flight import SimulatedFlight
from servofd.simulation.pulses import THROTTLE, THROTTLE_US
from servofd.simulation.surroundings import EPOCH_US, microseconds, sparse, surroundings

Sent = tuple[str, IntArray, dict[str, ArrayLike]]
"""Name of a message, when it was made [us], and its fields."""

VERSION: Final = "4.7.0-dev"
FEEDBACK: Final = ("named", "port", "array")
"""Messages that tell positions: see `servo_rows`."""

_FASTEST_LINK_US: Final = 12_000
"""Delay of the fastest message on the link [us]."""
_WAITING_US: Final = 3_000
"""Mean time that a message waits longer than that, of an exponential distribution [us]."""
_ARMED_AUTO: Final = 128 | 16 | 8 | 4 | 1
"""Mode of an armed aircraft in AUTO (MAVLink, MAV_MODE_FLAG)."""
_WRAP: Final = 2**32
"""Time stamps of 32 bits begin anew after this count."""
_POSITION_PORT: Final = 2
ARRAY_SIZE: Final = 58
"""Numbers of a DEBUG_FLOAT_ARRAY (MAVLink), and of a debug_array (PX4)."""


def telemetry_log(flight: SimulatedFlight, aircraft: Aircraft) -> bytes:
    """Content of a ``.tlog`` file."""
    return encode(telemetry_messages(flight, aircraft))


def telemetry_messages(flight: SimulatedFlight, aircraft: Aircraft) -> list[Message]:
    """Frames of each message, with the times at which a ground station received them.

    `flight`: with outputs. Its clocks overflow after 71.6 minutes (``time_usec``) and 49.7 days (``time_boot_ms``), as
    those of the real one do. Result: ``SERVO_OUTPUT_RAW``, and ``NAMED_VALUE_FLOAT`` named ``SRVP<n>`` for the arm of
    the servo on output n [deg], at the rate of the flight; HEARTBEAT, SYSTEM_TIME, ATTITUDE and VFR_HUD more seldom;
    parameters and words at the beginning.
    """
    beat, time = beats(flight)
    sent = [beat, *_words(flight, aircraft), time, *servo_rows(flight, aircraft), *air_rows(flight)]
    arrivals = _arrivals([made_us for _, made_us, _ in sent], np.random.default_rng([flight.seed, 1002]))
    return [Message(name, at_us, columns) for (name, _, columns), at_us in zip(sent, arrivals, strict=True)]


def beats(flight: SimulatedFlight) -> list[Sent]:
    """HEARTBEAT and SYSTEM_TIME, once a second."""
    seconds_us = microseconds(flight.time_s[sparse(flight.time_s, 1.0)])
    beat = {"type": Kind.FIXED_WING, "autopilot": Autopilot.ARDUPILOTMEGA, "base_mode": _ARMED_AUTO, "custom_mode": 10}
    beat |= {"system_status": State.ACTIVE, "mavlink_version": 3}
    return [
        ("HEARTBEAT", seconds_us, {name: np.full(seconds_us.size, value) for name, value in beat.items()}),
        ("SYSTEM_TIME", seconds_us, {"time_unix_usec": EPOCH_US + seconds_us, "time_boot_ms": _boot_ms(seconds_us)}),
    ]


def _words(flight: SimulatedFlight, aircraft: Aircraft) -> list[Sent]:
    start_us = microseconds(flight.time_s[:1])
    known = parameters(flight, aircraft, "script")
    param: dict[str, ArrayLike] = {
        "param_id": list(known),
        "param_value": list(known.values()),
        "param_type": [ParameterType.REAL32] * len(known),
        "param_count": [len(known)] * len(known),
        "param_index": np.arange(len(known)),
    }
    return [
        ("STATUSTEXT", start_us, {"severity": [6], "text": [banner(VERSION)]}),
        ("PARAM_VALUE", np.repeat(start_us, len(known)), param),
    ]


def servo_rows(flight: SimulatedFlight, aircraft: Aircraft, feedback: str = "named") -> list[Sent]:
    """Pulses and positions of all outputs.

    `feedback`: how the position of the servo on output n is sent: ``"named"``, NAMED_VALUE_FLOAT ``SRVP<n>``, angle of
    the arm [deg]; ``"array"``, the same in element n - 1 of a DEBUG_FLOAT_ARRAY named ``SRVP``; or ``"port"``, the
    pulse that would ask for it [us], rounded, as ``servo<n>_raw`` of a SERVO_OUTPUT_RAW with port 2 (port 1 is the
    outputs from 17 on).
    """
    made_us = microseconds(flight.time_s)
    stamp = {"time_usec": made_us % _WRAP}
    pulses: dict[str, ArrayLike] = {f"servo{o.number}_raw": flight.pulse_us[:, i] for i, o in enumerate(flight.outputs)}
    pulses.setdefault(f"servo{THROTTLE}_raw", np.full(made_us.size, THROTTLE_US))
    sent: list[Sent] = [("SERVO_OUTPUT_RAW", made_us, {**stamp, **pulses})]
    measured = reporting(flight, aircraft)
    arms_deg = {o.number: o.arm_deg(flight.measured_deg[:, i]) for i, o in measured}
    if feedback == "port" and measured:
        raw = {f"servo{o.number}_raw": o.nearest_us(flight.measured_deg[:, i]) for i, o in measured}
        sent.append(("SERVO_OUTPUT_RAW", made_us, {**stamp, "port": np.full(made_us.size, _POSITION_PORT), **raw}))
    elif feedback == "array" and measured:
        data = np.zeros((made_us.size, ARRAY_SIZE))
        for number, arm_deg in arms_deg.items():
            data[:, number - 1] = arm_deg
        ids = np.full(made_us.size, 1)
        array: dict[str, ArrayLike] = {"time_usec": made_us, "name": ["SRVP"] * made_us.size, "array_id": ids}
        sent.append(("DEBUG_FLOAT_ARRAY", made_us, {**array, "data": data}))
    elif feedback == "named":
        for number, arm_deg in arms_deg.items():
            position: dict[str, ArrayLike] = {"time_boot_ms": _boot_ms(made_us), "value": arm_deg}
            sent.append(("NAMED_VALUE_FLOAT", made_us, position | {"name": [f"SRVP{number}"] * made_us.size}))
    return sent


def air_rows(flight: SimulatedFlight) -> list[Sent]:
    """ATTITUDE ten times a second, VFR_HUD twice."""
    at_s = flight.time_s[sparse(flight.time_s, 10.0)]
    air, made_us = surroundings(at_s, flight.seed), microseconds(at_s)
    seldom = sparse(at_s, 2.0)
    attitude: dict[str, ArrayLike] = {
        "time_boot_ms": _boot_ms(made_us),
        "roll": np.radians(air.roll_deg),
        "pitch": np.radians(air.pitch_deg),
        "yaw": np.radians((air.yaw_deg + 180.0) % 360.0 - 180.0),
    }
    hud: dict[str, ArrayLike] = {
        "airspeed": air.airspeed_m_s[seldom],
        "groundspeed": air.airspeed_m_s[seldom],
        "heading": air.yaw_deg[seldom].astype(np.int64),
        "throttle": np.full(seldom.size, 55),
        "alt": air.altitude_m[seldom],
    }
    return [("ATTITUDE", made_us, attitude), ("VFR_HUD", made_us[seldom], hud)]


def _boot_ms(made_us: IntArray) -> IntArray:
    """The autopilot's other clock: whole milliseconds, cut off."""
    return made_us // 1000 % _WRAP


def _arrivals(made_us: Sequence[IntArray], rng: np.random.Generator) -> list[IntArray]:
    """When frames arrive over a link that delays them and keeps their order, in the shapes of `made_us`."""
    together = np.concatenate(made_us)
    order = np.argsort(together, kind="stable")
    late_us = _FASTEST_LINK_US + np.rint(rng.exponential(_WAITING_US, together.size)).astype(np.int64)
    arrival_us = np.empty_like(together)
    arrival_us[order] = np.maximum.accumulate(EPOCH_US + together[order] + late_us[order])
    return np.split(arrival_us, np.cumsum([m.size for m in made_us])[:-1])
