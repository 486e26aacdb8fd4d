"""A servo in steps of a quarter millisecond, written from scratch: shares nothing with the kernel that explains it.

Torque, friction and loads act on a mass; the loop's damping is split otherwise than in `servofd.servo.physics`.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np
from numba import njit

from servofd.core.types import FloatArray
from servofd.simulation.commands import COMMANDS

_STEPS = 40
_SPLIT = 0.65


@dataclass(frozen=True)
class FineServo:
    """HS-225BB of Eq. 3.1, and what is hidden in it."""

    delay_s: float = 0.004
    slow: float = 1.0
    rate_deg_s: float = math.inf
    deg_s_per_v: float = math.inf
    lower_deg: float = -math.inf
    upper_deg: float = math.inf
    deadband_deg: float = 0.0
    backlash_deg: float = 0.0
    friction_deg: float = 0.0
    gain: float = 1.0
    bias_deg: float = 0.0
    airload: float = 0.0
    lag_s: float = 0.0
    cyclic_deg: float = 0.0
    """Error of a worn gear: repeats every 4 deg; no model contains it."""

    def move(self, time_s: FloatArray, command_deg: FloatArray, air_pa: FloatArray, supply_v: FloatArray) -> FloatArray:
        """Position at the times of the commands [deg], which are uniform."""
        numbers = tuple(float(number) for number in astuple(self))
        return np.asarray(_moved(numbers, time_s, command_deg, air_pa, supply_v))


@njit(cache=True)
def _moved(
    numbers: tuple[float, ...], time_s: FloatArray, command_deg: FloatArray, air_pa: FloatArray, supply_v: FloatArray
) -> FloatArray:
    """The fields of a servo, and what acts on it; compiled, which takes a sixtieth of the time and rounds the same."""
    delay_s, slow, rate_deg_s, deg_s_per_v, lower_deg, upper_deg, deadband_deg = numbers[:7]
    backlash_deg, friction_deg, gain, bias_deg, airload, lag_s, cyclic_deg = numbers[7:]
    a, b, c = 24.84 * slow, 70.04 * slow, 4921.0 * slow**2
    a2, a1, a0 = a + b, a * b + c, a * c
    q = _SPLIT * a2
    p, r = a2 - q, a1 - (a2 - q) * q
    sample_s = float(time_s[1] - time_s[0])
    h, lag = sample_s / _STEPS, round(delay_s / sample_s * _STEPS)
    y = played = sensed = float(command_deg[0])
    v = torque = 0.0
    positions = np.empty(time_s.size)
    for k in range(time_s.size):
        positions[k] = sensed
        most = min(rate_deg_s, deg_s_per_v * float(supply_v[k])) * a1 / a0
        for i in range(_STEPS):
            u = float(command_deg[max((k * _STEPS + i - lag) // _STEPS, 0)])
            error = u - y
            error -= max(-deadband_deg / 2.0, min(deadband_deg / 2.0, error))
            error = max(-most, min(most, error))
            v_old = v
            load = a0 / q * airload * float(air_pa[k]) * y
            v += h * (-p * v + torque - load)
            brake = h * friction_deg * a0 / q
            v = max(0.0, v - brake) if v > 0.0 else min(0.0, v + brake)
            torque += h * (-q * torque - r * v_old + a0 * error)
            y += h * 0.5 * (v + v_old)
            half = backlash_deg / 2.0
            played = max(min(played, y + half), y - half)
            x = max(lower_deg, min(upper_deg, gain * played)) + bias_deg
            x += cyclic_deg * math.sin(0.5 * math.pi * y)
            sensed = x if lag_s == 0.0 else sensed + h / lag_s * (x - sensed)
    return positions


@dataclass(frozen=True)
class Hidden:
    """A log with something hidden in it."""

    time_s: FloatArray
    command_deg: FloatArray
    position_deg: FloatArray
    airspeed_m_s: FloatArray
    supply_v: FloatArray

    def write(self, path: Path) -> Path:
        """As a plain table."""
        header = "time_s,elevator_cmd_deg,elevator_pos_deg,airspeed_m_s,servo_voltage_v"
        columns = (self.time_s, self.command_deg, self.position_deg, self.airspeed_m_s, self.supply_v)
        np.savetxt(path, np.column_stack(columns), "%.6f", ",", header=header, comments="")
        return path


def hide(
    servo: FineServo, command: str = "gusty", *, seed: int = 0, duration_s: float = 30.0, noise_deg: float = 0.1
) -> Hidden:
    """Fly a servo."""
    rng = np.random.default_rng(seed)
    time_s = np.round(np.arange(round(duration_s * 100.0)) / 100.0, 6)
    command_deg = COMMANDS[command](time_s, rng)
    airspeed_m_s = 22.0 + 5.0 * np.sin(2.0 * np.pi * time_s / 17.0)
    supply_v = 6.0 - 0.8 * time_s / time_s[-1] + 0.2 * np.sin(time_s)
    position_deg = servo.move(time_s, command_deg, 0.6125 * airspeed_m_s**2, supply_v)
    position_deg += noise_deg * rng.standard_normal(time_s.size)
    return Hidden(time_s, command_deg, position_deg, airspeed_m_s, supply_v)
