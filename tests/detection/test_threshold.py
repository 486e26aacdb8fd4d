"""The interval threshold: no healthy servo leaves more than its tolerance, no level knows the future."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servofd.detection.residual import ResidualGenerator, Residuals
from servofd.detection.threshold import Threshold, constant_threshold, interval_threshold, suspicion
from servofd.segment import Segment
from servofd.simulation.commands import COMMANDS
from servofd.tolerance import Tolerance
from servofd.types import FloatArray
from tests.detection.tolerated import MODEL, deviating

GENERATOR = ResidualGenerator(MODEL, 50.0)
TIME_S = np.arange(2000) / 100.0
NOTHING = {"gain": 0.0, "delay_s": 0.0, "bandwidth": 0.0, "rate": 0.0, "bias_deg": 0.0, "noise_deg": 0.0}
ROUND_OFF_DEG = 1e-6

commands = st.builds(
    lambda style, seed, scale: scale * COMMANDS[style](TIME_S, np.random.default_rng(seed)),
    st.sampled_from(["flight", "chirp", "lively", "calm", "hand_flown"]),
    st.integers(0, 1000),
    st.floats(0.2, 1.5),
)
shares = st.floats(-1.0, 1.0)


def judged(
    time_s: FloatArray, command_deg: FloatArray, measured_deg: FloatArray, tolerance: Tolerance
) -> tuple[Residuals, Threshold]:
    segment = Segment("x", time_s, command_deg, time_s, measured_deg)
    residuals = GENERATOR.run(segment)
    return residuals, interval_threshold(GENERATOR, segment, residuals, tolerance)


def excess_deg(residuals: Residuals, threshold: Threshold) -> float:
    """By how much |residual| exceeds its tolerance at most [deg], once it has forgotten how the filter was started."""
    excess = np.abs(residuals.residual_deg) - threshold.tolerance_deg
    return float(np.max(excess[residuals.settled & (residuals.time_s > 1.0)]))


def alone(name: str, value: float) -> Tolerance:
    return Tolerance(**{**NOTHING, name: value})


class TestAHealthyServoStaysWithinItsTolerance:
    @settings(max_examples=30, deadline=None)
    @given(command_deg=commands, share=shares)
    @pytest.mark.parametrize(("name", "value"), [("gain", 0.03), ("bias_deg", 0.3)])
    def test_gain_and_bias(self, name: str, value: float, command_deg: FloatArray, share: float) -> None:
        measured_deg = deviating(TIME_S, command_deg, **{name: share * value})
        assert excess_deg(*judged(TIME_S, command_deg, measured_deg, alone(name, value))) <= ROUND_OFF_DEG

    @settings(max_examples=30, deadline=None)
    @given(command_deg=commands, share=shares)
    @pytest.mark.parametrize(("name", "value"), [("delay_s", 0.003), ("bandwidth", 0.1)])
    def test_delay_and_bandwidth_within_all_tolerances(
        self, name: str, value: float, command_deg: FloatArray, share: float
    ) -> None:
        measured_deg = deviating(TIME_S, command_deg, **{name: share * value})
        assert excess_deg(*judged(TIME_S, command_deg, measured_deg, Tolerance())) <= ROUND_OFF_DEG

    @pytest.mark.parametrize("size_deg", [15.0, 22.5, 30.0, 45.0])
    @pytest.mark.parametrize("share", [-0.1, -0.05, 0.1])
    def test_rate_limit(self, size_deg: float, share: float) -> None:
        command_deg = np.where(TIME_S > 5.0, size_deg, 0.0)
        measured_deg = deviating(TIME_S, command_deg, rate=share)
        assert excess_deg(*judged(TIME_S, command_deg, measured_deg, alone("rate", 0.1))) <= ROUND_OFF_DEG

    @pytest.mark.parametrize("size_deg", [20.0, 21.0])
    def test_rate_limit_that_only_the_slower_servo_reaches(self, size_deg: float) -> None:
        command_deg = np.where(TIME_S > 5.0, size_deg, 0.0)
        measured_deg = deviating(TIME_S, command_deg, rate=-0.1)
        assert excess_deg(*judged(TIME_S, command_deg, measured_deg, alone("rate", 0.1))) <= ROUND_OFF_DEG

    @pytest.mark.parametrize(("name", "value"), [("delay_s", 0.003), ("delay_s", -0.003), ("bandwidth", -0.1)])
    @pytest.mark.parametrize("frequency_hz", [2.0, 4.0, 8.0])
    def test_delay_and_bandwidth_alone(self, name: str, value: float, frequency_hz: float) -> None:
        command_deg = 5.0 * np.sin(2.0 * np.pi * frequency_hz * TIME_S)
        measured_deg = deviating(TIME_S, command_deg, **{name: value})
        assert excess_deg(*judged(TIME_S, command_deg, measured_deg, alone(name, abs(value)))) <= ROUND_OFF_DEG

    @settings(max_examples=40, deadline=None)
    @given(command_deg=commands, off=st.tuples(shares, shares, shares, shares), seed=st.integers(0, 1000))
    def test_all_at_once_on_jittered_stamps_with_noise(
        self, command_deg: FloatArray, off: tuple[float, float, float, float], seed: int
    ) -> None:
        rng = np.random.default_rng(seed)
        time_s = TIME_S + rng.uniform(0.0, 0.004, TIME_S.size)
        gain, delay, bandwidth, bias = off
        measured_deg = deviating(
            time_s, command_deg, gain=0.03 * gain, delay_s=0.003 * delay, bandwidth=0.1 * bandwidth, bias_deg=0.3 * bias
        )
        measured_deg += 0.1 * rng.standard_normal(time_s.size)
        residuals, threshold = judged(time_s, command_deg, measured_deg, Tolerance())
        assert np.all(np.abs(residuals.residual_deg) < threshold.level_deg, where=residuals.settled)

    @settings(max_examples=30, deadline=None)
    @given(command_deg=commands, seed=st.integers(0, 1000))
    def test_positions_that_are_lost_raise_nothing(self, command_deg: FloatArray, seed: int) -> None:
        measured_deg = deviating(TIME_S, command_deg, gain=0.03)
        measured_deg[np.random.default_rng(seed).random(TIME_S.size) < 0.1] = np.nan
        assert excess_deg(*judged(TIME_S, command_deg, measured_deg, alone("gain", 0.03))) <= ROUND_OFF_DEG


def test_at_rest_only_the_bias_is_left() -> None:
    command_deg = np.where((TIME_S > 5.0) & (TIME_S < 6.0), 20.0, 0.0)
    _, threshold = judged(TIME_S, command_deg, deviating(TIME_S, command_deg), Tolerance(bias_deg=0.25))
    np.testing.assert_allclose(threshold.tolerance_deg[TIME_S < 5.0], 0.25, atol=1e-12)
    assert threshold.tolerance_deg.max() > 1.0
    # The filter's own tail and the peak hold are over within some time constants.
    np.testing.assert_allclose(threshold.tolerance_deg[TIME_S > 10.0], 0.25, atol=1e-3)


@settings(max_examples=15, deadline=None)
@given(command_deg=commands, cut=st.integers(300, 1999))
def test_no_level_knows_what_comes_later(command_deg: FloatArray, cut: int) -> None:
    noise = 0.1 * np.random.default_rng(cut).standard_normal(TIME_S.size)
    measured_deg = deviating(TIME_S, command_deg) + noise
    _, whole = judged(TIME_S, command_deg, measured_deg, Tolerance())
    _, early = judged(TIME_S[:cut], command_deg[:cut], measured_deg[:cut], Tolerance())
    for name in ("level_deg", "tolerance_deg", "sigma_deg", "drift"):
        # The filter's gain is that of the median sample time, which the last bit of a stamp may move.
        np.testing.assert_allclose(getattr(early, name), getattr(whole, name)[:cut], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("noise_deg", [0.03, 0.1, 0.4])
def test_the_noise_becomes_known(noise_deg: float) -> None:
    command_deg = COMMANDS["flight"](TIME_S, np.random.default_rng(1))
    noise = noise_deg * np.random.default_rng(2).standard_normal(TIME_S.size)
    residuals, threshold = judged(TIME_S, command_deg, deviating(TIME_S, command_deg) + noise, Tolerance())
    true_deg = float(np.std(residuals.residual_deg[residuals.settled]))
    # Steps of 0.4 % that hunt for a median wander by some per cent.
    assert np.median(threshold.sigma_deg[TIME_S > 10.0]) == pytest.approx(true_deg, rel=0.12)
    assert np.all(threshold.sigma_deg[:200] >= 0.9 * min(true_deg, threshold.sigma_deg[0]))


def test_a_position_in_coarse_steps_is_not_called_noise_free() -> None:
    command_deg = np.where(TIME_S > 5.0, 4.0, 0.0)
    measured_deg = 0.5 * np.round(deviating(TIME_S, command_deg) / 0.5)
    _, threshold = judged(TIME_S, command_deg, measured_deg, Tolerance())
    ratio = threshold.sigma_deg[-1] / (0.5 / np.sqrt(12.0))
    noise = 0.1 * np.random.default_rng(1).standard_normal(TIME_S.size)
    residuals, _ = judged(TIME_S, command_deg, deviating(TIME_S, command_deg) + noise, Tolerance())
    gain = np.std(residuals.residual_deg[residuals.settled]) / 0.1
    assert ratio == pytest.approx(gain, rel=0.05)


def test_a_constant_threshold_still_knows_the_tolerance() -> None:
    command_deg = COMMANDS["lively"](TIME_S, np.random.default_rng(3))
    _, interval = judged(TIME_S, command_deg, deviating(TIME_S, command_deg), Tolerance())
    constant = constant_threshold(interval, 1.5)
    assert (constant.kind, interval.kind, constant.typical_deg) == ("constant", "interval", 1.5)
    assert np.all(constant.level_deg == 1.5)
    np.testing.assert_array_equal(constant.tolerance_deg, interval.tolerance_deg)
    np.testing.assert_array_equal(interval.level_deg, interval.tolerance_deg + 6.0 * interval.sigma_deg)


class TestSuspicion:
    def of(self, seed: int, **off: float) -> FloatArray:
        rng = np.random.default_rng(seed)
        command_deg = 0.5 * COMMANDS["lively"](TIME_S, rng)
        measured_deg = deviating(TIME_S, command_deg, **off) + 0.1 * rng.standard_normal(TIME_S.size)
        residuals, threshold = judged(TIME_S, command_deg, measured_deg, Tolerance())
        assert np.all(np.abs(residuals.residual_deg) < 1.5, where=residuals.settled)
        return TIME_S[suspicion(residuals, threshold)]

    @pytest.mark.parametrize("seed", range(3))
    @pytest.mark.parametrize("off", [{"bias_deg": 0.6}, {"gain": -0.2}, {"delay_s": 0.025}, {"bandwidth": -0.35}])
    def test_small_deviations_beyond_tolerance_show(self, off: dict[str, float], seed: int) -> None:
        assert self.of(seed, **off).size

    @pytest.mark.parametrize("seed", range(3))
    @pytest.mark.parametrize("off", [{}, {"bias_deg": 0.3}, {"gain": -0.03}, {"delay_s": 0.003}, {"bandwidth": -0.1}])
    def test_deviations_within_tolerance_do_not(self, off: dict[str, float], seed: int) -> None:
        assert not self.of(seed, **off).size
