"""Properties of the odds, and predictions against simulations that know nothing of the formulas."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servofd.core.errors import DesignError, NoMeasurement
from servofd.detection.probability import (
    Noise,
    TailFit,
    Wish,
    bias_response,
    detect,
    false_alarms_per_hour,
    fit_tail,
    persistent_false_alarms_per_hour,
    persistent_threshold_deg,
    smallest_bias_deg,
    threshold_for_rate_deg,
)
from servofd.detection.pulse import design_pulse_filter
from servofd.jobs.odds import LeftOut, Part, odds_from_logs
from servofd.servo.library import servo_named

ROOT = Path(__file__).parent.parent.parent
DESIGN = design_pulse_filter(servo_named("hs225bb-eq31").transfer, 0.004, 0.01, 50.0)
NOISE = Noise.designed(DESIGN, 1.0 / DESIGN.noise_gain)
WHITE = Noise(1.0, np.eye(8)[0], 0.01)


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(st.floats(-280.0, 3.0), st.floats(-0.99, 0.99), st.floats(1e-3, 0.1), st.floats(1e-3, 10.0))
def test_the_threshold_has_the_rate_it_was_asked_for(
    exponent: float, correlation: float, sample_time_s: float, sigma_deg: float
) -> None:
    threshold_deg = threshold_for_rate_deg(10.0**exponent, sigma_deg, correlation, sample_time_s)
    rate = false_alarms_per_hour(threshold_deg, sigma_deg, correlation, sample_time_s)
    assert rate == pytest.approx(10.0**exponent, rel=1e-8)


@pytest.mark.parametrize("rate", [1e9, 0.0])
def test_an_impossible_rate_is_refused(rate: float) -> None:
    with pytest.raises(DesignError, match="choose one between"):
        threshold_for_rate_deg(rate, 1.0, 0.6, 0.01)


def test_no_noise_needs_no_threshold() -> None:
    with pytest.raises(DesignError, match="without noise"):
        threshold_for_rate_deg(1e-3, 0.0, 0.6, 0.01)
    assert false_alarms_per_hour(1.0, 0.0, 0.6, 0.01) == 0.0


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
    assert false_alarms_per_hour(3.0 * z, 3.0, correlation, 0.01) == pytest.approx(exact_per_hour, rel=1e-6)


@pytest.mark.parametrize("samples", [2, 3, 5])
def test_runs_of_white_noise_have_a_closed_form(samples: int) -> None:
    from scipy.special import ndtr

    tail = float(ndtr(-3.0))
    exact = 2.0 * 3600.0 / 0.01 * tail**samples * (1.0 - tail)
    assert persistent_false_alarms_per_hour(3.0, WHITE, samples) == pytest.approx(exact, rel=1e-9)


def test_runs_of_one_are_crossings() -> None:
    run = persistent_false_alarms_per_hour(5.0, NOISE, 1)
    assert run == pytest.approx(false_alarms_per_hour(5.0, 1.0, NOISE.correlation, 0.01), rel=1e-12)
    with pytest.raises(ValueError, match="in a row"):
        persistent_false_alarms_per_hour(5.0, WHITE, 8)


def test_three_in_a_row_is_worth_more_than_one_sigma() -> None:
    single, triple = (persistent_threshold_deg(1e-3, NOISE, n) for n in (1, 3))
    assert 1.1 < single - triple < 1.3
    assert persistent_false_alarms_per_hour(triple, NOISE, 3) == pytest.approx(1e-3, rel=1e-9)


def test_a_mean_takes_its_size_off_the_margin() -> None:
    shifted = Noise(1.0, NOISE.autocorrelation, 0.01, mean_deg=-0.5)
    assert persistent_threshold_deg(1e-3, shifted, 3) == pytest.approx(persistent_threshold_deg(1e-3, NOISE, 3) + 0.5)
    rate = persistent_false_alarms_per_hour(4.0, NOISE, 3)
    assert persistent_false_alarms_per_hour(4.5, shifted, 3) == pytest.approx(rate, rel=1e-9)


def test_measured_noise_has_the_colour_that_was_put_in() -> None:
    record = NOISE.sample((1, 200_000), seed=5)[0] + 0.3
    record[1000:1100] = np.nan
    found = Noise.measured(record, 0.01, lags=80)
    assert found.mean_deg == pytest.approx(0.3, abs=0.03)
    assert found.sigma_deg == pytest.approx(1.0, abs=0.02)
    np.testing.assert_allclose(found.autocorrelation[:6], NOISE.autocorrelation[:6], atol=0.02)
    assert found.long_run_factor == pytest.approx(NOISE.long_run_factor, rel=0.1)


def test_noise_is_not_told_from_nothing() -> None:
    with pytest.raises(NoMeasurement, match="only 50 healthy samples"):
        Noise.measured(np.append(np.zeros(50), np.full(900, np.nan)), 0.01, 10)
    with pytest.raises(NoMeasurement, match="never changes"):
        Noise.measured(np.ones(1000), 0.01, 10)
    with pytest.raises(ValueError, match="standard deviation"):
        Noise(0.0, np.ones(2), 0.01)


def test_a_very_smooth_residual_is_no_trouble() -> None:
    smooth = Noise(1.0, np.cos(0.1 * np.arange(40)), 0.01)
    assert 0.0 < detect(np.full(50, 4.0), 5.0, smooth).likely[-1] <= 1.0
    assert np.isfinite(persistent_threshold_deg(1e-3, smooth, 3))


@pytest.mark.parametrize("index", [-0.2, 0.0, 0.2])
def test_the_tail_index_is_recovered(index: float) -> None:
    from scipy.stats import genpareto

    rng = np.random.default_rng(3)
    record = np.zeros(720_000)
    places = np.arange(100, record.size, 360)
    record[places] = 1.0 + genpareto.rvs(index, scale=0.1, size=places.size, random_state=rng)
    record *= rng.choice([-1.0, 1.0], record.size)
    fit = fit_tail(record, 0.01)
    assert fit.hours == pytest.approx(2.0)
    assert abs(fit.index - index) < 4.0 * fit.index_error


def test_the_profile_likelihood_has_no_better_tail() -> None:
    """The maximum that scipy finds, against one found along the profile in xi / beta."""
    from scipy.optimize import minimize_scalar

    record = np.random.default_rng(4).standard_t(6, 720_000)
    fit = fit_tail(record, 0.01)
    over = np.flatnonzero(np.abs(record) > fit.level_deg)
    clusters = np.split(np.abs(record)[over], np.flatnonzero(np.diff(over) >= 15) + 1)
    excess = np.array([cluster.max() for cluster in clusters]) - fit.level_deg
    assert excess.size == fit.peaks

    def cost(theta: float) -> float:
        index = float(np.log1p(theta * excess).mean())
        return float(np.log(index / theta) + index)

    best = minimize_scalar(cost, bounds=(1e-6, 5.0), method="bounded", options={"xatol": 1e-9}).x
    assert fit.index == pytest.approx(float(np.log1p(best * excess).mean()), abs=1e-3)


def test_tail_rates_and_thresholds_are_inverse_and_marked() -> None:
    fit = TailFit(1.0, 0.1, 0.15, 0.03, 1000, 10.0)
    for rate in (50.0, 1.0, 0.011, 1e-6):
        threshold = fit.threshold_deg(rate)
        assert fit.false_alarms_per_hour(threshold.value).value == pytest.approx(rate, rel=1e-9)
        assert threshold.extrapolated == (rate < 0.01) == fit.false_alarms_per_hour(threshold.value).extrapolated
    assert fit.false_alarms_per_hour(0.2).value == fit.peaks_per_hour
    ended = TailFit(1.0, 0.1, -0.5, 0.03, 1000, 10.0)
    assert ended.false_alarms_per_hour(1.3) == (0.0, True)
    assert ended.log_rate_error(1.3) == np.inf


def test_the_error_of_a_tail_rate_is_smooth_at_zero_index() -> None:
    near, at = (TailFit(1.0, 0.1, index, 0.03, 1000, 10.0).log_rate_error(2.0) for index in (1e-4, 0.0))
    assert near == pytest.approx(at, rel=5e-3)


def test_two_hours_are_needed_for_a_tail() -> None:
    with pytest.raises(NoMeasurement, match="needs 2 h"):
        fit_tail(np.random.default_rng(1).standard_normal(10_000), 0.01)
    with pytest.raises(NoMeasurement, match="no tail"):
        fit_tail(np.ones(720_000), 0.01)


def test_heavy_tails_are_told_from_gaussian_ones() -> None:
    rng = np.random.default_rng(6)
    normal, heavy = fit_tail(rng.standard_normal(1_500_000), 0.01), fit_tail(rng.standard_t(4, 1_500_000), 0.01)
    # Far out it would be 0 and 1/4; at the level where the data are, both are still below that.
    assert abs(normal.index) < 0.1
    assert 4.0 * heavy.index_error < heavy.index < 0.25


@pytest.mark.slow
@pytest.mark.parametrize("shift", [2.5, 3.5, 4.5, 6.0])
def test_the_predicted_delay_is_that_of_a_simulation(shift: float) -> None:
    response = np.append(shift * bias_response(DESIGN, 1.0), np.full(1400, shift))
    outside = np.abs(NOISE.sample((2000, response.size), seed=8) + response) >= 5.138
    delay_s = 0.01 * np.where(outside.any(axis=1), outside.argmax(axis=1), response.size)
    detection = detect(response[:101], 5.138, NOISE)
    horizon_s = 0.01 * response.size
    cut_off_s = detection.mean_delay_s * -np.expm1(-horizon_s / detection.mean_delay_s)
    assert cut_off_s == pytest.approx(delay_s.mean(), rel=0.07, abs=2e-3)
    seen = (delay_s <= 0.2).mean()
    assert detection.likely[20] == pytest.approx(seen, abs=0.035)
    assert (detection.least <= detection.likely).all()
    assert (detection.likely <= detection.most).all()


def test_detection_in_white_noise_is_geometric() -> None:
    """Every sample is missed with the same chance q, so alarms come like the first head of a coin."""
    from scipy.special import ndtr

    missed = float(ndtr(1.0) - ndtr(-5.0))
    detection = detect(np.full(11, 2.0), 3.0, WHITE)
    np.testing.assert_allclose(detection.least, 1.0 - missed, rtol=1e-12)
    np.testing.assert_allclose(detection.likely, 1.0 - missed ** np.arange(1, 12), rtol=1e-9)
    np.testing.assert_allclose(detection.most, detection.likely, rtol=1e-9)
    assert detection.steady_per_s == pytest.approx(-np.log(missed) / 0.01, rel=1e-9)
    drawn_s = 0.01 * sum(missed**k for k in range(1, 11))
    assert detection.mean_delay_s == pytest.approx(drawn_s - 0.01 * missed**11 / np.log(missed), rel=1e-9)
    assert detection.delay_s(0.5) == pytest.approx(0.04)  # 0.841^4 = 0.501, 0.841^5 = 0.422
    assert detection.delay_s(0.9) == float("inf")


def test_noise_alone_crosses_both_limits() -> None:
    assert detect(np.zeros(2), 1.0, WHITE).least == pytest.approx([0.317311, 0.317311], abs=1e-6)
    off_centre = Noise(2.0, np.eye(8)[0], 0.01, mean_deg=1.0)
    assert detect(np.zeros(2), 4.0, off_centre).least[0] == pytest.approx(0.066807 + 0.006210, abs=1e-6)


def test_what_is_seen_for_sure_in_the_end_has_a_delay() -> None:
    """A fault of 50 sigma in the fourth sample; before, each sample alarms with a chance of 2 Phi(-3) = 0.0027."""
    detection = detect(np.array([0.0, 0.0, 0.0, 50.0]), 3.0, WHITE)
    assert detection.steady_per_s == float("inf")
    assert detection.mean_delay_s == pytest.approx(0.01 * sum(0.9973002039**k for k in (1, 2, 3)), rel=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("correlations", [(0.9, 0.0), (0.2, 0.9)])
def test_the_colour_of_the_noise_reaches_as_far_back_as_it_is_known(correlations: tuple[float, float]) -> None:
    """Three samples against the trivariate normal law; the second colour is in the sample before the last."""
    from scipy.linalg import toeplitz
    from scipy.stats import multivariate_normal

    first, second = correlations
    colour = np.array([1.0, first, second or 2.0 * first**2 - 1.0])
    inside = multivariate_normal(cov=toeplitz(colour), allow_singular=True)
    stayed = inside.cdf(np.full(3, 0.5), lower_limit=np.full(3, -1.5))
    likely = detect(np.full(3, 0.5), 1.0, Noise(1.0, colour, 0.01)).likely
    assert likely[-1] == pytest.approx(1.0 - stayed, abs=0.015)


def test_the_sign_of_a_fault_does_not_matter() -> None:
    response = 4.0 * bias_response(DESIGN, 0.5)
    np.testing.assert_array_equal(detect(response, 5.0, NOISE).likely, detect(-response, 5.0, NOISE).likely)


def test_a_fault_that_is_not_there_is_seen_as_often_as_noise_alarms() -> None:
    delay_s = detect(np.zeros(100), 5.0, NOISE).mean_delay_s
    assert 3600.0 / delay_s == pytest.approx(false_alarms_per_hour(5.0, 1.0, NOISE.correlation, 0.01), rel=1e-3)


def test_the_smallest_bias_is_seen_in_time() -> None:
    for within_s in (0.05, 0.2):
        size_deg = smallest_bias_deg(DESIGN, 5.0, NOISE, within_s)
        assert detect(size_deg * bias_response(DESIGN, within_s), 5.0, NOISE).least[-1] == pytest.approx(0.99, abs=1e-9)


def part(record: np.ndarray[tuple[int, ...], np.dtype[np.float64]], servo: str = "hs225bb-eq31") -> Part:
    return Part("elevator", servo, "a.csv", 1.5, DESIGN, record)


@pytest.mark.slow
def test_logs_are_pooled_and_what_is_left_out_is_said() -> None:
    records = NOISE.sample((3, 400_000), seed=11) * 0.05
    parts: list[Part | LeftOut] = [part(records[0]), LeftOut("elevator", "bad.csv", "fault: stuck"), part(records[1])]
    (odds,) = odds_from_logs([*parts, part(records[2], servo="s9254")], Wish())
    assert not isinstance(odds, LeftOut)
    assert odds.hours == pytest.approx(800_000 / 360_000)
    assert odds.tail is not None
    assert odds.tail_threshold_deg is not None
    assert odds.tail_threshold_deg.extrapolated
    assert odds.notes == ("bad.csv left out, fault: stuck", "a.csv left out, its rate, filter or servo differs")
    assert odds.wished.threshold_deg == odds.tail_threshold_deg.value
    assert odds.wished.tail_per_hour is not None
    assert odds.wished.tail_per_hour.value == pytest.approx(1e-3)
    assert odds.in_force.gaussian_per_hour < 1e-100


def test_a_fault_or_too_little_contributes_nothing() -> None:
    (fault,) = odds_from_logs([LeftOut("elevator", "bad.csv", "fault: stuck")], Wish())
    assert fault == LeftOut("elevator", "bad.csv", "bad.csv left out, fault: stuck")
    (short,) = odds_from_logs([part(NOISE.sample((1, 500), seed=1)[0])], Wish())
    assert isinstance(short, LeftOut)
    assert "less than 10 s" in short.reason
    (silent,) = odds_from_logs([part(np.zeros(5000))], Wish())
    assert isinstance(silent, LeftOut)
    assert "never changes" in silent.reason


@pytest.mark.nightly
def test_simulated_flight_hours_see_the_predicted_false_alarms(capsys: pytest.CaptureFixture[str]) -> None:
    """A hundred alarms expected in 250 hours, the tail fitted to 25 others; a thousand hours are in docs/odds.md."""
    main = runpy.run_path(str(ROOT / "benchmarks" / "false_alarms.py"))["main"]
    single, triple, heavy, naive = main(hours=250, target_per_hour=0.4, fit_hours=25)
    assert "ratio" in capsys.readouterr().out
    for outcome in (single, triple, heavy):
        assert 1.0 / 1.5 < outcome.ratio < 1.5
    assert naive.ratio > 100.0
