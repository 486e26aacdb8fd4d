"""Parts of `explain`, each by itself: where a fault begins, when a model errs, frames of pulses, own effects."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hidden_physics import hidden
from servofd.aircraft.series import Series
from servofd.core.errors import ConfigError
from servofd.discrepancy.explanation import explain_gap, fault_start_s
from servofd.discrepancy.fit import Fitter
from servofd.discrepancy.own import load_own_effect
from servofd.discrepancy.record import simulate
from servofd.discrepancy.search import best_frame
from servofd.servo.effect import Parameter
from servofd.servo.effects.commands import Delay
from tests.recovery.test_honesty import KNOWN, flown


def _found(error_deg: Any, sigma_deg: float) -> Any:
    return SimpleNamespace(nominal=SimpleNamespace(error_deg=error_deg), sigma_deg=sigma_deg)


@pytest.mark.parametrize("begin_s", [6.0, 12.5, 22.0])
@pytest.mark.parametrize("end_s", [np.inf, 26.0])
def test_a_fault_begins_where_the_error_grows(begin_s: float, end_s: float) -> None:
    """Whether it stays or passes, and to a sample where its first error is no noise."""
    record = flown((), [], 1)
    for seed in range(10):
        rng = np.random.default_rng(seed)
        error_deg = 0.1 * rng.standard_normal(record.time_s.size)
        at_fault = (record.time_s >= begin_s) & (record.time_s < end_s)
        error_deg[at_fault] += 3.0 * np.cos(2.0 * record.time_s[at_fault])
        found_s = fault_start_s(record, _found(error_deg, 0.1))
        assert found_s is not None
        assert begin_s <= found_s < begin_s + 1.0


def test_noise_and_a_few_seconds_have_no_fault() -> None:
    record = flown((), [], 1)
    noise_deg = 0.1 * np.random.default_rng(0).standard_normal(record.time_s.size)
    assert fault_start_s(record, _found(noise_deg, 0.1)) is None
    better_later = np.where(record.time_s < 15.0, 10.0, 1.0) * noise_deg
    assert fault_start_s(record, _found(better_later, 0.1)) is None
    short = flown((), [], 1, duration_s=4.0)
    assert fault_start_s(short, _found(noise_deg[: short.time_s.size], 0.1)) is None


@pytest.mark.slow
def test_a_jam_in_a_short_flight_is_no_missing_effect() -> None:
    record = flown((), [], 3, duration_s=20.0)
    time_s, noise_deg = record.time_s, 0.1 * np.random.default_rng(0).standard_normal(record.time_s.size)
    jammed_deg = np.where(time_s > 13.0, record.measured_deg[1300] + noise_deg, record.measured_deg)
    found = explain_gap(
        Series("x", record.commands.effective_s, record.commands.command_deg, time_s, jammed_deg), KNOWN
    )
    assert found.conclusion == "unexplained"
    assert found.fault_s == pytest.approx(13.0, abs=0.5)
    assert found.selection.final.names == ()
    assert found.answer.startswith("FAULT from")
    assert "the position does not follow its command" in found.notes[0]


@pytest.mark.nightly
def test_a_frame_is_found_in_a_log_longer_than_the_window_it_was_seen_in() -> None:
    record = flown((), [], 2, duration_s=20.0)
    framed = record.model.physics._replace(frame_s=0.047, frame_phase=0.41)
    noise_deg = 0.1 * np.random.default_rng(2).standard_normal(record.time_s.size)
    record = replace(record, measured_deg=simulate(record, framed) + noise_deg)
    found = best_frame(record, record.model.physics)
    assert found is not None
    assert found[0] == pytest.approx(0.047, rel=3e-4)


@pytest.mark.slow
def test_no_frame_is_proposed_where_something_else_explains_the_error() -> None:
    record = flown((Delay,), [0.04], 2, duration_s=12.0)
    noise_deg = Fitter(record).judged((Delay,), record.model.physics._replace(delay_s=0.04)).error_deg
    assert best_frame(record, record.model.physics, noise_deg, 0.1) is None


@pytest.mark.parametrize(
    ("numbers", "why"),
    [
        ({"low": 1.0, "high": 0.0}, "its lower bound 1 must be below its upper bound 0"),
        ({"low": 0.0, "high": 1.0, "neutral": 2.0}, "neutral 2 must lie between 0 and 1"),
        ({"low": 0.0, "high": 0.0}, "its lower bound 0 must be below its upper bound 0"),
        ({"low": 0.0}, "high is missing"),
        ({"low": 0.0, "high": 1.0, "typical": 0.0}, "typical must be positive"),
    ],
)
def test_numbers_that_contradict_each_other(numbers: dict[str, Any], why: str) -> None:
    with pytest.raises(ConfigError, match=f"parameter size_deg: {why}"):
        Parameter("size_deg", **({"neutral": 0.0, "typical": 0.1} | numbers))


def test_where_no_usual_size_is_allowed_the_middle_is_tried() -> None:
    assert Parameter("size_deg", low=0.0, high=1e-6, neutral=0.0, typical=0.1).grid == (5e-7,)


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (None, "No such file"),
        (b"\xff\xfe\x00", "SyntaxError"),
        (b"x = 1\n", "defines no effect; one is needed"),
        (b"raise ValueError('no')\n", "ValueError"),
    ],
)
def test_files_that_define_no_effect(content: bytes | None, why: str, tmp_path: Path) -> None:
    path = tmp_path / "effect.py"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=why) as refused:
        load_own_effect(path)
    assert str(path) in str(refused.value)


def test_a_servo_that_runs_away_is_as_wrong_as_can_be() -> None:
    """A load that pushes the surface on, at a motor that has reached its limit, passes every number."""
    record = flown((), [], 2)
    lifted = replace(record, logged={"airspeed_m_s": np.full(record.time_s.size, 1e6)})
    limited = record.model.physics._replace(rate_up_deg_s=20.0, rate_down_deg_s=20.0, airload_per_pa=-0.0012)
    limited = limited._replace(follow_up_deg_s=math.inf, follow_down_deg_s=math.inf)
    moved_deg = simulate(lifted, limited)
    assert np.abs(moved_deg).max() == 1e6
    assert np.isfinite(moved_deg @ moved_deg)


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [2, 4])
def test_another_gain_below_zero_is_an_effect_and_no_fault(seed: int) -> None:
    """Flown by a simulator that shares nothing with the model; it was a fault from 15 s on."""
    made = hidden(seed, {}, "flight", 0.0)
    moved_deg = np.where(made.clean_deg > 0.0, 1.0, 0.92) * made.clean_deg
    measured_deg = moved_deg + 0.05 * np.random.default_rng(seed).standard_normal(made.time_s.size)
    found = explain_gap(Series("x", made.time_s, made.command_deg, made.time_s, measured_deg), KNOWN)
    assert found.fault_s is None
    assert found.conclusion == "explained"
    values = dict(zip(found.selection.final.names, found.selection.final.values.tolist(), strict=True))
    assert values["gain"] == pytest.approx(0.92, abs=0.005)
    assert values["linkage_nonlinearity"] == pytest.approx(1.0 / 0.92, abs=0.005)
