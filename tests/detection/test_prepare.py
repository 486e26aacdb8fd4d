"""What is done to a segment before it is judged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servofd.aircraft.series import Series
from servofd.detection.named import with_hold
from servofd.detection.residual import ResidualGenerator, Residuals
from tests.detection.tolerated import MODEL

TIME_S = np.arange(1000) / 50.0
COMMAND_DEG = 12.0 * np.sin(2.0 * np.pi * 0.7 * TIME_S)
GENERATOR = ResidualGenerator(MODEL, 50.0)


def thinly(period_s: float | None, *, kept: int = 5) -> Series:
    """Commands given at 50 Hz, of which every fifth is logged."""
    rng = np.random.default_rng(0)
    measured_deg = MODEL.simulate(TIME_S, COMMAND_DEG, TIME_S) + 0.05 * rng.standard_normal(TIME_S.size)
    return Series("x", TIME_S[::kept], COMMAND_DEG[::kept], TIME_S, measured_deg, command_period_s=period_s)


def largest_deg(residuals: Residuals) -> float:
    """Of the residual where it is judged [deg]."""
    return float(np.max(np.abs(residuals.residual_deg[residuals.settled])))


def test_commands_that_are_logged_thinly_are_joined_by_lines_and_it_is_said() -> None:
    segment, (note,) = with_hold(MODEL, thinly(None))
    assert "logged more thinly" in note
    assert largest_deg(GENERATOR.run(segment)) < 0.4 * largest_deg(GENERATOR.run(thinly(None)))


@pytest.mark.parametrize("segment", [thinly(0.02), thinly(None, kept=1)], ids=["known", "all there"])
def test_commands_whose_pace_is_known_or_fast_are_left_as_they_are(segment: Series) -> None:
    done, notes = with_hold(MODEL, segment)
    assert notes == ()
    assert done.command_period_s == segment.command_period_s


def test_a_servo_that_holds_thin_commands_is_not_taken_for_one_with_lost_ones() -> None:
    segment = thinly(None)
    held_deg = MODEL.simulate(segment.command_s, segment.command_deg, TIME_S)
    done, notes = with_hold(MODEL, replace(segment, measured_deg=held_deg))
    assert notes == ()
    assert done.command_period_s is None
