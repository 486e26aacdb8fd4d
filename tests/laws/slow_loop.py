"""A servo of one to three poles with what loads, stops and hangs on it, in steps of 0.1 ms: slow and readable.

The position loop of docs/explain.md, E1: an error turns into torque, torque into speed. It shares no formula of steps
with the kernel, which goes from event to event by matrices.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from servofd.core.types import FloatArray
from servofd.servo.physics import AFTER, BEFORE, INSIDE, Physics, split

_STEP_S = 1e-4


@dataclass
class SlowLoop:
    """At rest where its command wants it, whose deflection is read at `start_deg`."""

    denominator: tuple[float, ...]
    physics: Physics
    start_deg: float
    state: list[float] = field(init=False)
    """Position, speed and torque of the shaft."""

    def __post_init__(self) -> None:
        shaft = (self.start_deg - self.physics.bias_deg) / self.physics.gain
        self.state = [shaft, 0.0, 0.0]
        self.followed = self.tip = self.played = shaft
        self.swing, self.sensed, self.set_point = 0.0, self.start_deg, math.nan
        coefficients = [c / self.denominator[0] for c in self.denominator[1:]]
        self.let, self.slow_rad_s = shaft, 0.0
        if self.physics.slow_place != INSIDE:
            self.slow_rad_s, pair = split(np.array([1.0, *coefficients]))
            coefficients = list(pair)
        self.order, self.stiffness = len(coefficients), coefficients[-1]
        self.error_per_rate_s = ([1.0, *coefficients])[-2] / self.stiffness
        self.q = self.physics.torque_share * coefficients[0] if self.order == 3 else 1.0
        self.p = coefficients[0] - (self.q if self.order == 3 else 0.0)
        self.r = coefficients[1] - self.p * self.q if self.order == 3 else 0.0

    def effort(self, error: float, supply_v: float) -> float:
        """Error that acts [deg]."""
        is_first = self.order == 1
        dead = 0.5 * self.physics.deadband_deg + (self.physics.friction_deg if is_first else 0.0)
        bent = math.copysign(max(abs(error) - dead, 0.0), error)
        if abs(error) < 0.5 * self.physics.insensitive_deg:
            bent = 0.0
        bent /= math.sqrt(1.0 + abs(bent) / self.physics.knee_deg)
        by_supply = self.physics.deg_s_per_v * supply_v
        up, down = min(self.physics.rate_up_deg_s, by_supply), min(self.physics.rate_down_deg_s, by_supply)
        return max(min(bent, up * self.error_per_rate_s), -down * self.error_per_rate_s)

    def slopes(self, state: list[float], set_point: float, air_pa: float, supply_v: float) -> list[float]:
        """Derivatives of position, speed and torque; a load is told by the error that balances it."""
        y, v, torque = state
        effort = self.effort(set_point - y, supply_v)
        load = self.physics.airload_per_pa * air_pa * y + self.physics.droop_deg * math.sin(math.radians(y))
        if self.order == 1:
            return [self.stiffness * (effort - load), 0.0, 0.0]
        if self.order == 2:
            return [v, self.stiffness * (effort - load) - self.p * v, 0.0]
        turned = -self.q * torque - self.r * v + self.stiffness * effort
        return [v, torque - self.p * v - self.stiffness / self.q * load, turned]

    def step(self, h: float, command_deg: float, air_pa: float, supply_v: float) -> None:
        """Move on by `h` towards a command: midpoints, then friction, which stops and never drives."""
        if math.isnan(self.set_point):
            self.set_point = command_deg
        most = self.physics.set_point_deg_s * h
        self.set_point += max(min(command_deg - self.set_point, most), -most)
        target = self.set_point
        if self.physics.slow_place == BEFORE:
            before = self.let
            self.let = target + (before - target) * math.exp(-self.slow_rad_s * h)
            target = 0.5 * (before + self.let)
        begin = self.slopes(self.state, target, air_pa, supply_v)
        middle = [x + 0.5 * h * d for x, d in zip(self.state, begin, strict=True)]
        slope = self.slopes(middle, target, air_pa, supply_v)
        y, v, torque = (x + h * d for x, d in zip(self.state, slope, strict=True))
        if self.order > 1:
            push = middle[2]
            if self.order == 2:
                push = self.stiffness * self.effort(target - middle[0], supply_v)
            strength = self.stiffness / self.q * self.physics.friction_deg + self.physics.load_friction * abs(push)
            slower = math.copysign(max(abs(v) - strength * h, 0.0), v)
            y, v = y + 0.5 * h * (slower - v), slower
        if not -self.physics.speed_down_deg_s <= v <= self.physics.speed_up_deg_s:
            held_back = min(max(v, -self.physics.speed_down_deg_s), self.physics.speed_up_deg_s)
            y, v = y + h * (held_back - v) * 0.5, held_back
        if not self.physics.stop_lower_deg < y < self.physics.stop_upper_deg:
            y, v = min(max(y, self.physics.stop_lower_deg), self.physics.stop_upper_deg), 0.0
        self.hang(h, y)
        self.state = [y, v, torque]

    def hang(self, h: float, y: float) -> None:
        """What hangs on the shaft: an output that cannot follow, a flexible tip, play, a crooked linkage, a sensor."""
        before, tip = self.followed, self.tip
        up, down = self.physics.follow_up_deg_s * h, self.physics.follow_down_deg_s * h
        self.followed = before + max(min(y - before, up), -down)
        natural = 2.0 * math.pi * self.physics.resonance_hz
        if natural:
            drag = 2.0 * self.physics.resonance_damping * natural
            middle = self.swing + 0.5 * h * (natural**2 * (before - tip) - drag * self.swing)
            mean = 0.5 * (before + self.followed) - (tip + 0.5 * h * self.swing)
            self.tip, self.swing = tip + h * middle, self.swing + h * (natural**2 * mean - drag * middle)
        else:
            self.tip = self.followed
        half = 0.5 * self.physics.backlash_deg
        self.played = min(max(self.played, self.tip - half), self.tip + half)
        x = self.played
        surface = self.physics.gain * (x + self.physics.quadratic_per_deg * x**2 + self.physics.cubic_per_deg2 * x**3)
        surface = min(max(surface, self.physics.lower_deg), self.physics.upper_deg) + self.physics.bias_deg
        lag_s = 1.0 / self.slow_rad_s if self.physics.slow_place == AFTER else self.physics.lag_s
        share = -math.expm1(-h / lag_s) if lag_s else 1.0
        self.sensed += share * (surface - self.sensed)

    def positions(
        self, commands: FloatArray, at_s: FloatArray, air_pa: FloatArray, supply_v: FloatArray
    ) -> Iterator[float]:
        """Reading at each instant; commands of shape (3, n): when, what, and the slope from there on."""
        now = float(at_s[0])
        for until, air, supply in zip(at_s.tolist(), air_pa.tolist(), supply_v.tolist(), strict=True):
            within = commands[0][(commands[0] > now) & (commands[0] < until)]
            for end in [*within.tolist(), until]:
                k = int(np.searchsorted(commands[0], now + 1e-12, side="right")) - 1
                when_s, deg, slope = (float(row[max(k, 0)]) for row in commands)
                if math.isfinite(self.physics.set_point_deg_s):
                    slope = 0.0  # it follows steps
                count = math.ceil((end - now) / _STEP_S)
                h = (end - now) / max(count, 1)
                for i in range(count):
                    self.step(h, deg + slope * (now + (i + 0.5) * h - when_s), air, supply)
                now = end
            yield self.sensed
