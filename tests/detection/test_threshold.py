"""The threshold of a named servo: no servo within its tolerances passes it, and no level knows the future."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servofd.aircraft.schema import plain_aircraft
from servofd.aircraft.series import Series
from servofd.core.tolerance import Tolerance
from servofd.core.types import FloatArray
from servofd.detection.residual import Residuals, Threshold, ThresholdKind
from servofd.detection.seen import Healthy, Seen
from servofd.simulation.commands import COMMANDS
from tests.detection.tolerated import MODEL, deviating

TIME_S = np.arange(2000) / 100.0

commands = st.builds(
    lambda style, seed, scale: scale * COMMANDS[style](TIME_S, np.random.default_rng(seed)),
    st.sampled_from(["flight", "chirp", "gusty", "calm", "hand_flown"]),
    st.integers(0, 1000),
    st.floats(0.2, 1.5),
)
shares = st.floats(-1.0, 1.0)


def seen(
    time_s: FloatArray,
    command_deg: FloatArray,
    measured_deg: FloatArray,
    tolerance: Tolerance | None = None,
    kind: ThresholdKind = "interval",
) -> Seen:
    changes = {"tolerance": tolerance or Tolerance(), "threshold": kind}
    surface = plain_aircraft(["x"], "hs225bb-eq31").surfaces["x"].model_copy(update=changes)
    return Healthy(surface, MODEL).beside(Series("x", time_s, command_deg, time_s, measured_deg))


def nearest(residuals: Residuals, threshold: Threshold) -> float:
    """The largest residual over its threshold."""
    rows = residuals.settled
    return float(np.max(np.abs(residuals.residual_deg[rows]) / threshold.level_deg[rows]))


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(command_deg=commands, off=st.tuples(shares, shares, shares, shares), seed=st.integers(0, 1000))
def test_a_servo_within_its_tolerances_stays_below(
    command_deg: FloatArray, off: tuple[float, float, float, float], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    time_s = TIME_S + rng.uniform(0.0, 0.004, TIME_S.size)
    gain, delay, bandwidth, bias = off
    measured_deg = deviating(
        time_s, command_deg, gain=0.03 * gain, delay_s=0.003 * delay, bandwidth=0.1 * bandwidth, bias_deg=0.3 * bias
    )
    measured_deg += 0.1 * rng.standard_normal(time_s.size)
    found = seen(time_s, command_deg, measured_deg)
    assert nearest(found.residuals, found.threshold) < 1.0
    assert found.found.faults == ()


@pytest.mark.parametrize("size_deg", [15.0, 30.0, 45.0])
@pytest.mark.parametrize("share", [-0.1, 0.1])
def test_a_rate_limit_within_its_tolerance_stays_below(size_deg: float, share: float) -> None:
    command_deg = np.where(TIME_S > 5.0, size_deg, 0.0)
    found = seen(TIME_S, command_deg, deviating(TIME_S, command_deg, rate=share))
    assert nearest(found.residuals, found.threshold) < 1.0


def test_the_level_rises_with_motion_and_falls_after_it() -> None:
    command_deg = np.where((TIME_S > 5.0) & (TIME_S < 6.0), 20.0, 0.0)
    noise = 0.05 * np.random.default_rng(1).standard_normal(TIME_S.size)
    level_deg = seen(TIME_S, command_deg, deviating(TIME_S, command_deg) + noise).threshold.level_deg
    before, after = np.median(level_deg[(TIME_S > 4.0) & (TIME_S < 5.0)]), level_deg[-1]
    assert np.max(level_deg) > 2.0 * before
    assert after < 0.5 * np.max(level_deg)


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(command_deg=commands, cut=st.integers(300, 1999))
def test_no_level_knows_what_comes_later(command_deg: FloatArray, cut: int) -> None:
    noise = 0.1 * np.random.default_rng(cut).standard_normal(TIME_S.size)
    measured_deg = deviating(TIME_S, command_deg) + noise
    whole = seen(TIME_S, command_deg, measured_deg).threshold
    early = seen(TIME_S[:cut], command_deg[:cut], measured_deg[:cut]).threshold
    for name in ("level_deg", "sigma_deg"):
        # The filter's gain is that of the median sample time, which the last bit of a stamp may move.
        np.testing.assert_allclose(getattr(early, name), getattr(whole, name)[:cut], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("noise_deg", [0.03, 0.1, 0.4])
def test_the_noise_becomes_known(noise_deg: float) -> None:
    command_deg = COMMANDS["flight"](TIME_S, np.random.default_rng(1))
    noise = noise_deg * np.random.default_rng(2).standard_normal(TIME_S.size)
    found = seen(TIME_S, command_deg, deviating(TIME_S, command_deg) + noise)
    sigma_deg = found.threshold.sigma_deg
    true_deg = float(np.std(found.residuals.residual_deg[found.residuals.settled]))
    # Steps of 0.4 % that hunt for a median wander by some per cent.
    assert np.median(sigma_deg[TIME_S > 10.0]) == pytest.approx(true_deg, rel=0.12)
    assert np.all(sigma_deg[:200] >= 0.9 * min(true_deg, sigma_deg[0]))


def test_a_position_in_coarse_steps_is_not_called_noise_free() -> None:
    command_deg = np.where(TIME_S > 5.0, 4.0, 0.0)
    coarse = seen(TIME_S, command_deg, 0.5 * np.round(deviating(TIME_S, command_deg) / 0.5))
    noise = 0.1 * np.random.default_rng(1).standard_normal(TIME_S.size)
    noisy = seen(TIME_S, command_deg, deviating(TIME_S, command_deg) + noise).residuals
    gain = np.std(noisy.residual_deg[noisy.settled]) / 0.1
    assert coarse.threshold.sigma_deg[-1] / (0.5 / np.sqrt(12.0)) == pytest.approx(gain, rel=0.05)


def test_a_constant_threshold_is_the_level_that_was_named() -> None:
    command_deg = COMMANDS["gusty"](TIME_S, np.random.default_rng(3))
    constant = seen(TIME_S, command_deg, deviating(TIME_S, command_deg), kind="constant").threshold
    assert (constant.kind, constant.typical_deg) == ("constant", 1.5)
    assert np.all(constant.level_deg >= 1.5)
    slow = np.abs(np.gradient(deviating(TIME_S, command_deg), TIME_S)) < 20.0
    assert np.median(constant.level_deg[slow]) == pytest.approx(1.5)
