"""A servo moves alike with effects and without, however often it is looked at."""

from __future__ import annotations

import numpy as np
import pytest

from servofd.servo.effects.commands import Delay
from servofd.servo.effects.linkage import RateLimit
from servofd.servo.faults import Slow
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel, plant_of
from servofd.simulation.commands import doublets, flight

ALIKE_DEG = 1e-6
"""The shaft's motion between steps of 0.25 ms is a cubic to 1e-8 deg; instants at which a limit acts, to a root."""
COMMAND_S = np.arange(0.0, 20.0, 0.02)


def models(name: str, up_deg_s: float, down_deg_s: float) -> tuple[ServoModel, ServoModel]:
    servo = servo_named(name)
    plain = ServoModel((Delay(0.004), LinearDynamics(servo.transfer), RateLimit(up_deg_s, down_deg_s)))
    return plain, plain + Extension(plant_of(plain).neutral)


@pytest.mark.parametrize("limit_deg_s", [370.0, 120.0, 60.0])
@pytest.mark.parametrize("name", ["hs225bb-eq31", "s9254", "s3151"])
def test_a_rate_limit_acts_from_the_same_instants(name: str, limit_deg_s: float) -> None:
    plain, extended = models(name, limit_deg_s, 0.7 * limit_deg_s)
    rng = np.random.default_rng(1)
    for command_deg in (2.0 * flight(COMMAND_S, rng), 2.0 * doublets(COMMAND_S, rng)):
        often_s = np.round(np.arange(2000) * 0.01, 9)
        found_deg = extended.simulate(COMMAND_S, command_deg, often_s)
        assert np.abs(found_deg - plain.simulate(COMMAND_S, command_deg, often_s)).max() < ALIKE_DEG
        assert np.abs(found_deg[::10] - extended.simulate(COMMAND_S, command_deg, often_s[::10])).max() < ALIKE_DEG
        odd_s = np.cumsum(rng.uniform(5e-4, 0.05, 700))
        apart_deg = extended.simulate(COMMAND_S, command_deg, odd_s) - plain.simulate(COMMAND_S, command_deg, odd_s)
        assert np.abs(apart_deg).max() < ALIKE_DEG


@pytest.mark.parametrize("name", ["hs225bb-eq31", "s9254", "s3151"])
@pytest.mark.parametrize(
    "fault", [Slow(5.0, 0.5, end_s=13.0), Slow(5.0, rate_scale=0.3, end_s=12.0), Slow(5.0, 0.4, 0.3)]
)
def test_a_servo_that_becomes_slow_moves_alike(name: str, fault: Slow) -> None:
    plain, extended = models(name, 150.0, 150.0)
    command_deg = 2.0 * doublets(COMMAND_S, np.random.default_rng(2))
    at_s = np.arange(0.0, 20.0, 0.01)
    apart_deg = fault.deflection(plain, COMMAND_S, command_deg, at_s)
    assert np.ptp(apart_deg) > 5.0
    apart_deg -= fault.deflection(extended, COMMAND_S, command_deg, at_s)
    assert np.abs(apart_deg).max() < ALIKE_DEG
