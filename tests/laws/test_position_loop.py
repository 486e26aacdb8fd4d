"""The compiled position loop against one in small steps, on stamps and commands as they come."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from servofd.servo.loop_steps import ROW
from servofd.servo.position_loop import framed, new_memory, run

from servofd.core.types import FloatArray
from servofd.servo import position_loop
from servofd.servo.library import servo_named
from servofd.servo.physics import AFTER, BEFORE, Physics, Plant, longest_step_s
from servofd.servo.transfer import TransferFunction
from tests.laws.slow_loop import SlowLoop

DENOMINATORS = {
    1: (1.0, 25.0),
    2: (1.0, 42.0, 900.0),
    3: servo_named("hs225bb-eq31").transfer.denominator,
}
RNG = np.random.default_rng(4)
AT_S = 3.0 + np.cumsum(RNG.uniform(0.003, 0.03, 36))
COMMANDS = np.array(
    [  # a command long before, steps either way, ramps, a small step, a command at the instant of a position
        [2.9, 3.05, 3.09, 3.17, 3.25, AT_S[18], 3.45, 3.52],
        [1.0, 9.0, 9.3, -6.0, -6.0, 2.0, 2.0, 0.0],
        [0.0, 0.0, 40.0, 0.0, -30.0, 0.0, 25.0, 0.0],
    ]
)
AIR_PA = RNG.uniform(200.0, 500.0, AT_S.size)
SUPPLY_V = RNG.uniform(4.0, 7.0, AT_S.size)
ALIKE = (1e-4, 1e-4, 1e-4)
SIZES: list[tuple[dict[str, float], tuple[float, float, float]]] = [
    ({}, ALIKE),
    ({"deadband_deg": 1.2}, ALIKE),
    ({"insensitive_deg": 0.8}, (6e-3, 3e-3, 2e-3)),
    ({"friction_deg": 0.5}, (1e-4, 8e-3, 1.2e-2)),
    ({"load_friction": 0.3, "friction_deg": 0.2}, (1e-4, 4e-2, 7e-2)),
    ({"rate_up_deg_s": 60.0, "rate_down_deg_s": 110.0}, (3e-4, 1e-4, 1e-4)),
    ({"deg_s_per_v": 15.0, "rate_down_deg_s": 80.0}, ALIKE),
    ({"knee_deg": 2.0, "deadband_deg": 0.4}, (6e-2, 5e-4, 5e-4)),
    ({"set_point_deg_s": 90.0}, (7e-3, 7e-3, 7e-3)),
    ({"set_point_deg_s": 120.0, "insensitive_deg": 0.6}, (1e-2, 1e-2, 1e-2)),
    ({"stop_lower_deg": -3.0, "stop_upper_deg": 5.0}, (1e-4, 1e-4, 3e-2)),
    (
        {"stop_lower_deg": -3.0, "stop_upper_deg": 5.0, "friction_deg": 0.4, "rate_up_deg_s": 90.0},
        (3e-4, 2e-3, 2e-2),
    ),
    ({"airload_per_pa": 1e-3}, (0.2, 9e-3, 1.5e-2)),
    ({"droop_deg": 6.0}, (0.1, 5e-3, 6e-3)),
    ({"airload_per_pa": 1e-3, "droop_deg": 6.0, "friction_deg": 0.5, "load_friction": 0.1}, (0.25, 3e-2, 3e-2)),
    ({"follow_up_deg_s": 70.0, "follow_down_deg_s": 120.0}, (7e-3, 3e-4, 3e-5)),
    (
        {"resonance_hz": 14.0, "resonance_damping": 0.2, "backlash_deg": 1.0, "gain": 0.8, "bias_deg": 0.7},
        (6e-2, 4e-3, 4e-3),
    ),
    (
        {"lag_s": 0.02, "backlash_deg": 1.0, "quadratic_per_deg": 0.01, "cubic_per_deg2": 1e-3, "upper_deg": 7.0},
        (6e-2, 3e-2, 3e-2),
    ),
    ({"lag_s": 0.003, "lower_deg": -4.0, "gain": 1.2}, (0.1, 2e-2, 2.5e-2)),
]
"""With servos of one, two and three poles: loads, edges and what is driven, which of one pole moves in jumps, are exact
to the length of a step; the rest to the twin's."""
LONGEST_S = 5e-4


