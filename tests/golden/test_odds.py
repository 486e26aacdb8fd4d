"""False alarms, missed detections and delays: numbers from independent integrals and from thousands of simulated hours.

All for the HS-225BB of thesis Eq. 3.1 at 100 Hz, filter pole 50 rad/s, Gaussian noise.
"""

from __future__ import annotations

import numpy as np
import pytest

from servofd.detection.probability import (
    Noise,
    bias_response,
    detect,
    false_alarms_per_hour,
    persistent_false_alarms_per_hour,
    threshold_for_rate_deg,
)
from servofd.detection.pulse import design_pulse_filter
from servofd.servo.library import servo_named

T = 0.01
DESIGN = design_pulse_filter(servo_named("hs225bb-eq31").printed, 0.004, T, 50.0)
UNIT = Noise.designed(DESIGN, 1.0 / DESIGN.noise_gain)
TENTH = Noise.designed(DESIGN, 0.1)
LAST_DIGIT = 1.1  # in units of the last digit printed


def within_an_hour(rate_per_hour: float) -> float:
    return float(-np.expm1(-rate_per_hour))


@pytest.mark.parametrize(
    ("z", "chance"),
    [(4.25, 0.99942), (4.5, 0.90828), (4.75, 0.51312), (5.0, 0.18440), (5.25, 0.05283), (5.5, 0.01350)],
)
def test_chance_of_a_false_alarm_within_an_hour(z: float, chance: float) -> None:
    assert within_an_hour(false_alarms_per_hour(z, 1.0, UNIT.correlation, T)) == pytest.approx(chance, abs=1e-5)


@pytest.mark.parametrize(
    ("z", "chance"), [(4.25, 0.99925), (4.5, 0.91), (4.75, 0.5065), (5.0, 0.183), (5.25, 0.04675), (5.5, 0.01175)]
)
def test_chance_of_a_false_alarm_in_4000_simulated_hours(z: float, chance: float) -> None:
    standard_error = np.sqrt(chance * (1.0 - chance) / 4000.0)
    predicted = within_an_hour(false_alarms_per_hour(z, 1.0, UNIT.correlation, T))
    assert abs(predicted - chance) < 2.5 * standard_error


@pytest.mark.parametrize(
    ("z", "rate"), [(6.0, 7.08e-4), (6.5, 2.89e-5), (7.0, 9.21e-7), (7.5, 2.297e-8), (8.0, 4.48e-10)]
)
def test_rare_false_alarms(z: float, rate: float) -> None:
    assert false_alarms_per_hour(z, 1.0, UNIT.correlation, T) == pytest.approx(rate, rel=2e-3)


@pytest.mark.parametrize(
    ("chance", "z"),
    [(1e-1, 5.126), (1e-2, 5.553), (1e-3, 5.944), (1e-4, 6.310), (1e-5, 6.658), (1e-6, 6.989), (1e-9, 7.901)],
)
def test_threshold_for_a_chance_per_hour(chance: float, z: float) -> None:
    rate = -np.log1p(-chance)
    assert threshold_for_rate_deg(rate, 1.0, UNIT.correlation, T) == pytest.approx(z, abs=LAST_DIGIT * 1e-3)


@pytest.mark.parametrize(
    ("z", "chances"),
    [(3.5, (1.0, 1.0, 0.753, 0.225, 0.055)), (4.0, (1.0, 0.586, 0.081, 0.012, 0.002)), (4.5, (0.898, 0.053, 0.003))],
)
def test_persistence(z: float, chances: tuple[float, ...]) -> None:
    """Against simulation, whose standard error is about 0.01 in the middle and 5 % of small numbers."""
    for samples, chance in enumerate(chances, start=1):
        ours = within_an_hour(persistent_false_alarms_per_hour(z, UNIT, samples))
        assert ours == pytest.approx(chance, rel=0.05, abs=0.011 if chance > 0.01 else 6e-4)


@pytest.mark.parametrize(
    ("threshold_deg", "size_deg", "when_s", "seen", "least", "most"),
    [
        (0.4, 5.0, 0.07, 0.621, 0.621, 0.621),
        (0.4, 2.0, 0.09, 0.247, 0.251, 0.251),
        (0.4, 2.0, 0.10, 0.993, 0.993, 0.995),
    ],
)
def test_probability_of_seeing_a_stuck_servo(
    threshold_deg: float, size_deg: float, when_s: float, seen: float, least: float, most: float
) -> None:
    """40 000 simulated ramps of 0.1 s, and their bounds."""
    detection = detect(stuck(size_deg), threshold_deg, TENTH)
    k = round(when_s / T)
    assert detection.least[k] == pytest.approx(least, abs=LAST_DIGIT * 1e-3)
    assert detection.most[k] == pytest.approx(most, abs=LAST_DIGIT * 1e-3)
    assert detection.likely[k] == pytest.approx(seen, abs=0.005)


@pytest.mark.parametrize(
    ("size_deg", "probability", "delay_s"), [(5.0, 0.5, 0.11), (2.0, 0.5, 0.17), (1.55, 0.5, 0.24), (1.55, 0.99, 0.31)]
)
def test_time_until_a_stuck_servo_is_seen(size_deg: float, probability: float, delay_s: float) -> None:
    assert detect(stuck(size_deg), 1.5, TENTH).delay_s(probability) == pytest.approx(delay_s)


def stuck(size_deg: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Residual of a servo stuck at zero while the command ramps up within 0.1 s [deg]."""
    ramp = size_deg * np.clip(np.arange(60) * T / 0.1, 0.0, 1.0)
    return DESIGN.residual(np.zeros(60), ramp)


def test_long_run_factor() -> None:
    assert UNIT.long_run_factor == pytest.approx(5.71, abs=0.005)
    assert UNIT.long_run_factor == pytest.approx(1.0 / DESIGN.noise_gain**2, rel=1e-2)  # the same sum, from dc gain 1


@pytest.mark.parametrize(("shift", "median_s"), [(3.0, 0.65), (5.0, 0.02)])
def test_median_delay_of_the_constant_threshold(shift: float, median_s: float) -> None:
    delay_s = detect(np.full(101, shift), 5.138, UNIT).delay_s(0.5)
    assert delay_s == pytest.approx(median_s, abs=1.01 * T)


def test_the_bias_response_overshoots_by_two_percent() -> None:
    response = bias_response(DESIGN, 1.0)
    assert response.max() == pytest.approx(1.02, abs=5e-3)
