"""Servos that are slower for the rest of a flight, in motion that no window of seconds tells from a sound one's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import servofd
from servofd.core.types import FloatArray
from servofd.detection.audit import audit_log
from servofd.detection.lasting import NOTHING_LASTS, Lasting, slow_together
from servofd.feedback.flown import flown_aircraft, one_log
from servofd.servo.effects.commands import Delay
from servofd.servo.effects.shaft import Friction
from servofd.servo.library import second_order
from servofd.servo.servo_model import ServoModel

TIME_S: FloatArray = np.arange(0.0, 120.0, 0.02)
SINCE_S = 70.0


def servo(speed: float) -> ServoModel:
    """One with friction that its model has to learn, and a share of its speed."""
    return ServoModel(second_order(2.0 * np.pi * 6.0 * speed, 0.8)) + Delay(0.02) + Friction(0.1)


def calm(speeds: tuple[float, ...], time_s: FloatArray = TIME_S, since_s: float = SINCE_S) -> pd.DataFrame:
    """Surfaces in calm air, each with a share of its speed from some moment on, if not said after 70 s."""
    columns: dict[str, FloatArray] = {"time_s": time_s}
    for k, speed in enumerate(speeds):
        rng = np.random.default_rng(k)
        command_deg = np.zeros(time_s.size)
        for hz in (0.11, 0.23, 0.41, 0.83):
            command_deg += rng.uniform(1.0, 2.0) * np.sin(2.0 * np.pi * hz * time_s + rng.uniform(0.0, 6.0))
        sound_deg, slow_deg = (servo(share).simulate(time_s, command_deg, time_s) for share in (1.0, speed))
        moved_deg = np.where(time_s < since_s, sound_deg, slow_deg)
        noise_deg = rng.normal(0.0, 0.1, time_s.size)
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


@pytest.mark.slow
def test_one_that_was_slower_and_mended_itself_is_not_called_sound() -> None:
    """Its model is between the two servos that it was, and sees neither at fault: the part after it does."""
    sound, slow = (calm((share,), since_s=0.0) for share in (1.0, 0.4))
    (result,) = servofd.audit(sound.where(sound.time_s >= 50.0, slow))
    ((fault,),) = (surface.faults for surface in result.surfaces)
    assert (fault.kind, fault.end_s) == ("slow", pytest.approx(50.0, abs=1.0))


def scores(since_s: FloatArray, slower: FloatArray) -> Lasting:
    return Lasting(since_s, np.outer(slower, [1.0, 0.0, 0.0, 0.0]))


def test_a_servo_that_was_not_judged_for_a_while_dates_no_other_later() -> None:
    """What it shows at the end of its hole it would have shown in all of it."""
    since_s: FloatArray = np.arange(5.0, 115.0)
    score, late = (15.0 * np.exp(-0.5 * ((since_s - at_s) / 6.0) ** 2) for at_s in (60.0, 101.0))
    seen = (since_s < 60.0) | (since_s > 100.0)
    torn = scores(since_s[seen], np.where(since_s > 100.0, late, score)[seen])
    whole = scores(since_s, score)
    assert slow_together([whole, whole, torn]) == 60.0
    assert torn.is_slower_near(60.0)
    assert torn.is_slower_near(80.0)
    assert not torn.is_slower_near(120.0)
    assert not torn.is_slower_near(1.0)
    assert not NOTHING_LASTS.is_slower_near(60.0)
    assert slow_together([torn, torn]) == pytest.approx(102.0, abs=1.0)  # where nobody was judged: the end of the hole


@pytest.mark.slow
@pytest.mark.nightly
def test_a_supply_that_gives_way_while_one_servo_is_not_seen_is_one_event() -> None:
    """The hole is longer than what follows a change is looked at."""
    table = calm((0.5, 0.5, 0.5, 0.5), np.arange(0.0, 260.0, 0.02), 73.2)
    table.loc[(table.time_s >= 73.0) & (table.time_s < 200.0), "servo0_pos_deg"] = np.nan
    (result,) = servofd.audit(table)
    assert [len(surface.faults) for surface in result.surfaces] == [1, 1, 1, 1]
    assert [surface.faults[0].start_s for surface in result.surfaces] == pytest.approx([73.2] * 4, abs=1.0)
    (cause,) = result.common_causes
    assert len(cause.surfaces) == 4


@pytest.mark.slow
def test_progress_counts_each_surface_once_though_it_is_looked_at_twice(tmp_path: Path) -> None:
    calm((0.5, 0.5, 0.5)).to_csv(path := tmp_path / "flight.csv", index=False)
    log, done = one_log(path), list[str]()
    found = audit_log(log, flown_aircraft(log), progress=done.append)
    assert [cause.kind for cause in found.common_causes] == ["supply"]
    assert sorted(done) == ["servo0", "servo1", "servo2"]
