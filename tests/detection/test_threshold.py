"""The interval threshold: no healthy servo leaves more than its tolerance, no level knows the future."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servofd.aircraft.series import Series
from servofd.core.tolerance import Tolerance
from servofd.core.types import FloatArray
from servofd.detection.residual import ResidualGenerator, Residuals
from servofd.detection.threshold import Threshold, constant_threshold, follow, interval_threshold, new_state
from servofd.simulation.commands import COMMANDS
from tests.detection.tolerated import MODEL, deviating

GENERATOR = ResidualGenerator(MODEL, 50.0)
TIME_S = np.arange(2000) / 100.0
NOTHING = {"gain": 0.0, "delay_s": 0.0, "bandwidth": 0.0, "rate": 0.0, "bias_deg": 0.0, "noise_deg": 0.0}
ROUND_OFF_DEG = 1e-6

commands = st.builds(
    lambda style, seed, scale: scale * COMMANDS[style](TIME_S, np.random.default_rng(seed)),
    st.sampled_from(["flight", "chirp", "gusty", "calm", "hand_flown"]),
    st.integers(0, 1000),
    st.floats(0.2, 1.5),
)
shares = st.floats(-1.0, 1.0)


def judged(
    time_s: FloatArray, command_deg: FloatArray, measured_deg: FloatArray, tolerance: Tolerance
) -> tuple[Residuals, Threshold]:
    segment = Series("x", time_s, command_deg, time_s, measured_deg)
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

    @pytest.mark.slow
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
    for name in ("level_deg", "tolerance_deg", "sigma_deg"):
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
    command_deg = COMMANDS["gusty"](TIME_S, np.random.default_rng(3))
    _, interval = judged(TIME_S, command_deg, deviating(TIME_S, command_deg), Tolerance())
    constant = constant_threshold(interval, 1.5)
    assert (constant.kind, interval.kind, constant.typical_deg) == ("constant", "interval", 1.5)
    assert np.all(constant.level_deg == 1.5)
    np.testing.assert_array_equal(constant.tolerance_deg, interval.tolerance_deg)
    np.testing.assert_array_equal(interval.level_deg, interval.tolerance_deg + 6.0 * interval.sigma_deg)


class TestToleranceByHand:
    """One tolerance at a time; a servo with one pole at 10 rad/s, and peaks that halve in the filter's 0.15 s."""

    @staticmethod
    def followed(
        immobile_deg: list[float],
        step_s: float,
        parameters: tuple[float, float, float, float],
        decay_rad_s: complex = 10.0,
        **others: list[float],
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        size = len(immobile_deg)
        signals = np.zeros((7, size))
        signals[:2] = step_s * np.arange(size), immobile_deg
        signals[2] = np.nan
        rows = {"measured_deg": 3, "restarted": 4, "rate_error_deg": 5, "unseen_deg": 6}
        for name, values in others.items():
            signals[rows[name]] = values
        poles, out = np.array([decay_rad_s], dtype=complex), np.zeros((3, size))
        memory = new_state(0.1)
        follow(signals, np.array([*parameters, 0.1, 2.0]), *memory, np.zeros(1, dtype=complex), poles, out)
        tolerated, saturated, sigma = out
        return tolerated, saturated, sigma

    @pytest.mark.slow
    def test_a_gain_leaves_its_share_of_the_recent_peak(self) -> None:
        tolerated, saturated, sigma = self.followed([0.0, -10.0, 0.0, np.nan, 0.0], 0.15, (0.03, 0.0, 0.0, 0.3))
        np.testing.assert_allclose(tolerated, [0.3, 0.6, 0.45, 0.45, 0.3 + 0.3 / 2.0 / 3.0], rtol=1e-12)
        np.testing.assert_array_equal(saturated, 0.0)
        np.testing.assert_allclose(sigma, 2.0 * 0.1, rtol=1e-12)

    def test_a_delay_leaves_its_share_of_the_speed(self) -> None:
        """10 deg/s, and where it sets in 0.5 (1 + 3/10) times its change, for what a difference lags."""
        tolerated, *_ = self.followed([0.0, 0.1, 0.2], 0.01, (0.0, 0.003, 0.0, 0.0))
        np.testing.assert_allclose(tolerated, [0.0, 0.003 * 16.5, 0.003 * 16.5 * 15.0 / 16.0], rtol=1e-12)

    @pytest.mark.parametrize(("decay_rad_s", "members"), [(10.0, 1.0), (10.0 + 1e-12j, 2.0)])
    def test_a_bandwidth_leaves_its_share_of_what_passes_a_high_pass(
        self, decay_rad_s: complex, members: float
    ) -> None:
        """A step of 1 deg, of which the pole has followed 0.05 / 1.05 after 0.01 s, then 0.1 more of the rest."""
        tolerated, *_ = self.followed([0.0, 1.0, 1.0], 0.01, (0.0, 0.0, 0.5, 0.0), decay_rad_s)
        np.testing.assert_allclose(tolerated[:2], [0.0, 0.5 * members * 1.5 / 1.05], rtol=1e-9)
        np.testing.assert_allclose(tolerated[2], tolerated[1] * 15.0 / 16.0, rtol=1e-9)

    def test_a_start_knows_no_speed(self) -> None:
        tolerated, *_ = self.followed([0.0, 5.0, 5.0], 0.01, (0.0, 0.003, 0.5, 0.0), restarted=[1.0, 1.0, 0.0])
        np.testing.assert_array_equal(tolerated, 0.0)

    def test_what_a_saturated_servo_and_lost_commands_leave_fades(self) -> None:
        rate, unseen = [0.0, -0.5, 0.0, 0.0], [0.0, 0.0, 0.2, 0.2]
        tolerated, saturated, _ = self.followed(
            [0.0] * 4, 0.15, (0.0, 0.0, 0.0, 0.3), rate_error_deg=rate, unseen_deg=unseen
        )
        np.testing.assert_allclose(saturated, [0.0, 0.5, 0.25 + 0.2, 0.125 + 0.1 + 0.2], rtol=1e-12)
        np.testing.assert_allclose(tolerated - saturated, 0.3, rtol=1e-12)

    def test_no_noise_is_smaller_than_the_smallest_step_seen_allows(self) -> None:
        *_, sigma = self.followed([0.0] * 4, 0.01, (0.0, 0.0, 0.0, 0.3), measured_deg=[0.0, 0.9, 0.9, 1.5])
        np.testing.assert_allclose(sigma, [0.2, 2.0 * 0.9 / 12**0.5, 2.0 * 0.9 / 12**0.5, 2.0 * 0.6 / 12**0.5])
