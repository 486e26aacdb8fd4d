"""The search goes past what stands in for the truth: small minima, early finds, and the first of each kind."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hidden_effects import Case, judge
from hidden_logs import SURFACE, write
from hidden_physics import Effects, draw, hidden
from hidden_score import ask, score
from servofd.aircraft.series import Series
from servofd.discrepancy.record import Record, record_of, simulate
from servofd.servo.catalogue import installed
from servofd.servo.effect import Effect
from servofd.servo.effects.motor import CurrentLimit, MotorRate
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel
from servofd.simulation.commands import COMMANDS

KNOWN = ServoModel.of(servo_named("hs225bb-eq31"))
NOISE_DEG = 0.1


def swept(effects: tuple[type[Effect], ...], values: list[float], seed: int) -> Record:
    """A servo with effects in a chirp of one amplitude, simulated by the kernel."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, 60.0, 0.01)
    command_deg = COMMANDS["chirp"](time_s, rng)
    empty = record_of(Series("x", time_s, command_deg, time_s, 0.0 * time_s), KNOWN)
    moved_deg = simulate(empty, installed(empty.model.physics, effects, values))
    return replace(empty, measured_deg=moved_deg + NOISE_DEG * rng.standard_normal(time_s.size))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("names", "seed"),
    [
        pytest.param(("resonance", "rate_limit"), 102, marks=pytest.mark.nightly),
        pytest.param(("delay", "rate_limit", "deadband"), 102, marks=pytest.mark.nightly),
        pytest.param(("delay", "rate_limit", "backlash"), 101, marks=pytest.mark.nightly),
        pytest.param(("airload", "friction", "delay"), 103, marks=pytest.mark.nightly),
    ],
)
def test_several_effects_are_told_in_a_chirp_of_one_amplitude(
    names: tuple[str, ...], seed: int, tmp_path: Path
) -> None:
    lot = np.random.default_rng([seed, *(ord(letter) for name in names for letter in name)])
    effects = {name: draw(lot, name, "medium") for name in names}
    log = write(hidden(seed, effects, "chirp", NOISE_DEG), tmp_path / "log.csv")
    one = score(ask(log, SURFACE).said, effects, NOISE_DEG)
    assert one.in_set
    assert not one.extra
    assert one.conclusion == "explained"


@pytest.mark.nightly
def test_a_stop_that_is_never_reached_is_not_hidden() -> None:
    one = judge(Case("pair", ("position_limit", "backlash"), "medium", "chirp", 0.1, 101))
    assert one.score.hidden == ("backlash",)
    assert one.score.first
    assert not one.fair
    assert not one.silently_wrong


@pytest.mark.nightly
def test_a_fault_that_is_told_is_not_silent() -> None:
    one = judge(Case("outside", ("pot_spot",), "medium", "flight", 0.1, 83))
    assert one.score.fault
    assert not one.score.named
    assert not one.silently_wrong


def test_an_effect_near_the_lower_end_of_decades_is_an_answer() -> None:
    """A knee of 1 deg lies well above its bound of 0.3 deg, however far the upper one is."""
    (knee,) = CurrentLimit.parameters
    assert not knee.at_bound(1.05)
    assert knee.at_bound(0.31)
    (limit,) = MotorRate.parameters[:1]
    assert not limit.at_bound(4.0)
    assert limit.at_bound(2.1)


@pytest.mark.nightly
def test_a_knee_of_one_degree_is_found(tmp_path: Path) -> None:
    effects: Effects = {"current_limit": {"knee_deg": 1.05}}
    log = write(hidden(301, effects, "sweep", NOISE_DEG), tmp_path / "log.csv")
    assert score(ask(log, SURFACE).said, effects, NOISE_DEG).first


@pytest.mark.slow
def test_what_steady_air_cannot_tell_is_said(tmp_path: Path) -> None:
    """A load that grows with the deflection, or with its sine: within 10 deg they differ by a hundredth."""
    effects: Effects = {"airload": {"deg_per_deg_pa": 0.00194}}
    log = write(hidden(301, effects, "sweep", NOISE_DEG), tmp_path / "log.csv")
    one = score(ask(log, SURFACE).said, effects, NOISE_DEG)
    assert one.in_set
    assert one.set_size <= 2.0