def moved(order: int, physics: Physics, start_deg: float) -> FloatArray:
    plant = Plant(TransferFunction((DENOMINATORS[order][-1],), DENOMINATORS[order]), Physics())
    physics, loop = plant.machine(physics)
    longest_s = min(longest_step_s(physics), LONGEST_S)
    when_s, deg, slope_deg_s = COMMANDS
    return run(physics, loop, 1.0, longest_s, when_s, deg, slope_deg_s, AT_S, AIR_PA, SUPPLY_V, new_memory(start_deg))


def named(value: object) -> str:
    return "+".join(value) if isinstance(value, dict) else str(value)


@pytest.mark.parametrize("order", DENOMINATORS)
@pytest.mark.parametrize(("sizes", "within_deg"), SIZES, ids=named)
def test_it_moves_as_a_loop_in_small_steps(
    order: int, sizes: dict[str, float], within_deg: tuple[float, float, float]
) -> None:
    physics = Physics(torque_share=0.7, **sizes)
    start_deg = physics.gain + physics.bias_deg
    slow = SlowLoop(DENOMINATORS[order], physics, start_deg)
    expected_deg = np.array(list(slow.positions(COMMANDS, AT_S, AIR_PA, SUPPLY_V)))[1:]
    assert np.ptp(expected_deg) > 5.0
    assert np.abs(moved(order, physics, start_deg)[1:] - expected_deg).max() < within_deg[order - 1]


TWIN_LATE_S = 5e-5
"""Half of a step, by which the twin's lag is early."""
PLACED: list[tuple[dict[str, float], float]] = [
    ({}, 2e-3),
    ({"deadband_deg": 1.2}, 3e-3),
    ({"insensitive_deg": 0.8}, 5e-3),
    ({"friction_deg": 0.5}, 2e-2),
    ({"friction_deg": 0.2, "load_friction": 0.3, "droop_deg": 5.0}, 3e-2),
    ({"rate_up_deg_s": 60.0, "rate_down_deg_s": 110.0}, 2e-3),
    ({"deg_s_per_v": 15.0}, 2e-3),
    ({"speed_up_deg_s": 60.0, "speed_down_deg_s": 90.0}, 1e-2),
    ({"speed_up_deg_s": 80.0, "deadband_deg": 0.5, "backlash_deg": 0.6}, 1e-2),
    ({"set_point_deg_s": 90.0, "knee_deg": 2.0}, 1e-2),
    ({"stop_lower_deg": -3.0, "stop_upper_deg": 5.0}, 1e-2),
]


@pytest.mark.parametrize("order", DENOMINATORS)
def test_a_set_point_that_is_never_too_slow_is_none(order: int) -> None:
    """It arrives within a step of the kernel, and lags by no part of that."""
    plant = Plant(TransferFunction((DENOMINATORS[order][-1],), DENOMINATORS[order]), Physics())
    times_s, deg = np.arange(0.0, 5.0, 0.01), 8.0 * np.sin(np.arange(0.0, 5.0, 0.01) ** 2)
    nothing = np.zeros(times_s.size)
    turned = [
        run(physics, plant.loop(), 1.0, 0.002, times_s, deg, nothing, times_s, nothing, nothing, new_memory(0.0))
        for physics in (Physics(deadband_deg=1.0), Physics(deadband_deg=1.0, set_point_deg_s=1e7))
    ]
    assert np.abs(turned[1] - turned[0]).max() < 2e-3


