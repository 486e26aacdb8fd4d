"""Transfer functions and loops by closed forms: poles, modes, bandwidths, bounds and what scales them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.linalg

from servofd.core.errors import DesignError
from servofd.servo.effect import Slot
from servofd.servo.faults import Floating
from servofd.servo.library import library, servo_named
from servofd.servo.loop import AFTER, BEFORE, INSIDE, Scales, loop_of, scaled
from servofd.servo.motion import Motion, machine_of
from servofd.servo.physics import Physics
from servofd.servo.registry import everything
from servofd.servo.servo_model import ServoModel
from servofd.servo.transfer import TransferFunction

SECOND = TransferFunction((900.0,), (1.0, 42.0, 900.0))
KNOWN = ServoModel.of(servo_named("hs225bb-eq31"))
DENOMINATORS = [
    (2.0, 50.0),
    (1.0, 42.0, 900.0),
    (1.0, 70.0, 900.0),
    (0.5, 47.44, 3330.395, 61118.8),
    (1.0, 6.0, 11.0, 6.0),
]


def unit(*poles: complex) -> TransferFunction:
    denominator = np.poly(poles).real
    return TransferFunction((denominator[-1],), tuple(denominator.tolist()))


@pytest.mark.parametrize("name", library())
def test_modes_and_poles_are_those_of_the_transfer_function(name: str) -> None:
    transfer = servo_named(name).transfer
    s = 1j * np.array([0.3, 5.0, 28.0, 90.0])
    modes, poles = transfer.modes(), transfer.poles_rad_s
    # Of a pair only the member with positive imaginary part is kept; half of its weight is the other's.
    pairs = (modes.decay_rad_s.imag != 0.0)[:, None]
    one = modes.weight[:, None] * modes.decay_rad_s[:, None] / (s + modes.decay_rad_s[:, None])
    other = np.conj(modes.weight * modes.decay_rad_s)[:, None] / (s + np.conj(modes.decay_rad_s)[:, None])
    np.testing.assert_allclose(np.where(pairs, 0.5 * (one + other), one).sum(axis=0), transfer.at(s), rtol=1e-6)
    assert modes.weight.real.sum() == pytest.approx(transfer.dc_gain)
    np.testing.assert_allclose(np.polyval(transfer.denominator, poles) / transfer.denominator[-1], 0.0, atol=1e-9)
    assert list(poles.imag != 0.0) == sorted(poles.imag != 0.0)
    assert abs(transfer.at(np.array([1j * transfer.bandwidth_rad_s]))[0]) == pytest.approx(10.0 ** (-3.0 / 20.0))


@pytest.mark.parametrize(
    ("transfer", "bandwidth_rad_s"),
    [
        # |G|^2 = 10^-0.3, solved by hand.
        (unit(-25.0), 25.0 * math.sqrt(10.0**0.3 - 1.0)),
        (unit(-25.0, -25.0), 25.0 * math.sqrt(10.0**0.15 - 1.0)),
        (TransferFunction((1.0, 10.0), (1.0, 12.0)), math.inf),
        (SECOND, 30.0 * math.sqrt(1.0 - 2.0 * 0.49 + math.sqrt((1.0 - 2.0 * 0.49) ** 2 + 10.0**0.3 - 1.0))),
    ],
)
def test_the_bandwidth_is_where_the_gain_is_three_decibels_down(
    transfer: TransferFunction, bandwidth_rad_s: float
) -> None:
    assert transfer.bandwidth_rad_s == pytest.approx(bandwidth_rad_s, rel=1e-9)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("centre", [-40.0, -40.0 + 30.0j])
def test_poles_that_fall_together_respond_as_the_repeated_pole_does(count: int, centre: complex) -> None:
    poles = [centre] * count + ([centre.conjugate()] * count if isinstance(centre, complex) else [])
    if len(poles) > 6:
        return
    transfer = unit(*poles)
    modes, s = transfer.modes(), 1j * np.array([0.0, 11.0, 40.0])
    one = modes.weight[:, None] * modes.decay_rad_s[:, None] / (s + modes.decay_rad_s[:, None])
    other = np.conj(modes.weight * modes.decay_rad_s)[:, None] / (s + np.conj(modes.decay_rad_s)[:, None])
    pairs = (modes.decay_rad_s.imag != 0.0)[:, None]
    found = np.where(pairs, 0.5 * (one + other), one).sum(axis=0)
    np.testing.assert_allclose(found, np.prod([p / (p - s) for p in poles], axis=0), rtol=2e-4)


@pytest.mark.parametrize(
    ("transfer", "reason"),
    [
        (TransferFunction((1.0, 1.0), (1.0, 3.0)), "more poles than zeros"),
        (unit(-1.0, 2.0), "negative real parts"),
        (TransferFunction((1.0,), (1.0, 0.0)), "negative real parts"),
        (unit(-0.9e-5), "moves within 100000 s"),
        (unit(-5.0 + 1.1e5j, -5.0 - 1.1e5j), "swings no faster than 100000 rad/s"),
        (unit(*[-40.0 - 0.5 * k for k in range(6)]), "too close"),
    ],
)
def test_what_no_servo_can_be_is_refused(transfer: TransferFunction, reason: str) -> None:
    with pytest.raises(DesignError, match=reason):
        transfer.modes()


def test_the_slowest_and_the_fastest_servo_are_servos() -> None:
    assert unit(-1.1e-5).modes().weight == pytest.approx(1.0)
    assert unit(-5.0 + 0.9e5j, -5.0 - 0.9e5j).modes().weight.size == 1
    assert unit(-1e9).modes().decay_rad_s.real == pytest.approx(1e9)
    with pytest.raises(DesignError, match="must not be zero"):
        TransferFunction((1.0,), (0.0, 0.0))
    with pytest.raises(DesignError, match=r"numerator .* not finite"):
        TransferFunction((math.nan,), (1.0, 1.0))
    with pytest.raises(DesignError, match=r"denominator: the first coefficient, 1e-201, is nothing beside 1"):
        TransferFunction((1.0,), (1e-201, 1.0))
    assert TransferFunction((0.0, 3.0), (0.0, 0.0, 1.0, 2.0)) == TransferFunction((3.0,), (1.0, 2.0))
    assert TransferFunction((0.0,), (1.0, 2.0)).dc_gain == 0.0
    assert TransferFunction((1.0,), (1.0, 0.0)).dc_gain == math.inf


def test_a_scaled_bandwidth_stretches_time_and_a_unity_gain_is_one() -> None:
    transfer = TransferFunction((3.0, 40.0), (1.0, 12.0, 50.0))
    s = 1j * np.array([0.5, 3.0, 20.0])
    np.testing.assert_allclose(transfer.with_bandwidth_scaled(0.4).at(0.4 * s), transfer.at(s), rtol=1e-12)
    np.testing.assert_allclose(transfer.with_unity_dc().at(s), transfer.at(s) / 0.8, rtol=1e-12)


@pytest.mark.parametrize("place", [BEFORE, INSIDE, AFTER])
@pytest.mark.parametrize("denominator", DENOMINATORS)
@pytest.mark.parametrize(
    ("bandwidth", "damping", "share"), [(1.0, 1.0, 0.8), (0.6, 1.0, 0.6), (1.0, 0.5, 0.8), (1.7, 2.0, 0.9)]
)
def test_a_loop_has_the_poles_of_its_servo_scaled_and_rests_where_it_is_asked_to(
    denominator: tuple[float, ...], bandwidth: float, damping: float, share: float, place: float
) -> None:
    order = len(denominator) - 1
    transfer = TransferFunction((0.7 * denominator[-1],), denominator)
    scales = Scales(bandwidth=bandwidth, damping=damping, torque_share=share, place=place)
    loop, as_scaled = loop_of(transfer, scales), scaled(transfer, scales)
    states, by = loop.a.reshape(3, 3)[:order, :order], loop.b.reshape(3, 3)[:order]
    monic = np.array(as_scaled.denominator) / as_scaled.denominator[0]
    np.testing.assert_allclose(np.poly(states), monic, rtol=1e-9)
    assert (loop.gain, as_scaled.dc_gain) == pytest.approx((0.7, 0.7))
    # At rest the states are those of a command of one degree; a push counts as much, and a pull as one of its weight.
    np.testing.assert_allclose(states @ loop.rest[:order] + by[:, 0], 0.0, atol=1e-9 * np.abs(by).max())
    pulled = np.linalg.solve(states, -by[:, 2])[0]
    np.testing.assert_allclose(pulled * loop.per_error, np.linalg.solve(states, -by[:, 1])[0])
    # What is asked for and pushed leaves, through whichever state, as much.
    np.testing.assert_allclose(np.linalg.solve(states, -by[:, 0])[loop.leaves], 1.0)


def test_steps_are_matrix_exponentials_on_a_grid_that_is_fine_enough_for_the_fastest_pole() -> None:
    for transfer, grid_s in (
        (unit(-25.0), 2.5e-4),
        (unit(-1000.0), 3.125e-5),
        (unit(-24.0, -35.0 + 60.0j, -35.0 - 60.0j), 2.5e-4),
    ):
        loop = loop_of(transfer, Scales())
        assert loop.grid_s == pytest.approx(grid_s)
        size = loop.rest.size
        rates = np.zeros((size + 4, size + 4))
        rates[:size, :size], inputs = loop.a.reshape(size, size), loop.b.reshape(size, 3)
        rates[:size, size], rates[:size, size + 2 :], rates[size, size + 1] = inputs[:, 0], inputs[:, 1:], 1.0
        for k in (1, 7, len(loop.steps) - 1):
            expected = scipy.linalg.expm(rates * k * loop.grid_s)[:size]
            np.testing.assert_allclose(loop.steps[k].reshape(size, -1), expected, rtol=1e-9, atol=1e-13)


def test_damping_acts_on_the_fastest_pair_and_on_nothing_of_one_pole() -> None:
    half = Scales(damping=0.5)
    np.testing.assert_allclose(scaled(SECOND, half).denominator, (1.0, 21.0, 900.0), rtol=1e-12)
    np.testing.assert_allclose(scaled(unit(-25.0), half).denominator, (1.0, 25.0), rtol=1e-12)
    # A pair that is slower than the third pole is the pair all the same.
    slow_pair = unit(-300.0, -10.0 + 20.0j, -10.0 - 20.0j)
    expected = np.polymul([1.0, 300.0], [1.0, 10.0, 500.0])
    np.testing.assert_allclose(scaled(slow_pair, half).denominator, expected, rtol=1e-9)


def test_only_a_servo_on_which_something_acts_needs_short_steps() -> None:
    plain = Physics()
    assert (plain.delay_s, plain.frame_s, plain.command_step_deg, plain.offset_s, plain.output_step_deg) == (0.0,) * 5
    assert not machine_of(SECOND, [plain]).acts[-1]
    for name in ("friction_deg", "load_friction", "droop_deg", "airload_per_pa", "insensitive_deg", "lag_s"):
        assert machine_of(SECOND, [Physics(**{name: 0.1})]).acts[-1]
    assert not machine_of(SECOND, [Physics(offset_s=1.0, bias_deg=2.0, output_step_deg=0.1, gain=0.9)]).acts[-1]
    too_many, with_zero = unit(-1.0, -2.0, -3.0, -4.0), TransferFunction((1.0, 2.0), (1.0, 3.0, 2.0))
    for transfer, reason in ((too_many, "a servo of order 4 with 0 zeros"), (with_zero, "of order 2 with 1 zeros")):
        with pytest.raises(DesignError, match=reason):
            ServoModel(transfer).explainable()
        with pytest.raises(DesignError, match=reason):
            machine_of(transfer, [Physics(friction_deg=0.1)])


def test_effects_act_in_the_order_of_the_way_from_command_to_reading() -> None:
    order = ["EVENTS", "COMMAND", "ERROR", "LOAD", "GRIP", "SPEED", "STOP", "OUTPUT", "READING", "OWN"]
    assert [slot.name for slot in Slot] == order
    linkage = list(dict.fromkeys(each.name for each in everything() if each.slot is Slot.OUTPUT))
    way = ["rate_limit", "resonance", "backlash", "linkage_nonlinearity", "gain", "position_limit", "sensor_lag"]
    assert linkage == way


def test_frames_in_pieces_are_frames_in_one_go() -> None:
    servo = ServoModel(KNOWN.transfer, Physics(frame_s=0.03, frame_phase=0.4))
    at_s = 5.0 + np.arange(60) / 100.0
    commands = (np.arange(5.0, 5.6, 0.04), np.random.default_rng(1).uniform(-9.0, 9.0, 15), np.zeros(15))
    whole, pieces = Motion(servo, 1.0), Motion(servo, 1.0)
    whole.receive(*commands)
    pieces.receive(*commands)
    expected_deg = whole.at(at_s)
    found_deg = np.concatenate([pieces.at(at_s[k : k + 7]) for k in range(0, 60, 7)])
    assert np.ptp(expected_deg) > 5.0
    np.testing.assert_allclose(found_deg, expected_deg, atol=1e-12)


def test_a_command_in_steps_is_the_nearest_of_them_and_positions_may_be_stamped_late() -> None:
    at_s, commands = np.arange(80) / 100.0, (np.array([0.0, 0.2]), np.array([1.1, 4.7]), np.zeros(2))
    found = []
    for physics, late_s, deg in (
        (Physics(command_step_deg=0.5), 0.0, (1.0, 4.5)),
        (Physics(offset_s=0.03), 0.03, (1.1, 4.7)),
    ):
        motion, plain = (Motion(ServoModel(KNOWN.transfer, one), 1.0) for one in (physics, Physics()))
        motion.receive(*commands)
        plain.receive(commands[0], np.array(deg), commands[2])
        found.append(np.abs(motion.at(at_s) - plain.at(at_s - late_s)).max())
    assert found == pytest.approx([0.0, 0.0], abs=1e-12)


def test_the_wind_of_a_seed_is_the_same_in_every_version() -> None:
    moved_deg = Floating(0.0, seed=3).moved(KNOWN.servo(), np.array([0.0, 0.2, 1.0, 30.0]), np.full(4, 2.0))
    assert moved_deg == pytest.approx([2.0, -3.2631387, 0.8697992, -0.0847946], abs=1e-6)


def test_a_servo_with_effects_begins_where_the_latest_of_its_commands_wants_it() -> None:
    motion = Motion(ServoModel(KNOWN.transfer, Physics(backlash_deg=0.1)))
    motion.receive(np.array([0.0, 0.5, 2.0]), np.array([6.0, 9.0, -3.0]), np.zeros(3))
    assert motion.at(np.array([1.0]))[0] == pytest.approx(9.0)
