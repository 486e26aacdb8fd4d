"""A servo that changes in flight is judged by what it was at first, and a late bus is no servo's fault."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from logparsers.records import Channel, FlightLog
from servofd.aircraft.schema import plain_aircraft
from servofd.aircraft.series import Series
from servofd.detection.audit import audit_log
from servofd.detection.own import OwnServo, own_servo
from servofd.feedback.fitted import fitted_aircraft
from servofd.servo.effects.commands import Delay
from servofd.servo.effects.linkage import RateLimit
from servofd.servo.library import library, second_order
from servofd.servo.servo_model import ServoModel
from servofd.simulation.commands import doublets

if TYPE_CHECKING:
    from servofd.core.types import FloatArray
    from servofd.detection.verdict import SurfaceAudit

TIME_S = np.arange(0.0, 90.0, 0.02)


def servo(bandwidth_hz: float, damping: float = 0.8, delay_s: float = 0.03) -> ServoModel:
    return ServoModel(second_order(2.0 * np.pi * bandwidth_hz, damping)) + Delay(delay_s)


AT_FIRST = servo(6.0)


def commands(seed: int) -> FloatArray:
    return doublets(TIME_S, np.random.default_rng(seed))


def own(command_deg: FloatArray, position_deg: FloatArray) -> OwnServo:
    found = own_servo(Series("x", TIME_S, command_deg, TIME_S, position_deg))
    assert isinstance(found, OwnServo)
    return found


def lag_s(found: OwnServo) -> float:
    """What a slow command suffers: bandwidth, damping and delay are each known less well."""
    known = found.known.parameters
    return known["delay_s"] + 2.0 * float(np.exp(known["ln_damping"] - known["ln_bandwidth"]))


def read(position_deg: FloatArray, seed: int) -> FloatArray:
    """As a potentiometer reads it."""
    return np.round(position_deg + 0.05 * np.random.default_rng([seed, 1]).normal(size=TIME_S.size), 3)


def fitted_verdict(command_deg: FloatArray, position_deg: FloatArray) -> SurfaceAudit:
    channels = {
        "x_cmd_deg": Channel("x_cmd_deg", TIME_S, command_deg, "deg", ""),
        "x_pos_deg": Channel("x_pos_deg", TIME_S, position_deg, "deg", ""),
    }
    log = FlightLog(Path("x.csv"), "table", channels)
    return audit_log(log, fitted_aircraft(log, plain_aircraft(["x"])), threads=1).surfaces[0]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [pytest.param(0, marks=pytest.mark.nightly), 2])
def test_a_servo_that_becomes_slow_is_fitted_as_it_was_and_named_from_when_it_changed(seed: int) -> None:
    command_deg, from_s = commands(seed), 40.0
    before, after = (model.simulate(TIME_S, command_deg, TIME_S) for model in (AT_FIRST, servo(2.0)))
    position_deg = read(np.where(from_s <= TIME_S, after, before), seed)
    found = own(command_deg, position_deg)
    assert found.origin.fitted_between_s is not None
    assert found.origin.fitted_between_s[1] <= from_s + 1.0
    assert lag_s(found) == pytest.approx(0.03 - float(np.sum(1.0 / AT_FIRST.transfer.poles_rad_s).real), abs=0.004)
    verdict = fitted_verdict(command_deg, position_deg)
    seen = verdict.faults + verdict.suspicions
    assert "slow" in {fault.kind for fault in seen}
    assert min(fault.start_s for fault in seen) == pytest.approx(from_s, abs=5.0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [pytest.param(0, marks=pytest.mark.nightly), 2])
def test_an_oscillation_that_the_autopilot_answers_does_not_become_the_servos_resonance(seed: int) -> None:
    """In a closed loop the command leads the oscillation by a quarter of a period, as if it had caused it."""
    from_s, frequency_hz = 45.0, 3.0
    broken = from_s <= TIME_S
    turn = 2.0 * np.pi * frequency_hz * (TIME_S - from_s)
    command_deg = 0.3 * commands(seed) + np.where(broken, 2.0 * np.cos(turn), 0.0)
    answered = AT_FIRST.simulate(TIME_S, command_deg, TIME_S)
    verdict = fitted_verdict(command_deg, read(answered + np.where(broken, 3.5 * np.sin(turn), 0.0), seed))
    assert verdict.status == "fault"
    assert verdict.faults[0].kind == "oscillation"
    assert verdict.faults[0].start_s == pytest.approx(from_s, abs=2.0)
    assert verdict.faults[0].parameters["frequency_hz"].value == pytest.approx(frequency_hz, abs=0.2)


@pytest.mark.slow
def test_a_servo_that_stays_as_it_is_is_healthy() -> None:
    slow = servo(3.0, 1.5, 0.05) + RateLimit(150.0)
    for seed, model in enumerate((AT_FIRST, slow)):
        command_deg = commands(seed)
        verdict = fitted_verdict(command_deg, read(model.simulate(TIME_S, command_deg, TIME_S), seed))
        assert verdict.status == "healthy"
        assert verdict.model.origin == "fitted"


@pytest.mark.slow
def test_a_bus_that_is_late_for_a_fifth_of_a_second_makes_nothing_suspicious() -> None:
    seed = 4
    command_deg = commands(seed)
    position_deg = read(AT_FIRST.simulate(TIME_S, command_deg, TIME_S), seed)
    held = position_deg.copy()
    for first in np.random.default_rng(seed).integers(100, TIME_S.size - 100, 12).tolist():
        held[first : first + 10] = held[first]
    assert fitted_verdict(command_deg, held).status == "healthy"


@pytest.mark.slow
def test_a_surface_that_rests_within_a_small_travel_is_no_surface_at_its_stop() -> None:
    seed = 6
    command_deg = 0.25 * commands(seed)
    position_deg = AT_FIRST.simulate(TIME_S, command_deg, TIME_S)
    rests = TIME_S > 50.0
    at_deg = float(position_deg[~rests].max())
    asked_deg = np.where(rests, command_deg + 6.0 * np.sin(0.5 * TIME_S), command_deg)
    verdict = fitted_verdict(asked_deg, read(np.where(rests, at_deg, position_deg), seed))
    assert verdict.status == "fault"
    assert verdict.faults[0].kind in ("stuck", "hardover")


@pytest.mark.slow
@pytest.mark.parametrize("origin", ["fitted", "named"])
def test_nothing_below_a_step_of_the_command_is_named(origin: str) -> None:
    """The servo hears the command before it was rounded to whole microseconds, 0.18 deg each."""
    step_deg = 0.18
    for seed, (name, servo) in enumerate(sorted(library().items())):
        if seed % 4:
            continue
        command_deg = commands(seed)
        moved = ServoModel.of(servo).simulate(TIME_S, command_deg, TIME_S)
        logged_deg = np.round(command_deg / step_deg) * step_deg
        if origin == "fitted":
            verdict = fitted_verdict(logged_deg, read(moved, seed))
        else:
            channels = {
                "x_cmd_deg": Channel("x_cmd_deg", TIME_S, logged_deg, "deg", ""),
                "x_pos_deg": Channel("x_pos_deg", TIME_S, read(moved, seed), "deg", ""),
            }
            verdict = audit_log(FlightLog(Path("x.csv"), "table", channels), plain_aircraft(["x"], name)).surfaces[0]
        assert not verdict.faults + verdict.suspicions, (name, verdict.reason)
