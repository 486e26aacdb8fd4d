"""Terms too small to change a verdict, against what they are worth by definition."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from servofd.aircraft.pace import WARM_UP_STEPS
from servofd.detection.monitor import SurfaceMonitor
from servofd.detection.probability import Noise
from servofd.detection.pulse import design_pulse_filter
from servofd.detection.seen import odds
from servofd.detection.wiring import wiring_problem
from servofd.servo.library import servo_named
from servofd.servo.transfer import TransferFunction
from tests.detection.test_monitor import surface
from tests.detection.tolerated import MODEL
from tests.detection.windows import residuals_of


@pytest.mark.parametrize("times", [0.25, 8.0])
def test_coefficients_that_all_are_so_many_times_larger_are_the_same_servo(times: float) -> None:
    servo = servo_named("hs225bb-eq31").transfer
    numerator, denominator = (tuple(times * c for c in part) for part in (servo.numerator, servo.denominator))
    design = design_pulse_filter(TransferFunction(numerator, denominator), 0.004, 0.01, 50.0)
    assert design.leakage(np.linspace(0.1, 314.0, 50)) < 1e-11


@pytest.mark.parametrize(("seconds", "told"), [(9.5, False), (10.5, True)])
def test_odds_of_one_log_need_ten_seconds(seconds: float, told: bool) -> None:
    time_s = np.arange(0.0, seconds, 0.05)
    residual_deg = 0.1 * np.random.default_rng(0).standard_normal(time_s.size)
    residuals: Any = SimpleNamespace(settled=np.ones(time_s.size, bool), time_s=time_s, residual_deg=residual_deg)
    assert (odds(residuals, np.inf, 0.05, 1.5) is not None) == told


def test_a_gain_that_changes_in_flight_is_no_wrong_scale() -> None:
    """Wired wrongly, a position is off by the same factor throughout; a fault comes in flight."""
    time_s = np.arange(6000) / 100.0
    command_deg = 8.0 * np.sin(2.0 * time_s)
    moved_deg = MODEL.simulate(time_s, command_deg, time_s)
    assert "2.00x" in wiring_problem(residuals_of(time_s, command_deg, 2.0 * moved_deg))
    for last, wrong in ((1.8, True), (1.6, False)):
        changed_deg = np.where(time_s < 40.0, 2.0, last) * moved_deg
        assert ("scale" in wiring_problem(residuals_of(time_s, command_deg, changed_deg))) == wrong


@pytest.mark.parametrize("colour", [-0.5, 0.6, 0.95])
def test_the_odds_of_a_log_are_those_of_its_colour_offset_and_healthy_part(colour: float) -> None:
    rng = np.random.default_rng(3)
    values = np.zeros(20_000)
    for k, shock in enumerate(rng.standard_normal(values.size - 1)):
        values[k + 1] = colour * values[k] + shock
    time_s = np.arange(values.size) / 50.0
    healthy_deg = -0.4 + 0.2 * values
    settled = time_s > 1.0
    residual_deg = np.where(settled & (time_s < 300.0), healthy_deg, 50.0)  # else, what must not count
    residuals: Any = SimpleNamespace(settled=settled, time_s=time_s, residual_deg=residual_deg)
    counted = healthy_deg[settled & (time_s < 300.0)]
    alike = float(np.corrcoef(counted[:-1], counted[1:])[0, 1])
    expected = Noise(float(np.std(counted)), alike, 0.02, float(counted.mean())).false_alarms_per_hour(1.5)
    found = odds(residuals, 300.0, 0.02, 1.5)
    assert found == pytest.approx(expected, rel=5e-3)
    assert alike == pytest.approx(colour, abs=0.02)
    assert found != pytest.approx(Noise(float(np.std(counted)), alike, 0.02).false_alarms_per_hour(1.5), rel=0.5)


@pytest.mark.slow
def test_what_comes_too_slowly_for_long_fills_no_memory_and_delays_nothing() -> None:
    """Five minutes at 5 Hz, then 50 Hz: it is watched once the slow ones are no longer most of what a pace needs."""
    monitor, now_s, told = SurfaceMonitor("x", *surface(servo="hs225bb-eq31")), 0.0, []
    for _ in range(1500):
        now_s += 0.2
        at = np.array([now_s])
        told += monitor.feed((at, np.sin(at)), (at, 0.9 * np.sin(at)))
        assert max(map(len, monitor._waiting)) <= 1.5 * WARM_UP_STEPS
    assert [event.event for event in told] == ["no_data"]
    quick = 0
    while not monitor.is_watched:
        quick += 1
        now_s += 0.02
        at = np.array([now_s])
        monitor.feed((at, np.sin(at)), (at, 0.9 * np.sin(at)))
        assert quick <= 2.5 * WARM_UP_STEPS
