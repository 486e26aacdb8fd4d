"""Steps of one size: a slow servo and one whose speed is limited are told as a tie, with the test that tells."""

from __future__ import annotations

import numpy as np
import pytest

from servofd.aircraft.series import Series
from servofd.core.types import FloatArray
from servofd.discrepancy.explanation import Explanation, explain_gap
from servofd.discrepancy.known import NOTHING
from servofd.jobs.explaining import UNKNOWN_SERVO
from servofd.servo.servo_model import ServoModel

_STEP_S, _NATURAL_RAD_S, _DAMPING = 1e-3, 40.0, 0.8
_TIME_S = np.arange(0.0, 30.0, 0.02)
_ONE: FloatArray = np.array(10.0 * (_TIME_S % 2.0 < 1.0), dtype=np.float64)
_TWO: FloatArray = np.array(_ONE * (1.0 + (_TIME_S % 4.0 < 2.0)), dtype=np.float64)


def moved(command_deg: FloatArray, fastest_deg_s: float) -> FloatArray:
    """A loop of second order whose shaft has a largest speed, in steps of 1 ms; it shares no code with servofd."""
    position, speed, result = 0.0, 0.0, []
    for asked in command_deg:
        result.append(position)
        for _ in range(round(0.02 / _STEP_S)):
            pull = _NATURAL_RAD_S**2 * (asked - position) - 2.0 * _DAMPING * _NATURAL_RAD_S * speed
            speed = min(max(speed + _STEP_S * pull, -fastest_deg_s), fastest_deg_s)
            position += _STEP_S * speed
    return np.array(result)


def explained(command_deg: FloatArray, fastest_deg_s: float) -> Explanation:
    noise_deg = 0.1 * np.random.default_rng(0).standard_normal(_TIME_S.size)
    measured_deg = moved(command_deg, fastest_deg_s) + noise_deg
    segment = Series("elevator", _TIME_S, command_deg, _TIME_S, measured_deg)
    return explain_gap(segment, ServoModel.of(UNKNOWN_SERVO), known=NOTHING)


@pytest.mark.nightly
def test_a_limit_in_steps_of_one_size_may_be_slow_poles() -> None:
    found = explained(_ONE, 60.0)
    assert found.selection.ties == (("rate_limit", "slow_dynamics"),)
    assert "steps of two sizes" in found.separating[0].sentence
    assert "the data cannot tell which" in found.answer
    assert any("all steps are of one size" in note for note in found.notes)


@pytest.mark.nightly
def test_steps_of_two_sizes_tell() -> None:
    found = explained(_TWO, 60.0)
    assert found.selection.final.names[0] == "rate_limit"
    assert found.selection.final.values[0] == pytest.approx(60.0, rel=0.02)
    assert not any("slow_dynamics" in tie for tie in found.selection.ties)


@pytest.mark.nightly
def test_a_linear_servo_lacks_nothing() -> None:
    """What a linear servo explains to the noise has no effect, though one would take away a little more."""
    found = explained(_ONE, np.inf)
    assert found.conclusion == "nothing_missing"
    assert any("all steps are of one size" in note for note in found.notes)
