"""What every servo model must obey, whatever its numbers and whatever the samples."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from servofd.core.errors import DesignError
from servofd.servo.effects.commands import Delay
from servofd.servo.effects.linkage import PositionLimit, RateLimit
from servofd.servo.library import library, servo_named
from servofd.servo.loops import play
from servofd.servo.servo_model import ServoModel
from servofd.servo.transfer import TransferFunction
from tests.laws.reference_twin import limited_deflection, linear_deflection

if TYPE_CHECKING:
    from servofd.core.types import FloatArray

NANODEGREE = 1e-9


def transfer_of(poles: list[float]) -> TransferFunction:
    denominator = np.poly(-np.array(poles))
    return TransferFunction((denominator[-1],), tuple(denominator))


def are_a_servo(poles: list[float]) -> bool:
    """Four poles that nearly coincide are refused, which test_transfer proves."""
    try:
        transfer_of(poles).modes()
    except DesignError:
        return False
    return True


poles = st.lists(st.floats(5.0, 150.0), min_size=1, max_size=4).filter(are_a_servo)
seeds = st.integers(0, 2**32 - 1)


def irregular(rng: np.random.Generator, samples: int, period_s: float = 0.01) -> FloatArray:
    return np.cumsum(period_s * rng.uniform(0.4, 1.6, samples))


@pytest.mark.parametrize("name", library())
def test_linear_motion_equals_the_reference_twin_on_irregular_samples(name: str) -> None:
    rng = np.random.default_rng(1)
    command_s, at_s = irregular(rng, 150), irregular(rng, 200)
    at_s = at_s + command_s[0]
    command_deg = rng.uniform(-10.0, 10.0, 150)
    model = ServoModel.of(servo_named(name)).linear()
    twin = linear_deflection(model.transfer, model.delay_s, command_s, command_deg, at_s)
    assert np.max(np.abs(model.simulate(command_s, command_deg, at_s) - twin)) < NANODEGREE


@pytest.mark.parametrize("delay_s", [0.0, 0.0004, 0.004, 0.01, 0.015, 0.0371])
def test_any_delay_equals_the_reference_twin(delay_s: float) -> None:
    rng = np.random.default_rng(2)
    time_s = np.arange(200) / 100.0
    command_deg = rng.uniform(-10.0, 10.0, 200)
    model = ServoModel(servo_named("hs225bb-eq31").transfer) + Delay(delay_s)
    twin = linear_deflection(model.transfer, delay_s, time_s, command_deg, time_s)
    assert np.max(np.abs(model.simulate(time_s, command_deg, time_s) - twin)) < NANODEGREE


@pytest.mark.parametrize("multiplicity", [1, 2, 3, 4])
def test_repeated_poles_equal_the_reference_twin(multiplicity: int) -> None:
    rng = np.random.default_rng(3)
    denominator = np.poly(np.full(multiplicity, -40.0))
    transfer = TransferFunction((denominator[-1],), tuple(denominator))
    time_s = np.arange(200) / 100.0
    command_deg = rng.uniform(-10.0, 10.0, 200)
    simulated = ServoModel(transfer).simulate(time_s, command_deg, time_s)
    twin = linear_deflection(transfer, 0.0, time_s, command_deg, time_s)
    # Poles moved apart by the optimal radius: see TransferFunction.modes.
    assert np.max(np.abs(simulated - twin)) < 1e-7


@pytest.mark.slow
@given(poles=poles, seed=seeds)
@settings(max_examples=60, deadline=None)
@example(poles=[40.0], seed=69323)  # a limit that lasts 2 ms after a command
def test_looking_more_often_changes_nothing(poles: list[float], seed: int) -> None:
    """The position at an instant does not depend on when else it was measured, rate limit or not.

    A limit is as exact as a cubic between steps.
    """
    rng = np.random.default_rng(seed)
    model = ServoModel(transfer_of(poles)) + Delay(rng.uniform(0.0, 0.03)) + RateLimit(rng.uniform(50.0, 500.0))
    command_s = irregular(rng, 60)
    command_deg = rng.uniform(-20.0, 20.0, 60)
    often_s = np.sort(rng.uniform(command_s[0], command_s[-1], 300))
    seldom = np.flatnonzero(rng.random(300) < 0.2)
    often = model.simulate(command_s, command_deg, np.append(command_s[0], often_s))[1:]
    few = model.simulate(command_s, command_deg, np.append(command_s[0], often_s[seldom]))[1:]
    assert np.max(np.abs(few - often[seldom]), initial=0.0) < 0.1
    model = model.linear()
    often = model.simulate(command_s, command_deg, np.append(command_s[0], often_s))[1:]
    few = model.simulate(command_s, command_deg, np.append(command_s[0], often_s[seldom]))[1:]
    assert np.max(np.abs(few - often[seldom]), initial=0.0) < NANODEGREE


@pytest.mark.slow
@given(rate_deg_s=st.floats(20.0, 600.0), seed=seeds)
@settings(max_examples=60, deadline=None)
def test_no_servo_is_faster_than_its_rate_limit(rate_deg_s: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    time_s = irregular(rng, 400, 0.005)
    command_deg = np.repeat(rng.uniform(-40.0, 40.0, 20), 20)
    model = ServoModel.of(servo_named("s9254")) + RateLimit(rate_deg_s)
    deflection = model.simulate(time_s, command_deg, time_s)
    assert np.max(np.abs(np.diff(deflection) / np.diff(time_s))) <= rate_deg_s * (1 + 1e-9)


@pytest.mark.parametrize(("up", "down"), [(370.0, 370.0), (255.0, 100.0)])
def test_rate_limit_equals_the_reference_twin(up: float, down: float) -> None:
    transfer = servo_named("hs225bb-eq31").transfer
    model = ServoModel(transfer) + RateLimit(up, down)
    command_s, command_deg = np.array([0.0, 0.3, 0.6, 0.65]), np.array([0.0, 50.0, -30.0, 20.0])
    fine_s = np.arange(20_000) / 20_000.0
    linear = ServoModel(transfer).simulate(command_s, command_deg, fine_s)
    twin = limited_deflection(linear, 5e-5, up) if up == down else None
    deflection = model.simulate(command_s, command_deg, fine_s[::200])
    rates = np.diff(deflection) / np.diff(fine_s[::200])
    assert rates.max() == pytest.approx(up, rel=1e-6)
    assert rates.min() == pytest.approx(-down, rel=1e-6)
    if twin is not None:
        assert np.max(np.abs(deflection - twin[::200])) < 2e-3


def test_the_rate_limit_reproduces_the_published_peaks() -> None:
    """Peak residual of a linear filter on a rate-limited healthy servo, steps of 20 to 60 deg (370 deg/s)."""
    from servofd.aircraft.series import Series
    from servofd.detection.residual import ResidualGenerator

    servo = servo_named("hs225bb-eq31")
    linear = ServoModel(servo.printed) + Delay(servo.transport_delay_s)
    time_s = np.arange(300) / 100.0
    peaks = []
    for size_deg in (20.0, 25.0, 30.0, 40.0, 60.0):
        command_deg = np.where(time_s >= 0.5, size_deg, 0.0)
        limited = (linear + RateLimit(370.0)).simulate(time_s, command_deg, time_s)
        segment = Series("x", time_s, command_deg, time_s, limited)
        peaks.append(np.max(np.abs(ResidualGenerator(linear, 50.0).run(segment).residual_deg)))
    assert peaks == pytest.approx([0.0, 0.44, 1.94, 6.72, 20.1], abs=0.05)


@given(delay_s=st.floats(0.0, 0.05), seed=seeds)
@settings(max_examples=40, deadline=None)
def test_a_delay_is_a_command_that_comes_later(delay_s: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    time_s, command_deg = irregular(rng, 100), rng.uniform(-10.0, 10.0, 100)
    model = ServoModel(servo_named("s9256").transfer)
    late_deg = (model + Delay(delay_s)).simulate(time_s, command_deg, time_s)
    at_s = time_s[time_s >= time_s[0] + delay_s]
    expected_deg = model.simulate(time_s + delay_s, command_deg, at_s)
    assert np.max(np.abs(late_deg[time_s >= time_s[0] + delay_s] - expected_deg)) < NANODEGREE


@given(shift_s=st.floats(0.0, 1000.0), seed=seeds)
@settings(max_examples=40, deadline=None)
def test_time_has_no_origin(shift_s: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    time_s, command_deg = irregular(rng, 100), rng.uniform(-10.0, 10.0, 100)
    model = ServoModel.of(servo_named("hs225bb-eq31"))
    here = model.simulate(time_s, command_deg, time_s)
    there = model.simulate(time_s + shift_s, command_deg, time_s + shift_s)
    assert np.max(np.abs(here - there)) < 1e-7


@given(lower=st.floats(-20.0, -1.0), upper=st.floats(1.0, 20.0), seed=seeds)
@settings(max_examples=30, deadline=None)
def test_stops_hold(lower: float, upper: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    time_s, command_deg = irregular(rng, 100), rng.uniform(-40.0, 40.0, 100)
    model = ServoModel.of(servo_named("hs225bb-eq31"))
    free = model.simulate(time_s, command_deg, time_s)
    stopped = (model + PositionLimit(lower, upper)).simulate(time_s, command_deg, time_s)
    assert np.array_equal(stopped, np.clip(free, lower, upper))


@given(seed=seeds, width=st.floats(0.1, 5.0))
def test_play_stays_within_its_zone_and_moves_only_at_its_edge(seed: int, width: float) -> None:
    rng = np.random.default_rng(seed)
    values = np.cumsum(rng.normal(size=200))
    held = play(values, width, 0.0)
    assert np.all(np.abs(values - held) <= width / 2 * (1 + 1e-12))
    moved = np.abs(np.diff(held)) > 0.0
    assert np.allclose(np.abs(values - held)[1:][moved], width / 2)


def test_the_order_in_which_effects_are_put_on_a_servo_does_not_matter_and_the_last_of_a_kind_holds() -> None:
    transfer = servo_named("s9254").transfer
    one = ServoModel(transfer) + PositionLimit(-5.0, 5.0) + RateLimit(100.0) + Delay(0.01)
    two = ServoModel(transfer) + Delay(0.01) + RateLimit(300.0) + RateLimit(100.0) + PositionLimit(-5.0, 5.0)
    assert one == two
    assert (one.delay_s, one.physics.follow_up_deg_s, one.servo().stops_deg[1]) == (0.01, 100.0, 5.0)
