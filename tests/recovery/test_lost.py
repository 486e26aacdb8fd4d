"""Lost commands that nobody can guess are found by the beat of those that are left."""

from __future__ import annotations

import numpy as np
import pytest

from servofd.aircraft.marks import Why
from servofd.aircraft.pace import rhythm
from servofd.aircraft.series import Series, settled_from_s
from servofd.core.types import FloatArray
from servofd.discrepancy.record import after_lost_commands, record_of
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel

PERIOD_S, HOLE_S = 0.01, 0.1


def beaten(seed: int, loss: float, off_s: float = 0.003, size: int = 6000) -> tuple[FloatArray, FloatArray]:
    """Commands that keep to a clock, each off by a little, and those of them that are left."""
    rng = np.random.default_rng(seed)
    sent_s = PERIOD_S * np.arange(size) + rng.uniform(-off_s, off_s, size)
    return sent_s, sent_s[rng.random(size) >= loss]


def wavy(time_s: FloatArray) -> FloatArray:
    """Three turns a second: it bends between any three commands but near its zeros."""
    return 40.0 * np.sin(20.0 * time_s)


@pytest.mark.parametrize("seed", range(4))
def test_samples_after_lost_commands_do_not_count(seed: int) -> None:
    """Some intervals in which one was lost are shorter than others in which none was."""
    sent_s, left_s = beaten(seed, 0.03)
    lost_s = sent_s[1:-1][~np.isin(sent_s[1:-1], left_s)]
    lost_s = lost_s[np.abs(wavy(lost_s)) > 20.0]
    after = after_lost_commands(left_s, wavy(left_s), HOLE_S, lost_s + 0.02)
    assert lost_s.size > 80
    assert after.mean() > 0.98


@pytest.mark.parametrize("seed", range(4))
def test_where_none_was_lost_samples_count(seed: int) -> None:
    """Two or three of a hundred intervals are longer than 14.5 ms, each of which hid a lost command once."""
    _, left_s = beaten(seed, 0.0)
    assert np.mean(np.diff(left_s) > 1.45 * PERIOD_S) > 0.02
    assert np.mean(after_lost_commands(left_s, wavy(left_s), HOLE_S, left_s)) < 0.02


def test_without_a_beat_every_long_interval_is_doubtful() -> None:
    """A clock that goes on from each command, however late it was, tells nobody how many there were."""
    step_s = PERIOD_S + np.random.default_rng(1).uniform(-0.005, 0.005, 4000)
    sent_s = np.cumsum(step_s)
    before = np.flatnonzero((step_s[1:] > 1.49 * PERIOD_S) & (np.abs(wavy(sent_s[:-1])) > 25.0))
    after = after_lost_commands(sent_s, wavy(sent_s), HOLE_S, sent_s[before] + 0.01)
    assert before.size > 8
    assert after.mean() > 0.7


def test_jitter_and_losses_leave_a_rhythm() -> None:
    """A hundred intervals of the warm-up scatter: one log in a hundred was said to have none."""
    found_s = [rhythm(beaten(seed, 0.03, size=400)[1]).period_s for seed in range(300)]
    assert np.isfinite(found_s).all()
    assert np.median(found_s) == pytest.approx(PERIOD_S, rel=0.02)


@pytest.mark.parametrize(("lacking", "counts_at_once"), [("positions", True), ("commands", False), ("torque", False)])
def test_what_follows_a_hole_counts_where_commands_were_known(lacking: str, counts_at_once: bool) -> None:
    """A telemetry that freezes leaves out what it repeats, and not half a second of motion behind it."""
    time_s = np.arange(500) / 50.0
    command_deg, hole = 20.0 * np.sin(time_s), (time_s > 4.0) & (time_s < 4.5)
    why = np.where(hole, {"positions": Why.FROZEN, "torque": Why.TORQUE_OFF}.get(lacking, Why.GAP), Why.COUNTS)
    kept = ~hole if lacking == "commands" else np.ones(time_s.size, dtype=bool)
    measured_deg = np.where(hole, np.nan, command_deg)
    segment = Series("x", time_s[kept], command_deg[kept], time_s, measured_deg, why=why.astype(np.int8))
    record = record_of(segment, ServoModel.of(servo_named("hs225bb-eq31")))
    assert record.counts[(time_s > 4.51) & (time_s < 4.6)].all() == counts_at_once
    assert record.counts[time_s > 5.1].all()


def test_a_servo_that_begins_elsewhere_is_judged_once_it_has_forgotten_that() -> None:
    """When it was asked to go there, or powered, no log tells; one that stands where it is asked to has no secret."""
    time_s = np.arange(100) / 50.0
    for away_deg, from_s in ((20.0, 0.5), (0.1, 0.02)):
        asked = time_s, np.full(time_s.size, away_deg)
        assert settled_from_s(0.0, asked, time_s, np.zeros(time_s.size)) == pytest.approx(from_s)
