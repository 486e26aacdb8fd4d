"""One step of the position loop and of what hangs on its shaft, against matrix exponentials and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm

from servofd.core.types import FloatArray
from servofd.servo import linkage
from servofd.servo.library import servo_named
from servofd.servo.loop_steps import ROW, build, coasted, column, row, sine, step_matrices
from servofd.servo.physics import Loop, Physics, Plant
from servofd.servo.transfer import TransferFunction

SERVOS = {
    "Eq. 3.1": servo_named("hs225bb-eq31").transfer,
    "second order": TransferFunction((900.0,), (1.0, 42.0, 900.0)),
    "first order": TransferFunction((25.0,), (1.0, 25.0)),
}
RNG = np.random.default_rng(8)
STEPS_S = [1e-6, 7.3e-5, 2.5e-4, 0.0031, 0.00987, *RNG.uniform(1e-5, 0.01, 12).tolist()]
STATE = (3.0, -140.0, 9e3, 5.0, -60.0, 0.7, 800.0)
"""Position, speed, torque; command and its slope, constant error, deceleration: each moves the servo noticeably."""


def loop_of(name: str) -> Loop:
    return Plant(SERVOS[name], Physics()).loop()


def exact(rate: FloatArray, h: float) -> FloatArray:
    """States after `h` per state and input, shape (3, 7)."""
    whole = np.zeros((7, 7))
    whole[:3] = rate
    whole[3, 4] = 1.0
    return np.asarray(expm(whole * h))[:3]


def both(loop: Loop) -> list[tuple[FloatArray, FloatArray]]:
    """Matrices of grid steps and derivatives: while the error acts, and while it does not."""
    opened_rate = loop.closed_rate.copy()
    opened_rate[loop.order - 1, [0, 3]] = 0.0
    return [(loop.closed, loop.closed_rate), (loop.opened, opened_rate)]


@pytest.mark.parametrize("name", SERVOS)
def test_a_step_is_the_matrix_exponential(name: str) -> None:
    loop, x, table = loop_of(name), np.array(STATE), np.full((2, 3 * ROW), np.nan)
    for k, (steps, rate) in enumerate(both(loop)):
        for h in STEPS_S:
            expected = exact(rate, h) @ x
            scale = np.abs(exact(rate, h)) @ np.abs(x)
            build(table, k, steps, loop.grid_s, h)
            found = np.array([row(table, k, i, STATE) for i in range(3)])
            assert np.all(np.abs(found - expected) <= 3e-8 * scale), (h, found, expected)
            assert column(table, k, 6) == pytest.approx(exact(rate, h)[:, 6], rel=1e-7, abs=1e-12)


@pytest.mark.parametrize("name", SERVOS)
def test_grid_steps_are_matrix_exponentials(name: str) -> None:
    loop = loop_of(name)
    steps = step_matrices(loop.closed_rate, loop.grid_s, 30)
    for k in (0, 1, 2, 17, 30):
        expected = exact(loop.closed_rate, k * loop.grid_s)
        found = steps[k, 0].reshape(3, ROW)[:, :7]
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-13 * np.abs(expected).max())


@pytest.mark.parametrize("name", SERVOS)
def test_without_an_error_that_acts_a_servo_coasts(name: str) -> None:
    loop, table = loop_of(name), np.full((1, 3 * ROW), np.nan)
    for h in STEPS_S:
        build(table, 0, loop.opened, loop.grid_s, h)
        assert coasted(table, 0, STATE) == pytest.approx([row(table, 0, i, STATE) for i in range(3)], rel=1e-9)


def test_the_torque_of_a_servo_that_sticks_is_that_of_its_equation() -> None:
    """tau' = -q tau + K (error + its slope t), from the loop's own rates."""
    loop, table = loop_of("Eq. 3.1"), np.full((1, 3 * ROW), np.nan)
    q, stiffness = -loop.closed_rate[2, 2], loop.closed_rate[2, 5]
    for h in STEPS_S:
        motion = expm(np.array([[-q, stiffness, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]) * h)
        for steps, _ in both(loop):
            build(table, 0, steps, loop.grid_s, h)
            assert column(table, 0, ROW - 1) == pytest.approx(motion[0].tolist(), rel=1e-8)


def test_without_a_torque_nothing_winds_down() -> None:
    loop, table = loop_of("second order"), np.full((1, 3 * ROW), np.nan)
    build(table, 0, loop.closed, loop.grid_s, 0.004)
    share, filled, ramped = column(table, 0, ROW - 1)
    assert share == pytest.approx(1.0, abs=1e-8)
    assert (filled, ramped) == pytest.approx((0.0, 0.0), abs=1e-12)


def test_the_sine_is_the_sine() -> None:
    angles = np.concatenate([np.linspace(-20.0, 20.0, 4001), np.pi * np.arange(-6, 7) / 2.0])
    assert max(abs(sine(float(angle)) - math.sin(angle)) for angle in angles) < 1e-9


@pytest.mark.parametrize(
    ("lag_s", "hertz", "damping"),
    [(0.002, 0.0, 0.1), (0.02, 9.0, 0.1), (0.0015, 80.0, 0.4), (0.05, 95.0, 0.02), (2e-4, 30.0, 0.3)],
)
def test_what_a_step_leaves_of_a_lag_and_a_swing_is_exact(lag_s: float, hertz: float, damping: float) -> None:
    link = np.zeros(linkage.LINKAGE)
    linkage.rest_linkage(link, 0.0, 0.0)
    linkage.begin_linkage(link, Physics(lag_s=lag_s, resonance_hz=hertz, resonance_damping=damping))
    natural = 2.0 * math.pi * hertz
    turn = natural * math.sqrt(1.0 - damping**2)
    for h in [*STEPS_S, 0.0121, 0.03]:
        at = linkage._faded(link, h)
        assert link[at] == pytest.approx(h)
        assert link[at + 4] * h == pytest.approx(1.0)
        assert link[at + 1] == pytest.approx(math.exp(-h / lag_s), abs=2e-9)
        if hertz:
            decay = math.exp(-damping * natural * h)
            assert link[at + 2 : at + 4] == pytest.approx(
                [decay * math.cos(turn * h), decay * math.sin(turn * h)], abs=2e-8
            )
        again = linkage._faded(link, h)
        assert again == at


def test_a_surface_goes_as_fast_as_its_deflection_changes_and_not_beyond_its_limits() -> None:
    link = np.zeros(linkage.LINKAGE)
    sizes = {"quadratic_per_deg": 0.004, "cubic_per_deg2": 3e-4, "lower_deg": -9.0, "upper_deg": 7.0, "bias_deg": 0.5}
    linkage.begin_linkage(link, Physics(gain=0.8, **sizes))
    for played in np.linspace(-20.0, 20.0, 41).tolist():
        free = 0.8 * played * (1.0 + 0.004 * played + 3e-4 * played**2)
        assert linkage.deflected(link, played) == pytest.approx(min(max(free, -9.0), 7.0) + 0.5, rel=1e-12)
        change = linkage.deflected(link, played + 1e-6) - linkage.deflected(link, played - 1e-6)
        assert linkage._climb(link, played, 30.0) == pytest.approx(30.0 * change / 2e-6, abs=1e-6)
