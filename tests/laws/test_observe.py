"""The kernel of servo and residual, call by call: starts, ramps, restarts and gains, against matrix exponentials."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.signal import tf2ss

from servofd.core.types import FloatArray
from servofd.detection.residual import FilterMemory, FilterParameters, filter_in_place, lag_weights
from servofd.servo.effects.commands import Commands
from servofd.servo.effects.linkage import PositionLimit
from servofd.servo.library import servo_named
from servofd.servo.motion import started_anew
from servofd.servo.servo_model import ServoModel
from servofd.servo.transfer import TransferFunction

EQ31 = servo_named("hs225bb-eq31").transfer
RESTART_NONE, RESTART_FILTER, RESTART_ALL = 0, 1, 2
"""What begins anew at a sample: nothing, the filter, or servo and filter."""
GAINS = {
    1.0: EQ31,
    0.7: TransferFunction((0.7 * EQ31.denominator[-1],), EQ31.denominator),
}
NONE = np.zeros((3, 0))
STEPS = np.array([[0.5, 0.8], [10.0, -4.0], [0.0, 0.0]])
RAMPS = np.array([[0.0, 0.11, 0.25, 0.4], [1.0, 6.0, 6.0, -2.0], [20.0, -35.0, 0.0, 50.0]])
AT_S = np.cumsum(np.random.default_rng(11).uniform(0.002, 0.03, 60))


def filter_of(transfer: TransferFunction, pole_rad_s: float = 50.0) -> FilterParameters:
    return FilterParameters(pole_rad_s, -transfer.poles_rad_s, transfer.dc_gain)


def observed(
    transfer: TransferFunction, commands: FloatArray, at_s: FloatArray, measured_deg: FloatArray, restart: list[int]
) -> tuple[FloatArray, FloatArray]:
    """Simulated position and residual."""
    servo = ServoModel(transfer).servo()
    restarts = np.array(restart + [RESTART_NONE] * (at_s.size - len(restart)), dtype=np.int8)
    simulated_deg = started_anew(servo, Commands(*commands), at_s, measured_deg, restarts == RESTART_ALL)
    return simulated_deg, filtered(filter_of(transfer), at_s, measured_deg - simulated_deg, restarts)


def filtered(
    residual_filter: FilterParameters, at_s: FloatArray, error_deg: FloatArray, restarts: NDArray[np.int8]
) -> FloatArray:
    memory = FilterMemory.of(residual_filter, 1)
    residual_deg = np.array(error_deg)
    filter_in_place(residual_filter, memory, at_s, residual_deg, restarts)
    return residual_deg


def exact(transfer: TransferFunction, start_deg: float, commands: FloatArray, at_s: FloatArray) -> FloatArray:
    """From rest at a deflection at the first instant: one matrix exponential per event, the command on its ramp."""
    a, b, c, _ = tf2ss(transfer.numerator, transfer.denominator)
    n = a.shape[0]
    whole = np.zeros((n + 2, n + 2))
    whole[:n, :n], whole[:n, n:-1], whole[n, n + 1] = a, b, 1.0
    held = start_deg / transfer.dc_gain
    state = np.concatenate([np.linalg.solve(-a, b[:, 0] * held), [held, 0.0]])
    now, found = at_s[0], []
    events = [(when_s, 0, k) for k, when_s in enumerate(commands[0])] + [(when_s, 1, 0) for when_s in at_s]
    for when_s, kind, k in sorted(events):
        state = expm(whole * max(when_s - now, 0.0)) @ state
        now = max(now, when_s)
        if kind:
            found.append(float((c @ state[:n])[0]))
        else:
            state[n:] = commands[1, k] + commands[2, k] * (now - when_s), commands[2, k]
    return np.array(found)


@pytest.mark.parametrize("gain", GAINS)
def test_a_servo_stays_where_it_was_measured_until_its_first_command(gain: float) -> None:
    measured_deg = np.full(AT_S.size, 3.0)
    found_deg, _ = observed(GAINS[gain], STEPS, AT_S, measured_deg, [RESTART_ALL])
    assert found_deg[AT_S < 0.5] == pytest.approx(3.0, abs=1e-12)
    np.testing.assert_allclose(found_deg, exact(GAINS[gain], 3.0, STEPS, AT_S), atol=1e-9)
    assert np.ptp(found_deg) > 5.0
    alone_deg, _ = observed(GAINS[gain], NONE, AT_S, measured_deg, [RESTART_ALL])
    assert alone_deg == pytest.approx(3.0, abs=1e-12)


@pytest.mark.parametrize("gain", GAINS)
def test_where_nothing_was_measured_it_begins_where_a_command_wants_it(gain: float) -> None:
    unknown_deg = np.full(AT_S.size, math.nan)
    found_deg, residual_deg = observed(GAINS[gain], STEPS, AT_S, unknown_deg, [RESTART_ALL])
    assert found_deg[AT_S < 0.8] == pytest.approx(10.0 * gain, abs=1e-9)
    np.testing.assert_allclose(found_deg, exact(GAINS[gain], 10.0 * gain, STEPS, AT_S), atol=1e-9)
    assert np.isnan(residual_deg).all()


@pytest.mark.parametrize("gain", GAINS)
@pytest.mark.parametrize("first_s", [0.0, 0.11, 0.17])
def test_a_ramp_that_is_under_way_is_taken_up_where_it_is(gain: float, first_s: float) -> None:
    """A command at the very instant of the start is in force; the ramp before it is over."""
    at_s = first_s + AT_S - AT_S[0]
    unknown_deg = np.full(AT_S.size, math.nan)
    k = int(np.searchsorted(RAMPS[0], first_s, side="right")) - 1
    wanted_deg = RAMPS[1, k] + RAMPS[2, k] * (first_s - RAMPS[0, k])
    for measured_deg, start_deg in ((unknown_deg, gain * wanted_deg), (np.full(AT_S.size, 2.5), 2.5)):
        found_deg, _ = observed(GAINS[gain], RAMPS, at_s, measured_deg, [RESTART_ALL])
        np.testing.assert_allclose(found_deg, exact(GAINS[gain], start_deg, RAMPS[:, k:], at_s), atol=1e-9)


def test_a_restart_on_the_way_forgets_what_was_before() -> None:
    """The servo begins anew at rest where it is measured then; its filter, at the error that there is."""
    measured_deg = exact(EQ31, 1.0, RAMPS, AT_S) + 0.4
    measured_deg[20] = -6.0
    restart = [RESTART_ALL, *[RESTART_NONE] * 19, RESTART_ALL]
    found_deg, residual_deg = observed(EQ31, RAMPS, AT_S, measured_deg, restart)
    k = int(np.searchsorted(RAMPS[0], AT_S[20], side="right")) - 1
    np.testing.assert_allclose(found_deg[20:], exact(EQ31, -6.0, RAMPS[:, k:], AT_S[20:]), atol=1e-9)
    assert residual_deg[20] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("gain", GAINS)
def test_a_steady_error_passes_by_the_inverse_gain_from_the_first_sample_on(gain: float) -> None:
    transfer = GAINS[gain]
    measured_deg = exact(transfer, gain, RAMPS, AT_S) + 0.8
    measured_deg[0] -= 0.8
    found_deg, residual_deg = observed(transfer, RAMPS, AT_S, measured_deg, [RESTART_ALL, RESTART_FILTER])
    assert residual_deg[1:] == pytest.approx(0.8 / gain, abs=1e-9)
    error_deg = measured_deg - found_deg
    restarts = np.array([RESTART_ALL, RESTART_FILTER, *[RESTART_NONE] * (AT_S.size - 2)], dtype=np.int8)
    error_deg[30] = math.nan
    alone_deg = filtered(filter_of(transfer), AT_S, error_deg, restarts)
    assert np.isnan(alone_deg[30])
    assert np.delete(alone_deg, 30) == pytest.approx(np.delete(residual_deg, 30), abs=1e-9)


@pytest.mark.parametrize("transfer", [EQ31, TransferFunction((2.0 * 25.0,), (1.0, 25.0))], ids=["three", "one"])
@pytest.mark.parametrize("step_s", [0.004, 0.02])
def test_the_residual_undoes_the_servo_and_leaves_lags_of_its_filter(transfer: TransferFunction, step_s: float) -> None:
    """What an additive command does to the deflection comes out as that command, lagged once more than it has poles.

    On uniform samples: the lags cancel the servo's response to a held command, whatever it is.
    """
    order = transfer.poles_rad_s.size
    at_s = np.arange(0.0, 200.0) * step_s
    held_deg = np.repeat(np.random.default_rng(3).uniform(-5.0, 5.0, 20), 10)
    hidden = np.array([at_s, held_deg, 0.0 * at_s])
    measured_deg = exact(transfer, 0.0, hidden, at_s + 1e-12)
    _, residual_deg = observed(transfer, NONE, at_s, measured_deg, [RESTART_ALL])
    lag = math.exp(-50.0 * step_s)
    # The numerator of the sampled servo has as many zeros as poles less one; from any other input it comes out as well.
    response = exact(transfer, 0.0, np.array([[0.0], [1.0], [0.0]]), at_s[: order + 1])
    denominator = np.poly(np.exp(transfer.poles_rad_s * step_s)).real
    numerator = np.convolve(denominator, np.diff(response, prepend=0.0))[: order + 1]
    expected_deg = np.convolve(numerator, held_deg)[: at_s.size] / numerator.sum()
    for _ in range(order + 1):
        value, lagged = 0.0, np.empty(at_s.size)
        for k in range(at_s.size):
            value = lag * value + (1.0 - lag) * expected_deg[k]
            lagged[k] = value
        expected_deg = lagged
    assert np.ptp(expected_deg) > 1.0
    np.testing.assert_allclose(residual_deg, expected_deg, atol=1e-6)
    assert lag_weights(filter_of(transfer), step_s).sum() == pytest.approx(1.0 / transfer.dc_gain)


def test_a_stop_is_where_the_position_ends() -> None:
    model = ServoModel(EQ31) + PositionLimit(-2.0, 3.0)
    found_deg = model.simulate(STEPS[0], STEPS[1], 0.5 + AT_S)
    np.testing.assert_allclose(found_deg, np.clip(exact(EQ31, 10.0, STEPS, 0.5 + AT_S), -2.0, 3.0), atol=1e-9)


def test_a_step_of_one_second_is_a_step_like_any_other() -> None:
    at_s, ramp = np.arange(0.0, 5.0), np.array([[0.0], [1.0], [2.0]])
    slow = TransferFunction((0.5,), (1.0, 0.5))
    restarts = np.array([RESTART_FILTER] + [RESTART_NONE] * 4, dtype=np.int8)
    residual_deg = filtered(filter_of(slow, 1.0), at_s, np.full(5, 0.5), restarts)
    assert residual_deg == pytest.approx(0.5, abs=1e-9)
    found_deg, _ = observed(slow, ramp, at_s, np.full(5, 1.0), [RESTART_ALL])
    np.testing.assert_allclose(found_deg, exact(slow, 1.0, ramp, at_s), atol=1e-9)
