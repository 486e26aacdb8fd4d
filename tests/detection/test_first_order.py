"""What the tolerances of a working servo leave in the residual (docs/detection.md, D2), against servos that have it."""

from __future__ import annotations

import numpy as np
import pytest

from servofd.aircraft.series import Series
from servofd.core.types import FloatArray
from servofd.detection.residual import ResidualGenerator
from servofd.servo.effects.commands import Delay
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel
from servofd.servo.transfer import TransferFunction
from servofd.simulation.commands import COMMANDS

SERVO = servo_named("hs225bb-eq31")
TIME_S = np.arange(6000) / 500.0
COMMAND_DEG = COMMANDS["gusty"](TIME_S, np.random.default_rng(1))
GENERATOR = ResidualGenerator(ServoModel(SERVO.transfer) + Delay(SERVO.delay_s), 50.0)
GAIN, DELAY_S, BANDWIDTH = 0.01, 0.5e-3, 0.01


def residual(gain: float = 0.0, delay_s: float = 0.0, bandwidth: float = 0.0) -> FloatArray:
    """Of a servo that is off by so much, shape (n,)."""
    transfer = SERVO.transfer.with_bandwidth_scaled(1.0 + bandwidth)
    scaled = TransferFunction(tuple((1.0 + gain) * c for c in transfer.numerator), transfer.denominator)
    real = ServoModel(scaled) + Delay(SERVO.delay_s + delay_s)
    measured_deg = real.simulate(TIME_S, COMMAND_DEG, TIME_S)
    return GENERATOR.run(Series("x", TIME_S, COMMAND_DEG, TIME_S, measured_deg)).residual_deg


def r0() -> FloatArray:
    healthy = GENERATOR.run(Series("x", TIME_S, COMMAND_DEG, TIME_S, np.zeros(TIME_S.size)))
    return GENERATOR.filtered(TIME_S, healthy.simulated_deg, healthy.restart)


def quick(values_deg: FloatArray) -> FloatArray:
    """Sum of s/(s + a) over all poles -a, by what each first-order lag of the values leaves."""
    from scipy.signal import lfilter

    total = np.zeros(values_deg.size, dtype=complex)
    for pole in SERVO.transfer.poles_rad_s:
        keep = (1.0 + pole / 1000.0) / (1.0 - pole / 1000.0)  # the trapezoidal rule at 500 Hz
        total += lfilter([(1.0 + keep) / 2.0, -(1.0 + keep) / 2.0], [1.0, -keep], values_deg - values_deg[0])
    return np.real(total)


@pytest.mark.parametrize(
    ("error", "term"),
    [
        ({"gain": GAIN}, lambda r: GAIN * r),
        ({"delay_s": DELAY_S}, lambda r: -DELAY_S * np.gradient(r, TIME_S)),
        ({"bandwidth": BANDWIDTH}, lambda r: BANDWIDTH * quick(r)),
    ],
    ids=["gain", "delay", "bandwidth"],
)
def test_a_small_error_leaves_the_term_of_d2(error: dict[str, float], term: object) -> None:
    assert callable(term)
    left, expected = residual(**error)[100:], term(r0())[100:]
    assert np.max(np.abs(expected)) > 0.01
    np.testing.assert_allclose(left, expected, rtol=0, atol=0.04 * float(np.max(np.abs(expected))))