@pytest.mark.parametrize("place", [BEFORE, AFTER], ids=["before", "after"])
@pytest.mark.parametrize(("sizes", "within_deg"), PLACED, ids=named)
def test_with_its_slow_pole_elsewhere_it_moves_as_that_loop_in_small_steps(
    place: float, sizes: dict[str, float], within_deg: float
) -> None:
    physics = Physics(slow_place=place, **sizes)
    expected_deg = np.array(list(SlowLoop(DENOMINATORS[3], physics, 1.0).positions(COMMANDS, AT_S, AIR_PA, SUPPLY_V)))[
        1:
    ]
    assert np.ptp(expected_deg) > 5.0
    twin_deg = TWIN_LATE_S * np.abs(np.diff(expected_deg) / np.diff(AT_S[1:])).max() if place == AFTER else 0.0
    assert np.abs(moved(3, physics, 1.0)[1:] - expected_deg).max() < within_deg + twin_deg


@pytest.mark.parametrize("place", [BEFORE, AFTER], ids=["before", "after"])
def test_where_nothing_switches_the_place_of_the_slow_pole_does_not_matter(place: float) -> None:
    inside_deg = moved(3, Physics(lag_s=0.0, gain=0.9, delay_s=0.01, slow_scale=0.8), 1.0)
    there_deg = moved(3, Physics(slow_place=place, gain=0.9, delay_s=0.01, slow_scale=0.8), 1.0)
    np.testing.assert_allclose(there_deg[1:], inside_deg[1:], atol=2e-3 if place == AFTER else 1e-6)


def held(order: int, physics: Physics, error_deg: float) -> FloatArray:
    """A servo at rest whose command grows to an error within four seconds, and stays there for one."""
    plant = Plant(TransferFunction((DENOMINATORS[order][-1],), DENOMINATORS[order]), Physics())
    at_s = np.arange(500) / 100.0
    when_s, deg, slope_deg_s = np.array([[0.0, 4.0], [0.0, error_deg], [error_deg / 4.0, 0.0]])
    constant = np.ones(at_s.size)
    return run(physics, plant.loop(), 1.0, 2.5e-3, when_s, deg, slope_deg_s, at_s, constant, constant, new_memory(0.0))


@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize(("friction_deg", "share"), [(0.5, 0.0), (0.5, 0.4), (1.0, 0.2)])
def test_a_servo_that_sticks_does_not_creep_and_breaks_away_at_the_torque_that_overcomes_its_friction(
    order: int, friction_deg: float, share: float
) -> None:
    """The torque of an error e overcomes a friction of f + s e from e = f / (1 - s) on."""
    physics, breakaway_deg = Physics(friction_deg=friction_deg, load_friction=share), friction_deg / (1.0 - share)
    np.testing.assert_array_equal(held(order, physics, 0.99 * breakaway_deg), 0.0)
    assert held(order, physics, 1.02 * breakaway_deg)[-1] > 0.0


@pytest.mark.parametrize("order", DENOMINATORS)
def test_a_dead_band_and_an_insensitive_one_hold_the_servo(order: int) -> None:
    for name in ("deadband_deg", "insensitive_deg"):
        np.testing.assert_array_equal(held(order, Physics(**{name: 1.0}), 0.49), 0.0)
        assert held(order, Physics(**{name: 1.0}), 0.52)[-1] > 0.01


