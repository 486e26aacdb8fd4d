"""False alarms: numbers from independent integrals and from thousands of simulated hours.

All for the HS-225BB of thesis Eq. 3.1 at 100 Hz, filter pole 50 rad/s, Gaussian noise.
"""

from __future__ import annotations

import numpy as np
import pytest

from servofd.detection.probability import (
    Noise,
    smallest_offset_deg,
)
from servofd.detection.pulse import design_pulse_filter
from servofd.servo.library import servo_named

T = 0.01
DESIGN = design_pulse_filter(servo_named("hs225bb-eq31").printed, 0.004, T, 50.0)
UNIT = Noise.designed(DESIGN, 1.0 / DESIGN.noise_gain)
LAST_DIGIT = 1.1  # in units of the last digit printed


def within_an_hour(rate_per_hour: float) -> float:
    return float(-np.expm1(-rate_per_hour))


@pytest.mark.parametrize(
    ("z", "chance"),
    [(4.25, 0.99942), (4.5, 0.90828), (4.75, 0.51312), (5.0, 0.18440), (5.25, 0.05283), (5.5, 0.01350)],
)
def test_chance_of_a_false_alarm_within_an_hour(z: float, chance: float) -> None:
    assert within_an_hour(UNIT.false_alarms_per_hour(z)) == pytest.approx(chance, abs=1e-5)


@pytest.mark.parametrize(
    ("z", "chance"), [(4.25, 0.99925), (4.5, 0.91), (4.75, 0.5065), (5.0, 0.183), (5.25, 0.04675), (5.5, 0.01175)]
)
def test_chance_of_a_false_alarm_in_4000_simulated_hours(z: float, chance: float) -> None:
    standard_error = np.sqrt(chance * (1.0 - chance) / 4000.0)
    predicted = within_an_hour(UNIT.false_alarms_per_hour(z))
    assert abs(predicted - chance) < 2.5 * standard_error


@pytest.mark.parametrize(
    ("z", "rate"), [(6.0, 7.08e-4), (6.5, 2.89e-5), (7.0, 9.21e-7), (7.5, 2.297e-8), (8.0, 4.48e-10)]
)
def test_rare_false_alarms(z: float, rate: float) -> None:
    assert UNIT.false_alarms_per_hour(z) == pytest.approx(rate, rel=2e-3)


@pytest.mark.parametrize(
    ("chance", "z"),
    [(1e-1, 5.126), (1e-2, 5.553), (1e-3, 5.944), (1e-4, 6.310), (1e-5, 6.658), (1e-6, 6.989), (1e-9, 7.901)],
)
def test_threshold_for_a_chance_per_hour(chance: float, z: float) -> None:
    rate = -np.log1p(-chance)
    assert UNIT.threshold_deg(rate) == pytest.approx(z, abs=LAST_DIGIT * 1e-3)


def test_the_bias_response_overshoots_by_two_percent() -> None:
    assert smallest_offset_deg(DESIGN, 1.5, Noise(0.0, 0.0, T), 1.0) == pytest.approx(1.5 / 1.02, rel=5e-3)
