"""Logs too slow to show motion: play is told from where the surface rests, and from nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from servofd.aircraft.series import Series
from servofd.core.errors import NoMeasurement
from servofd.core.types import FloatArray
from servofd.discrepancy.explanation import explain_gap
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel

MODEL = ServoModel.of(servo_named("hs225bb-eq31"))
TIME_S = np.arange(0.0, 120.0, 0.1)
HELD_DEG = 10.0 * (TIME_S // 12.0 % 3.0 - 1.0)


def slow(pulled_deg: FloatArray, command_deg: FloatArray = HELD_DEG, step_deg: float = 0.088, seed: int = 0) -> Series:
    """A servo sampled at 10 Hz by a converter, while something pulls its surface away."""
    moved = MODEL.simulate(TIME_S, command_deg, TIME_S) + pulled_deg
    moved += 0.02 * np.random.default_rng(seed).standard_normal(TIME_S.size)
    return Series("rudder", TIME_S, command_deg, TIME_S, step_deg * np.round(moved / step_deg))


@pytest.mark.slow
@pytest.mark.parametrize("width_deg", [0.5, 1.5])
def test_pulled_from_either_side(width_deg: float) -> None:
    found = explain_gap(slow(0.5 * width_deg * np.sign(np.sin(TIME_S))), MODEL)
    assert found.selection.final.names == ("backlash",)
    assert found.selection.final.values[0] == pytest.approx(width_deg, abs=0.05)
    assert found.selection.ties == (("backlash", "deadband", "friction"),)
    assert found.conclusion == "partly_explained"  # how it moves was not judged
    assert "only rests are judged" in found.notes[0]
    assert "hysteresis" in found.notes[0]


WANDER_DEG = 0.3 * np.sin(0.31 * TIME_S)
"""As a supply or a temperature would have it: anywhere between two ends, not at them."""


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    "pulled_deg",
    [np.zeros(TIME_S.size), WANDER_DEG, 0.05 * np.sign(np.sin(TIME_S)), 0.4 * (TIME_S > 60.0)],
    ids=["tight", "wandering", "less than the converter shows", "moved once"],
)
def test_no_play_is_invented(pulled_deg: FloatArray, seed: int) -> None:
    with pytest.raises(NoMeasurement, match=r"none is seen .* log faster"):
        explain_gap(slow(pulled_deg, seed=seed), MODEL)


def test_what_never_rests_cannot_be_judged() -> None:
    command = 10.0 * np.sin(TIME_S)
    with pytest.raises(NoMeasurement, match="position comes at 10 Hz") as refused:
        explain_gap(slow(0.25 * np.sign(np.sin(5.0 * TIME_S)), command), MODEL)
    assert "rested" not in str(refused.value)
