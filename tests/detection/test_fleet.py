"""The fleet on which detectors are measured: simulated apart from servofd's kernel, and of one mind with it."""

from __future__ import annotations

import numpy as np
import pytest

from fleet import KINDS, SIZES, STYLES, FleetServo, Truth, cases, deflection, flight
from servofd.servo.faults import FAULTS
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel
from servofd.simulation.commands import COMMANDS

MODEL = ServoModel.of(servo_named("hs225bb-eq31"))
START_S = 22.3456
RNG = np.random.default_rng(1)
TIME_S = np.maximum(np.arange(4000) / 100.0 + RNG.uniform(-0.002, 0.002, 4000), 0.0)


@pytest.mark.parametrize("style", STYLES)
def test_two_simulators_agree_on_a_healthy_servo(style: str) -> None:
    command_deg = COMMANDS[style](TIME_S, np.random.default_rng(3))
    exact_deg = MODEL.simulate(TIME_S, command_deg, TIME_S)
    # Steps of 1 ms: second order in the step; measured 0.0016 deg on the chirp, less elsewhere.
    np.testing.assert_allclose(deflection(FleetServo(), TIME_S, command_deg), exact_deg, rtol=0, atol=0.005)


def test_two_simulators_agree_at_the_rate_limit() -> None:
    command_deg = np.where(TIME_S < 20.0, -20.0, 40.0)
    exact_deg = MODEL.simulate(TIME_S, command_deg, TIME_S)
    np.testing.assert_allclose(deflection(FleetServo(), TIME_S, command_deg), exact_deg, rtol=0, atol=0.05)


@pytest.mark.parametrize("size", ["small", "large"])
@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "floating"])
def test_two_simulators_agree_on_every_fault(kind: str, size: str) -> None:
    command_deg = COMMANDS["hand_flown"](TIME_S, np.random.default_rng(4))
    name, sizes = SIZES[kind]
    parameters = {} if kind == "stuck" else {name: sizes[size]}
    if kind == "oscillation":
        parameters["frequency_hz"] = 2.0
    exact_deg = FAULTS[kind](start_s=START_S, **parameters).deflection(MODEL, TIME_S, command_deg, TIME_S)
    truth = Truth(kind, size, START_S, parameters, 0.0)
    # A change of the dynamics falls on a step of 1 ms.
    np.testing.assert_allclose(deflection(FleetServo(), TIME_S, command_deg, truth), exact_deg, rtol=0, atol=0.02)


@pytest.mark.slow
def test_all_cases_fly_and_say_what_they_hold() -> None:
    flown = [flight(seed, style, kind, size or "medium", duration_s=30.0) for seed, (style, kind, size) in all_cases()]
    assert len(flown) == 5 * (1 + 3 * 8)
    for one in flown:
        assert 0.94 < one.time_s.size / 3000 < 0.99
        assert np.all(np.diff(one.time_s) > 0.0)
        assert np.all(np.isfinite(one.measured_deg))
        assert 0.97 <= one.servo.gain <= 1.03
        np.testing.assert_allclose(np.round(one.measured_deg / one.servo.step_deg) % 1.0, 0.0)
        if one.truth is not None:
            assert 2.0 <= one.truth.start_s <= 28.0


def all_cases() -> list[tuple[int, tuple[str, str | None, str]]]:
    return list(enumerate(cases()))


@pytest.mark.parametrize("kind", KINDS)
def test_a_seed_is_a_flight_and_healthy_until_the_fault(kind: str) -> None:
    one, same = (flight(5, "gusty", kind, "large", duration_s=30.0) for _ in range(2))
    healthy = flight(5, "gusty", duration_s=30.0)
    np.testing.assert_array_equal(one.measured_deg, same.measured_deg)
    assert one.truth is not None
    assert one.truth == same.truth
    np.testing.assert_array_equal(one.command_deg, healthy.command_deg)
    before = one.time_s < one.truth.start_s
    np.testing.assert_array_equal(one.measured_deg[before], healthy.measured_deg[before])
    assert np.max(np.abs(one.measured_deg - healthy.measured_deg)[~before]) > 0.5
    assert not np.array_equal(one.command_deg[:900], flight(6, "gusty", duration_s=30.0).command_deg[:900])


@pytest.mark.slow
def test_a_large_jam_is_one_with_much_motion_after_it() -> None:
    motion = {
        size: np.median([flight_motion(seed, size) for seed in range(12)]) for size in ("small", "medium", "large")
    }
    assert motion["small"] < motion["medium"] < motion["large"]


def flight_motion(seed: int, size: str) -> float:
    """How far the command goes in the 10 s after the jam."""
    one = flight(seed, "calm", "stuck", size)
    assert one.truth is not None
    since_s = one.time_s - one.truth.start_s
    after = one.command_deg[(since_s >= 0.0) & (since_s < 10.0)]
    return float(np.max(np.abs(after - after[0])))


def test_the_wind_moves_a_floating_surface_as_far_as_it_says() -> None:
    healthy = FleetServo()
    rms = []
    for seed in range(10):
        values = {"amplitude_deg": 3.0, "bandwidth_hz": 1.0, "seed": float(seed)}
        truth = Truth("floating", "medium", 5.0, values, 0.0)
        moved = deflection(healthy, TIME_S, 8.0 * np.sin(TIME_S), truth)
        assert np.max(np.abs(np.diff(moved))) < 1.0
        rms.append(np.std(moved[TIME_S > 8.0]))
    assert np.mean(rms) == pytest.approx(3.0 / np.sqrt(2.0), rel=0.15)
