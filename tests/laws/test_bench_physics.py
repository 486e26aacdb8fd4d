"""Effects that bench servos need: none when neutral, and the same motion as slow integration in plain Python."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from servofd.aircraft.series import Series
from servofd.core.types import FloatArray
from servofd.discrepancy.record import Record, joined, record_of, simulate
from servofd.servo.catalogue import by_condition
from servofd.servo.context import Context
from servofd.servo.effects.commands import SetPointRate
from servofd.servo.motion import Machine
from servofd.servo.physics import Physics
from servofd.servo.servo_model import ServoModel
from servofd.servo.transfer import TransferFunction

NATURAL_RAD_S, DAMPING = 25.0, 0.7
MODEL = ServoModel(TransferFunction((NATURAL_RAD_S**2,), (1.0, 2.0 * DAMPING * NATURAL_RAD_S, NATURAL_RAD_S**2)))
TIME_S = np.arange(0.0, 4.0, 0.01)
COMMAND_DEG = 50.0 * np.sin(1.5 * TIME_S**2)


def bench_record(context: Context | None = None) -> Record:
    segment = Series("servo", TIME_S, COMMAND_DEG, TIME_S, 0.0 * TIME_S, context=context or Context())
    return record_of(segment, MODEL, at_rest=True)


def integrated(
    knee_deg: float = math.inf, droop_deg: float = 0.0, load_friction: float = 0.0, rate_deg_s: float = math.inf
) -> FloatArray:
    """The servo in steps of 50 us: force on a mass, friction that cannot reverse it."""
    stiffness, drag = NATURAL_RAD_S**2, 2.0 * DAMPING * NATURAL_RAD_S
    steps, h = 200, 5e-5
    most = rate_deg_s * drag / stiffness
    y = v = 0.0
    result = np.empty(TIME_S.size)
    for k in range(TIME_S.size):
        result[k] = y
        for _ in range(steps):
            error = COMMAND_DEG[k] - y
            error /= math.sqrt(1.0 + abs(error) / knee_deg)
            error = max(-most, min(most, error))
            v += h * (stiffness * (error - droop_deg * math.sin(math.radians(y))) - drag * v)
            brake = h * load_friction * stiffness * abs(error)
            v = max(0.0, v - brake) if v > 0.0 else min(0.0, v + brake)
            y += h * v
    return result


@pytest.mark.slow
@pytest.mark.parametrize(
    "effects",
    [
        {"knee_deg": 5.0},
        {"droop_deg": 30.0},
        {"load_friction": 0.4},
        {"droop_deg": 20.0, "load_friction": 0.5, "knee_deg": 40.0},
        {"load_friction": 0.3, "rate_deg_s": 120.0},
    ],
)
def test_it_moves_as_slow_integration_does(effects: dict[str, float]) -> None:
    fields = {key: value for key, value in effects.items() if key != "rate_deg_s"}
    if "rate_deg_s" in effects:
        fields |= dict.fromkeys(("rate_up_deg_s", "rate_down_deg_s"), effects["rate_deg_s"])
    moved = simulate(bench_record(), Physics(**fields))
    slow = integrated(**effects)
    assert np.abs(slow - integrated()).max() > 2.0
    assert np.sqrt(np.mean((moved - slow) ** 2)) < 0.05


def test_neutral_values_are_no_effect() -> None:
    record = bench_record(Context(current_s=TIME_S, current_a=np.abs(COMMAND_DEG)))
    plain = simulate(record, Physics())
    for neutral in ({"knee_deg": math.inf}, {"load_friction": 0.0}, {"droop_deg": 0.0}, {"deg_per_a": 0.0}):
        np.testing.assert_array_equal(simulate(record, Physics(**neutral)), plain)


def test_a_knee_far_away_is_no_knee() -> None:
    record = bench_record()
    assert np.abs(simulate(record, Physics(knee_deg=1e6)) - simulate(record, Physics())).max() < 1e-2


def test_supply_coupling_moves_the_reading_and_nothing_else() -> None:
    current_a = np.abs(np.sin(TIME_S))
    record = bench_record(Context(current_s=TIME_S, current_a=current_a))
    moved = simulate(record, Physics(deg_per_a=-2.0)) - simulate(record, Physics())
    np.testing.assert_allclose(moved, -2.0 * current_a, atol=1e-12)


def test_joined_runs_move_as_each_run_does_alone() -> None:
    one = bench_record()
    later = Series("servo", TIME_S + 7.0, -COMMAND_DEG, TIME_S + 7.0, 3.0 + 0.0 * TIME_S)
    two = record_of(later, MODEL, at_rest=True)
    both = joined([one, two])
    physics = Physics(load_friction=0.3, droop_deg=10.0)
    alone = [simulate(each, physics) for each in (one, two)]
    np.testing.assert_allclose(simulate(both, physics), np.concatenate(alone), atol=1e-9)
    assert joined([one]) is one


@pytest.mark.parametrize(
    ("physics", "journeys"),
    [
        (Physics(rate_up_deg_s=40.0), 1),
        (Physics(friction_deg=0.6), 2),
        (Physics(set_point_deg_s=60.0)._replace(**by_condition(SetPointRate, 0, "load").fixed, run_slope=-20.0), 2),
    ],
    ids=["one for all", "once more from where each lay", "one for each condition"],
)
def test_runs_are_one_journey_of_the_stepper(physics: Physics, journeys: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither late commands of one run nor the place where it ended reach the next, whatever is fitted."""
    runs = []
    for k in range(5):
        at_s, read_deg = TIME_S[k : 200 + 10 * k], 0.9 * COMMAND_DEG[k : 200 + 10 * k]
        segment = Series("servo", TIME_S - 0.403 * k, COMMAND_DEG + k, at_s, read_deg - read_deg[0])
        runs.append(replace(record_of(segment, MODEL), conditions=((-1.0) ** k,), condition_names=("load",)))
    physics = physics._replace(delay_s=0.3, bias_deg=0.5, gain=0.9)
    alone = [simulate(joined([each] * 3), physics)[: each.time_s.size] for each in runs]
    moved, made = Machine.run, []

    def counted(*arguments: Any, **options: Any) -> Any:
        made.append(1)
        return moved(*arguments, **options)

    monkeypatch.setattr(Machine, "run", counted)
    together = joined(runs)
    together = replace(together, counts=np.zeros_like(together.counts))
    np.testing.assert_allclose(simulate(together, physics), np.concatenate(alone), atol=1e-9)
    assert len(made) == journeys


def test_of_many_runs_whole_ones_are_the_folds_and_of_few_blocks_of_each() -> None:
    one = bench_record()
    for count in (2, 5, 6, 9):
        both = joined([one] * count)
        folds = [set(both.fold[both.run == k].tolist()) for k in range(count)]
        assert all(len(each) == 1 for each in folds) == (count >= 6)
        assert set().union(*folds) >= {0, 1}
        if count < 6:
            shares = [np.mean(both.fold[both.run == k] == 1) for k in range(count)]
            assert shares == pytest.approx([0.5] * count, abs=0.1)
