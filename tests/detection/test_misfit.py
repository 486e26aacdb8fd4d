"""A servo that was fitted to its log may be off: slower, or of another scale, than the one that flew."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import servofd
from servofd.core.types import FloatArray
from servofd.detection.verdict import SurfaceAudit
from servofd.servo.effects.commands import Delay
from servofd.servo.effects.linkage import RateLimit
from servofd.servo.library import second_order
from servofd.servo.servo_model import ServoModel

TIME_S = np.arange(0.0, 60.0, 0.05)
SEEDS = (0, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in (1, 2, 3)))


def servo(rate_deg_s: float) -> ServoModel:
    return ServoModel(second_order(2.0 * np.pi * 6.0, 0.8)) + Delay(0.08) + RateLimit(rate_deg_s)


def steps(size_deg: float, seed: int) -> FloatArray:
    """A command that jumps every 3 to 6 s, and rests between."""
    rng = np.random.default_rng(seed)
    jumps_s = np.cumsum(rng.uniform(3.0, 6.0, 20))
    return rng.uniform(-size_deg, size_deg, 21)[np.searchsorted(jumps_s, TIME_S)]


def verdict_of(command_deg: FloatArray, measured_deg: FloatArray) -> SurfaceAudit:
    table = pd.DataFrame({"time_s": TIME_S, "x_cmd_deg": command_deg, "x_pos_deg": measured_deg})
    found: SurfaceAudit = servofd.audit(table).surfaces[0]
    return found


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_what_moves_by_a_little_more_than_it_is_asked_is_at_no_fault(seed: int) -> None:
    command_deg = steps(80.0, seed)
    assert verdict_of(command_deg, 1.04 * servo(300.0).simulate(TIME_S, command_deg, TIME_S)).status != "fault"


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_a_jam_is_found_where_nobody_named_the_servo(seed: int) -> None:
    command_deg = steps(30.0, seed)
    moved_deg = servo(400.0).simulate(TIME_S, command_deg, TIME_S)
    verdict = verdict_of(command_deg, np.where(TIME_S < 25.0, moved_deg, moved_deg[500]))
    assert verdict.faults[0].kind in ("stuck", "hardover")
    assert 19.0 < verdict.faults[0].start_s < 31.0  # it rested before, and was then asked to move


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
    known = result.aircraft.surfaces["x"].calibrated
    assert known is not None
    assert known.parameters["gain"] == pytest.approx(scale, rel=0.02)
    assert result.aircraft.model("x").physics.follow_up_deg_s == pytest.approx(200.0, rel=0.12)
    assert verdict.status != "fault"
