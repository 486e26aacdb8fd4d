"""Simulated bench tests with a known truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from servofd.aircraft.series import Series
from servofd.core.types import FloatArray
from servofd.servo.effects.linkage import RateLimit
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel
from servofd.simulation.commands import chirp


def quantized(values: FloatArray, bits: int) -> FloatArray:
    """What a converter of so many bits over 180 deg reads."""
    step_deg = 180.0 / 2**bits
    read: FloatArray = np.round(values / step_deg) * step_deg
    return read


def sweep(
    servo: str,
    *,
    noise_deg: float = 0.1,
    bits: int = 12,
    seed: int = 0,
    duration_s: float = 120.0,
    amplitude: float = 1.0,
    rate_deg_s: float | None = None,
) -> Series:
    """Chirp of thesis 3.2.3 on a library servo."""
    rng = np.random.default_rng(seed)
    time_s = np.round(np.arange(round(100.0 * duration_s)) / 100.0, 9)
    command_deg = amplitude * chirp(time_s, rng)
    model = ServoModel.of(servo_named(servo))
    if rate_deg_s is not None:
        model = model + RateLimit(rate_deg_s)
    measured_deg = model.simulate(time_s, command_deg, time_s) + noise_deg * rng.standard_normal(time_s.size)
    return Series("elevator", time_s, command_deg, time_s, quantized(measured_deg, bits))


def step(size_deg: float, *, noise_deg: float = 0.05, seed: int = 0) -> Series:
    """Step up and back of an HS-225BB at 100 Hz."""
    rng = np.random.default_rng(seed)
    time_s = np.round(np.arange(400) / 100.0, 9)
    command_deg = np.where((time_s > 1.0) & (time_s < 2.5), size_deg / 2.0, -size_deg / 2.0)
    deflection_deg = ServoModel.of(servo_named("hs225bb-eq31")).simulate(time_s, command_deg, time_s)
    return Series("elevator", time_s, command_deg, time_s, deflection_deg + noise_deg * rng.standard_normal(400))


def written(path: Path, segment: Series) -> Path:
    """The same as a plain table."""
    rows = np.column_stack([segment.measured_s, segment.command_deg, segment.measured_deg])
    np.savetxt(path, rows, delimiter=",", header="time_s,elevator_cmd_deg,elevator_pos_deg", comments="", fmt="%.6f")
    return path
