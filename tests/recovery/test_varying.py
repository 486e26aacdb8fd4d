"""A value that goes with what was logged beside a servo is found, and foresees runs that were not fitted."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from servofd.aircraft.series import Series
from servofd.discrepancy.explanation import Explanation, explain_gap
from servofd.discrepancy.varying import varying
from servofd.servo.library import servo_named
from servofd.servo.physics import Physics
from servofd.servo.servo_model import ServoModel

if TYPE_CHECKING:
    from servofd.core.types import FloatArray

KNOWN = ServoModel.of(servo_named("hs225bb-eq31"))
LOAD_G = np.array([0.0, 0.0, 100.0, 100.0, 200.0, 200.0, 300.0, 300.0, 50.0, 50.0, 250.0, 250.0])
AT_ZERO, SLOPE, NOISE_DEG = 120.0, -0.2, 0.05


BY_LOT = {f"lot {k}": np.random.default_rng(k).standard_normal(12) for k in range(4)}
GAP = {"gap": np.where(np.arange(12) == 3, np.nan, LOAD_G)}
CONDITIONS = {"load_g": LOAD_G, "arm_n": 0.0098 * LOAD_G, "trial": np.arange(12.0) % 2, "flat": np.ones(12)}
CONDITIONS |= BY_LOT | GAP


def explained(conditions: dict[str, FloatArray], slope: float = SLOPE) -> Explanation:
    """Steps of a servo whose rate limit [deg/s] falls with a load [g] that hangs from it."""
    rng, runs = np.random.default_rng(4), []
    time_s = np.arange(0.0, 4.0, 0.01)
    for load_g in LOAD_G:
        command_deg = np.repeat(rng.choice(np.array([-20.0, -8.0, 8.0, 20.0]), 8), 50)
        limit_deg_s = AT_ZERO + slope * load_g
        physics = Physics(delay_s=KNOWN.delay_s, rate_up_deg_s=limit_deg_s, rate_down_deg_s=limit_deg_s)
        moved_deg = KNOWN.with_physics(physics).simulate(time_s, command_deg, time_s)
        runs.append(Series("servo", time_s, command_deg, time_s, moved_deg + NOISE_DEG * rng.standard_normal(400)))
    return explain_gap(runs, KNOWN, on_bench=True, conditions=conditions)


@pytest.mark.slow
def test_a_rate_limit_that_falls_with_the_load_is_told_with_its_slope() -> None:
    selection = explained(CONDITIONS).selection
    assert selection.final.names[0] == "rate_limit"
    (first,) = varying(selection, CONDITIONS)
    assert (first.effect, first.parameter) == ("rate_limit", "rate_limit_deg_s")
    assert set(first.conditions) == {"load_g", "arm_n"}
    (_, empty), (_, loaded) = first.ends
    assert (empty, loaded) == pytest.approx((AT_ZERO, AT_ZERO + SLOPE * 300.0), rel=0.01)
    assert first.line_rms_deg < 0.1 * first.common_rms_deg
    assert first.line_rms_deg < 1.1 * NOISE_DEG
    assert first.line_rms_deg**2 == pytest.approx(selection.final.held_out)
    assert "rate_limit_deg_s falls with" in first.sentence
    assert first.document()["slope"] == first.slope


@pytest.mark.nightly
def test_what_does_not_go_with_the_value_is_not_told() -> None:
    """Numbers drawn by lot for each run, and one that is missing for a run, where nothing else was logged."""
    conditions = BY_LOT | GAP
    assert varying(explained(conditions).selection, conditions) == ()


@pytest.mark.nightly
def test_one_limit_for_all_runs_goes_with_nothing() -> None:
    found = explained({"load_g": LOAD_G}, 0.0)
    assert found.selection.final.names == ("rate_limit",)
    assert varying(found.selection, {"load_g": LOAD_G}) == ()
