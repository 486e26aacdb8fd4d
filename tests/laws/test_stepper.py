"""The one stepper: exact where a servo is linear, a loop in small steps where one bends it, in one go or in pieces."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from logparsers.compiled import cache_folder
from servofd.core.errors import DesignError
from servofd.core.types import FloatArray
from servofd.servo.catalogue import installed
from servofd.servo.context import Context
from servofd.servo.effect import Effect, Now, Parameter, Slot
from servofd.servo.effects.commands import Commands
from servofd.servo.effects.linkage import Backlash, RateLimit
from servofd.servo.generate import STEPPED, stepper_of
from servofd.servo.library import library, servo_named
from servofd.servo.loop import AFTER, BEFORE
from servofd.servo.motion import Machine, Motion, machine_of, received, started_anew
from servofd.servo.physics import Physics
from servofd.servo.registry import everything, fields_of, including
from servofd.servo.servo_model import ServoModel
from servofd.servo.transfer import TransferFunction
from servofd.simulation.commands import gusty
from tests.laws.reference_twin import linear_deflection
from tests.laws.slow_loop import SlowLoop

NANODEGREE = 1e-9
EQ31 = servo_named("hs225bb-eq31").transfer
TRANSFERS = {
    1: TransferFunction((25.0,), (1.0, 25.0)),
    2: TransferFunction((900.0,), (1.0, 42.0, 900.0)),
    3: TransferFunction((EQ31.denominator[-1],), EQ31.denominator),
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
AROUND = np.column_stack(
    [
        RNG.uniform(200.0, 500.0, AT_S.size),
        RNG.uniform(4.0, 7.0, AT_S.size),
        RNG.uniform(0.8, 1.2, AT_S.size),
        RNG.uniform(0.0, 2.0, AT_S.size),
        RNG.uniform(-1.0, 1.0, AT_S.size),
    ]
)
STEPPED_EFFECTS = tuple(effect for effect in everything() if effect.slot in STEPPED)
every_effect = pytest.mark.parametrize("effect", everything(), ids=lambda effect: effect.key())
every_stepped_effect = pytest.mark.parametrize("effect", STEPPED_EFFECTS, ids=lambda effect: effect.key())
seeds = st.integers(0, 2**32 - 1)


def of_size(effect: type[Effect], larger: float = 1.0) -> Physics:
    """A servo with an effect that is well seen; poles and shares of its own a little off."""
    values = []
    for p in effect.parameters:
        grid = [value for value in p.grid if value != p.neutral]
        value = grid[len(grid) // 2] if grid else min(max(p.neutral, p.low) + p.typical, p.high)
        if grid and "deg_s" in p.name:  # a limit that a flight reaches
            value = grid[2] if p.name == "rate_limit_deg_s" else grid[1]
        values.append(min(max(value * larger, p.low), p.high))
    return installed(Physics(), [effect], values)


def moved(
    machine: Machine,
    physics: Physics,
    commands: FloatArray = COMMANDS,
    at_s: FloatArray = AT_S,
    around: FloatArray = AROUND,
) -> FloatArray:
    """Readings, shape (n, V), from rest where the command in force wants it."""
    effective = received(physics, Commands(*commands))
    return machine.run(machine.new_state(), effective, at_s, around=around)[0]


def alone(transfer: TransferFunction, physics: Physics, finer: float = 1.0) -> FloatArray:
    return moved(machine_of(transfer, [physics], finer), physics)[:, 0]


# Linear servos.


def some_transfer(rng: np.random.Generator, order: int, zeros: int) -> TransferFunction:
    """Poles from 5 to 150 rad/s, real or in pairs, and zeros on either side."""
    poles: list[complex] = []
    while len(poles) < order:
        size = 10.0 ** rng.uniform(math.log10(5.0), math.log10(150.0))
        if order - len(poles) > 1 and rng.random() < 0.5:
            turn = rng.uniform(0.3, 1.4)
            poles += [-size * np.exp(1j * turn), -size * np.exp(-1j * turn)]
        else:
            poles.append(-size)
    denominator = np.poly(poles).real
    numerator = np.atleast_1d(np.poly(rng.uniform(20.0, 300.0, zeros) * rng.choice([-1.0, 1.0], zeros)))
    scale = rng.uniform(0.5, 1.5) * denominator[-1] / numerator[-1]
    return TransferFunction(tuple((scale * numerator).tolist()), tuple(denominator.tolist()))


@pytest.mark.parametrize(("order", "zeros"), [(n, z) for n in (1, 2, 3, 4) for z in range(n)])
@given(seed=seeds)
@settings(max_examples=12, deadline=None)
def test_a_linear_servo_moves_exactly_whatever_the_stamps(order: int, zeros: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    transfer, delay_s = some_transfer(rng, order, zeros), rng.choice([0.0, rng.uniform(0.0, 0.05)])
    command_s = np.cumsum(rng.uniform(1e-4, 0.04, 40))
    at_s = command_s[0] + np.cumsum(rng.choice([1e-5, 1e-3, 0.01, 0.3], 60) * rng.uniform(0.5, 1.5, 60))
    command_deg = rng.uniform(-5.0, 5.0, 40)
    model = ServoModel(transfer, Physics(delay_s=delay_s))
    expected_deg = linear_deflection(transfer, delay_s, command_s, command_deg, at_s)
    found_deg = model.simulate(command_s, command_deg, at_s)
    assert np.abs(found_deg - expected_deg).max() < NANODEGREE * max(np.abs(expected_deg).max(), 1.0)


@pytest.mark.parametrize("place", [BEFORE, AFTER], ids=["before", "after"])
@pytest.mark.parametrize("name", library())
def test_where_nothing_bends_it_the_place_of_the_slow_pole_does_not_matter(name: str, place: float) -> None:
    transfer = servo_named(name).transfer
    if len(transfer.denominator) != 4:
        return
    sizes = Physics(gain=0.9, delay_s=0.01, slow_scale=0.8)
    there_deg = alone(transfer, sizes._replace(slow_place=place))
    np.testing.assert_allclose(there_deg, alone(transfer, sizes), rtol=0, atol=NANODEGREE)
    assert np.ptp(there_deg) > 5.0


def test_variants_with_other_poles_move_side_by_side_as_each_does_alone() -> None:
    variants = [Physics(bandwidth_scale=scale, damping_scale=1.0 / scale) for scale in (0.3, 1.0, 1.7, 4.0)]
    together_deg = moved(machine_of(EQ31, variants), Physics())
    for k, each in enumerate(variants):
        np.testing.assert_allclose(together_deg[:, k], alone(EQ31, each), rtol=0, atol=NANODEGREE)


# Effects, each against a loop in small steps.

FINE_S = 5e-4
ALIKE = (2e-4, 2e-4, 2e-4)
SIZES: list[tuple[dict[str, float], tuple[float, float, float]]] = [
    ({}, ALIKE),
    ({"command_gain": 0.8}, ALIKE),
    ({"deadband_deg": 1.2}, ALIKE),
    ({"insensitive_deg": 0.8}, (6e-3, 3e-3, 3e-3)),
    ({"friction_deg": 0.5}, (2e-4, 1e-2, 1.5e-2)),
    ({"friction_deg": 0.5, "stribeck": 0.4}, (2e-4, 2e-2, 2e-2)),
    ({"load_friction": 0.3, "friction_deg": 0.2}, (2e-4, 4e-2, 7e-2)),
    ({"rate_up_deg_s": 60.0, "rate_down_deg_s": 110.0}, (6e-2, 2e-4, 2e-4)),
    ({"deg_s_per_v": 15.0, "rate_down_deg_s": 80.0}, (6e-2, 2e-4, 2e-4)),
    ({"torque": 0.7}, (1e-2, 3e-4, 3e-4)),
    ({"knee_deg": 2.0, "deadband_deg": 0.4}, (3e-2, 5e-4, 5e-4)),
    ({"set_point_deg_s": 90.0}, (7e-3, 7e-3, 7e-3)),
    ({"set_point_deg_s": 120.0, "insensitive_deg": 0.6}, (1e-2, 1e-2, 1e-2)),
    ({"speed_up_deg_s": 60.0, "speed_down_deg_s": 90.0}, (math.nan, 1e-2, 1e-2)),
    ({"speed_deg_s_per_v": 12.0}, (math.nan, 1e-2, 1e-2)),
    ({"stop_lower_deg": -3.0, "stop_upper_deg": 5.0}, (1e-2, 1e-2, 3e-2)),
    ({"airload_per_pa": 1e-3}, (1e-2, 3e-3, 3e-3)),
    ({"air_trim_per_pa": 4e-3}, (3e-3, 3e-3, 3e-3)),
    ({"droop_deg": 6.0}, (1e-2, 3e-3, 3e-3)),
    ({"droop_deg": 6.0, "hangs_deg": 40.0}, (3e-3, 3e-3, 3e-3)),
    ({"load_deg": 0.8}, (3e-3, 3e-3, 3e-3)),
    ({"airload_per_pa": 1e-3, "droop_deg": 6.0, "friction_deg": 0.5, "load_friction": 0.1}, (math.nan, 3e-2, 3e-2)),
    ({"airload_per_pa": 1e-3, "backlash_deg": 1.0}, (3e-2, 3e-2, 3e-2)),
    ({"follow_up_deg_s": 70.0, "follow_down_deg_s": 120.0}, (2e-2, 2e-3, 2e-3)),
    ({"resonance_hz": 14.0, "resonance_damping": 0.2, "gain": 0.8, "bias_deg": 0.7}, (6e-2, 6e-3, 6e-3)),
    ({"lag_s": 0.02, "backlash_deg": 1.0, "quadratic_per_deg": 0.01, "cubic_per_deg2": 1e-3}, (2e-2, 2e-2, 2e-2)),
    ({"lag_s": 0.003, "lower_deg": -4.0, "upper_deg": 7.0, "gain": 1.2}, (5e-2, 2e-2, 2.5e-2)),
    ({"deg_per_a": -0.8}, ALIKE),
]
"""With servos of one, two and three poles: edges and what is driven, which of one pole moves in jumps, are exact to the
length of a step; the rest to the twin's. The twin of one pole has no speed of its own, and no friction by effort."""


