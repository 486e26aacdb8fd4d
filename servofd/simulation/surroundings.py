"""What a log holds beside commands and positions: the air, the power, the state of each servo. Context, not truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from logparsers.units import US_PER_S
from servofd.core.types import FloatArray, IntArray
from servofd.servo.context import Context

EPOCH_US: Final = 1_700_000_000_000_000
"""When every simulated vehicle was booted [us since 1970]: the same flight gives the same file."""

_STALLED_A, _NEAR_DEG, _ALL_DEG, _PUSHES_S = 1.2, 0.4, 3.0, 0.3
"""A small servo that is held further away than that draws up to so much, so many degrees later, and after so long."""
_SPEED_M_S = 22.0
"""Mean airspeed [m/s]."""
RAIL_V = 7.4
"""Supply of the servos without load [V]."""
_EARTH_M_PER_DEG = 111_195.0
"""Length of a degree of latitude [m]."""
_FIELD_DEG = (44.725, -93.075)
"""Latitude and longitude of UMore Park, where FASER flew [deg]."""


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """Flight state at some times, each of shape (n,)."""

    roll_deg: FloatArray
    pitch_deg: FloatArray
    yaw_deg: FloatArray
    """From 0 to 360."""
    airspeed_m_s: FloatArray
    altitude_m: FloatArray
    latitude_deg: FloatArray
    longitude_deg: FloatArray
    rail_v: FloatArray
    """Supply of the servos."""
    board_v: FloatArray


def surroundings(time_s: FloatArray, seed: int) -> Surroundings:
    """Circle over a field at 22 m/s, with a little noise, at some times (n,) [s]."""
    rng = np.random.default_rng([seed, 1000])

    def noise(deviation: float) -> FloatArray:
        return deviation * rng.standard_normal(time_s.size)

    turn = 2.0 * np.pi * time_s / 90.0
    radius_deg = _SPEED_M_S * 90.0 / (2.0 * np.pi) / _EARTH_M_PER_DEG
    return Surroundings(
        roll_deg=28.0 + 2.0 * np.sin(0.9 * time_s) + noise(0.2),
        pitch_deg=3.0 + np.sin(0.7 * time_s) + noise(0.1),
        yaw_deg=np.degrees(turn) % 360.0,
        airspeed_m_s=_SPEED_M_S + np.sin(0.3 * time_s) + noise(0.3),
        altitude_m=120.0 + 3.0 * np.sin(0.1 * time_s) + noise(0.1),
        latitude_deg=_FIELD_DEG[0] + radius_deg * np.sin(turn),
        longitude_deg=_FIELD_DEG[1] + radius_deg * (1.0 - np.cos(turn)) / np.cos(np.radians(_FIELD_DEG[0])),
        rail_v=RAIL_V + noise(0.02),
        board_v=5.05 + noise(0.01),
    )


def acting(time_s: FloatArray, *, pushed: bool = False) -> Context:
    """Conditions of a servo: gusts, and airspeed and supply that vary enough to be separated from gain and rate limit.

    `pushed`: whether a load of 0.05 N m comes and goes.
    """
    wave = 2.0 * np.pi * time_s / 40.0
    return Context(
        airspeed_s=time_s,
        airspeed_m_s=_SPEED_M_S + 5.0 * np.sin(wave),
        voltage_s=time_s,
        voltage_v=RAIL_V - 0.5 * (1.0 - np.cos(wave)),
        load_s=time_s if pushed else np.zeros(0),
        load=np.where((time_s % 5.0 < 1.5) & (time_s >= 5.0), 0.05, 0.0) if pushed else np.zeros(0),
    )


def current_a(speed_deg_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """What a servo draws as it turns [A], shape (n,)."""
    load = np.minimum(np.abs(speed_deg_s) / 200.0, 1.0)
    return np.abs(0.06 + 0.9 * load + 0.01 * rng.standard_normal(speed_deg_s.size))


def stalled_a(time_s: FloatArray, asked_deg: FloatArray, measured_deg: FloatArray) -> FloatArray:
    """What a motor draws that pushes without reaching where it is asked to be [A], shape (n,).

    `time_s`, `asked_deg`, `measured_deg` (shape (n,)): command and motion [s], [deg].

    Examples
    --------
    >>> stalled_a(np.arange(0.0, 2.0, 0.5), np.full(4, 10.0), np.array([10.0, 10.0, 0.0, 0.0])).tolist()
    [0.0, 0.0, 0.0, 1.2]
    """
    away_deg = np.abs(asked_deg - measured_deg)
    back = np.maximum(np.searchsorted(time_s, time_s - _PUSHES_S + 1e-9) - 1, 0)
    # A servo that is on its way is nearer somewhere within that time.
    lately_deg = np.minimum(np.minimum(away_deg, away_deg[back]), away_deg[(back + np.arange(time_s.size)) // 2])
    return _STALLED_A * np.clip((lately_deg - _NEAR_DEG) / _ALL_DEG, 0.0, 1.0)


def sparse(time_s: FloatArray, rate_hz: float) -> IntArray:
    """Indices of the samples that a slower message would hold, shape (m,)."""
    at_s = np.arange(time_s[0], time_s[-1] + 1e-9, 1.0 / rate_hz)
    return np.unique(np.searchsorted(time_s, at_s - 1e-9)).astype(np.int64)


def microseconds(time_s: FloatArray) -> IntArray:
    """Time since boot as autopilots stamp it [us], of the same shape."""
    return np.rint(time_s * US_PER_S).astype(np.int64)
