"""Properties of the odds, and predictions against simulations that know nothing of the formulas."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from servofd.aircraft.schema import plain_aircraft
from servofd.core.errors import DesignError
from servofd.detection.probability import (
    Noise,
    crossings,
    smallest_offset_deg,
)
from servofd.detection.pulse import design_pulse_filter
from servofd.jobs.odds import odds_from_logs
from servofd.servo.library import servo_named

DESIGN = design_pulse_filter(servo_named("hs225bb-eq31").transfer, 0.004, 0.01, 50.0)
NOISE = Noise.designed(DESIGN, 1.0 / DESIGN.noise_gain)


def simulated(samples: int, seed: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Residual of a healthy servo whose position carries the noise of `NOISE`."""
    white = np.random.default_rng(seed).standard_normal(samples + 500) / DESIGN.noise_gain
    residual: np.ndarray[tuple[int, ...], np.dtype[np.float64]] = lfilter(DESIGN.g * DESIGN.a, DESIGN.md, white)[500:]
    return residual


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(st.floats(-280.0, 3.0), st.floats(-0.99, 0.99), st.floats(1e-3, 0.1), st.floats(1e-3, 10.0))
def test_the_threshold_has_the_rate_it_was_asked_for(
    exponent: float, correlation: float, sample_time_s: float, sigma_deg: float
) -> None:
    noise = Noise(sigma_deg, correlation, sample_time_s)
    threshold_deg = noise.threshold_deg(10.0**exponent)
    rate = noise.false_alarms_per_hour(threshold_deg)
    assert rate == pytest.approx(10.0**exponent, rel=1e-8)


@pytest.mark.parametrize("rate", [1e9, 0.0])
def test_an_impossible_rate_is_refused(rate: float) -> None:
    with pytest.raises(DesignError, match="choose one between"):
        Noise(1.0, 0.6, 0.01).threshold_deg(rate)


def test_no_noise_needs_no_threshold() -> None:
    with pytest.raises(DesignError, match="without noise"):
        Noise(0.0, 0.6, 0.01).threshold_deg(1e-3)
    assert Noise(0.0, 0.6, 0.01).false_alarms_per_hour(1.0) == 0.0


@pytest.mark.parametrize("correlation", [-0.7, 0.0, 0.5])
@pytest.mark.parametrize("z", [1.0, 2.5])
def test_the_rate_of_crossings_is_that_of_the_bivariate_normal_law(correlation: float, z: float) -> None:
    """One sample inside both limits, the next outside either: 2 [P(b > z) - P(|a| > z, b > z)] per sample time."""
    from scipy.special import ndtr
    from scipy.stats import multivariate_normal

    same, other = (
        float(multivariate_normal.cdf([-z, -z], cov=[[1.0, rho], [rho, 1.0]])) for rho in (correlation, -correlation)
    )
    exact_per_hour = 2.0 * 3600.0 / 0.01 * (float(ndtr(-z)) - same - other)
    assert Noise(3.0, correlation, 0.01).false_alarms_per_hour(3.0 * z) == pytest.approx(exact_per_hour, rel=1e-6)


@pytest.mark.parametrize("mean_deg", [0.0, -0.3])
def test_measured_noise_and_its_crossings_are_those_that_were_put_in(mean_deg: float) -> None:
    record = simulated(200_000, seed=5) + mean_deg
    record[1000:1100] = np.nan
    found = Noise.measured(record, 0.01)
    assert found.mean_deg == pytest.approx(mean_deg, abs=0.03)
    assert found.sigma_deg == pytest.approx(1.0, abs=0.02)
    assert found.correlation == pytest.approx(NOISE.correlation, abs=0.02)
    hours = 199_900 / 360_000
    expected = (
        0.5
        * hours
        * sum(Noise(1.0, NOISE.correlation, 0.01).false_alarms_per_hour(3.0 + s * mean_deg) for s in (1, -1))
    )
    assert crossings(record, 3.0) == pytest.approx(expected, rel=4.0 / np.sqrt(expected))
    assert found.threshold_deg(1e-3) == pytest.approx(NOISE.threshold_deg(1e-3) + abs(mean_deg), rel=0.02)


def test_the_smallest_offset_is_seen_in_time() -> None:
    """At the sample of its largest response 99 in 100 of noisy flights are over the threshold."""
    size_deg = smallest_offset_deg(DESIGN, 5.0, NOISE, 0.2)
    response = lfilter(DESIGN.g * DESIGN.a, DESIGN.md, np.full(21, size_deg))
    flights = response.max() + simulated(100_000, seed=8)
    assert np.mean(np.abs(flights) >= 5.0) == pytest.approx(0.99, abs=0.002)


def audited(record: Any, servo: str = "hs225bb-eq31", status: str = "healthy") -> Any:
    """What the odds read of an audited log."""
    surface = SimpleNamespace(
        surface="elevator",
        servo=servo,
        status=status,
        reason="stuck",
        expected=True,
        threshold_deg=1.5,
        residuals=SimpleNamespace(settled=np.ones(record.size, dtype=bool), residual_deg=record),
        segment=SimpleNamespace(period_s=0.01),
    )
    source = SimpleNamespace(name="bad.csv" if status == "fault" else "a.csv")
    return SimpleNamespace(
        aircraft=plain_aircraft(["elevator"], servo), log=SimpleNamespace(source=source), surfaces=(surface,)
    )


def test_logs_are_pooled_and_what_is_left_out_is_said() -> None:
    records = [0.05 * simulated(20_000, seed) for seed in (1, 2, 3)]
    logs = [audited(records[0]), audited(records[0], status="fault"), audited(records[1])]
    (odds,), missing = odds_from_logs([*logs, audited(records[2], servo="s9254")])
    assert not missing
    assert odds.hours == pytest.approx(40_000 / 360_000)
    assert odds.alarms == 0
    assert odds.noise.sigma_deg == pytest.approx(0.05, rel=0.03)
    assert odds.notes == ("bad.csv left out, fault: stuck", "a.csv left out, its rate, filter or servo differs")


def test_a_fault_or_too_little_contributes_nothing() -> None:
    record = simulated(500, seed=1)
    assert odds_from_logs([audited(record, status="fault")]) == ([], {"elevator": "bad.csv left out, fault: stuck"})
    for useless, reason in ((record, "less than 10 s"), (np.zeros(5000), "never changes")):
        odds, missing = odds_from_logs([audited(useless)])
        assert not odds
        assert reason in missing["elevator"]
