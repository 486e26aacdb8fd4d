"""The residual: silent for every command of a healthy servo, whatever the samples; loud for a fault."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servofd.aircraft.series import Series
from servofd.core.types import FloatArray
from servofd.detection.pulse import design_pulse_filter
from servofd.detection.residual import ResidualGenerator
from servofd.estimate.record import SETTLING_S, commands_at_servo
from servofd.servo.library import library, servo_named
from servofd.servo.servo_model import ServoModel
from servofd.simulation.commands import flight
from tests.laws.reference_twin import linear_deflection

SILENT_DEG = 1e-9
RATE_HZ = 100.0
UNIFORM_S = np.arange(6000) / RATE_HZ


def peak(generator: ResidualGenerator, segment: Series) -> float:
    residuals = generator.run(segment)
    assert residuals.settled.mean() > 0.5
    return float(np.nanmax(np.abs(residuals.residual_deg[residuals.settled])))


def command_for(seed: int, time_s: FloatArray = UNIFORM_S) -> FloatArray:
    return flight(time_s, np.random.default_rng(seed))


@pytest.mark.parametrize("name", library())
class TestHealthyServoIsSilent:
    """Against the twin of matrix exponentials, so that the kernel is not checked against itself."""

    def twin(self, name: str, time_s: FloatArray, command_deg: FloatArray) -> FloatArray:
        model = ServoModel.of(servo_named(name))
        return linear_deflection(model.transfer, model.delay_s, time_s, command_deg, time_s)

    def generator(self, name: str, segment: Series) -> ResidualGenerator:
        return ResidualGenerator.fitting(ServoModel.of(servo_named(name)).linear(), segment.period_s)

    def test_on_uniform_samples(self, name: str) -> None:
        time_s = UNIFORM_S[:2000]
        command_deg = command_for(1)[:2000]
        segment = Series(name, time_s, command_deg, time_s, self.twin(name, time_s, command_deg))
        assert peak(self.generator(name, segment), segment) < SILENT_DEG

    def test_on_jittered_samples(self, name: str) -> None:
        time_s = UNIFORM_S[:2000] + np.random.default_rng(2).uniform(-0.003, 0.003, 2000)
        command_deg = command_for(2)[:2000]
        segment = Series(name, time_s, command_deg, time_s, self.twin(name, time_s, command_deg))
        assert peak(self.generator(name, segment), segment) < SILENT_DEG

    def test_with_a_fifth_of_the_positions_lost(self, name: str) -> None:
        time_s = UNIFORM_S[:2000]
        command_deg = command_for(3)[:2000]
        measured_deg = self.twin(name, time_s, command_deg)
        measured_deg[np.random.default_rng(3).random(2000) < 0.2] = np.nan
        segment = Series(name, time_s, command_deg, time_s, measured_deg)
        assert peak(self.generator(name, segment), segment) < SILENT_DEG

    @pytest.mark.parametrize("seed", range(3))
    def test_nearly_with_a_twentieth_of_the_rows_lost(self, name: str, seed: int) -> None:
        model = ServoModel.of(servo_named(name))
        command_deg = command_for(seed)
        measured_deg = model.simulate(UNIFORM_S, command_deg, UNIFORM_S)
        kept = np.random.default_rng(seed).random(UNIFORM_S.size) > 0.05
        segment = Series(name, UNIFORM_S[kept], command_deg[kept], UNIFORM_S[kept], measured_deg[kept])
        assert peak(ResidualGenerator.fitting(model, segment.period_s), segment) < 0.1


@pytest.mark.parametrize("name", ["hs225bb-eq31", "s9254", "s3151", "9360th"])
def test_both_ways_to_the_residual_agree(name: str) -> None:
    """Plant-first filter on command and deflection, and Qy on the simulation error."""
    rng = np.random.default_rng(4)
    servo = servo_named(name)
    model = ServoModel.of(servo).linear()
    command_deg = command_for(4)
    command_deg[:20] = command_deg[0]
    measured_deg = model.simulate(UNIFORM_S, command_deg, UNIFORM_S)
    measured_deg[3000:] += np.cumsum(rng.normal(size=3000)) * 0.1
    design = design_pulse_filter(servo.transfer, servo.transport_delay_s, 1.0 / RATE_HZ, 40.0)
    segment = Series(name, UNIFORM_S, command_deg, UNIFORM_S, measured_deg)
    ours = ResidualGenerator(model, 40.0).run(segment).residual_deg
    difference = (ours - design.residual(measured_deg, command_deg))[200:]
    assert np.max(np.abs(difference)) < SILENT_DEG


@given(seed=st.integers(0, 2**31), pole=st.floats(10.0, 100.0))
@settings(max_examples=30, deadline=None)
def test_a_constant_error_passes_with_the_inverse_dc_gain_on_any_samples(seed: int, pole: float) -> None:
    rng = np.random.default_rng(seed)
    model = ServoModel.of(servo_named("s3151"))
    time_s = np.cumsum(rng.uniform(0.002, 0.03, 600))
    command_deg = 5.0 * np.sin(time_s)
    measured_deg = model.simulate(time_s, command_deg, time_s) + np.where(time_s > time_s[100], 2.0, 0.0)
    residual = ResidualGenerator(model, pole).run(Series("x", time_s, command_deg, time_s, measured_deg)).residual_deg
    assert residual[-1] == pytest.approx(2.0, abs=1e-3)


def test_a_log_may_be_cut_anywhere() -> None:
    """Blanking hides how the filter was started: both halves say what the whole says."""
    model = ServoModel.of(servo_named("hs225bb-eq31"))
    command_deg = command_for(6)
    measured_deg = model.simulate(UNIFORM_S, command_deg, UNIFORM_S) + 0.1
    generator = ResidualGenerator(model, 50.0)
    whole = generator.run(Series("x", UNIFORM_S, command_deg, UNIFORM_S, measured_deg))
    half = slice(3100, None)
    part = generator.run(Series("x", UNIFORM_S[half], command_deg[half], UNIFORM_S[half], measured_deg[half]))
    settled = part.settled
    assert np.max(np.abs(part.residual_deg - whole.residual_deg[half])[settled]) < 0.05


def test_a_gap_restarts_and_blanks_the_filter() -> None:
    model = ServoModel.of(servo_named("hs225bb-eq31"))
    command_deg = command_for(7)
    measured_deg = model.simulate(UNIFORM_S, command_deg, UNIFORM_S)
    kept = (UNIFORM_S < 20.0) | (UNIFORM_S >= 21.0)
    generator = ResidualGenerator(model, 50.0)
    segment = Series("x", UNIFORM_S[kept], command_deg[kept], UNIFORM_S[kept], measured_deg[kept])
    residuals = generator.run(segment)
    after = (residuals.time_s >= 21.0) & (residuals.time_s < 21.0 + SETTLING_S - 1e-9)
    assert not residuals.settled[after].any()
    assert residuals.settled[residuals.time_s > 21.5].all()
    assert np.nanmax(np.abs(residuals.residual_deg[residuals.settled])) < 0.05


def test_positions_without_commands_are_not_judged() -> None:
    model = ServoModel.of(servo_named("hs225bb-eq31"))
    commanded = UNIFORM_S < 30.0
    measured_deg = np.full(UNIFORM_S.size, 5.0)
    segment = Series("x", UNIFORM_S[commanded], command_for(8)[commanded], UNIFORM_S, measured_deg)
    residuals = ResidualGenerator(model, 50.0).run(segment)
    assert not residuals.settled[UNIFORM_S > 30.2].any()


def test_a_rate_limited_healthy_servo_is_silent() -> None:
    model = ServoModel.of(servo_named("s3151"))
    command_deg = np.where(np.sin(UNIFORM_S * 3.0) > 0.0, 40.0, -40.0)
    measured_deg = model.simulate(UNIFORM_S, command_deg, UNIFORM_S)
    segment = Series("x", UNIFORM_S, command_deg, UNIFORM_S, measured_deg)
    assert peak(ResidualGenerator(model, 30.0), segment) < SILENT_DEG
    assert peak(ResidualGenerator(model.linear(), 30.0), segment) > 5.0


def test_thinned_logs_are_bridged_by_straight_lines() -> None:
    """Commands at 100 Hz of which the log holds every second one (and the autopilot's period is known)."""
    model = ServoModel.of(servo_named("hs225bb-eq31"))
    command_deg = command_for(9)
    measured_deg = model.simulate(UNIFORM_S, command_deg, UNIFORM_S)
    every = slice(None, None, 2)
    time_s = UNIFORM_S[every]
    held = Series("x", time_s, command_deg[every], time_s, measured_deg[every])
    linear = Series("x", time_s, command_deg[every], time_s, measured_deg[every], command_period_s=0.01)
    generator = ResidualGenerator(model, 30.0)
    assert peak(generator, linear) < 0.05
    assert peak(generator, held) > 5 * peak(generator, linear)


def test_lost_commands_are_put_back_on_a_straight_line() -> None:
    time_s = np.array([0.0, 0.01, 0.02, 0.05, 0.06, 0.07, 0.08, 0.09, 1.0, 1.01])
    commands = commands_at_servo(Series("x", time_s, time_s, time_s, time_s), 0.1)
    filled = [0.0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07, 0.08, 0.09, 1.0, 1.01]
    np.testing.assert_allclose(commands.effective_s, filled)
    np.testing.assert_allclose(commands.command_deg, filled)


def test_no_command_is_made_up_where_commands_come_as_they_please() -> None:
    time_s = np.cumsum(np.random.default_rng(5).uniform(0.001, 0.05, 200))
    commands = commands_at_servo(Series("x", time_s, time_s, time_s, time_s), 0.1)
    assert np.array_equal(commands.effective_s, time_s)
