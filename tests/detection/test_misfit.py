"""A servo that was fitted to its log may be off: slower, or of another scale, than the one that flew."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import servofd
from servofd.aircraft.series import Series
from servofd.core.types import FloatArray
from servofd.detection.contradiction import contradictions
from servofd.detection.residual import ResidualGenerator
from servofd.servo.effects.commands import Delay
from servofd.servo.effects.linkage import RateLimit
from servofd.servo.library import second_order
from servofd.servo.servo_model import ServoModel

TIME_S = np.arange(0.0, 60.0, 0.05)


def servo(rate_deg_s: float) -> ServoModel:
    return ServoModel(second_order(2.0 * np.pi * 6.0, 0.8)) + Delay(0.08) + RateLimit(rate_deg_s)


def steps(size_deg: float, seed: int) -> FloatArray:
    """A command that jumps every 3 to 6 s, and rests between."""
    rng = np.random.default_rng(seed)
    jumps_s = np.cumsum(rng.uniform(3.0, 6.0, 20))
    return rng.uniform(-size_deg, size_deg, 21)[np.searchsorted(jumps_s, TIME_S)]


def found(command_deg: FloatArray, measured_deg: FloatArray, rate_deg_s: float) -> list[str]:
    generator = ResidualGenerator(servo(rate_deg_s), 12.0)
    residuals = generator.run(Series("x", TIME_S, command_deg, TIME_S, measured_deg))
    return [fault.kind for fault in contradictions(generator, residuals)]


@pytest.mark.parametrize("seed", range(6))
def test_a_servo_faster_than_its_model_is_neither_stuck_nor_does_it_oscillate(seed: int) -> None:
    """It rests where it is asked to be while its model is on the way there."""
    command_deg = steps(60.0, seed)
    noise_deg = np.random.default_rng(100 + seed).normal(0.0, 0.1, TIME_S.size)
    measured_deg = servo(400.0).simulate(TIME_S, command_deg, TIME_S) + noise_deg
    assert found(command_deg, measured_deg, 200.0) == []


@pytest.mark.parametrize("seed", range(4))
def test_a_scale_that_is_off_far_out_is_no_jam(seed: int) -> None:
    command_deg = steps(80.0, seed)
    measured_deg = 1.04 * servo(300.0).simulate(TIME_S, command_deg, TIME_S)
    assert found(command_deg, measured_deg, 300.0) == []


@pytest.mark.parametrize("seed", range(4))
def test_a_jam_is_one_all_the_same(seed: int) -> None:
    command_deg = steps(30.0, seed)
    moved_deg = servo(400.0).simulate(TIME_S, command_deg, TIME_S)
    measured_deg = np.where(TIME_S < 25.0, moved_deg, moved_deg[500])
    assert found(command_deg, measured_deg, 100.0)[:1] in (["stuck"], ["hardover"])


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.6, 1.4])
def test_the_rate_limit_of_a_fitted_servo_is_that_of_the_surface(scale: float) -> None:
    """Whatever degrees a command is in."""
    rng = np.random.default_rng(7)
    command_deg = np.repeat(rng.uniform(-25.0, 25.0, 120), 10)
    measured_deg = servo(200.0).simulate(TIME_S, command_deg, TIME_S) + rng.normal(0.0, 0.05, TIME_S.size)
    columns = {"x_cmd_deg": command_deg / scale, "x_pos_deg": measured_deg}
    result = servofd.audit(pd.DataFrame({"time_s": TIME_S, **columns}))[0]
    verdict = result.surfaces[0]
    assert verdict.model.origin == "fitted"
    assert result.aircraft.model("x").physics.follow_up_deg_s == pytest.approx(200.0, rel=0.05)
    assert verdict.status != "fault"