@pytest.mark.parametrize("order", DENOMINATORS)
@pytest.mark.parametrize(
    "sizes",
    [
        {"deadband_deg": 0.8},
        {"rate_up_deg_s": 9.0, "backlash_deg": 0.5},
        {"slow_place": BEFORE, "deadband_deg": 0.8},
        {"slow_place": BEFORE, "rate_up_deg_s": 9.0},
        {"slow_place": BEFORE, "friction_deg": 0.5},
    ],
    ids=named,
)
def test_a_servo_that_is_seldom_looked_at_moves_as_one_that_is_watched(order: int, sizes: dict[str, float]) -> None:
    """Two seconds are more steps than are taken at once."""
    plant = Plant(TransferFunction((DENOMINATORS[order][-1],), DENOMINATORS[order]), Physics())
    watched_s, seldom_s = np.arange(0.0, 6.01, 0.01), np.arange(0.0, 6.01, 2.0)
    when_s, deg, slope_deg_s = np.array([[0.0, 0.5, 2.7], [0.0, 25.0, -10.0], [0.0, 0.0, 3.0]])
    found_deg = []
    for at_s in (watched_s, seldom_s):
        constant, memory = np.ones(at_s.size), new_memory(0.0)
        inputs = (when_s, deg, slope_deg_s, at_s, constant, constant)
        physics = Physics(**sizes) if order == 3 else Physics(**sizes)._replace(slow_place=0.0)
        found_deg.append(run(*plant.machine(physics), 1.0, LONGEST_S, *inputs, memory))
    assert np.ptp(found_deg[1]) > 10.0
    np.testing.assert_allclose(found_deg[1], found_deg[0][::200], rtol=0, atol=2e-3)


def test_a_reading_in_steps_is_the_nearest_of_them() -> None:
    fine_deg = moved(3, Physics(), 1.0)
    coarse_deg = moved(3, Physics(output_step_deg=0.35), 1.0)
    np.testing.assert_allclose(coarse_deg / 0.35, np.round(fine_deg / 0.35), atol=1e-9)


@pytest.mark.slow
def test_frames_carry_the_command_in_force_when_they_begin() -> None:
    time_s, period_s, phase = COMMANDS[0], 0.02, 0.3
    frame_s, frame_deg = framed(*COMMANDS, period_s, phase)
    np.testing.assert_allclose(frame_s / period_s - phase, np.arange(145, 145 + frame_s.size), atol=1e-9)
    assert frame_s[0] - period_s < time_s[0] <= frame_s[0]
    assert frame_s[-2] <= time_s[-1] < frame_s[-1]
    for when_s, deg in zip(frame_s, frame_deg, strict=True):
        k = np.flatnonzero(time_s <= when_s)[-1]
        assert deg == pytest.approx(COMMANDS[1, k] + COMMANDS[2, k] * (when_s - time_s[k]), abs=1e-12)


@given(seed=st.integers(0, 2**32 - 1), width_deg=st.floats(0.2, 3.0), spare=st.integers(1, 8))
def test_a_servo_that_chatters_beyond_the_room_for_notes_keeps_to_it(seed: int, width_deg: float, spare: int) -> None:
    """The shaft turns as with room enough, its play follows it as closely, and nothing is written behind the room."""
    rng = np.random.default_rng(seed)
    at_s = np.cumsum(rng.uniform(0.005, 0.02, 60))
    asked = 3.0 * np.sin(40.0 * at_s) + rng.normal(size=at_s.size)
    nothing = np.zeros(at_s.size)
    known = Plant(TransferFunction((900.0,), DENOMINATORS[2]), Physics())
    physics, loop = known.machine(Physics(backlash_deg=width_deg, friction_deg=0.3, deadband_deg=0.2))
    least = position_loop._NOTES - position_loop._MOST_STEPS + spare
    results, memories = [], []
    for room in (position_loop._NOTES, least):
        table, notes = np.empty((2 * position_loop._SLOTS, 3 * ROW)), np.full((room + 50, 5), np.pi)
        memory, result = new_memory(0.0)[None], np.empty((1, at_s.size))
        inputs = (at_s, asked, nothing, at_s, nothing, nothing, nothing)
        position_loop._run(tuple(physics), tuple(loop), 1.0, 2e-4, inputs, memory, table, notes[:room], result)
        assert np.all(notes[room:] == np.pi)
        results.append(result[0])
        memories.append(memory[0, :5])
    assert np.array_equal(memories[0], memories[1])
    assert np.all(np.abs(results[0] - results[1]) < 0.5 * width_deg)
