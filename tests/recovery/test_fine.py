"""What `explain` and an audit simulate is what two servos in small steps do, written from scratch: without noise."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from hidden_physics import Air, deflection
from servofd.servo.catalogue import effects_installed
from servofd.servo.context import Context
from servofd.servo.effects.linkage import RateLimit
from servofd.servo.library import servo_named
from servofd.servo.motion import Motion
from servofd.servo.physics import Physics
from servofd.servo.servo_model import ServoModel
from servofd.servo.transfer import TransferFunction
from servofd.simulation.commands import COMMANDS
from tests.laws.reference_twin import linear_deflection
from tests.recovery.fine_servo import FineServo

KNOWN = ServoModel.of(servo_named("hs225bb-eq31"))
TIME_S = np.arange(1000) / 100.0
_LIVELY_DEG = COMMANDS["gusty"](TIME_S, np.random.default_rng(5))
COMMAND_DEG = _LIVELY_DEG - _LIVELY_DEG[0]
AIR_PA = 300.0 + 100.0 * np.sin(0.7 * TIME_S)
SUPPLY_V = 6.0 - 0.08 * TIME_S
SPEED_M_S, STEADY_V = 22.0, 5.5
SETTLED = 50
"""The others start from where the command is, whatever their gain and bias."""


def moved(physics: Physics, airspeed_m_s: Any, supply_v: Any) -> Any:
    constant = np.ones(TIME_S.size)
    context = Context(TIME_S, airspeed_m_s * constant, TIME_S, supply_v * constant)
    motion = Motion(ServoModel(KNOWN.transfer, physics, context), 0.0)
    motion.receive(TIME_S, COMMAND_DEG, np.zeros(TIME_S.size))
    return motion.at(TIME_S)


SERVOS: list[tuple[FineServo, dict[str, float]]] = [
    (FineServo(), {}),
    (FineServo(rate_deg_s=25.0), {"rate_up_deg_s": 25.0, "rate_down_deg_s": 25.0}),
    (FineServo(deg_s_per_v=4.0), {"deg_s_per_v": 4.0}),
    (FineServo(airload=1e-3), {"airload_per_pa": 1e-3}),
    (
        FineServo(friction_deg=0.4, airload=6e-4, deadband_deg=0.5, rate_deg_s=30.0),
        {"friction_deg": 0.4, "airload_per_pa": 6e-4, "deadband_deg": 0.5}
        | {"rate_up_deg_s": 30.0, "rate_down_deg_s": 30.0},
    ),
    (FineServo(lag_s=0.03, backlash_deg=0.6), {"lag_s": 0.03, "backlash_deg": 0.6}),
    (
        FineServo(lag_s=0.02, gain=0.9, lower_deg=-4.0, upper_deg=5.0, bias_deg=0.3),
        {"lag_s": 0.02, "gain": 0.9, "lower_deg": -4.0, "upper_deg": 5.0, "bias_deg": 0.3},
    ),
]


def named(value: object) -> str:
    return "+".join(value) if isinstance(value, dict) else ""


@pytest.mark.parametrize(("servo", "sizes"), SERVOS, ids=named)
def test_it_moves_as_a_servo_in_quarter_milliseconds(servo: FineServo, sizes: dict[str, float]) -> None:
    """Its steps and those of the lag are worth 0.01 and 0.02 deg."""
    expected_deg = servo.move(TIME_S, COMMAND_DEG, AIR_PA, SUPPLY_V)
    physics = Physics(delay_s=0.004, torque_share=0.65, **sizes)
    gap_deg = (moved(physics, np.sqrt(AIR_PA / 0.6125), SUPPLY_V) - expected_deg)[SETTLED:]
    assert np.abs(gap_deg).max() < 0.03
    assert np.sqrt(np.mean(gap_deg**2)) < 0.005


EFFECTS: list[tuple[dict[str, dict[str, float]], float]] = [
    ({}, 1e-3),
    ({"rate_limit": {"rate_up_deg_s": 20.0, "rate_down_deg_s": 35.0}}, 1e-3),
    ({"voltage_rate": {"deg_s_per_v": 4.0}}, 1e-3),
    ({"friction": {"friction_deg": 0.4}}, 1e-3),
    ({"deadband": {"width_deg": 1.0}}, 1e-3),
    ({"backlash": {"width_deg": 0.8}}, 1e-3),
    ({"airload": {"deg_per_deg_pa": 1e-3}}, 1e-3),
    ({"gravity_load": {"droop_deg": 9.0}}, 1e-3),
    ({"load_friction": {"share": 0.2}}, 1e-2),
    ({"sensor_lag": {"time_constant_s": 0.02}}, 1e-2),
    ({"resonance": {"frequency_hz": 9.0, "damping_ratio": 0.1}}, 1e-3),
    ({"current_limit": {"knee_deg": 1.0}}, 1e-3),
    ({"current_limit": {"knee_deg": 1.0}, "friction": {"friction_deg": 0.3}, "load_friction": {"share": 0.1}}, 5e-3),
    ({"slow_dynamics": {"bandwidth_scale": 0.6}, "friction": {"friction_deg": 0.4}}, 1e-3),
    (
        {"deadband": {"width_deg": 0.6}, "friction": {"friction_deg": 0.3}, "gravity_load": {"droop_deg": 5.0}}
        | {"rate_limit": {"rate_limit_deg_s": 30.0}, "backlash": {"width_deg": 0.5}},
        1e-3,
    ),
]


@pytest.mark.parametrize(("effects", "within_deg"), EFFECTS, ids=named)
def test_it_moves_as_the_servo_in_which_effects_are_hidden(
    effects: dict[str, dict[str, float]], within_deg: float
) -> None:
    air = Air.steady(float(TIME_S[-1]), SPEED_M_S, STEADY_V)
    expected_deg = deflection(effects, TIME_S, COMMAND_DEG, air, np.random.default_rng(0))
    # A tenth of the hidden servo's damping acts on its speed.
    physics = effects_installed(KNOWN.physics, effects)._replace(torque_share=0.9)
    gap_deg = (moved(physics, SPEED_M_S, STEADY_V) - expected_deg)[SETTLED:]
    assert np.abs(gap_deg).max() < within_deg


@pytest.mark.parametrize(
    "sizes",
    [
        {"resonance_hz": 9.0, "resonance_damping": 0.1},
        {"lag_s": 0.02},
        {"lag_s": 0.03, "resonance_hz": 14.0, "resonance_damping": 0.3, "gain": 0.8},
        {"lag_s": 0.001},
    ],
    ids=named,
)
def test_a_tip_and_a_sensor_are_linear_systems(sizes: dict[str, float]) -> None:
    numerator, denominator = np.array(KNOWN.transfer.numerator), np.array(KNOWN.transfer.denominator)
    if natural := 2.0 * math.pi * sizes.get("resonance_hz", 0.0):
        numerator = numerator * natural**2
        denominator = np.polymul(denominator, [1.0, 2.0 * sizes["resonance_damping"] * natural, natural**2])
    if "lag_s" in sizes:
        denominator = np.polymul(denominator, [sizes["lag_s"], 1.0])
    whole = TransferFunction(tuple((sizes.get("gain", 1.0) * numerator).tolist()), tuple(denominator.tolist()))
    twin_deg = linear_deflection(whole, 0.004, TIME_S, COMMAND_DEG, TIME_S)
    found_deg = moved(Physics(delay_s=0.004, **sizes), SPEED_M_S, STEADY_V)
    assert np.abs(found_deg - twin_deg).max() < 1e-4


@pytest.mark.parametrize(("up_deg_s", "down_deg_s"), [(40.0, 25.0), (60.0, 90.0), (20.0, 15.0)])
def test_an_output_that_follows_is_that_of_the_other_kernel(up_deg_s: float, down_deg_s: float) -> None:
    """There, bisection finds when the limit begins and ends; here a step has four parts, worth 3e-4 deg."""
    rate_limited = KNOWN.linear() + RateLimit(up_deg_s, down_deg_s)
    expected_deg = rate_limited.simulate(TIME_S, COMMAND_DEG, TIME_S)
    sizes = {"follow_up_deg_s": up_deg_s, "follow_down_deg_s": down_deg_s}
    found_deg = moved(Physics(delay_s=KNOWN.delay_s, **sizes), SPEED_M_S, STEADY_V)
    assert np.abs(found_deg - expected_deg).max() < 6e-4


@pytest.mark.parametrize("denominator", [(1.0, 25.0), (1.0, 42.0, 900.0), (1.0, 94.88, 6660.79, 122237.6)])
def test_a_gain_of_the_servo_scales_its_motion_and_what_is_told_in_its_degrees(denominator: tuple[float, ...]) -> None:
    """Dead bands are told in degrees of the command, friction and rates in those of the surface."""
    found_deg = []
    for gain in (1.0, 0.7):
        transfer = TransferFunction((gain * denominator[-1],), denominator)
        physics = Physics(
            friction_deg=0.5 * gain, deadband_deg=0.4, rate_up_deg_s=40.0 * gain, stop_upper_deg=5.0 * gain
        )
        motion = Motion(ServoModel(transfer, physics), 2.0 * gain)
        motion.receive(TIME_S, COMMAND_DEG, np.zeros(TIME_S.size))
        found_deg.append(motion.at(TIME_S) / gain)
    assert found_deg[0][0] == pytest.approx(2.0)
    assert np.ptp(found_deg[0]) > 4.0
    np.testing.assert_allclose(found_deg[0], found_deg[1], rtol=0, atol=1e-9)
