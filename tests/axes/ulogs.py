"""Flights as PX4 logs them: topics and rates of its default logging profile (src/modules/logger/logged_topics.cpp)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

import logparsers
from logparsers.records import FlightLog
from logparsers.ulog.encode import Topic, encode
from servofd.axes.motion import Motion

__all__ = ["ALLOCATED", "ELEVONS", "Surfaces", "read_as_ulog"]

Surfaces = Mapping[str, tuple[tuple[int, float], ...]]
"""CA_SV_CSk_TYPE and sign of the surfaces of each axis."""
ALLOCATED: Surfaces = {"roll": ((1, -1.0), (2, 1.0)), "pitch": ((3, 1.0),), "yaw": ((4, 1.0),)}
ELEVONS: Surfaces = {"roll": ((5, -1.0), (6, 1.0))}


def read_as_ulog(
    folder: Path,
    flight: Motion,
    surfaces: Surfaces | None = None,
    *,
    vtol_state: np.ndarray | None = None,
    parameters: Mapping[str, int | float] | None = None,
    vehicle: int = 1,
) -> FlightLog:
    """Write a flight as a ULog and read it again; without surfaces as before the control allocation (PX4 1.13)."""

    def stamps(step_s: float) -> tuple[np.ndarray, np.ndarray]:
        time_s = np.arange(flight.time_s[0], flight.time_s[-1], step_s)
        return time_s, np.round(time_s * 1e6).astype(np.uint64)

    def at(time_s: np.ndarray, *columns: np.ndarray) -> np.ndarray:
        return np.column_stack([np.interp(time_s, flight.time_s, one) for one in columns]).astype(np.float32)

    topics = []
    for name, field, step_s, columns in (
        ("vehicle_angular_velocity", "xyz", 0.02, np.radians(flight.rates_deg_s)),
        ("vehicle_acceleration", "xyz", 0.05, flight.accelerations_m_s2),
        ("vehicle_attitude", "q", 0.05, _quaternion(flight)),
    ):
        time_s, us = stamps(step_s)
        topics.append(Topic(name, {"timestamp": us, field: at(time_s, *columns)}))
    time_s, us = stamps(0.2)
    topics.append(
        Topic("airspeed_validated", {"timestamp": us, "true_airspeed_m_s": at(time_s, flight.airspeed_m_s)[:, 0]})
    )
    time_s, us = stamps(0.1)
    asked = {axis: at(time_s, values / 500.0)[:, 0] for axis, values in flight.commands_us.items()}
    controls = np.full((us.size, 8), np.nan, np.float32)
    settings: dict[str, int | float] = {"MAV_TYPE": vehicle, **(parameters or {})}
    if surfaces is None:
        controls[:, : len(asked)] = np.column_stack([asked[axis] for axis in ("roll", "pitch", "yaw") if axis in asked])
        controls[:, 3] = at(time_s, flight.throttle)[:, 0]
        topics.append(Topic("actuator_controls_0", {"timestamp": us, "control": controls}))
    else:
        parts = [(axis, *part) for axis, of_axis in surfaces.items() if axis in asked for part in of_axis]
        for k, (axis, kind, sign) in enumerate(parts):
            controls[:, k] = sign * asked[axis]
            settings[f"CA_SV_CS{k}_TYPE"] = kind
        topics.append(Topic("actuator_servos", {"timestamp": us, "control": controls}))
    if vtol_state is not None:
        states = np.interp(time_s, flight.time_s, vtol_state).astype(np.uint8)
        topics.append(Topic("vtol_vehicle_status", {"timestamp": us, "vehicle_vtol_state": states}))
    path = folder / "flight.ulg"
    path.write_bytes(encode(topics, parameters=settings))
    return logparsers.read(path)


def _quaternion(flight: Motion) -> tuple[np.ndarray, ...]:
    """Of an aircraft that heads north."""
    roll, pitch = np.radians(flight.roll_deg) / 2.0, np.radians(flight.pitch_deg) / 2.0
    return (
        np.cos(roll) * np.cos(pitch),
        np.sin(roll) * np.cos(pitch),
        np.cos(roll) * np.sin(pitch),
        -np.sin(roll) * np.sin(pitch),
    )
