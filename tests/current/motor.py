"""Servos as direct-current motors, with more physics than the model that judges their current.

A controller with a dead band and a full duty far from its set point, back EMF, gears whose friction grows with what
they carry and ripples with their teeth, a spring of air, gusts, a rail that sags by what all its servos draw, and a
current sensor that averages, ripples with the pulse width and counts in steps.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import lfilter

from logparsers.compiled import compiled
from servofd.simulation.commands import flight

if TYPE_CHECKING:
    from servofd.core.types import FloatArray

STEP_S = 0.002
RAIL_V, RAIL_OHM = 6.0, 0.08


@dataclass(frozen=True)
class Servo:
    """Torques in newton metres, at the output shaft; a hobby servo of 0.4 N m."""

    ohm: float = 2.5
    volts_per_deg_s: float = 6.0 / 330.0
    nm_per_a: float = 0.22
    inertia_nm_s2_deg: float = 4e-6
    coulomb_nm: float = 0.03
    by_load: float = 0.25
    ripple: float = 0.15
    teeth_deg: float = 7.0
    viscous_nm_s_deg: float = 5e-5
    full_duty_deg: float = 3.0
    damping_s: float = 0.012
    dead_deg: float = 0.15
    air_nm_deg: float = 0.012
    trim_deg: float = 1.5
    gust_nm: float = 0.015
    idle_a: float = 0.012


FAULTS = {"": 0, "blocked": 1, "unpowered": 2, "binding": 3, "worn": 4}


@dataclass(frozen=True)
class Sensor:
    """How the current is measured."""

    rate_hz: float = 10.0
    averages: bool = False
    step_a: float = 0.01
    noise_a: float = 0.01
    late_s: float = 0.03


@dataclass(frozen=True)
class Flown:
    """One flight of one servo."""

    command_s: FloatArray
    command_deg: FloatArray
    current_s: FloatArray
    current_a: FloatArray
    position_deg: FloatArray = field(repr=False)
    """At `current_s`."""
    airspeed_m_s: FloatArray = field(repr=False)
    voltage_v: FloatArray = field(repr=False)

    def csv(self, surface: str, *, position: bool = False, air: bool = False) -> str:
        """Plain table with commands at 25 Hz and currents in rows of their own."""
        head = ["time_s", f"{surface}_cmd_deg", f"{surface}_current_a"]
        head += [f"{surface}_pos_deg"] * position + ["airspeed_m_s"] * air
        asked = zip(self.command_s, self.command_deg, strict=True)
        rows = [(t, f"{t:.4f},{c:.3f}," + "," * (len(head) - 3)) for t, c in asked]
        for k, (t, a) in enumerate(zip(self.current_s, self.current_a, strict=True)):
            extra = [f"{self.position_deg[k]:.3f}"] * position + [f"{self.airspeed_m_s[k]:.2f}"] * air
            rows.append((t, ",".join([f"{t:.4f}", "", f"{a:.4f}", *extra])))
        return "\n".join([",".join(head), *(text for _, text in sorted(rows))]) + "\n"


def fly(
    seconds: float,
    seed: int,
    servo: Servo = Servo(),
    sensor: Sensor = Sensor(),
    *,
    fault: str = "",
    start_s: float = np.inf,
    end_s: float = np.inf,
    times: float = 3.0,
    command_deg: FloatArray | None = None,
    airspeed_m_s: float = 20.0,
) -> Flown:
    """Fly for so long, with a fault from `start_s` on; `times` is by how much binding multiplies friction."""
    rng = np.random.default_rng(seed)
    count = round(seconds / STEP_S)
    time_s: FloatArray = np.arange(float(count)) * STEP_S
    every = round(0.04 / STEP_S)
    asked = flight(time_s[::every], rng) if command_deg is None else command_deg
    wanted = np.repeat(asked, every)[:count]
    speed = airspeed_m_s * (1.0 + 0.1 * np.sin(2.0 * np.pi * time_s / 47.0 + rng.uniform(0.0, 6.0)))
    gust = lfilter([STEP_S / 0.3], [1.0, STEP_S / 0.3 - 1.0], rng.standard_normal(count)) * np.sqrt(2 * 0.3 / STEP_S)
    others_a = 1.2 * np.abs(lfilter([STEP_S / 0.2], [1.0, STEP_S / 0.2 - 1.0], rng.standard_normal(count))) * 6.0
    position, current, volts = np.empty(count), np.empty(count), np.empty(count)
    numbers = np.array([getattr(servo, name) for name in Servo.__dataclass_fields__])
    _turn(
        numbers,
        time_s,
        wanted,
        speed / 20.0,
        gust,
        others_a,
        FAULTS[fault],
        start_s,
        end_s,
        times,
        position,
        current,
        volts,
    )
    period_s = 1.0 / sensor.rate_hz
    at_s = np.arange(0.5 * period_s, seconds - 0.1, period_s)
    at_s = at_s + rng.uniform(-0.05, 0.05, at_s.size) * period_s
    sums = np.concatenate([[0.0], np.cumsum(current)])
    width = max(round((period_s if sensor.averages else 0.01) / STEP_S), 1)
    last = np.clip(np.round((at_s - sensor.late_s) / STEP_S).astype(int), width, count)
    seen = (sums[last] - sums[last - width]) / width
    seen = seen * (1.0 + 0.05 * rng.standard_normal(at_s.size)) + sensor.noise_a * rng.standard_normal(at_s.size)
    if sensor.step_a:
        seen = np.round(seen / sensor.step_a) * sensor.step_a
    now = np.clip(np.round(at_s / STEP_S).astype(int), 0, count - 1)
    return Flown(time_s[::every], asked, at_s, seen, position[now], speed[now], volts[now])


@compiled
def _turn(
    p: FloatArray, time_s: FloatArray, wanted: FloatArray, air: FloatArray, gust: FloatArray, others_a: FloatArray,
    fault: int, start_s: float, end_s: float, times: float, position: FloatArray, current: FloatArray,
    volts: FloatArray,
) -> None:  # fmt: skip
    y, v, drawn = 0.0, 0.0, 0.0
    h = time_s[1] - time_s[0]
    for k in range(time_s.size):
        on = fault if start_s <= time_s[k] < end_s else 0
        rail_v = 6.0 - 0.08 * (drawn + others_a[k]) - 0.3 * time_s[k] / 3600.0
        error = wanted[k] - y
        near = max(abs(error) - p[11], 0.0) * (1.0 if error > 0.0 else -1.0)
        duty = min(max(near / p[9] - p[10] * v / p[9], -1.0), 1.0)
        amps = (duty * rail_v - p[1] * v) / p[0]
        if duty == 0.0:
            amps = -p[1] * v / p[0] * 0.2
        if on == 2:
            amps = 0.0
        load = -p[12] * air[k] ** 2 * (y - p[13]) + p[14] * air[k] ** 2 * gust[k]
        drive = p[2] * amps + load
        grip = p[4] + p[5] * abs(load)
        if on == 3:
            grip *= times
        if on == 4:
            grip *= 1.0 + 0.8 * np.sin(2.0 * np.pi * y / 3.1) + 0.6 * np.sin(37.0 * y)
        grip *= 1.0 + p[6] * np.sin(2.0 * np.pi * y / p[7])
        if on == 1 or (abs(v) < 0.5 and abs(drive) <= grip):
            v = 0.0
        else:
            way = v if abs(v) >= 0.5 else drive
            torque = drive - grip * (1.0 if way > 0.0 else -1.0) - p[8] * v
            damp = p[1] * p[2] / p[0] / p[3]
            fresh = v + h * torque / p[3]
            fresh = (v + h * (torque / p[3] + damp * v)) / (1.0 + h * damp) if on != 2 and duty != 0.0 else fresh
            v = 0.0 if fresh * v < 0.0 else fresh
            v = min(max(v, -600.0), 600.0)
        y += h * v
        drawn = abs(duty * amps) + (p[15] if on != 2 else 0.0)
        position[k], current[k], volts[k] = y, drawn, rail_v
