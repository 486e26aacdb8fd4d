"""A servo of one to three poles with what loads, stops and hangs on it, in steps of 0.1 ms: slow and readable.

The position loop of docs/explain.md, E1: an error turns into torque, torque into speed. It shares no formula of steps
with the stepper, which goes from event to event by matrices.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import InitVar, dataclass, field

import numpy as np

from servofd.core.types import FloatArray
from servofd.servo.loop import AFTER, BEFORE, INSIDE
from servofd.servo.physics import Physics

Around = tuple[float, ...]
"""Dynamic pressure, supply, supply over the usual one, current, load."""
_STEP_S = 1e-4
_STRIBECK_DEG_S, _PUSH_PER_PA_S = 10.0, 25.0 / 300.0


class Sizes:
    """Those of a servo, which looks each up anew when it is asked: here that is fifty times in each step."""

    def __init__(self, physics: Physics) -> None:
        self.of = physics

    def __getattr__(self, name: str) -> float:
        value: float = getattr(self.of, name)
        setattr(self, name, value)
        return value


@dataclass
class SlowLoop:
    """At rest where its command wants it, whose deflection is read at `start_deg`."""

    denominator: tuple[float, ...]
    of: InitVar[Physics]
    start_deg: float
    physics: Sizes = field(init=False)
    state: list[float] = field(init=False)
    """Position, speed and torque of the shaft."""

    def __post_init__(self, of: Physics) -> None:
        self.physics = Sizes(of)
        shaft = (self.start_deg - self.physics.bias_deg) / self.physics.gain
        self.state = [shaft, 0.0, 0.0]
        self.moved = self.followed = self.tip = self.played = shaft
        self.swing, self.sensed, self.set_point = 0.0, self.start_deg, math.nan
        coefficients = [c / self.denominator[0] for c in self.denominator[1:]]
        self.let, self.slow_rad_s = shaft, 0.0
        if self.physics.slow_place != INSIDE:
            roots = np.roots([1.0, *coefficients])
            real = roots[roots.imag == 0.0].real
            self.slow_rad_s = float(np.abs(real).min())
            pair = np.delete(roots, np.argmin(np.abs(roots + self.slow_rad_s)))
            coefficients = np.poly(pair).real[1:].tolist()
        self.order, self.stiffness = len(coefficients), coefficients[-1]
        self.error_per_rate_s = ([1.0, *coefficients])[-2] / self.stiffness
        self.q = self.physics.torque_share * coefficients[0] if self.order == 3 else 1.0
        self.p = coefficients[0] - (self.q if self.order == 3 else 0.0)
        self.r = coefficients[1] - self.p * self.q if self.order == 3 else 0.0

    def effort(self, error: float, supply_v: float, power: float) -> float:
        """Error that acts [deg]."""
        is_first = self.order == 1
        dead = 0.5 * self.physics.deadband_deg + (self.physics.friction_deg if is_first else 0.0)
        bent = math.copysign(max(abs(error) - dead, 0.0), error)
        if abs(error) < 0.5 * self.physics.insensitive_deg:
            bent = 0.0
        bent /= math.sqrt(1.0 + abs(bent) / self.physics.knee_deg)
        by_supply = self.physics.deg_s_per_v * supply_v
        up, down = min(self.physics.rate_up_deg_s, by_supply), min(self.physics.rate_down_deg_s, by_supply)
        bent = max(min(bent, up * self.error_per_rate_s), -down * self.error_per_rate_s)
        return bent * (self.physics.torque * power if math.isfinite(self.physics.torque) else 1.0)

    def load(self, y: float, around: Around) -> float:
        """Deflection that all loads take away [deg]."""
        air_pa, _, _, _, external = around
        load = self.physics.airload_per_pa * air_pa * y + self.physics.air_trim_per_pa * air_pa
        load += self.physics.droop_deg * math.sin(math.radians(y - self.physics.hangs_deg))
        return load - self.physics.load_deg * external

    def slopes(self, state: list[float], set_point: float, around: Around) -> list[float]:
        """Derivatives of position, speed and torque; a load is told by the error that balances it."""
        y, v, torque = state
        effort = self.effort(set_point - y, around[1], around[2])
        load = self.load(y, around)
        if self.order == 1:
            return [self.stiffness * (effort - load), 0.0, 0.0]
        if self.order == 2:
            return [v, self.stiffness * (effort - load) - self.p * v, 0.0]
        turned = -self.q * torque - self.r * v + self.stiffness * effort
        return [v, torque - self.p * v - self.stiffness / self.q * load, turned]

    def step(self, h: float, command_deg: float, around: Around) -> None:
        """Move on by `h` towards a command: midpoints, then friction, which stops and never drives."""
        if math.isnan(self.set_point):
            self.set_point = command_deg
        command_deg *= self.physics.command_gain
        most = self.physics.set_point_deg_s * h
        self.set_point += max(min(command_deg - self.set_point, most), -most)
        target = self.set_point
        if self.physics.slow_place == BEFORE:
            before = self.let
            self.let = target + (before - target) * math.exp(-self.slow_rad_s * h)
            target = 0.5 * (before + self.let)
        begin = self.slopes(self.state, target, around)
        middle = [x + 0.5 * h * d for x, d in zip(self.state, begin, strict=True)]
        slope = self.slopes(middle, target, around)
        y, v, torque = (x + h * d for x, d in zip(self.state, slope, strict=True))
        if self.order > 1:
            push = middle[2]
            if self.order == 2:
                push = self.stiffness * self.effort(target - middle[0], around[1], around[2])
            slip = self.physics.stribeck * math.exp(-((v / _STRIBECK_DEG_S) ** 2))
            strength = self.stiffness / self.q * self.physics.friction_deg * (1.0 + slip)
            strength += self.physics.load_friction * abs(push)
            slower = math.copysign(max(abs(v) - strength * h, 0.0), v)
            y, v = y + 0.5 * h * (slower - v), slower
        by_supply = self.physics.speed_deg_s_per_v * around[1]
        down, up = min(self.physics.speed_down_deg_s, by_supply), min(self.physics.speed_up_deg_s, by_supply)
        if not -down <= v <= up:
            held_back = min(max(v, -down), up)
            y, v = y + h * (held_back - v) * 0.5, held_back
        if not self.physics.stop_lower_deg < y < self.physics.stop_upper_deg:
            y, v = min(max(y, self.physics.stop_lower_deg), self.physics.stop_upper_deg), 0.0
        self.state = [y, v, torque]
        if self.physics.slow_place == AFTER:
            self.moved += (y - self.moved) * -math.expm1(-self.slow_rad_s * h)
            y = self.moved
        self.hang(h, y, around)

    def hang(self, h: float, y: float, around: Around) -> None:
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
        side = min(max(10.0 * self.load(self.state[0], around), -1.0), 1.0)  # to where the air pushes it
        pushed = _PUSH_PER_PA_S * around[0] if side != 0.0 else 0.0
        self.played += h * pushed * (self.tip - side * half - self.played)
        self.played = min(max(self.played, self.tip - half), self.tip + half)
        x = self.played
        surface = self.physics.gain * (x + self.physics.quadratic_per_deg * x**2 + self.physics.cubic_per_deg2 * x**3)
        surface = min(max(surface, self.physics.lower_deg), self.physics.upper_deg) + self.physics.bias_deg
        share = -math.expm1(-h / self.physics.lag_s) if self.physics.lag_s else 1.0
        self.sensed += share * (surface - self.sensed)

    def positions(self, commands: FloatArray, at_s: FloatArray, around: FloatArray) -> Iterator[float]:
        """Reading at each instant; commands of shape (3, n): when, what, and the slope from there on."""
        now = float(at_s[0])
        for until, beside in zip(at_s.tolist(), around.tolist(), strict=True):
            within = commands[0][(commands[0] > now) & (commands[0] < until)]
            for end in [*within.tolist(), until]:
                k = int(np.searchsorted(commands[0], now + 1e-12, side="right")) - 1
                when_s, deg, slope = (float(row[max(k, 0)]) for row in commands)
                count = math.ceil((end - now) / _STEP_S)
                h = (end - now) / max(count, 1)
                for i in range(count):
                    self.step(h, deg + slope * (now + (i + 0.5) * h - when_s), tuple(beside))
                now = end
            yield self.sensed + self.physics.deg_per_a * beside[3]
