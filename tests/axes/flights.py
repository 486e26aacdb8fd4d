"""Flights of a small aeroplane whose truth is known: another structure than the models of axes."""

from __future__ import annotations

import functools

import numpy as np

from servofd.aircraft.axes import MotionModel
from servofd.axes.calibrate import calibrate_motion
from servofd.axes.motion import Motion
from servofd.core.types import FloatArray

__all__ = ["calibrated", "flown"]


def flown(
    seed: int,
    day: str = "2026-05-01",
    *,
    duration_s: float = 120.0,
    rate_hz: float = 25.0,
    aileron_share: float = 1.0,
    from_s: float = 1e9,
    later_share: float = 1.0,
    later_s: float = 1e9,
    gusts: float = 6.0,
    trim_step_us: float = 0.0,
) -> Motion:
    """Roll by Euler steps with a servo's lag, gusts and a pilot; at last ailerons that keep a share of their effect.

    At the same time their trim may change, and later the share again.
    """
    rng = np.random.default_rng(seed)
    trim = np.random.default_rng(list(day.encode())).normal(0.0, 6.0)
    n, dt = int(duration_s * rate_hz), 1.0 / rate_hz
    time_s: FloatArray = np.arange(n, dtype=np.float64) * dt
    speed = 18.0 + 2.0 * np.sin(0.05 * time_s + rng.uniform(0.0, 6.0))
    gust = np.zeros(n)
    shocks = rng.normal(0.0, 1.0, n)
    roll, rate, surface = np.zeros(n), np.zeros(n), np.zeros(n)
    asked = np.zeros(n)
    want, hold = 0.0, 0
    for k in range(1, n):
        if hold == 0:
            want, hold = rng.uniform(-35.0, 35.0), int(rng.uniform(2.0, 6.0) * rate_hz)
        hold -= 1
        gust[k] = 0.96 * gust[k - 1] + gusts * shocks[k]
        asked[k] = np.clip(6.0 * (want - roll[k - 1]) - 1.0 * rate[k - 1], -250.0, 250.0)
        surface[k] = surface[k - 1] + (asked[k] - surface[k - 1]) * dt / 0.08
        share, away_us = (aileron_share, trim_step_us) if time_s[k] >= from_s else (1.0, 0.0)
        share = later_share if time_s[k] >= later_s else share
        v = speed[k] / 18.0
        pull = 3.0 * v * v * (share * surface[k] + trim + away_us) - 8.0 * v * rate[k - 1] + gust[k]
        rate[k] = rate[k - 1] + pull * dt
        roll[k] = roll[k - 1] + rate[k] * dt
    pitch_asked = 20.0 * np.sin(0.3 * time_s) + rng.normal(0.0, 2.0, n)
    rates = np.array([rate, 0.1 * pitch_asked, 9.8 / speed * np.degrees(np.tan(np.radians(roll)))])
    forces = np.array([np.full(n, 0.5), 0.05 * rate, -9.8 / np.cos(np.radians(roll))])
    rates = rates + rng.normal(0.0, 0.3, rates.shape)
    forces = forces + rng.normal(0.0, 0.05, forces.shape)
    return Motion(
        name=f"flight {seed}",
        day=day,
        time_s=time_s,
        commands_us={"roll": asked},
        rates_deg_s=rates,
        accelerations_m_s2=forces,
        roll_deg=roll,
        pitch_deg=np.zeros(n),
        airspeed_m_s=speed,
        throttle=np.full(n, 0.5),
        present=np.ones(n, dtype=bool),
        members={"roll": ("aileron_left", "aileron_right")},
    )


@functools.cache
def calibrated() -> MotionModel:
    """The aeroplane, by six flights of three days."""
    return calibrate_motion([flown(seed, f"2026-05-0{1 + seed % 3}") for seed in range(6)])
