"""What every simulated fault must obey: it comes and goes without a jump, and does what its name says in between."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servofd.core.errors import ConfigError
from servofd.servo.effects.linkage import PositionLimit, RateLimit
from servofd.servo.faults import (
    FAULTS,
    Bias,
    DeadBand,
    Failure,
    Floating,
    HardOver,
    LossOfEffectiveness,
    Oscillation,
    Slow,
    Stuck,
    failing_deflection,
    in_order,
)
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel
from servofd.simulation.commands import flight

if TYPE_CHECKING:
    from servofd.core.types import FloatArray

MODEL = ServoModel.of(servo_named("hs225bb-eq31"))
RATE_DEG_S = 370.0
STOPPED = MODEL + RateLimit(RATE_DEG_S) + PositionLimit(-20.0, 20.0)
TIME_S = np.round(np.arange(3000) / 100.0, 9)
START_S, END_S = 10.0, 20.0

kinds = st.sampled_from(sorted(FAULTS))
seeds = st.integers(0, 2**32 - 1)


def command(seed: int = 0) -> FloatArray:
    return flight(TIME_S, np.random.default_rng(seed))


@pytest.mark.slow
@given(kind=kinds, seed=seeds, start_s=st.floats(0.1, 25.0), samples=st.integers(50, 400))
@settings(max_examples=80, deadline=None)
def test_before_it_starts_nothing_has_failed(kind: str, seed: int, start_s: float, samples: int) -> None:
    rng = np.random.default_rng(seed)
    command_s, at_s = np.cumsum(rng.uniform(0.01, 0.1, samples)), np.sort(rng.uniform(0.0, 30.0, samples))
    command_deg = rng.uniform(-15.0, 15.0, samples)
    healthy = STOPPED.simulate(command_s, command_deg, at_s)
    failing = FAULTS[kind](start_s=start_s).deflection(STOPPED, command_s, command_deg, at_s)
    before = at_s < start_s
    np.testing.assert_array_equal(failing[before], healthy[before])
    assert np.all(np.abs(failing) <= 20.0)


@pytest.mark.slow
@given(kind=kinds, seed=seeds, start_s=st.floats(1.0, 15.0), lasts_s=st.floats(0.01, 10.0))
@settings(max_examples=80, deadline=None)
def test_no_fault_makes_a_surface_jump(kind: str, seed: int, start_s: float, lasts_s: float) -> None:
    end_s = start_s + lasts_s
    close_s = np.sort(np.append(TIME_S, [start_s, start_s + 1e-6, end_s, end_s + 1e-6]))
    fault = FAULTS[kind](start_s=start_s, end_s=end_s)
    deflection = fault.deflection(STOPPED, TIME_S, command(seed), close_s)
    # The wind blows faster than the servo turns: 4 deg at up to 1 Hz, and the way from where it was.
    fastest_deg_s = RATE_DEG_S + (2.0 * np.pi * (4.0 * 8.0 + 20.0) if kind in ("floating", "oscillation") else 0.0)
    assert np.max(np.abs(np.diff(deflection)) - fastest_deg_s * np.diff(close_s)) < 1e-6


@given(kind=kinds, seed=seeds)
@settings(max_examples=40, deadline=None)
def test_a_fault_that_has_passed_leaves_a_healthy_servo(kind: str, seed: int) -> None:
    healthy = STOPPED.simulate(TIME_S, command(seed), TIME_S)
    failing = FAULTS[kind](start_s=START_S, end_s=END_S).deflection(STOPPED, TIME_S, command(seed), TIME_S)
    # Thesis Eq. 3.1: the slowest pole forgets with 24.84 rad/s, 40 deg in 1 s to below 1e-9 deg.
    np.testing.assert_allclose(failing[TIME_S > END_S + 1.2], healthy[TIME_S > END_S + 1.2], rtol=0, atol=1e-8)
    assert np.max(np.abs(failing - healthy)) > 0.1


@pytest.mark.slow
@given(seed=seeds, first=kinds, second=kinds, start_s=st.floats(0.5, 8.0), lasts_s=st.floats(0.1, 8.0))
@settings(max_examples=60, deadline=None)
def test_the_second_fault_does_not_remember_the_first(
    seed: int, first: str, second: str, start_s: float, lasts_s: float
) -> None:
    end_s = start_s + lasts_s
    one, two = FAULTS[first](start_s=start_s, end_s=end_s), FAULTS[second](start_s=end_s + 1.3)
    both = failing_deflection(STOPPED, [two, one], TIME_S, command(seed), TIME_S)
    alone = [fault.deflection(STOPPED, TIME_S, command(seed), TIME_S) for fault in (one, two)]
    early, late = end_s >= TIME_S, end_s + 1.3 <= TIME_S
    np.testing.assert_array_equal(both[early], alone[0][early])
    np.testing.assert_allclose(both[late], alone[1][late], rtol=0, atol=1e-8)


def test_without_faults_it_is_the_simulation() -> None:
    plain = failing_deflection(STOPPED, (), TIME_S, command(), TIME_S)
    np.testing.assert_array_equal(plain, STOPPED.simulate(TIME_S, command(), TIME_S))


def test_a_dead_band_and_then_a_jam_on_one_surface() -> None:
    both = failing_deflection(MODEL, [Stuck(20.0), DeadBand(5.0, width_deg=4.0, end_s=15.0)], TIME_S, command(), TIME_S)
    band = DeadBand(5.0, width_deg=4.0).deflection(MODEL, TIME_S, command(), TIME_S)
    healthy = MODEL.simulate(TIME_S, command(), TIME_S)
    first, between, last = TIME_S < 15.0, (TIME_S > 16.2) & (TIME_S < 20.0), TIME_S >= 20.0
    np.testing.assert_array_equal(both[first], band[first])
    np.testing.assert_allclose(both[between], healthy[between], rtol=0, atol=1e-8)
    assert np.ptp(both[last]) == 0.0


def test_a_jam_holds_what_it_caught() -> None:
    at_s = np.sort(np.append(TIME_S, 12.3456))
    healthy = MODEL.simulate(TIME_S, command(), at_s)
    jammed = Stuck(12.3456).deflection(MODEL, TIME_S, command(), at_s)
    assert np.ptp(jammed[at_s >= 12.3456]) == 0.0
    assert jammed[-1] == pytest.approx(healthy[at_s == 12.3456][0], abs=1e-9)


def test_a_jam_at_a_given_position_gets_there_with_the_dynamics_of_the_servo() -> None:
    jammed = Stuck(START_S, position_deg=-6.0).deflection(MODEL, TIME_S, command(), TIME_S)
    np.testing.assert_allclose(jammed[TIME_S > START_S + 1.2], -6.0, rtol=0, atol=1e-8)


def test_a_bias_is_an_offset_once_the_servo_has_moved_to_it() -> None:
    healthy = MODEL.simulate(TIME_S, command(), TIME_S)
    biased = Bias(START_S, bias_deg=1.5).deflection(MODEL, TIME_S, command(), TIME_S)
    late = TIME_S > START_S + 1.2
    np.testing.assert_allclose((biased - healthy)[late], 1.5, rtol=0, atol=1e-8)


@given(gain=st.floats(0.0, 0.99))
@settings(max_examples=20, deadline=None)
def test_a_loss_of_effectiveness_scales_the_motion(gain: float) -> None:
    healthy = MODEL.simulate(TIME_S, command(), TIME_S)
    weak = LossOfEffectiveness(START_S, gain=gain).deflection(MODEL, TIME_S, command(), TIME_S)
    late = TIME_S > START_S + 1.2
    np.testing.assert_allclose(weak[late], gain * healthy[late], rtol=0, atol=1e-8)


@given(scale=st.floats(0.05, 1.0))
@settings(max_examples=30, deadline=None)
def test_a_slow_servo_is_a_healthy_one_in_stretched_time(scale: float) -> None:
    model = ServoModel(servo_named("hs225bb-eq31").transfer)
    since_s = np.linspace(0.0, 2.0, 400)
    command_s, command_deg = np.array([0.0, 1.0]), np.array([0.0, 5.0])
    slow = Slow(0.5, bandwidth_scale=scale).deflection(model, command_s, command_deg, 1.0 + since_s)
    healthy = model.simulate(command_s, command_deg, 1.0 + scale * since_s)
    np.testing.assert_allclose(slow, healthy, rtol=0, atol=1e-9)


@given(scale=st.floats(0.05, 1.0), rate_scale=st.floats(0.1, 1.0), start_s=st.floats(0.9, 1.2))
@settings(max_examples=40, deadline=None)
def test_a_slow_servo_that_was_at_its_limit_keeps_to_its_new_one(
    scale: float, rate_scale: float, start_s: float
) -> None:
    model = MODEL + RateLimit(100.0)
    at_s = np.linspace(0.0, 4.0, 4001)
    command_s, command_deg = np.array([0.0, 1.0]), np.array([0.0, 40.0])
    slow = Slow(start_s, scale, rate_scale, end_s=3.0).deflection(model, command_s, command_deg, at_s)
    during = (at_s[1:] > start_s + 1e-3) & (at_s[1:] <= 3.0)
    rates = np.diff(slow) / np.diff(at_s)
    assert np.max(np.abs(rates)) <= 100.0 * (1 + 1e-6)
    assert np.max(np.abs(rates[during])) <= 100.0 * rate_scale * (1 + 1e-6)


@pytest.mark.parametrize(("goal_deg", "rest_deg"), [(None, 20.0), (15.0, 15.0), (-90.0, -20.0)])
def test_a_hardover_runs_to_its_stop_at_the_rate_limit(goal_deg: float | None, rest_deg: float) -> None:
    healthy = STOPPED.simulate(TIME_S, command(), TIME_S)
    fine_s = START_S + np.arange(3000) / 1e4
    hard = HardOver(START_S, goal_deg).deflection(STOPPED, TIME_S, command(), fine_s)
    rates = np.abs(np.diff(hard) * 1e4)
    way_deg = abs(rest_deg - healthy[TIME_S == START_S][0])
    assert hard[-1] == rest_deg
    np.testing.assert_allclose(rates[fine_s[1:] < START_S + way_deg / RATE_DEG_S], RATE_DEG_S, rtol=1e-6)


@given(amplitude=st.floats(0.2, 5.0), tone_hz=st.floats(0.5, 8.0), replaces=st.booleans())
@settings(max_examples=30, deadline=None)
def test_an_oscillation_has_its_amplitude_and_frequency(amplitude: float, tone_hz: float, replaces: bool) -> None:
    healthy = MODEL.simulate(TIME_S, command(), TIME_S)
    swinging = Oscillation(START_S, amplitude, tone_hz, replaces=replaces).deflection(MODEL, TIME_S, command(), TIME_S)
    late = TIME_S >= START_S
    rest = swinging[late] - (healthy[TIME_S == START_S] if replaces else healthy[late])
    np.testing.assert_allclose(
        rest, amplitude * np.sin(2.0 * np.pi * tone_hz * (TIME_S[late] - START_S)), rtol=0, atol=1e-9
    )


@given(one=seeds, two=seeds, seed=st.integers(0, 100))
@settings(max_examples=20, deadline=None)
def test_a_floating_surface_does_not_know_its_command(one: int, two: int, seed: int) -> None:
    fault = Floating(START_S, bandwidth_hz=0.8, seed=seed)
    first, second = (fault.deflection(MODEL, TIME_S, command(s), TIME_S) for s in (one, two))
    since_s = TIME_S[TIME_S >= START_S] - START_S
    difference = (first - second)[TIME_S >= START_S]
    np.testing.assert_allclose(difference, difference[0] * np.exp(-2.0 * np.pi * 0.8 * since_s), rtol=0, atol=1e-9)


def test_a_floating_surface_moves_within_its_band() -> None:
    since_s = np.arange(20_000) / 20.0
    moved = Floating(0.0, amplitude_deg=3.0, bandwidth_hz=1.5, mean_deg=-2.0, seed=4).moved(
        MODEL.servo(), since_s, np.zeros(since_s.size)
    )
    power = np.abs(np.fft.rfft((moved + 2.0) * np.hanning(since_s.size))) ** 2
    frequency_hz = np.fft.rfftfreq(since_s.size, 1 / 20.0)
    assert power[frequency_hz > 1.51].sum() < 1e-3 * power.sum()
    assert moved.mean() == pytest.approx(-2.0, abs=0.05)
    assert moved.std() == pytest.approx(3.0 / math.sqrt(2.0), rel=0.03)


@pytest.mark.parametrize(
    ("kind", "parameters", "expected"),
    [
        (Bias, {"bias_deg": math.nan}, "bias_deg must be finite"),
        (Stuck, {"end_s": 9.0}, "end_s must be later than its start at 10 s"),
        (DeadBand, {"end_s": math.nan}, "end_s must be later"),
        (DeadBand, {"width_deg": 0.0}, "width_deg must be positive"),
        (Floating, {"seed": 1.5}, "whole number"),
        (Floating, {"bandwidth_hz": -1.0}, "bandwidth_hz must be positive"),
        (Oscillation, {"replaces": 2.0}, "replaces must be 0"),
        (Slow, {"bandwidth_scale": 1.5}, "at most 1"),
        (LossOfEffectiveness, {"gain": 1.0}, "below 1"),
    ],
)
def test_what_no_fault_can_be_is_refused(kind: type[Failure], parameters: dict[str, Any], expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        kind(START_S, **parameters)


def test_a_servo_with_a_lower_rate_limit_keeps_its_poles() -> None:
    assert (Slow(START_S).bandwidth_scale, Slow(START_S).rate_scale) == (0.5, 1.0)
    assert Slow(START_S, rate_scale=0.16).bandwidth_scale == 1.0
    assert Slow(START_S, 0.4, 0.16).bandwidth_scale == 0.4
    healthy = MODEL.servo()
    limited = Slow(START_S, rate_scale=0.16).become(healthy)
    assert (limited.transfer, limited.physics.scales) == (healthy.transfer, healthy.physics.scales)
    assert limited.rates_deg_s[0] == pytest.approx(0.16 * RATE_DEG_S)


def test_a_fault_may_be_older_than_the_first_command() -> None:
    model = MODEL.linear()
    later_s = 5.0 + TIME_S
    weak = LossOfEffectiveness(2.0, gain=0.5).deflection(model, later_s, 3.0 + command(), later_s)
    np.testing.assert_allclose(weak, 0.5 * model.simulate(later_s, 3.0 + command(), later_s), rtol=0, atol=1e-9)
    over = LossOfEffectiveness(2.0, gain=0.5, end_s=4.0).deflection(model, later_s, 3.0 + command(), later_s)
    np.testing.assert_allclose(over, model.simulate(later_s, 3.0 + command(), later_s), rtol=0, atol=1e-9)


def test_a_command_between_two_others_is_heard_anew_by_a_fault() -> None:
    """The one in force when it begins, between two commands, and when it ends."""
    command_s, command_deg = np.array([0.0, 10.0]), np.array([8.0, 4.0])
    weak = LossOfEffectiveness(2.0, gain=0.5, end_s=6.0)
    at_s = np.array([1.9, 5.9, 9.9, 11.9])
    np.testing.assert_allclose(weak.deflection(MODEL, command_s, command_deg, at_s), [8.0, 4.0, 8.0, 4.0], atol=1e-6)


def test_a_hardover_without_limits_runs_as_the_hs_225bb_does() -> None:
    """To the full travel of 25 deg at 400 deg/s, between the two speeds of thesis Appendix A; not from rest at it."""
    fine_s = 1.0 + np.array([0.0, 0.01, 0.05, 0.1])
    moved_deg = HardOver(1.0).deflection(MODEL.linear(), np.zeros(1), np.full(1, 2.0), fine_s)
    np.testing.assert_allclose(moved_deg, [2.0, 6.0, 22.0, 25.0], atol=1e-9)
    down_deg = HardOver(1.0, -9.0).deflection(MODEL + RateLimit(100.0, 50.0), np.zeros(1), np.full(1, 2.0), fine_s)
    np.testing.assert_allclose(down_deg, [2.0, 1.5, -0.5, -3.0], atol=1e-9)


def test_the_smallest_and_largest_sizes_are_faults_too() -> None:
    assert LossOfEffectiveness(0.0, gain=0.0).received(np.zeros(1), np.array([4.0]), 0.0) == 0.0
    assert (Slow(0.0, 1.0, 1.0).bandwidth_scale, Floating(0.0, seed=0).seed) == (1.0, 0)
    with pytest.raises(ConfigError, match="whole number of zero or more"):
        Floating(0.0, seed=-1)
    with pytest.raises(ConfigError, match="at least 0"):
        LossOfEffectiveness(0.0, gain=-0.1)
    one, two = in_order([Stuck(12.0), Slow(10.0, end_s=12.0)])
    assert (one.kind, two.kind) == ("slow", "stuck")


def test_one_fault_at_a_time() -> None:
    with pytest.raises(ConfigError, match=r"stuck at 12 s begins before slow at 10 s has ended"):
        failing_deflection(MODEL, [Stuck(12.0), Slow(10.0)], TIME_S, command(), TIME_S)
