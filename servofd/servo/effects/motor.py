"""Effects on the position error that drives the motor."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import ClassVar

from servofd.servo.effect import SELDOM, Effect, Now, Parameter, Slot
from servofd.servo.effects.commands import LARGEST_SPEED
from servofd.servo.loop import AFTER, BEFORE, INSIDE

WIDTHS_DEG = (0.1, 0.2, 0.4, 0.8, 1.4, 2.2, 3.5, 6.0)
"""Widths of dead bands and play from which a search starts."""
UNFOLLOWED = {"follow_up_deg_s": math.inf, "follow_down_deg_s": math.inf}
"""The limit of an output that follows, replaced by another kind of limit."""
_RATES_PER_V = (1.4, 2.5, 4.0, 7.0, 11.0, 16.0, 22.0, 30.0, 45.0, 70.0)
"""Largest speeds per volt from which a search starts."""
_UP_DOWN_DEG_S = (20.0, 40.0, 90.0, 180.0, 350.0)
"""The same where each direction has its own: fewer, because every pair is tried."""


class DeadBand(Effect):
    """Position error that the servo's controller ignores, counted from the edge."""

    name, slot, form, family, rank = "deadband", Slot.ERROR, "error from the edge", "hysteresis", 12
    spoken = "a dead band"
    sound, advice = 0.4, "check the servo's electronics and its dead band setting"
    places: ClassVar[tuple[float, ...] | None] = (BEFORE, INSIDE, AFTER)
    varies, at_rest = True, 4
    parameters = (Parameter("width_deg", ("deadband_deg",), 0.0, 20.0, 0.0, 0.3, WIDTHS_DEG, loose=0.5, smallest=0.15),)

    @staticmethod
    def act(x: float, now: Now, width_deg: float) -> float:
        return max(x - 0.5 * width_deg, 0.0) + min(x + 0.5 * width_deg, 0.0)


class InsensitiveBand(DeadBand):
    """Position error below which the motor is off, and above which it sees all of it."""

    form, rank, longest_s, at_rest = "whole error", 13, 1e-3, 5
    places, varies = (BEFORE, INSIDE), False
    parameters = (replace(DeadBand.parameters[0], fields=("insensitive_deg",)),)
    sees = ("insensitive_deg",)

    @staticmethod
    def act(x: float, now: Now, width_deg: float) -> float:
        return 0.0 if abs(x) < 0.5 * width_deg else x


class CurrentLimit(Effect):
    """Supply that cannot give more current: the torque grows with the root of large position errors.

    The duty cycle is proportional to the error, and what the bridge draws from a limited supply to its square
    (Rhoban's bam notes the same law for XL330 servos); linear well below the knee.
    """

    name, slot, rank = "current_limit", Slot.ERROR, 30
    spoken = "a supply that limits its current"
    varies, surprise = True, SELDOM
    parameters = (
        Parameter("knee_deg", ("knee_deg",), 0.3, 1e3, 1e3, 300.0, (1.0, 3.0, 8.0, 20.0, 50.0), off=math.inf),
    )

    @staticmethod
    def act(x: float, now: Now, knee_deg: float) -> float:
        return x / math.sqrt(1.0 + abs(x) / knee_deg)


class MotorRate(Effect):
    """Largest speed of the motor: the position error saturates, the loop waits."""

    name, slot, form, fixed, rank = "rate_limit", Slot.ERROR, "motor", UNFOLLOWED, 6
    spoken = "a rate limit"
    places: ClassVar[tuple[float, ...] | None] = (BEFORE, INSIDE, AFTER)
    varies = True
    parameters: ClassVar[tuple[Parameter, ...]] = (LARGEST_SPEED(fields=("rate_up_deg_s", "rate_down_deg_s")),)

    @staticmethod
    def act(x: float, now: Now, up_deg_s: float, down_deg_s: float) -> float:
        return min(max(x, -down_deg_s * now.error_s), up_deg_s * now.error_s)


class AsymmetricRate(MotorRate):
    """Largest speed of the motor, different in the two directions: a load that pulls one way."""

    form, rank, places, varies = "motor, asymmetric", 31, (BEFORE, INSIDE), False
    parameters = tuple(
        replace(MotorRate.parameters[0], name=way, fields=(way,), grid=_UP_DOWN_DEG_S)
        for way in ("rate_up_deg_s", "rate_down_deg_s")
    )


class VoltageRate(Effect):
    """Largest speed of the motor in proportion to its supply."""

    name, slot, fixed, rank = "voltage_rate", Slot.ERROR, UNFOLLOWED, 19
    spoken = "a rate limit that falls with the supply"
    places, needs, instead = (BEFORE, INSIDE, AFTER), ("servo_voltage_v",), ("rate_limit",)
    parameters = (Parameter("deg_s_per_v", ("deg_s_per_v",), 0.5, 600.0, 600.0, 12.0, _RATES_PER_V, off=math.inf),)

    @staticmethod
    def act(x: float, now: Now, deg_s_per_v: float) -> float:
        most = deg_s_per_v * now.supply_v * now.error_s
        return min(max(x, -most), most)


class Torque(Effect):
    """Torque of the motor beside its usual one, in proportion to its supply; off, the supply is nothing to it."""

    name, slot, searched = "torque", Slot.ERROR, False
    parameters = (Parameter("share", ("torque",), 0.05, 2.0, 1.0, 0.1, off=math.inf),)

    @staticmethod
    def act(x: float, now: Now, share: float) -> float:
        return share * now.power * x
