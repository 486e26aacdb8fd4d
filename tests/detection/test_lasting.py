"""Servos that are slower for the rest of a flight, in motion that no window of seconds tells from a sound one's."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import servofd
from servofd.core.types import FloatArray
from servofd.servo.effects.commands import Delay
from servofd.servo.effects.shaft import Friction
from servofd.servo.library import second_order
from servofd.servo.servo_model import ServoModel

TIME_S: FloatArray = np.arange(0.0, 120.0, 0.02)
SINCE_S = 70.0


def servo(speed: float) -> ServoModel:
    """One with friction that its model has to learn, and a share of its speed."""
    return ServoModel(second_order(2.0 * np.pi * 6.0 * speed, 0.8)) + Delay(0.02) + Friction(0.1)


def calm(speeds: tuple[float, ...]) -> pd.DataFrame:
    """Surfaces in calm air, each with a share of its speed from 70 s on."""
    columns: dict[str, FloatArray] = {"time_s": TIME_S}
    for k, speed in enumerate(speeds):
        rng = np.random.default_rng(k)
        command_deg = np.zeros(TIME_S.size)
        for hz in (0.11, 0.23, 0.41, 0.83):
            command_deg += rng.uniform(1.0, 2.0) * np.sin(2.0 * np.pi * hz * TIME_S + rng.uniform(0.0, 6.0))
        sound_deg, slow_deg = (servo(share).simulate(TIME_S, command_deg, TIME_S) for share in (1.0, speed))
        moved_deg = np.where(TIME_S < SINCE_S, sound_deg, slow_deg)
        noise_deg = rng.normal(0.0, 0.1, TIME_S.size)
        columns |= {f"servo{k}_cmd_deg": command_deg, f"servo{k}_pos_deg": np.round(moved_deg + noise_deg, 1)}
    return pd.DataFrame(columns)


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.5, 1.0])
def test_servos_of_one_supply_tell_together_that_they_are_slower(speed: float) -> None:
    (result,) = servofd.audit(calm((speed, speed, speed)))
    faults = [fault for surface in result.surfaces for fault in surface.faults]
    if speed == 1.0:
        assert faults == []
        assert result.common_causes == ()
        return
    assert [fault.kind for fault in faults] == ["slow"] * 3
    assert [fault.start_s for fault in faults] == pytest.approx([SINCE_S] * 3, abs=2.0)
    assert [fault.parameters["bandwidth_scale"].value for fault in faults] == pytest.approx([speed] * 3, abs=0.15)
    (cause,) = result.common_causes
    assert (cause.kind, cause.surfaces) == ("supply", ("servo0", "servo1", "servo2"))


@pytest.mark.slow
def test_one_that_is_slower_accuses_no_other() -> None:
    (result,) = servofd.audit(calm((1.0, 0.4, 1.0)))
    assert [surface.status for surface in result.surfaces] == ["healthy", "fault", "healthy"]
    (fault,) = result.surfaces[1].faults
    assert fault.start_s == pytest.approx(SINCE_S, abs=2.0)
