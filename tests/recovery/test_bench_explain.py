"""What bench servos have, recovered from a simulator that shares nothing with the kernel, by runs held out whole."""

from __future__ import annotations

import numpy as np
import pytest

from hidden_physics import Air, Effects, deflection, hidden
from servofd.aircraft.series import Series
from servofd.core.types import FloatArray
from servofd.discrepancy.explanation import Explanation, explain_gap
from servofd.discrepancy.known import NOTHING
from servofd.servo.context import Context
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel
from servofd.servo.transfer import TransferFunction

KNOWN = ServoModel.of(servo_named("hs225bb-eq31"))
UNKNOWN = ServoModel(TransferFunction((987.0,), (1.0, 50.3, 987.0)))
TIME_S = np.arange(800) / 100.0


def sines(seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    waves = [rng.uniform(4.0, 9.0) * np.sin(2.0 * np.pi * rng.uniform(0.3, 2.5) * TIME_S) for _ in range(4)]
    return np.asarray(np.sum(waves, axis=0))


def run(seed: int, effects: Effects, noise_deg: float = 0.05) -> Series:
    rng = np.random.default_rng([seed, 1])
    moved = deflection(effects, TIME_S, sines(seed), Air.steady(8.0, 20.0, 6.0), rng)
    return Series("servo", TIME_S, sines(seed), TIME_S, moved + noise_deg * rng.standard_normal(TIME_S.size))


def explained(effects: Effects, runs: int = 4) -> Explanation:
    return explain_gap([run(seed, effects) for seed in range(runs)], KNOWN, on_bench=True)


@pytest.mark.nightly
def test_a_current_limit_is_named_and_measured() -> None:
    record = hidden(3, {"current_limit": {"knee_deg": 3.0}}, "sweep", 0.05, duration_s=30.0)
    segment = Series("servo", record.time_s, record.command_deg, record.time_s, record.measured_deg)
    fitter = explain_gap(segment, KNOWN).selection
    assert fitter.final.names == ("current_limit",)
    assert fitter.final.values[0] == pytest.approx(3.0, rel=0.02)


@pytest.mark.nightly
def test_runs_held_out_whole_are_predicted_by_the_others() -> None:
    found = explained({"gravity_load": {"droop_deg": 15.0}, "delay": {"delay_s": 0.02}})
    assert set(found.selection.final.names) == {"gravity_load", "delay"}
    assert found.conclusion == "explained"
    assert len(found.runs) == 4
    for each in found.runs:
        assert each.held_out_rms_deg < 0.06
        assert each.nominal_rms_deg > 1.0


@pytest.mark.nightly
def test_poles_that_nobody_knows_are_found_beside_the_effects() -> None:
    """Of third order in truth, so that sizes come out off by the order that lacks, and the motion hardly."""
    effects: Effects = {"gravity_load": {"droop_deg": 15.0}}
    found = explain_gap([run(k, effects) for k in range(4)], UNKNOWN, on_bench=True, known=NOTHING)
    assert found.selection.nominal.physics.gain < 0.85  # a linear servo comes as near only with a gain that none has
    assert found.physics.gain == pytest.approx(1.0, abs=0.02)
    assert found.rms_deg(found.selection.final)["held_out_rms_deg"] < 0.06
    model = found.document()["final"]["model"]
    assert model["gravity_load"]["droop_deg"] == pytest.approx(15.0, rel=0.2)


@pytest.mark.slow
def test_a_reading_that_moves_with_the_current_is_not_called_motion() -> None:
    """Spikes of current at each start, on a supply shared with the sensor."""
    plain = run(1, {})
    current_a = np.abs(np.gradient(plain.command_deg, TIME_S)) / 40.0
    segment = Series(
        "servo",
        TIME_S,
        plain.command_deg,
        TIME_S,
        plain.measured_deg - 0.8 * current_a,
        context=Context(current_s=TIME_S, current_a=current_a),
    )
    found = explain_gap(segment, KNOWN)
    assert found.selection.final.names == ("supply_coupling",)
    assert found.selection.final.values[0] == pytest.approx(-0.8, rel=0.03)
