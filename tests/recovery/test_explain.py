"""What a simulator that is not the kernel hides in a servo comes out again, by name and size; and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servofd.aircraft.series import Series
from servofd.discrepancy.explanation import Explanation, explain_gap
from servofd.discrepancy.locate import bad_seconds, blocks
from servofd.discrepancy.record import comb_step_deg, record_of, simulate
from servofd.servo.context import Context
from servofd.servo.library import library, servo_named
from servofd.servo.servo_model import ServoModel
from servofd.simulation.commands import COMMANDS
from tests.recovery.fine_servo import FineServo, Hidden, hide

KNOWN = ServoModel.of(servo_named("hs225bb-eq31"))


def explained(log: Hidden, *, context: bool = True) -> Explanation:
    segment = Series("elevator", log.time_s, log.command_deg, log.time_s, log.position_deg)
    there = Context(airspeed_s=log.time_s, airspeed_m_s=log.airspeed_m_s, voltage_s=log.time_s, voltage_v=log.supply_v)
    return explain_gap(replace(segment, context=there) if context else segment, KNOWN)


def assert_named(found: Explanation, name: str, value: float, within: float) -> None:
    document = found.document()
    assert found.conclusion == "explained", document["steps"]
    step = document["steps"][0]
    assert step["effect"] == name
    first = next(iter(step["parameters"].values()))
    assert first["value"] == pytest.approx(value, abs=within)
    assert first["low"] <= first["value"] <= first["high"]
    assert document["final"]["held_out_rms_deg"] < 1.06 * document["noise_floor_rms_deg"]
    assert all(rival["held_out_rms_deg"] >= 0.99 * step["held_out_rms_deg"] for rival in step["rivals"])


@pytest.mark.parametrize("name", library())
def test_without_effects_it_is_the_linear_servo(name: str) -> None:
    rng = np.random.default_rng(0)
    time_s = np.cumsum(rng.uniform(0.007, 0.013, 1500))
    command_deg = 6.0 * np.sin(time_s) + 2.0 * np.sin(17.0 * time_s)
    model = ServoModel.of(servo_named(name)).linear()
    expected = model.simulate(time_s, command_deg, time_s)
    segment = Series("x", time_s, command_deg, time_s, np.full(time_s.size, expected[0]))
    record = record_of(segment, model)
    moved = simulate(record, record.model.physics)
    assert np.abs(moved - expected).max() < 1e-6


@pytest.mark.parametrize(
    "change",
    [
        {"rate_up_deg_s": 60.0, "rate_down_deg_s": 60.0},
        {"friction_deg": 0.4},
        {"deadband_deg": 1.0},
        {"backlash_deg": 0.8},
        {"resonance_hz": 9.0, "resonance_damping": 0.1},
        {"lag_s": 0.02},
    ],
)
def test_shorter_steps_change_nothing(change: dict[str, float]) -> None:
    time_s = np.arange(0.0, 20.0, 0.01)
    command_deg = 8.0 * np.sign(np.sin(1.3 * time_s)) + 2.0 * np.sin(5.0 * time_s)
    record = record_of(Series("x", time_s, command_deg, time_s, np.full(time_s.size, 8.0)), KNOWN.linear())
    coarse = simulate(record, record.model.physics._replace(**change))
    fine = simulate(record, record.model.physics._replace(**change), 16.0)
    assert np.abs(coarse - fine)[record.counts].max() < 0.03
    assert np.sqrt(np.mean((coarse - fine)[record.counts] ** 2)) < 0.005


def test_a_rate_limit_is_the_largest_speed() -> None:
    time_s = np.arange(0.0, 4.0, 0.01)
    command_deg = np.where(time_s < 1.0, 0.0, 40.0)
    record = record_of(Series("x", time_s, command_deg, time_s, np.zeros(time_s.size)), KNOWN.linear())
    moved = simulate(record, record.model.physics._replace(rate_up_deg_s=100.0))
    steady = (time_s > 1.15) & (time_s < 1.3)
    assert np.polyfit(time_s[steady], moved[steady], 1)[0] == pytest.approx(100.0, rel=2e-3)
    assert moved[-1] == pytest.approx(40.0, abs=1e-6)


@pytest.mark.nightly
def test_a_rate_limit_is_named_in_a_chirp() -> None:
    found = explained(hide(FineServo(rate_deg_s=50.0), "chirp"), context=False)
    assert_named(found, "rate_limit", 50.0, 1.0)
    assert any("cannot be judged: airload, voltage_rate" in note for note in found.notes)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.nightly)])
def test_nothing_is_missing_from_a_healthy_servo(seed: int) -> None:
    found = explained(hide(FineServo(), seed=seed))
    assert found.conclusion == "nothing_missing"
    assert bad_seconds(found.record, found.selection.nominal.error_deg, found.selection.sigma_deg) == ()
    assert found.where[0].startswith("nowhere")


@pytest.mark.slow
def test_lost_rows_and_jitter_are_no_effect() -> None:
    rng = np.random.default_rng(5)
    log = hide(FineServo(), "gusty", seed=4)
    kept = rng.random(log.time_s.size) > 0.03
    parts = [values[kept] for values in (log.time_s, log.command_deg, log.position_deg)]
    parts[0] = parts[0] + 0.001 * rng.uniform(-1.0, 1.0, kept.sum())
    segment = Series("elevator", parts[0], parts[1], parts[0], parts[2])
    assert explain_gap(segment, KNOWN).conclusion == "nothing_missing"


@pytest.mark.slow
def test_a_fault_in_the_middle_is_no_missing_effect() -> None:
    log = hide(FineServo(), "gusty", seed=3)
    stuck = np.where(log.time_s > 18.0, log.position_deg[1800], log.position_deg)
    stuck[log.time_s > 18.0] += 0.1 * np.random.default_rng(0).standard_normal(int((log.time_s > 18.0).sum()))
    found = explained(replace(log, position_deg=stuck))
    assert found.conclusion == "unexplained"
    assert found.fault_s == pytest.approx(18.0, abs=0.5)
    assert found.selection.final.names == ()
    assert found.answer.startswith("FAULT from")
    assert "the position does not follow its command" in found.notes[0]


@pytest.mark.slow
@pytest.mark.parametrize("command", ["gusty", pytest.param("chirp", marks=pytest.mark.nightly)])
@pytest.mark.parametrize(
    ("servo", "name", "value", "within"),
    [
        pytest.param(FineServo(delay_s=0.03), "delay", 0.03, 4e-4, marks=pytest.mark.nightly),
        pytest.param(FineServo(slow=0.75), "slow_dynamics", 0.75, 0.01, marks=pytest.mark.nightly),
        pytest.param(FineServo(deadband_deg=1.2), "deadband", 1.2, 0.05, marks=pytest.mark.nightly),
        pytest.param(FineServo(backlash_deg=0.8), "backlash", 0.8, 0.03, marks=pytest.mark.nightly),
        (FineServo(friction_deg=0.5), "friction", 0.5, 0.03),
        pytest.param(FineServo(gain=0.9), "gain", 0.9, 0.005, marks=pytest.mark.nightly),
        pytest.param(FineServo(bias_deg=0.5), "bias", 0.5, 0.02, marks=pytest.mark.nightly),
        pytest.param(FineServo(airload=8e-4), "airload", 8e-4, 5e-5, marks=pytest.mark.nightly),
        pytest.param(FineServo(deg_s_per_v=7.0), "voltage_rate", 7.0, 0.15, marks=pytest.mark.nightly),
        pytest.param(FineServo(lag_s=0.025), "sensor_lag", 0.025, 1.5e-3, marks=pytest.mark.nightly),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_single_effects(servo: FineServo, name: str, value: float, within: float, command: str) -> None:
    assert_named(explained(hide(servo, command, duration_s=60.0)), name, value, within)


@pytest.mark.slow
def test_stops_are_named_where_they_are_reached() -> None:
    assert_named(
        explained(hide(FineServo(lower_deg=-5.0, upper_deg=5.0), duration_s=20.0)), "position_limit", -5.0, 0.05
    )


@pytest.mark.nightly
def test_two_effects_are_both_named() -> None:
    found = explained(hide(FineServo(rate_deg_s=50.0, backlash_deg=0.8), duration_s=60.0))
    assert set(found.selection.final.names) == {"rate_limit", "backlash"}
    assert found.conclusion == "explained"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, *(pytest.param(k, marks=pytest.mark.nightly) for k in (0, *range(2, 12)))])
def test_healthy_servos_at_several_noises(seed: int) -> None:
    command = ("gusty", "chirp", "doublets", "flight")[seed % 4]
    found = explained(hide(FineServo(), command, seed=seed, noise_deg=(0.05, 0.1, 0.2)[seed % 3]))
    assert found.conclusion == "nothing_missing"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.nightly)])
def test_what_no_model_contains_is_not_explained(seed: int) -> None:
    found = explained(hide(FineServo(cyclic_deg=0.5), seed=seed, duration_s=60.0))
    assert found.conclusion in ("unexplained", "partly_explained")


def test_seconds_of_a_healthy_servo_are_not_bad_and_those_of_a_slow_one_are() -> None:
    healthy, slow = (hide(FineServo(rate_deg_s=rate), seed=6, noise_deg=0.1) for rate in (np.inf, 40.0))
    for log, least, most in ((healthy, 0, 0), (slow, 5, 30)):
        segment = Series("elevator", log.time_s, log.command_deg, log.time_s, log.position_deg)
        record = record_of(segment, KNOWN)
        error_deg = record.measured_deg - simulate(record, record.model.physics)
        found = blocks(record, error_deg, 0.1)
        bad = [block for block in found if block.bad]
        assert least <= len(bad) <= most
        assert all(block.rms_deg > 0.1 for block in bad)
        assert all(block.end_s == block.start_s + 1.0 for block in found)


def test_an_interval_in_which_a_lost_row_may_hide_does_not_count() -> None:
    time_s = np.arange(0.0, 10.0, 0.01) + 0.002 * np.random.default_rng(7).uniform(-1.0, 1.0, 1000)
    time_s[499] += 0.0025
    time_s = np.delete(time_s, 500)
    time_s[500] = time_s[499] + 0.0155
    command_deg = 5.0 * np.sin(30.0 * time_s)
    record = record_of(Series("elevator", time_s, command_deg, time_s, np.zeros(time_s.size)), KNOWN)
    since_s = time_s - time_s[500]
    assert not record.counts[(since_s >= 0.0) & (since_s < 0.15)].any()
    assert record.counts[(since_s > 0.2) & (since_s < 4.0)].all()


@pytest.mark.slow
def test_the_steps_of_a_converter_are_seen_and_named() -> None:
    log = hide(FineServo(), seed=8, noise_deg=0.05)
    coarse = replace(log, position_deg=0.7 * np.round(log.position_deg / 0.7))
    found = explained(coarse)
    assert found.selection.final.names == ("quantization",)
    assert found.selection.final.values[0] == pytest.approx(0.7, abs=1e-3)
    assert comb_step_deg(log.position_deg) is None


def jammed(log: Hidden, from_s: float, until_s: float) -> Hidden:
    there = (log.time_s >= from_s) & (log.time_s < until_s)
    noise = 0.1 * np.random.default_rng(0).standard_normal(log.time_s.size)
    return replace(log, position_deg=np.where(there, log.position_deg[np.argmax(there)] + noise, log.position_deg))


@pytest.mark.slow
@pytest.mark.parametrize(
    "command", ["gusty", *(pytest.param(each, marks=pytest.mark.nightly) for each in ("doublets", "chirp"))]
)
@pytest.mark.parametrize(
    ("noise_deg", "step_deg"),
    [
        pytest.param(0.02, 0.3, marks=pytest.mark.nightly),
        pytest.param(0.05, 0.3, marks=pytest.mark.nightly),
        pytest.param(0.05, 0.8, marks=pytest.mark.nightly),
        pytest.param(0.2, 2.0, marks=pytest.mark.nightly),
    ],
)
def test_coarse_steps_are_told_by_the_readings_alone(command: str, noise_deg: float, step_deg: float) -> None:
    """At rest for most of the time, fast, fine or swamped by noise: the comb of the readings is the proof."""
    time_s = np.arange(0.0, 60.0, 0.01)
    model = ServoModel.of(servo_named("hs225bb-eq31"))
    command_deg = COMMANDS[command](time_s, np.random.default_rng(5))
    record = record_of(Series("x", time_s, command_deg, time_s, 0.0 * time_s), model)
    moved_deg = simulate(record, record.model.physics)
    noisy_deg = moved_deg + noise_deg * np.random.default_rng(6).standard_normal(time_s.size)
    found = explain_gap(Series("x", time_s, command_deg, time_s, step_deg * np.round(noisy_deg / step_deg)), model)
    assert found.conclusion == "explained"
    assert found.selection.final.names == ("quantization",)
    assert found.selection.final.values[0] == pytest.approx(step_deg, rel=1e-3)


@pytest.mark.slow
def test_a_jam_that_passes_is_no_missing_effect() -> None:
    found = explained(jammed(hide(FineServo(), "gusty", seed=3), 12.0, 18.0))
    assert found.conclusion == "unexplained"
    assert found.fault_s == pytest.approx(12.0, abs=1.0)


@pytest.mark.nightly
def test_a_jam_stands_out_where_what_came_before_is_not_explained_either() -> None:
    log = hide(FineServo(), "gusty", seed=3, duration_s=40.0)
    spikes = np.random.default_rng(1)
    odd = np.where(spikes.random(log.time_s.size) < 0.01, spikes.normal(0.0, 2.0, log.time_s.size), 0.0)
    found = explained(jammed(replace(log, position_deg=log.position_deg + odd), 24.0, 32.0))
    assert found.conclusion in ("unexplained", "partly_explained")
    assert found.fault_s == pytest.approx(24.0, abs=1.5)


@pytest.mark.nightly
def test_a_drift_is_no_fault_that_sets_in() -> None:
    log = hide(FineServo(), "gusty", seed=3, duration_s=16.0)
    found = explained(replace(log, position_deg=log.position_deg + 1.5 * log.time_s / 16.0))
    assert found.fault_s is None
    assert found.conclusion == "partly_explained"


@pytest.mark.slow
def test_a_gain_that_a_slow_command_shows_is_no_drift() -> None:
    """Error and command rise along a line together: an offset that grows would not follow the command."""
    time_s = np.arange(0.0, 30.0, 0.02)
    command_deg = np.linspace(-20.0, 20.0, time_s.size) + np.sin(3.0 * time_s)
    noise_deg = np.random.default_rng(1).normal(0.0, 0.05, time_s.size)
    position_deg = 0.7 * KNOWN.simulate(time_s, command_deg, time_s) + noise_deg
    found = explain_gap(Series("rudder", time_s, command_deg, time_s, position_deg), KNOWN)
    assert found.conclusion == "explained"
    assert [effect.name for effect in found.selection.final.effects] == ["gain"]
