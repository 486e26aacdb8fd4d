"""What explain finds, an audit simulates: the same motion, in pieces or at once, and a residual of noise alone."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import logparsers
from servofd.aircraft.schema import Aircraft, load_aircraft
from servofd.aircraft.series import Series
from servofd.core.errors import ConfigError
from servofd.core.types import FloatArray
from servofd.detection.audit import audit_log
from servofd.detection.seen import Healthy, Pace
from servofd.detection.verdict import SurfaceAudit
from servofd.discrepancy.record import record_of, simulate
from servofd.servo.catalogue import effects_installed, installed, table_of
from servofd.servo.context import Context
from servofd.servo.faults import Bias, Failure, HardOver, LossOfEffectiveness, Slow, Stuck
from servofd.servo.library import servo_named
from servofd.servo.loop import Scales, loop_of, scaled
from servofd.servo.motion import Motion, machine_of
from servofd.servo.physics import Physics
from servofd.servo.registry import catalogue
from servofd.servo.servo_model import ServoModel
from servofd.servo.transfer import TransferFunction
from servofd.simulation.commands import gusty
from servofd.simulation.flight import simulate_flight
from tests.recovery.fine_servo import FineServo, Hidden, hide

KNOWN = ServoModel.of(servo_named("hs225bb-eq31"))
SIZES = {
    "rate_limit": {"rate_limit_deg_s": 60.0},
    "voltage_rate": {"deg_s_per_v": 12.0},
    "friction": {"friction_deg": 0.4},
    "deadband": {"width_deg": 1.0},
    "backlash": {"width_deg": 0.8},
    "airload": {"deg_per_deg_pa": 4e-4},
    "gravity_load": {"droop_deg": 3.0},
    "external_load": {"deg_per_unit": 20.0},
    "load_friction": {"share": 0.2},
    "pwm_frame": {"period_s": 0.02, "phase": 0.3},
    "sensor_lag": {"time_constant_s": 0.02},
    "quantization": {"step_deg": 0.35},
    "linkage_nonlinearity": {"quadratic_per_deg": 0.004, "cubic_per_deg2": 2e-4},
    "resonance": {"frequency_hz": 9.0, "damping_ratio": 0.1},
    "clock_offset": {"offset_s": 0.02},
    "delay": {"delay_s": 0.03},
    "slow_dynamics": {"bandwidth_scale": 0.6},
    "damping": {"damping_scale": 0.6},
    "position_limit": {"lower_deg": -4.0, "upper_deg": 5.0},
    "gain": {"gain": 0.9},
    "bias": {"bias_deg": 1.0},
    "current_limit": {"knee_deg": 3.0},
    "supply_coupling": {"deg_per_a": 2.0},
}
FORMS = {
    "rate_limit set point": ("rate_limit", {"form": "set point", "rate_limit_deg_s": 60.0}),
    "rate_limit asymmetric": ("rate_limit", {"rate_up_deg_s": 50.0, "rate_down_deg_s": 90.0}),
    "deadband whole error": ("deadband", {"form": "whole error", "width_deg": 1.0}),
    "quantization command": ("quantization", {"form": "command", "step_deg": 0.5}),
}
for new in catalogue():  # one that has no size above is taken at what is common
    common = {p: p.neutral + p.typical for p in new.parameters}
    SIZES.setdefault(new.name, {p.name: v if v <= p.high else p.neutral - p.typical for p, v in common.items()})
CASES = {name: (name, size) for name, size in SIZES.items()} | FORMS
TIME_S: FloatArray = np.cumsum(np.random.default_rng(3).uniform(0.008, 0.012, 800))
COMMAND_DEG = gusty(TIME_S, np.random.default_rng(1))
CONTEXT = Context(
    *(TIME_S, 22.0 + 4.0 * np.sin(TIME_S)), *(TIME_S, 6.0 - 0.1 * TIME_S), *(TIME_S, 0.3 + 0.2 * np.sin(3.0 * TIME_S))
)


def extended(name: str, size: Mapping[str, float | str]) -> ServoModel:
    return KNOWN.with_physics(effects_installed(KNOWN.physics, {name: size}))


def test_every_effect_of_the_catalogue_can_be_written_and_read() -> None:
    for effect in catalogue():
        values = [p.low + 0.37 * (p.high - p.low) for p in effect.parameters]
        expected = installed(KNOWN.physics, [effect], values)
        read = effects_installed(KNOWN.physics, table_of([effect], np.array(values)))
        assert dict(read) == pytest.approx(dict(expected), rel=1e-6)


@pytest.mark.parametrize(("name", "size"), CASES.values(), ids=CASES)
def test_a_run_in_pieces_is_the_run_in_one_go(name: str, size: dict[str, float | str]) -> None:
    model = extended(name, size)
    servo = model.servo(CONTEXT)
    heard_s = TIME_S + model.delay_s
    whole, pieces, samples = (Motion(servo, 1.0) for _ in range(3))
    whole.receive(heard_s, COMMAND_DEG, np.zeros(TIME_S.size))
    expected = whole.at(TIME_S)
    assert np.ptp(expected) > 3.0
    cuts = [0, 1, 7, 300, 301, 555, TIME_S.size]
    by_piece, by_sample = [], []
    for first, last in pairwise(cuts):
        pieces.receive(heard_s[first:last], COMMAND_DEG[first:last], np.zeros(last - first))
        by_piece.append(pieces.at(TIME_S[first:last]))
    for k in range(TIME_S.size):
        samples.receive(heard_s[k : k + 1], COMMAND_DEG[k : k + 1], np.zeros(1))
        by_sample.append(samples.at(TIME_S[k : k + 1]))
    assert np.abs(np.concatenate(by_piece) - expected).max() < 1e-12
    assert np.abs(np.concatenate(by_sample) - expected).max() < 1e-12


class TestNumbersOfAServoWithEffects:
    """By hand."""

    servo = ServoModel(
        KNOWN.transfer,
        Physics(
            rate_up_deg_s=90.0,
            rate_down_deg_s=80.0,
            set_point_deg_s=85.0,
            gain=0.5,
            lower_deg=-20.0,
            upper_deg=30.0,
            stop_lower_deg=-30.0,
            stop_upper_deg=40.0,
            bandwidth_scale=0.8,
            backlash_deg=0.6,
            deadband_deg=0.4,
            friction_deg=0.1,
        ),
    )

    def test_the_tightest_limit_counts(self) -> None:
        assert self.servo.rates_deg_s == (85.0, 80.0)
        assert self.servo.stops_deg == (-15.0, 20.0)

    def test_play_is_half_of_every_full_width_and_all_of_the_friction(self) -> None:
        assert self.servo.physics.loose_deg == pytest.approx(0.3 + 0.2 + 0.1)

    def test_slower_and_weaker_change_what_they_say(self) -> None:
        assert self.servo.slower(0.5).physics == self.servo.physics._replace(bandwidth_scale=0.4)
        weak = self.servo.weaker(0.1).physics
        assert (weak.rate_up_deg_s, weak.rate_down_deg_s, weak.set_point_deg_s) == pytest.approx((81.0, 72.0, 76.5))
        assert weak.follow_up_deg_s == np.inf

    def test_it_begins_where_its_command_wants_it_or_where_it_was_measured(self) -> None:
        calm = ServoModel(KNOWN.transfer, Physics(gain=0.5, bias_deg=1.0))
        for start_deg, expected_deg in ((np.nan, 0.5 * 6.0 + 1.0), (-2.0, -2.0)):
            motion = Motion(calm, start_deg)
            motion.receive(np.array([0.0, 0.5]), np.array([6.0, 9.0]), np.zeros(2))
            np.testing.assert_allclose(motion.at(np.array([0.0]))[0], expected_deg, atol=1e-9)
        assert Motion(calm).at(np.zeros(1))[0] == 0.0

    def test_an_output_follows_no_faster_than_its_two_rates(self) -> None:
        physics = Physics(follow_up_deg_s=100.0, follow_down_deg_s=50.0)
        motion = Motion(ServoModel(KNOWN.transfer, physics), 0.0)
        motion.receive(np.array([0.0, 1.0]), np.array([20.0, 0.0]), np.zeros(2))
        position_deg = motion.at(np.arange(251) / 100.0)
        rates_deg_s = np.diff(position_deg) * 100.0
        assert (rates_deg_s.max(), rates_deg_s.min()) == pytest.approx((100.0, -50.0), rel=1e-6)
        assert position_deg[[100, 250]] == pytest.approx([20.0, 0.0], abs=1e-3)

    def test_frames_carry_the_command_in_force_when_they_begin(self) -> None:
        """Frames at 0.1, 0.3, 0.5 s: a ramp of 10 deg/s is heard as 1, 3 and 5 deg."""
        framed = Motion(ServoModel(KNOWN.transfer, Physics(frame_s=0.2, frame_phase=0.5)), 0.0)
        framed.receive(np.zeros(1), np.zeros(1), np.full(1, 10.0))
        held = Motion(ServoModel(KNOWN.transfer, Physics()), 0.0)
        held.receive(np.array([0.1, 0.3, 0.5]), np.array([1.0, 3.0, 5.0]), np.zeros(3))
        at_s = np.arange(0.0, 0.7, 0.01)
        np.testing.assert_allclose(framed.at(at_s), held.at(at_s), atol=1e-9)


def test_scaled_damping_keeps_the_frequency_of_the_fast_pair() -> None:
    """Thesis Eq. 3.1: (s + 24.84)(s^2 + 70.04 s + 4921), of which the pair rings at 70.15 rad/s."""
    transfer = TransferFunction((122300.0,), tuple(np.polymul([1.0, 24.84], [1.0, 70.04, 4921.0])))
    damped = scaled(transfer, Scales(damping=0.5))
    np.testing.assert_allclose(damped.denominator, np.polymul([1.0, 24.84], [1.0, 35.02, 4921.0]), rtol=1e-9)
    both = scaled(transfer, Scales(damping=0.5, bandwidth=2.0))
    np.testing.assert_allclose(both.poles_rad_s, 2.0 * damped.poles_rad_s, rtol=1e-9)
    assert damped.dc_gain == pytest.approx(both.dc_gain) == pytest.approx(transfer.dc_gain)
    real = scaled(TransferFunction((6.0,), (1.0, 6.0, 11.0, 6.0)), Scales(damping=2.0))
    np.testing.assert_allclose(real.denominator, np.polymul([1.0, 1.0], [1.0, 10.0, 6.0]), rtol=1e-9)


def test_the_loop_has_the_poles_of_its_servo() -> None:
    loop = loop_of(KNOWN.transfer, Scales())
    states, inputs = loop.a.reshape(3, 3), loop.b.reshape(3, 3)
    np.testing.assert_allclose(np.poly(states), np.array(KNOWN.transfer.denominator), rtol=1e-9)
    # At rest, a constant deceleration is balanced by the error that it is worth.
    resting = np.linalg.solve(states, -(inputs[:, 2] * loop.per_error))
    assert resting[0] == pytest.approx(1.0)


def test_what_is_linear_needs_no_substeps() -> None:
    def is_linear(physics: Physics) -> bool:
        return not machine_of(KNOWN.transfer, (physics,)).acts[-1]

    linear = (Physics(), Physics(bandwidth_scale=0.5, delay_s=0.1), Physics(bias_deg=1.0, lower_deg=-3.0))
    assert all(map(is_linear, linear))
    for name in ("deadband_deg", "insensitive_deg", "friction_deg", "load_friction", "airload_per_pa", "lag_s"):
        assert not is_linear(Physics(**{name: 0.1}))
    for name in ("rate_up_deg_s", "rate_down_deg_s", "deg_s_per_v", "knee_deg", "stop_upper_deg", "set_point_deg_s"):
        assert not is_linear(Physics(**{name: 9.0}))


def test_a_model_says_which_context_its_effects_depend_on() -> None:
    needs = {name: extended(name, size).physics.needs for name, size in SIZES.items()}
    assert {name for name, need in needs.items() if need} == {
        "airload",
        "voltage_rate",
        "supply_coupling",
        "external_load",
    }
    for effect in catalogue():
        assert needs[effect.name] == set(effect.needs)


@pytest.mark.parametrize(("name", "size"), CASES.values(), ids=CASES)
def test_the_audit_simulates_what_was_fitted(name: str, size: dict[str, float | str]) -> None:
    segment = Series("x", TIME_S, COMMAND_DEG, TIME_S, np.full(TIME_S.size, 1.0), context=CONTEXT)
    record = record_of(segment, KNOWN)
    fitted = simulate(record, effects_installed(record.model.physics, {name: size}))
    model = extended(name, size)
    motion = Motion(model.servo(CONTEXT), 1.0)
    motion.receive(record.commands.effective_s + model.delay_s, record.commands.command_deg, np.zeros(TIME_S.size))
    # Poles that are scaled are another transfer function here, and scaled matrices there.
    assert np.abs(motion.at(TIME_S) - fitted).max() < 1e-6


def audited(log: Hidden, effects: dict[str, dict[str, float]], folder: Path, **changes: object) -> SurfaceAudit:
    path = log.write(folder / "log.csv")
    surface: dict[str, object] = {
        "servo": "hs225bb-eq31",
        "command": {"channel": "elevator_cmd_deg", "unit": "deg"},
        "measured": {"channel": "elevator_pos_deg", "unit": "deg"},
        "effects": effects,
        **changes,
    }
    aircraft = Aircraft.model_validate({"surfaces": {"elevator": surface}})
    return audit_log(logparsers.read(path), aircraft).surfaces[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("servo", "effects"),
    [
        (FineServo(backlash_deg=1.2), {"backlash": {"width_deg": 1.2}}),
        (FineServo(deadband_deg=1.2), {"deadband": {"width_deg": 1.2}}),
        (FineServo(friction_deg=0.6), {"friction": {"friction_deg": 0.6, "torque_share": 0.65}}),
        (FineServo(airload=6e-4), {"airload": {"deg_per_deg_pa": 6e-4, "torque_share": 0.65}}),
        (FineServo(deg_s_per_v=5.0), {"voltage_rate": {"deg_s_per_v": 5.0}}),
        (FineServo(lag_s=0.03, gain=0.9), {"sensor_lag": {"time_constant_s": 0.03}, "gain": {"gain": 0.9}}),
    ],
    ids=lambda value: "+".join(value) if isinstance(value, dict) else "",
)
def test_the_residual_of_a_servo_with_its_effects_is_noise(
    servo: FineServo, effects: dict[str, dict[str, float]], tmp_path: Path
) -> None:
    log = hide(servo, duration_s=12.0)
    without = audited(log, {}, tmp_path)
    found = audited(log, effects, tmp_path, threshold="interval")
    assert found.status == "healthy", found.reason
    assert found.statistics is not None
    assert without.statistics is not None
    # Noise of 0.1 deg passes the filter with a gain of 0.42.
    assert found.statistics.std_deg < 0.045
    assert without.statistics.std_deg > 0.09


def broken(log: Hidden, position_deg: FloatArray) -> Hidden:
    return Hidden(log.time_s, log.command_deg, position_deg, log.airspeed_m_s, log.supply_v)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "kind"),
    [
        (Bias(8.0, bias_deg=1.0), "bias"),
        (Stuck(8.0), "stuck"),
        (HardOver(8.0, -20.0), "hardover"),
        (Slow(8.0, bandwidth_scale=0.3), "slow"),
        (LossOfEffectiveness(8.0, gain=0.5), "loss_of_effectiveness"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_simulated_faults_of_a_servo_with_effects_are_named(fault: Failure, kind: str) -> None:
    entry = {
        "servo": "hs225bb-eq31",
        "command": {"channel": "c", "unit": "deg"},
        "measured": {"channel": "p", "unit": "deg"},
        "threshold": "interval",
        "effects": {"backlash": {"width_deg": 0.8}, "friction": {"friction_deg": 0.3}},
    }
    aircraft = Aircraft.model_validate({"surfaces": {"elevator": entry}})
    flown = simulate_flight(aircraft, command="gusty", duration_s=24.0, seed=4, faults={"elevator": fault})
    segment = Series("elevator", flown.time_s, flown.command_deg[:, 0], flown.time_s, flown.measured_deg[:, 0])
    found = Healthy(aircraft.surfaces["elevator"], aircraft.model("elevator")).beside(segment).found
    assert [each.kind for each in found.faults][:1] == [kind]
    assert found.faults[0].start_s == pytest.approx(8.0, abs=1.5)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["bias", "stuck", "loss_of_effectiveness"])
def test_faults_of_a_servo_with_backlash_are_named(kind: str, tmp_path: Path) -> None:
    log = hide(FineServo(backlash_deg=1.2), duration_s=30.0)
    ill = log.time_s >= 12.0
    noise = 0.1 * np.random.default_rng(8).standard_normal(log.time_s.size)
    wrong = {
        "bias": log.position_deg + 1.5,
        "stuck": log.position_deg[np.argmax(ill)] + noise,
        "loss_of_effectiveness": 0.5 * log.position_deg,
    }[kind]
    found = audited(
        broken(log, np.where(ill, wrong, log.position_deg)),
        {"backlash": {"width_deg": 1.2}},
        tmp_path,
        threshold="interval",
    )
    assert [fault.kind for fault in found.faults] == [kind]
    assert found.faults[0].start_s == pytest.approx(12.0, abs=1.0)


@pytest.mark.slow
def test_an_effect_without_its_signal_is_left_out_and_said(tmp_path: Path) -> None:
    log = hide(FineServo(airload=6e-4), duration_s=12.0)
    path = log.write(tmp_path / "log.csv")
    rows = [",".join(line.split(",")[:3]) for line in path.read_text().splitlines()]
    path.write_text("\n".join(rows) + "\n")
    (tmp_path / "a.toml").write_text(
        '[surfaces.elevator]\nservo = "hs225bb-eq31"\ncommand = { channel = "elevator_cmd_deg", unit = "deg" }\n'
        'measured = { channel = "elevator_pos_deg", unit = "deg" }\n'
        "[surfaces.elevator.effects]\nairload = { deg_per_deg_pa = 6e-4 }\nvoltage_rate = { deg_s_per_v = 60.0 }\n"
    )
    found = audit_log(logparsers.read(path), load_aircraft(tmp_path / "a.toml")).surfaces[0]
    assert "no airspeed: the load of the air is left out" in found.reason
    assert "no supply voltage: the rate that it limits is left out" in found.reason
    assert found.statistics is not None
    assert found.statistics.std_deg > 0.2


@pytest.mark.parametrize(
    ("effects", "reason"),
    [
        ("backlsh = { width_deg = 1.0 }", "did you mean backlash?"),
        ("backlash = { width = 1.0 }", "unknown parameter 'width'; did you mean width_deg?"),
        ("backlash = {}", "effects.backlash.width_deg: give it too, a number from"),
        ("backlash = { width_deg = 99.0 }", "must lie between 0 and 8, not 99"),
        ("backlash = { width_deg = nan }", "must be a number from 0 to 8, not nan"),
        ('rate_limit = { form = "motr", rate_limit_deg_s = 60.0 }', "unknown form 'motr'; did you mean motor"),
        ("position_limit = { lower_deg = 0.0, upper_deg = 0.0 }", "lower_deg must be below upper_deg"),
    ],
)
def test_wrong_effects_are_refused_at_the_door(effects: str, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text(
        '[surfaces.elevator]\nservo = "s9254"\ncommand = { channel = "c", unit = "deg" }\n'
        f"[surfaces.elevator.effects]\n{effects}"
    )
    with pytest.raises(ConfigError, match="elevator") as error:
        load_aircraft(path)
    assert reason in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    "effects",
    [{"backlash": {"width_deg": 0.8}}, pytest.param({"pwm_frame": {"period_s": 0.02}}, marks=pytest.mark.nightly)],
    ids=str,
)
def test_a_monitor_in_flight_sees_what_the_audit_sees(effects: dict[str, dict[str, float]]) -> None:
    log = hide(FineServo(backlash_deg=0.8), duration_s=12.0)
    known = {"servo": "hs225bb-eq31", "command": {"channel": "c", "unit": "deg"}, "threshold": "interval"}
    surface = Aircraft.model_validate({"surfaces": {"x": {**known, "effects": effects}}})
    segment = Series("x", log.time_s, log.command_deg, log.time_s, log.position_deg)
    healthy = Healthy(surface.surfaces["x"], surface.model("x"))
    stream = healthy.stream(Pace(segment.period_s, log.time_s[:101], None))
    pieces = []
    for k, (time_s, position_deg) in enumerate(zip(log.time_s.tolist(), log.position_deg.tolist(), strict=True)):
        stream.commands(log.time_s[k : k + 1], log.command_deg[k : k + 1])
        stream.position(time_s, position_deg)
        pieces.append(stream.evaluate())
    pieces.append(stream.evaluate(final=True))
    seen = [piece for piece in pieces if piece is not None]
    expected = healthy.beside(segment)
    residual_deg = np.concatenate([piece.residuals.residual_deg for piece in seen])
    level_deg = np.concatenate([piece.threshold.level_deg for piece in seen])
    assert residual_deg.size == log.time_s.size
    np.testing.assert_allclose(residual_deg, expected.residuals.residual_deg, atol=1e-9)
    np.testing.assert_allclose(level_deg, expected.threshold.level_deg, rtol=1e-9)