def named(value: object) -> str:
    return "+".join(value) or "nothing" if isinstance(value, dict) else str(value)


def twin(order: int, physics: Physics) -> FloatArray:
    start_deg = physics.gain * (1.0 + physics.quadratic_per_deg + physics.cubic_per_deg2) + physics.bias_deg
    if physics.command_gain != 1.0:
        start_deg = physics.command_gain
    slow = SlowLoop(TRANSFERS[order].denominator, physics, start_deg)
    return np.array(list(slow.positions(COMMANDS, AT_S, AROUND)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sizes", "order", "within_deg"),
    [
        # Where all three are as near, the poles make no difference: one order is enough by day.
        pytest.param(sizes, order, within, marks=pytest.mark.nightly if order < 3 and len({*each}) == 1 else ())
        for sizes, each in SIZES
        for order, within in zip(TRANSFERS, each, strict=True)
        if not math.isnan(within)
    ],
    ids=named,
)
def test_it_moves_as_a_loop_in_small_steps(sizes: dict[str, float], order: int, within_deg: float) -> None:
    physics = Physics(torque_share=0.7, **sizes)
    longest_s = machine_of(TRANSFERS[order], [physics]).longest_s
    expected_deg = twin(order, physics)[1:]
    assert np.ptp(expected_deg) > 5.0
    found_deg = alone(TRANSFERS[order], physics, max(longest_s / FINE_S, 1.0))[1:]
    assert np.abs(found_deg - expected_deg).max() < within_deg


PLACED: list[tuple[dict[str, float], float]] = [
    ({}, 2e-3),
    ({"deadband_deg": 1.2}, 3e-3),
    ({"insensitive_deg": 0.8}, 1.5e-2),
    ({"friction_deg": 0.5}, 2e-2),
    ({"friction_deg": 0.2, "load_friction": 0.3, "droop_deg": 5.0}, 3e-2),
    ({"rate_up_deg_s": 60.0, "rate_down_deg_s": 110.0}, 2e-3),
    ({"deg_s_per_v": 15.0}, 2e-3),
    ({"speed_up_deg_s": 60.0, "speed_down_deg_s": 90.0}, 1e-2),
    ({"speed_up_deg_s": 80.0, "deadband_deg": 0.5, "backlash_deg": 0.6}, 1e-2),
    ({"set_point_deg_s": 90.0, "knee_deg": 2.0}, 1e-2),
    ({"stop_lower_deg": -3.0, "stop_upper_deg": 5.0}, 1e-2),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    "place", [pytest.param(BEFORE, id="before"), pytest.param(AFTER, id="after", marks=pytest.mark.nightly)]
)
@pytest.mark.parametrize(("sizes", "within_deg"), PLACED, ids=named)
def test_with_its_slow_pole_elsewhere_it_moves_as_that_loop_in_small_steps(
    place: float, sizes: dict[str, float], within_deg: float
) -> None:
    physics = Physics(slow_place=place, **sizes)
    expected_deg = twin(3, physics)[1:]
    assert np.ptp(expected_deg) > 5.0
    finer = max(machine_of(TRANSFERS[3], [physics]).longest_s / FINE_S, 1.0)
    # What is read behind a slow pole is exact to the twin's own step alone.
    twin_deg = 0.015 if place == AFTER else 0.0
    assert np.abs(alone(TRANSFERS[3], physics, finer)[1:] - expected_deg).max() < within_deg + twin_deg


FLIGHT_S = np.arange(0.0, 20.0, 0.02)
FLIGHT = np.array([FLIGHT_S, gusty(FLIGHT_S, np.random.default_rng(3)), np.zeros(FLIGHT_S.size)])
CALM = np.tile([300.0, 5.0, 1.0, 0.5, 0.3], (FLIGHT_S.size, 1))


@every_stepped_effect
def test_half_of_the_longest_step_changes_a_gusty_flight_by_less_than_is_said(effect: type[Effect]) -> None:
    physics = of_size(effect)
    whole_deg, half_deg = (
        moved(machine_of(EQ31, [physics], finer), physics, FLIGHT, FLIGHT_S, CALM)[:, 0] for finer in (1.0, 2.0)
    )
    plain_deg = moved(machine_of(EQ31, [Physics()]), Physics(), FLIGHT, FLIGHT_S, CALM)[:, 0]
    assert np.abs(whole_deg - plain_deg).max() > 0.02
    # A motor that is off within a band chatters at its edge.
    within_deg = 2e-2 if effect.form == "whole error" else 2e-3
    assert np.sqrt(np.mean((whole_deg - half_deg) ** 2)) < within_deg


@pytest.mark.parametrize("hangs", [{"resonance_hz": 12.0, "resonance_damping": 0.05}, {"lag_s": 0.03}], ids=named)
@pytest.mark.parametrize("servo", [{}, {"rate_up_deg_s": 60.0, "rate_down_deg_s": 60.0}], ids=named)
def test_what_hangs_on_a_shaft_is_as_exact_as_its_way_in_a_step(
    hangs: dict[str, float], servo: dict[str, float]
) -> None:
    """On a straight line from step to step, of 5 ms, it would be off by up to 4e-3 deg."""
    physics = Physics(**hangs, **servo)
    whole_deg, tenth_deg = (
        moved(machine_of(EQ31, [physics], finer), physics, FLIGHT, FLIGHT_S, CALM)[:, 0] for finer in (1.0, 10.0)
    )
    alone_deg = [
        moved(machine_of(EQ31, [Physics(**servo)], n), Physics(**servo), FLIGHT, FLIGHT_S, CALM) for n in (1.0, 10.0)
    ]
    assert np.abs(whole_deg - tenth_deg).max() < 1e-4 + 2.0 * np.abs(alone_deg[0] - alone_deg[1]).max()


@pytest.mark.parametrize("hangs", [{"resonance_hz": 3.0, "resonance_damping": 0.05}, {"lag_s": 0.25}], ids=named)
@pytest.mark.parametrize("apart_s", [2e-12, 1e-10, 1e-8, 1e-6, 9e-6, 2e-5])
def test_a_command_beside_an_instant_by_rounding_bends_nothing(hangs: dict[str, float], apart_s: float) -> None:
    """An autopilot that has run for hours stamps a position, and a command that takes effect, by one rounding apart."""
    physics, commands = Physics(**hangs), FLIGHT.copy()
    beside = FLIGHT.copy()
    beside[0] += apart_s
    near_deg, at_deg = (
        moved(machine_of(EQ31, [physics]), physics, each, FLIGHT_S, CALM)[:, 0] for each in (beside, commands)
    )
    assert np.abs(near_deg - at_deg).max() < 1e-3 + 300.0 * apart_s


# What holds of every effect.


@every_effect
@given(cuts=st.lists(st.integers(0, AT_S.size), max_size=6), order=st.sampled_from([1, 2, 3]))
@settings(max_examples=8, deadline=None)
def test_a_run_in_pieces_is_the_run_in_one_go(effect: type[Effect], cuts: list[int], order: int) -> None:
    physics = of_size(effect)
    if effect.slot is Slot.OWN and order != 3:
        physics = physics._replace(slow_place=0.0)
    machine = machine_of(TRANSFERS[order], [physics, physics._replace(bias_deg=1.0)])
    waiting, state, pieces = received(physics, Commands(*COMMANDS)), machine.new_state(), []
    edges = [0, *sorted(cuts), AT_S.size]
    for first, last in pairwise(edges):
        other = state.copy()
        found_deg, used = machine.run(state, waiting, AT_S[first:last], around=AROUND[first:last])
        again_deg, _ = machine.run(other, waiting, AT_S[first:last], around=AROUND[first:last])
        np.testing.assert_array_equal(again_deg, found_deg)
        pieces.append(found_deg)
        waiting = Commands(*(each[used:] for each in waiting))
    np.testing.assert_allclose(np.concatenate(pieces), moved(machine, physics), rtol=0, atol=NANODEGREE)


@every_effect
def test_commands_that_come_in_by_and_by_are_those_that_come_at_once(effect: type[Effect]) -> None:
    context = Context(
        airspeed_s=AT_S, airspeed_m_s=18.0 + AROUND[:, 1], voltage_s=AT_S, voltage_v=AROUND[:, 1],
        current_s=AT_S, current_a=AROUND[:, 3], load_s=AT_S, load=AROUND[:, 4],
    )  # fmt: skip
    servo = ServoModel(
        EQ31, of_size(effect)._replace(load_late_s=0.0), context if effect.name != "external_load" else Context()
    )
    at_once, by_and_by = Motion(servo, 1.0), Motion(servo, 1.0)
    at_once.receive(*COMMANDS)
    expected_deg, found_deg, known = at_once.at(AT_S), [], 0
    for at_s in AT_S:
        coming = int(np.searchsorted(COMMANDS[0], at_s + 0.2))
        by_and_by.receive(*COMMANDS[:, known:coming])
        found_deg.append(by_and_by.at(np.array([at_s]))[0])
        known = coming
    np.testing.assert_allclose(found_deg, expected_deg, rtol=0, atol=NANODEGREE)
    assert np.ptp(expected_deg) > 1.0


@every_effect
def test_variants_move_side_by_side_as_each_does_alone(effect: type[Effect]) -> None:
    variants = [of_size(effect), of_size(effect, 0.9), of_size(effect, 1.1)]
    together_deg = moved(machine_of(EQ31, variants), variants[0])
    for k, each in enumerate(variants):
        found_deg = moved(machine_of(EQ31, [each]), variants[0])[:, 0]
        np.testing.assert_allclose(together_deg[:, k], found_deg, rtol=0, atol=NANODEGREE)


@every_effect
def test_a_servo_beside_one_with_an_effect_has_none(effect: type[Effect]) -> None:
    """What is off does nothing, though the steps are short and all slots are passed."""
    for order, transfer in TRANSFERS.items():
        plain = Physics(slow_place=of_size(effect).slow_place if order == 3 else 0.0)
        with_effect = of_size(effect)._replace(slow_place=plain.slow_place)
        together_deg = moved(machine_of(transfer, [plain, with_effect]), plain)
        np.testing.assert_allclose(together_deg[:, 0], alone(transfer, plain), rtol=0, atol=NANODEGREE)


@every_effect
def test_a_size_at_which_it_is_off_is_no_effect(effect: type[Effect]) -> None:
    off = fields_of(everything())
    physics = installed(Physics(), [effect], [p.off for p in effect.parameters])
    at_rest = physics._replace(slow_place=0.0)
    assert {name: value for name, value in at_rest if value != off[name]} == {}


@every_stepped_effect
def test_plain_python_and_the_compiled_stepper_give_the_same_numbers(effect: type[Effect]) -> None:
    physics = of_size(effect)
    for transfer in TRANSFERS.values():
        compiled = machine_of(transfer, [physics, of_size(effect, 0.8)])
        plain = replace(compiled, stepper=stepper_of(everything(), is_compiled=False))
        assert plain.stepper.run is not compiled.stepper.run
        few_s, few = AT_S[:16], AROUND[:16]
        compiled_deg, plain_deg = (moved(each, physics, COMMANDS, few_s, few) for each in (compiled, plain))
        np.testing.assert_allclose(plain_deg, compiled_deg, rtol=0, atol=NANODEGREE)


@every_effect
def test_rest_stays_rest(effect: type[Effect]) -> None:
    for order in TRANSFERS:
        check_rest(effect, order)


def check_rest(effect: type[Effect], order: int) -> None:
    """Under a command that holds; a load is balanced by the error that it costs."""
    physics = of_size(effect)
    if order != 3:
        physics = physics._replace(slow_place=0.0)
    at_s = np.arange(0.0, 4.0, 0.013)
    machine, around = machine_of(TRANSFERS[order], [physics]), np.tile(CALM[0], (at_s.size, 1))
    hold = np.array([[-1.0], [4.0], [0.0]])
    read_deg = moved(machine, physics, hold, at_s, around)[:, 0]
    if effect.slot is Slot.LOAD:
        shaft_deg, (pressure_pa, *_, load) = read_deg[-1], CALM[0].tolist()
        taken_deg = physics.airload_per_pa * pressure_pa * shaft_deg + physics.air_trim_per_pa * pressure_pa
        taken_deg += physics.droop_deg * math.sin(math.radians(shaft_deg - physics.hangs_deg)) - physics.load_deg * load
        assert shaft_deg == pytest.approx(4.0 - taken_deg, abs=1e-6)
        assert abs(taken_deg) > 0.05
    else:
        np.testing.assert_allclose(read_deg, read_deg[0], rtol=0, atol=NANODEGREE)
        assert 3.0 < read_deg[0] < 6.0


def test_a_clock_that_is_off_is_a_delay_that_may_be_negative() -> None:
    late_deg, expected_deg = alone(EQ31, Physics(offset_s=0.03)), alone(EQ31, Physics(delay_s=0.03))
    np.testing.assert_array_equal(late_deg, expected_deg)
    early_deg = moved(machine_of(EQ31, [Physics()]), Physics(offset_s=-0.02))[:, 0]
    shifted = COMMANDS - np.array([[0.02], [0.0], [0.0]])
    expected_deg = moved(machine_of(EQ31, [Physics()]), Physics(), shifted)[:, 0]
    np.testing.assert_allclose(early_deg, expected_deg, rtol=0, atol=NANODEGREE)


@every_effect
def test_a_servo_that_becomes_slow_does_not_jump(effect: type[Effect]) -> None:
    for order in (1, 2, 3, 4):
        check_no_jump(effect, order)


def check_no_jump(effect: type[Effect], order: int) -> None:
    """Its position; of what hangs on it nothing jumps either."""
    physics = of_size(effect)
    transfer = TRANSFERS.get(order)
    if transfer is None:
        if effect.slot in STEPPED[:6]:
            return
        transfer = TransferFunction((4e6, 4e8), tuple(np.poly([-30.0, -60.0, -200.0 + 50.0j, -200.0 - 50.0j]).real))
    if order != 3:
        physics = physics._replace(slow_place=0.0)
    if effect.slot in (Slot.EVENTS, Slot.READING) and effect.form in ("position",):
        return  # read in steps
    servo = ServoModel(transfer, physics)
    motion = Motion(servo, 1.0)
    motion.receive(*COMMANDS)
    (before_deg,) = motion.at(AT_S[:14])[-1:]
    motion.become(servo.slower(0.3))
    at_s = AT_S[13] + np.array([0.0, 1e-7, 1e-4])
    after_deg = motion.at(at_s)
    assert after_deg[0] == pytest.approx(before_deg, abs=1e-9)
    assert after_deg[1] == pytest.approx(before_deg, abs=1e-3)
    assert abs(after_deg[2] - before_deg) < 0.2


@pytest.mark.parametrize(("order", "zeros"), [(n, z) for n in (1, 2, 3, 4) for z in range(n)])
def test_a_slower_servo_is_a_servo_in_stretched_time(order: int, zeros: int) -> None:
    servo = ServoModel(some_transfer(np.random.default_rng(order + 7 * zeros), order, zeros)).servo()
    since_s, share = np.linspace(0.0, 1.0, 60), 0.4
    healthy, slow = Motion(servo, 0.0), Motion(servo, 0.0)
    for motion in (healthy, slow):
        motion.receive(np.zeros(1), np.ones(1), np.zeros(1))
        motion.rest(-0.1, 0.0)
        motion.at(np.array([0.03]))
    slow.become(servo.slower(share))
    expected_deg = healthy.at(0.03 + share * since_s)
    np.testing.assert_allclose(slow.at(0.03 + since_s), expected_deg, rtol=0, atol=1e-9 * np.abs(expected_deg).max())


# Friction, dead bands and frames in closed form.


def held(order: int, physics: Physics, error_deg: float) -> FloatArray:
    """A servo at rest whose command grows to an error within four seconds, and stays there for one."""
    commands = np.array([[0.0, 4.0], [0.0, error_deg], [error_deg / 4.0, 0.0]])
    at_s = np.arange(500) / 100.0
    return moved(machine_of(TRANSFERS[order], [physics]), physics, commands, at_s, np.tile(CALM[0], (500, 1)))[:, 0]


@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize(("friction_deg", "share"), [(0.5, 0.0), (0.5, 0.4), (1.0, 0.2)])
def test_a_servo_that_sticks_does_not_creep_and_breaks_away_at_the_torque_that_overcomes_its_friction(
    order: int, friction_deg: float, share: float
) -> None:
    """The torque of an error e overcomes a friction of f + s e from e = f / (1 - s) on."""
    physics, breakaway_deg = Physics(friction_deg=friction_deg, load_friction=share), friction_deg / (1.0 - share)
    np.testing.assert_array_equal(held(order, physics, 0.99 * breakaway_deg), 0.0)
    assert held(order, physics, 1.02 * breakaway_deg)[-1] > 0.0


@pytest.mark.parametrize("order", TRANSFERS)
@pytest.mark.parametrize("field", ["deadband_deg", "insensitive_deg"])
def test_a_dead_band_holds_the_servo(order: int, field: str) -> None:
    np.testing.assert_allclose(held(order, Physics(**{field: 1.0}), 0.49), 0.0, atol=1e-3)
    assert held(order, Physics(**{field: 1.0}), 0.52)[-1] > 0.01


def test_a_reading_in_steps_is_the_nearest_of_them() -> None:
    fine_deg, coarse_deg = alone(EQ31, Physics()), alone(EQ31, Physics(output_step_deg=0.35))
    np.testing.assert_allclose(coarse_deg / 0.35, np.floor(fine_deg / 0.35 + 0.5), atol=1e-9)


def test_frames_carry_the_command_in_force_when_they_begin() -> None:
    period_s, phase = 0.02, 0.3
    physics = Physics(frame_s=period_s, frame_phase=phase)
    frame_s, frame_deg, slope_deg_s = received(physics, Commands(*COMMANDS))
    np.testing.assert_allclose(frame_s / period_s - phase, np.arange(145, 145 + frame_s.size), atol=1e-9)
    assert frame_s[0] - period_s < COMMANDS[0, 0] <= frame_s[0]
    assert frame_s[-2] <= COMMANDS[0, -1] < frame_s[-1]
    assert not slope_deg_s.any()
    for when_s, deg in zip(frame_s, frame_deg, strict=True):
        k = np.flatnonzero(COMMANDS[0] <= when_s)[-1]
        assert deg == pytest.approx(COMMANDS[1, k] + COMMANDS[2, k] * (when_s - COMMANDS[0, k]), abs=1e-12)


# What a log may hold.

T = np.arange(0.0, 0.2, 0.01)
STEP = np.where(T > 0.025, 5.0, 1.0)
MODELS = [
    ServoModel(EQ31),
    ServoModel.of(servo_named("hs225bb-eq31")),
    ServoModel(EQ31) + RateLimit(60.0) + Backlash(0.5),
]


@pytest.mark.parametrize("model", MODELS)
def test_logs_with_next_to_nothing_in_them(model: ServoModel) -> None:
    nothing = np.zeros(0)
    assert model.simulate(T[:2], STEP[:2], T[:2]) == pytest.approx([1.0, 1.0], abs=1e-9)
    assert model.simulate(T, STEP, nothing).size == 0
    np.testing.assert_array_equal(model.simulate(nothing, nothing, T), 0.0)
    servo, anew = model.servo(), np.arange(T.size) == 0
    held_deg = started_anew(servo, Commands(nothing, nothing, nothing), T, np.full(T.size, 3.0), anew)
    np.testing.assert_allclose(held_deg, 3.0, atol=1e-9)
    assert started_anew(servo, Commands(T, STEP, 0.0 * T), nothing, nothing, anew).size == 0


@pytest.mark.parametrize("model", MODELS)
def test_a_stamp_that_goes_back_or_is_none_does_not_move_the_clock(model: ServoModel) -> None:
    orderly = [0, 1, 2, 5, 6, 7, 12]
    expected_deg = model.simulate(T, STEP, T[orderly])
    assert np.ptp(expected_deg) > 0.5
    back_deg = model.simulate(T, STEP, T[[0, 1, 2, 5, 4, 6, 7, 12]])
    np.testing.assert_array_equal(np.delete(back_deg, 4), expected_deg)
    assert back_deg[4] == back_deg[3]
    with_nan_s = T[[0, 1, 2, 5, 6, 7, 12]]
    with_nan_deg = model.simulate(T, STEP, np.insert(with_nan_s, 4, np.nan))
    np.testing.assert_array_equal(np.delete(with_nan_deg, 4), expected_deg)
    twice_deg = model.simulate(T, STEP, np.repeat(T[orderly], 2))
    np.testing.assert_array_equal(twice_deg, np.repeat(expected_deg, 2))


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("rate_hz", [20_000.0, 1.0])
def test_it_may_be_looked_at_very_often_or_seldom(model: ServoModel, rate_hz: float) -> None:
    at_s = np.arange(0.0, 5.0, 1.0) if rate_hz == 1.0 else np.arange(0.0, 0.2, 1.0 / rate_hz)
    command_s, command_deg = np.array([0.0, 0.02, 1.5]), np.array([0.0, 5.0, -4.0])
    usual_s = np.arange(0.0, at_s[-1] + 0.005, 0.01)
    usual_deg = model.simulate(command_s, command_deg, usual_s)
    found_deg = model.simulate(command_s, command_deg, at_s)
    same = np.isclose(at_s[:, None], usual_s[None, :], rtol=0, atol=1e-9)
    rows, columns = np.nonzero(same)
    assert rows.size > 3
    np.testing.assert_allclose(found_deg[rows], usual_deg[columns], rtol=0, atol=1e-4)


def test_a_block_of_nan_commands_spoils_no_servo_for_ever() -> None:
    """A servo with an effect in its loop goes on; where nothing bends it, what is asked is what it does."""
    command_deg = STEP.copy()
    command_deg[4:7] = np.nan
    physics = Physics(friction_deg=0.2)
    commands = np.array([T, command_deg, 0.0 * T])
    at_s = np.arange(0.0, 3.0, 0.01)
    found_deg = moved(machine_of(EQ31, [physics]), physics, commands, at_s, np.tile(CALM[0], (at_s.size, 1)))[:, 0]
    assert found_deg[-1] == pytest.approx(5.0, abs=0.25)


@every_stepped_effect
def test_commands_far_beyond_any_travel_leave_finite_numbers(effect: type[Effect]) -> None:
    physics = of_size(effect)
    far = COMMANDS * np.array([[1.0], [60.0], [60.0]])
    read_deg = moved(machine_of(EQ31, [physics]), physics, far)
    assert np.abs(far[1]).max() > 500.0
    assert np.isfinite(read_deg).all()
    assert np.abs(read_deg).max() < 2e5  # through a linkage whose ratio grows with the square of its travel


@pytest.mark.parametrize(
    "field",
    ["rate_up_deg_s", "speed_up_deg_s", "follow_up_deg_s", "set_point_deg_s", "deg_s_per_v", "speed_deg_s_per_v"],
)
@pytest.mark.parametrize("order", TRANSFERS)
def test_a_servo_of_no_speed_stays_where_it_is(field: str, order: int) -> None:
    sizes = {field: 0.0, field.replace("_up_", "_down_"): 0.0}
    read_deg = alone(TRANSFERS[order], Physics(**sizes))
    # Under a ramp, the error of a step is held at its middle.
    np.testing.assert_allclose(read_deg, 1.0, rtol=0, atol=0.01)


def test_effects_in_the_loop_of_a_servo_that_has_no_shaft_are_refused() -> None:
    four = TransferFunction((24.0,), tuple(np.poly([-1.0, -2.0, -3.0, -4.0])))
    zero = TransferFunction((1.0, 2.0), (1.0, 3.0, 2.0))
    for transfer, words in ((four, "order 4 with 0 zeros"), (zero, "order 2 with 1 zeros")):
        with pytest.raises(DesignError, match=f"{words} has no friction"):
            machine_of(transfer, [Physics(friction_deg=0.1)])
        assert machine_of(transfer, [Physics(backlash_deg=0.1)]).longest_s < 1.0


class Tired(Effect):
    """A motor that loses torque for as long as a run lasts."""

    name, slot, memory = "tired", Slot.ERROR, 1
    parameters = (Parameter("share", low=0.0, high=1.0, neutral=0.0, typical=0.5),)

    @staticmethod
    def act(x: float, now: Now, share: float, since_s: float) -> tuple[float, float]:
        """Less of the error drives it, the longer the run."""
        since_s = min(since_s + now.step_s, 1.0)
        return x * (1.0 - share * since_s), since_s


@pytest.mark.slow
def test_what_an_effect_in_the_loop_remembers_is_forgotten_where_a_run_begins_anew() -> None:
    at_s = np.concatenate([AT_S, AT_S + 10.0])
    anew = np.zeros(at_s.size, dtype=bool)
    anew[[0, AT_S.size]] = True
    commands = np.concatenate([COMMANDS, COMMANDS + np.array([[10.0], [0.0], [0.0]])], axis=1)
    around = np.concatenate([AROUND, AROUND])
    with including(Tired):
        physics = installed(Physics(), [Tired], [0.9])
        machine = machine_of(TRANSFERS[3], [physics])
        read_deg, _ = machine.run(
            machine.new_state(), Commands(*commands), at_s,
            anew=anew, measured_deg=np.zeros(at_s.size), around=around,
        )  # fmt: skip
    first_deg, second_deg = read_deg[: AT_S.size, 0], read_deg[AT_S.size :, 0]
    np.testing.assert_allclose(second_deg, first_deg, rtol=0, atol=NANODEGREE)
    assert np.abs(first_deg - alone(TRANSFERS[3], Physics())).max() > 0.1


@pytest.mark.slow
def test_threads_that_need_a_stepper_at_once_make_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the home cannot be written, too: each wrote the same file, and the second found its part gone."""
    blocked, temporary = tmp_path / "file", tmp_path / "temporary"
    blocked.write_text("no folder")
    temporary.mkdir()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(blocked))
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    cache_folder.cache_clear()
    effects = [each for each in everything() if each.slot in STEPPED]
    for last in range(2, 12):  # each time another stepper
        few = tuple(effects[1:last:2])
        with ThreadPoolExecutor(8) as pool:
            made = list(pool.map(stepper_of, [few] * 8))
        assert len({each.run for each in made}) == 1
    cache_folder.cache_clear()


@pytest.mark.slow
def test_kept_machine_code_is_made_anew_where_a_number_of_another_file_changes(tmp_path: Path) -> None:
    """A calibrated effect adds columns to what compiled loops of other files take: they went on with the old ones."""
    (tmp_path / "outer.py").write_text(
        "import sys\nfrom logparsers.compiled import compiled\nfrom inner import OFFSET, twice\n\n"
        "@compiled\ndef outer(x):\n    return twice(x) + OFFSET\n\nprint(outer(1.0))\n"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept"), "PYTHONDONTWRITEBYTECODE": "1"}

    def said(offset: float, factor: float) -> str:
        (tmp_path / "inner.py").write_text(
            f"from logparsers.compiled import compiled\n\nOFFSET = {offset}\n\n"
            f"@compiled\ndef twice(x):\n    return {factor} * x\n"
        )
        command = [sys.executable, str(tmp_path / "outer.py")]
        return subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout.strip()

    assert [said(1.0, 2.0), said(5.0, 2.0), said(5.0, 3.0), said(1.0, 2.0)] == ["3.0", "7.0", "8.0", "3.0"]
