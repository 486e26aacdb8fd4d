"""Dead telemetry is neither a jam nor health."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from logparsers import Channel, FlightLog
from servofd.aircraft.schema import Aircraft
from servofd.core.types import BoolArray, FloatArray
from servofd.detection.audit import audit_log
from servofd.detection.verdict import SurfaceAudit
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel
from servofd.simulation.commands import flight

TIME_S = np.arange(3000) / 50.0
COMMAND_DEG = flight(TIME_S, np.random.default_rng(3))


def audited(dead: BoolArray, jammed: BoolArray) -> SurfaceAudit:
    """Audit of one servo whose telemetry dies, or whose shaft jams, in some rows."""
    rng = np.random.default_rng(0)
    position = ServoModel.of(servo_named("hs225bb-eq31")).simulate(TIME_S, COMMAND_DEG, TIME_S)
    volts = np.round(6.0 + 0.02 * rng.standard_normal(TIME_S.size), 2)
    position = np.round(position + 0.05 * rng.standard_normal(TIME_S.size), 2)
    if jammed.any():
        position[jammed] = position[np.flatnonzero(jammed)[0]]
    for values in (position, volts):
        if dead.any():
            values[dead] = values[np.flatnonzero(dead)[0]]
    channels = {name: made(name, v) for name, v in (("cmd", COMMAND_DEG), ("pos", position), ("volts", volts))}
    aircraft = Aircraft.model_validate(
        {
            "surfaces": {
                "elevator": {
                    "servo": "hs225bb-eq31",
                    "command": {"channel": "cmd", "unit": "deg"},
                    "measured": {"channel": "pos", "unit": "deg"},
                    "alive": ["volts"],
                }
            }
        }
    )
    return audit_log(FlightLog(Path("x"), "dataflash", channels), aircraft).surfaces[0]


def made(name: str, values: FloatArray) -> Channel:
    return Channel(name, TIME_S, values, "", name)


def between(begin_s: float, end_s: float) -> BoolArray:
    return (begin_s <= TIME_S) & (end_s > TIME_S)


NEVER = between(1.0, 0.0)


def test_a_live_servo_is_healthy() -> None:
    assert audited(NEVER, NEVER).status == "healthy"


@pytest.mark.slow
def test_a_jam_is_a_fault() -> None:
    verdict = audited(NEVER, between(20.0, 60.0))
    assert verdict.status == "fault"
    (fault,) = verdict.faults
    assert fault.kind == "stuck"
    assert 20.0 <= fault.start_s < 29.0


def test_telemetry_that_dies_for_a_while_is_not_judged_meanwhile() -> None:
    verdict = audited(between(20.0, 40.0), NEVER)
    assert verdict.status == "healthy"
    assert "20.0 s of frozen telemetry" in verdict.reason


def test_telemetry_that_dies_for_good_is_no_data() -> None:
    verdict = audited(between(20.0, 61.0), NEVER)
    assert verdict.status == "no_data"
    assert "froze" in verdict.reason


@pytest.mark.slow
def test_a_fault_before_the_telemetry_dies_stays_a_fault() -> None:
    assert audited(between(40.0, 61.0), between(20.0, 61.0)).status == "fault"
