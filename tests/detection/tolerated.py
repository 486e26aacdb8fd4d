"""Servos that differ from the model as much as a healthy one may."""

from __future__ import annotations

import numpy as np

from servofd.core.types import FloatArray
from servofd.servo.effects.commands import Delay
from servofd.servo.effects.linkage import RateLimit
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel
from servofd.servo.transfer import TransferFunction

__all__ = ["MODEL", "deviating"]

MODEL = ServoModel.of(servo_named("hs225bb-eq31"))


def deviating(
    time_s: FloatArray,
    command_deg: FloatArray,
    *,
    gain: float = 0.0,
    delay_s: float = 0.0,
    bandwidth: float = 0.0,
    rate: float = 0.0,
    bias_deg: float = 0.0,
) -> FloatArray:
    """Deflection, of shape (n,), of a servo that is off by so much; without any noise."""
    servo = ServoModel(_scaled(MODEL.transfer, 1.0 + bandwidth)) + Delay(MODEL.delay_s + delay_s)
    servo += RateLimit((1.0 + rate) * MODEL.physics.follow_up_deg_s)
    return (1.0 + gain) * servo.simulate(time_s, command_deg, time_s) + bias_deg


def _scaled(transfer: TransferFunction, scale: float) -> TransferFunction:
    """Every pole and zero of G(s), scaled: G(s / scale)."""
    powers = [scale ** -np.arange(len(p))[::-1] for p in (transfer.numerator, transfer.denominator)]
    return TransferFunction(tuple(transfer.numerator * powers[0]), tuple(transfer.denominator * powers[1]))
