"""The hypotheses: each recovers its own fault, and the decision between them is right where it is sure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servofd.core.types import FloatArray
from servofd.detection.verdict import Fault as Found
from servofd.detection.wiring import wiring_problem
from servofd.servo.faults import (
    Bias,
    DeadBand,
    Failure,
    Floating,
    HardOver,
    LossOfEffectiveness,
    Oscillation,
    Slow,
    Stuck,
)
from servofd.simulation.commands import COMMANDS
from tests.detection.tolerated import MODEL, deviating
from tests.detection.windows import NOISE_DEG, command, flown, judged, residuals_of

GROSS: dict[str, Failure] = {
    "bias": Bias(2.0, bias_deg=2.0),
    "stuck": Stuck(2.0, position_deg=1.0),
    "hardover": HardOver(2.0, position_deg=30.0),
    "floating": Floating(2.0, amplitude_deg=5.0),
    "oscillation": Oscillation(2.0, amplitude_deg=2.0, frequency_hz=2.3),
    "deadband": DeadBand(2.0, width_deg=4.0),
    "slow": Slow(2.0, bandwidth_scale=0.4),
    "loss_of_effectiveness": LossOfEffectiveness(2.0, gain=0.5),
}
TIME_S = np.arange(6000) / 100.0


@pytest.mark.slow
@pytest.mark.parametrize("kind", GROSS)
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.nightly)])
def test_a_gross_fault_gets_its_name(kind: str, seed: int) -> None:
    found = judged(TIME_S, command(seed, TIME_S), flown(seed, replace(GROSS[kind], start_s=20.0), TIME_S), "interval")
    assert [fault.kind for fault in found.faults] == [kind]
    assert 19.5 < found.faults[0].start_s < 23.0


@pytest.mark.parametrize("seed", range(4))
def test_a_healthy_servo_is_healthy(seed: int) -> None:
    found = judged(TIME_S, command(seed, TIME_S), flown(seed, None, TIME_S), "interval")
    assert (found.faults, found.suspicions) == ((), ())


@pytest.mark.slow
def test_what_nothing_explains_is_unknown() -> None:
    rng = np.random.default_rng(5)
    wild = flown(1, None, TIME_S) + 8.0 * np.sign(rng.standard_normal(TIME_S.size)) * (TIME_S > 20.0)
    (fault,) = judged(TIME_S, command(1, TIME_S), wild, "interval").faults
    assert fault.kind == "unknown"


class TestSmallButLasting:
    @pytest.mark.slow
    @pytest.mark.parametrize("bias_deg", [-0.9, 1.1])
    def test_a_bias_below_the_constant_threshold_is_suspect(self, bias_deg: float) -> None:
        command_deg = COMMANDS["calm"](TIME_S, np.random.default_rng(2))
        measured_deg = deviating(TIME_S, command_deg) + bias_deg * (TIME_S >= 20.0)
        measured_deg += NOISE_DEG * np.random.default_rng(1).standard_normal(TIME_S.size)
        found = judged(TIME_S, command_deg, measured_deg)
        assert found.faults == ()
        assert [(each.kind, each.level, each.end_s) for each in found.suspicions] == [("bias", "suspect", None)]
        assert 20.0 <= found.suspicions[0].alarm_s < 22.0

    @pytest.mark.parametrize("bias_deg", [0.0, 0.2, -0.3])
    def test_one_within_the_tolerance_is_not(self, bias_deg: float) -> None:
        command_deg = COMMANDS["calm"](TIME_S, np.random.default_rng(2))
        measured_deg = deviating(TIME_S, command_deg) + bias_deg
        measured_deg += NOISE_DEG * np.random.default_rng(1).standard_normal(TIME_S.size)
        found = judged(TIME_S, command_deg, measured_deg)
        assert (found.faults, found.suspicions) == ((), ())


@pytest.mark.slow
def test_a_lasting_fault_is_told_so_many_samples_later() -> None:
    measured_deg = flown(3, Bias(20.0, bias_deg=4.0), TIME_S)
    (first,), (later,) = (judged(TIME_S, command(3, TIME_S), measured_deg, persistence=many).faults for many in (1, 4))
    assert later.alarm_s - first.alarm_s == pytest.approx(0.03, abs=1e-9)


def only(time_s: FloatArray, command_deg: FloatArray, measured_deg: FloatArray) -> Found:
    judgement = judged(time_s, command_deg, measured_deg)
    assert judgement.suspicions == ()
    (fault,) = judgement.faults
    return fault


class TestFlights:
    @pytest.mark.slow
    def test_positions_that_are_lost_in_bursts_change_no_name(self) -> None:
        measured_deg = flown(1, LossOfEffectiveness(20.0, gain=0.5), TIME_S)
        for begin in range(500, 6000, 700):
            measured_deg[begin : begin + 60] = np.nan
        fault = only(TIME_S, command(1, TIME_S), measured_deg)
        assert fault.kind == "loss_of_effectiveness"
        assert fault.parameters["gain"].value == pytest.approx(0.5, abs=0.03)

    @pytest.mark.slow
    @pytest.mark.parametrize("kind", ["stuck", "bias", "loss_of_effectiveness"])
    def test_a_log_that_is_one_long_fault(self, kind: str) -> None:
        since_ever = replace(GROSS[kind], start_s=0.0)
        fault = only(TIME_S, command(2, TIME_S), flown(2, since_ever, TIME_S))
        assert (fault.kind, fault.end_s) == (kind, None)
        assert fault.start_s < 5.0

    @pytest.mark.slow
    @pytest.mark.parametrize(
        "kind", ["bias", *(pytest.param(kind, marks=pytest.mark.nightly) for kind in ("stuck", "oscillation"))]
    )
    def test_a_log_that_starts_inside_a_fault_which_passes(self, kind: str) -> None:
        passing = replace(GROSS[kind], start_s=0.0, end_s=15.0)
        fault = only(TIME_S, command(2, TIME_S), flown(2, passing, TIME_S))
        assert fault.kind == kind
        assert fault.end_s is not None
        assert 10.0 < fault.end_s < 17.0

    @pytest.mark.slow
    @pytest.mark.parametrize(
        "kind",
        ["stuck", "deadband", *(pytest.param(kind, marks=pytest.mark.nightly) for kind in ("bias", "oscillation"))],
    )
    def test_a_passing_fault_has_an_end(self, kind: str) -> None:
        passing = replace(GROSS[kind], start_s=20.0, end_s=30.0)
        fault = only(TIME_S, command(3, TIME_S), flown(3, passing, TIME_S))
        assert fault.kind == kind
        assert 20.0 <= fault.start_s <= fault.alarm_s < 26.0
        assert fault.end_s is not None
        assert 25.0 < fault.end_s < 33.0

    @pytest.mark.slow
    def test_two_faults_one_after_the_other(self) -> None:
        healthy_deg = flown(4, Bias(10.0, end_s=20.0, bias_deg=2.5), TIME_S)
        measured_deg = np.where(TIME_S < 40.0, healthy_deg, flown(4, Stuck(40.0), TIME_S))
        bias, jam = judged(TIME_S, command(4, TIME_S), measured_deg).faults
        assert (bias.kind, jam.kind) == ("bias", "stuck")
        assert bias.end_s is not None
        assert 19.0 < bias.end_s < 23.0
        assert 40.0 <= jam.start_s <= jam.alarm_s < 45.0

    @pytest.mark.slow
    @pytest.mark.parametrize("seed", [0, pytest.param(2, marks=pytest.mark.nightly)])
    def test_a_small_lasting_loss_is_one_fault_by_the_interval_threshold(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        command_deg = COMMANDS["gusty"](TIME_S, rng)
        measured_deg = LossOfEffectiveness(20.0, gain=0.88).deflection(MODEL, TIME_S, command_deg, TIME_S)
        measured_deg += NOISE_DEG * rng.standard_normal(TIME_S.size)
        assert len(judged(TIME_S, command_deg, measured_deg, "interval").faults) == 1

    @pytest.mark.slow
    @pytest.mark.parametrize("kind", ["bias", "stuck", "hardover", "loss_of_effectiveness"])
    def test_ten_hertz_are_enough(self, kind: str) -> None:
        time_s = np.arange(900) / 10.0
        fault = only(time_s, command(5, time_s), flown(5, replace(GROSS[kind], start_s=30.0), time_s))
        assert fault.kind == kind
        assert 29.5 <= fault.start_s <= fault.alarm_s < 40.0


class TestWiring:
    @pytest.mark.parametrize(
        ("gain", "expected"),
        [
            (-0.97, "position is -0.97x the command throughout: check the sign of the calibration"),
            (57.3, "position is 57.30x the command throughout: check the scale of the calibration"),
            (0.0175, "position is 0.02x the command throughout: check the scale of the calibration"),
            (1.0, ""),
            (0.5, ""),
        ],
    )
    def test_sign_and_scale(self, gain: float, expected: str) -> None:
        command_deg = command(6, TIME_S)
        position_deg = gain * MODEL.simulate(TIME_S, command_deg, TIME_S)
        noise_deg = min(1.0, abs(gain)) * NOISE_DEG * np.random.default_rng(6).standard_normal(TIME_S.size)
        assert wiring_problem(residuals_of(TIME_S, command_deg, position_deg + noise_deg)) == expected

    def test_a_stuck_surface_is_no_question_of_scale(self) -> None:
        residuals = residuals_of(TIME_S, command(6, TIME_S), flown(6, Stuck(0.0), TIME_S))
        assert wiring_problem(residuals) == ""

    def test_a_sign_that_changes_in_flight_is_a_fault(self) -> None:
        command_deg = command(6, TIME_S)
        position_deg = MODEL.simulate(TIME_S, command_deg, TIME_S) * np.where(TIME_S < 30.0, 1.0, -1.0)
        assert wiring_problem(residuals_of(TIME_S, command_deg, position_deg)) == ""
