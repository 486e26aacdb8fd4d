"""Effects of the position sensor."""

from __future__ import annotations

import math

from servofd.servo.effect import HARDLY_EVER, SELDOM, Effect, Now, Parameter, Slot
from servofd.servo.effects.commands import STEP
from servofd.servo.effects.linkage import speed_over

_LAGS_S = (0.003, 0.008, 0.016, 0.03, 0.06, 0.12, 0.25)
"""Lags of a sensor from which a search starts."""


class SensorLag(Effect):
    """First-order filter of the position sensor."""

    name, slot, rank, memory = "sensor_lag", Slot.OUTPUT, 17, 2
    spoken = "a sensor that lags"
    longest_s, apart_s = 5e-3, 1e-3
    parameters = (Parameter("time_constant_s", ("lag_s",), 0.0, 1.0, 0.0, 0.01, _LAGS_S, smallest=0.004),)

    @staticmethod
    def act(x: float, now: Now, constant_s: float, at: float, ahead: float) -> tuple[float, float, float]:
        """A low pass, exactly, as the surface moves in a step; remembered by how far it is ahead of it."""
        step_s = now.step_s
        if step_s <= 0.0:
            return x + ahead, x, ahead
        begins, faster, square, _ = speed_over(x, at, now)
        bent = -constant_s * square  # behind, drifts and bent: of a surface that goes on so for ever
        drifts = -constant_s * (faster + 2.0 * bent)
        behind = -constant_s * (begins + drifts)
        ahead = math.exp(-step_s / constant_s) * (ahead - behind)
        ahead += behind + step_s * (drifts + step_s * bent)
        return x + ahead, x, ahead


class Bias(Effect):
    """Trim that was lost, or a sensor's zero."""

    name, slot, rank = "bias", Slot.READING, 1
    spoken = "an offset"
    sound, advice = 1.0, "trim it, and check whether the horn slipped"
    varies, at_rest = True, 1
    parameters = (Parameter("bias_deg", ("bias_deg",), -30.0, 30.0, 0.0, 0.3, (-1.0, 1.0), smallest=0.2),)

    @staticmethod
    def act(x: float, now: Now, bias_deg: float) -> float:
        return x + bias_deg


class SupplyCoupling(Effect):
    """Reading that moves with the servo's current, because both hang on one supply: nothing has moved."""

    name, slot, rank = "supply_coupling", Slot.READING, 24
    spoken = "a reading that moves with the current"
    surprise = SELDOM
    needs = ("servo_current_a",)
    parameters = (Parameter("deg_per_a", ("deg_per_a",), -20.0, 20.0, 0.0, 0.3, (-1.0, 1.0)),)

    @staticmethod
    def act(x: float, now: Now, deg_per_a: float) -> float:
        return x + deg_per_a * now.current_a


class Quantization(Effect):
    """Steps of the position sensor."""

    name, slot, form, rank, surprise = "quantization", Slot.READING, "position", 22, HARDLY_EVER
    spoken = "coarse steps"
    parameters = (STEP(fields=("output_step_deg",)),)

    @staticmethod
    def act(x: float, now: Now, step_deg: float) -> float:
        return step_deg * math.floor(x / step_deg + 0.5)
