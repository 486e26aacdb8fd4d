r"""A servo as a position loop, with one place for every effect; see docs/explain.md, equations E1 to E4.

.. math:: \dot y = v, \quad \dot v = -p v + \tau + d, \quad \dot\tau = -q\tau - r v + K \varphi(u - y) \qquad (E1)

has the characteristic polynomial :math:`s^3 + (p + q) s^2 + (pq + r) s + K`: the third-order shape of thesis Eq. 3.1
fixes its three coefficients and leaves one split free. Servos of second and first order lack the states that they do
not need.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from servofd.core.types import FloatArray
    from servofd.servo.transfer import TransferFunction

_TORQUE_SHARE = 0.8
"""Share of the damping that acts on the torque (q); the split changes neither the linear servo nor any steady state."""
_FINEST_S, _LONGEST_S = 2.5e-4, 1e-2
_FASTEST_TIMES_STEP = 0.05
"""Of the fastest pole: what is left of a step is then a series of five terms, the next of which is below 1e-10."""
_MOST_ENTRIES = 400
_TIED = 1e-9


_SUBSTEP_S, _SHORT_SUBSTEP_S = 2.5e-3, 1e-3
"""The shorter one for a servo that switches on and off at an edge."""

RATE_FIELDS = (
    "rate_up_deg_s",
    "rate_down_deg_s",
    "speed_up_deg_s",
    "speed_down_deg_s",
    "speed_deg_s_per_v",
    "follow_up_deg_s",
    "follow_down_deg_s",
    "set_point_deg_s",
    "deg_s_per_v",
)
"""Sizes of `Physics` that limit a speed."""
LOOSE_FIELDS = {"backlash_deg": 0.5, "deadband_deg": 0.5, "insensitive_deg": 0.5, "friction_deg": 1.0}
"""Sizes of `Physics` within which a surface rests anywhere, and the share of each that it may be off to either side."""


BEFORE, INSIDE, AFTER = -1.0, 0.0, 1.0
"""Places of a servo's slow pole: a filter of the command, a part of the position loop, a filter of what it moves."""


class Physics(NamedTuple):
    """Size of every effect, in physical order; the defaults are neutral."""

    delay_s: float = 0.0
    """Total transport delay."""
    frame_s: float = 0.0
    """Period of the pulse frames that carry commands."""
    frame_phase: float = 0.0
    """When frames begin, as a share of the period."""
    command_step_deg: float = 0.0
    set_point_deg_s: float = math.inf
    """Rate at which a servo's set point follows its command."""
    bandwidth_scale: float = 1.0
    damping_scale: float = 1.0
    torque_share: float = _TORQUE_SHARE
    """Share of the damping that acts on the torque; matters for loads and friction alone."""
    deadband_deg: float = 0.0
    """Full width, on the position error; outside, the error counts from the edge."""
    insensitive_deg: float = 0.0
    """Full width of a dead band outside of which the whole error counts."""
    rate_up_deg_s: float = math.inf
    rate_down_deg_s: float = math.inf
    deg_s_per_v: float = math.inf
    """Rate limit per volt of supply."""
    knee_deg: float = math.inf
    """Position error beyond which the torque grows as its root: a supply that cannot give more current."""
    friction_deg: float = 0.0
    load_friction: float = 0.0
    """Friction as a share of the motor's effort."""
    airload_per_pa: float = 0.0
    droop_deg: float = 0.0
    stop_lower_deg: float = -math.inf
    """Stops that block the servo itself."""
    stop_upper_deg: float = math.inf
    follow_up_deg_s: float = math.inf
    """Rate of an output that follows the linear motion (`servofd.servo.effects.RateLimit`)."""
    follow_down_deg_s: float = math.inf
    resonance_hz: float = 0.0
    resonance_damping: float = 0.05
    backlash_deg: float = 0.0
    gain: float = 1.0
    quadratic_per_deg: float = 0.0
    cubic_per_deg2: float = 0.0
    lower_deg: float = -math.inf
    upper_deg: float = math.inf
    bias_deg: float = 0.0
    lag_s: float = 0.0
    output_step_deg: float = 0.0
    deg_per_a: float = 0.0
    """How far the reading moves with the current that the servo draws, on a supply that it shares with its sensor."""
    offset_s: float = 0.0
    """How much too late positions are stamped."""
    slow_place: float = INSIDE
    """Where the slow pole of a servo of three acts: before its position loop, inside or after it."""
    slow_scale: float = 1.0
    """Of that pole alone."""
    pair_scale: float = 1.0
    """Of the other two poles alone."""
    speed_up_deg_s: float = math.inf
    """Speed at which the shaft is held back, whatever drives it: the loop does not wait."""
    speed_down_deg_s: float = math.inf
    speed_deg_s_per_v: float = math.inf
    """The same speed per volt of supply."""
    stribeck: float = 0.0
    """By which share friction is larger at rest than at speed."""
    stribeck_deg_s: float = 10.0
    """Speed at which most of that is gone."""
    hangs_deg: float = 0.0
    """Where a weight on the horn hangs at rest: its load is droop times the sine of the angle from there."""
    load_deg: float = 0.0
    """Deflection at which a unit of the load that was logged holds the servo."""
    load_late_s: float = 0.0
    """How much later it acts than it is stamped."""
    run_slope: float = 0.0
    """By how much a size is larger in the run with the largest value of a condition than in the mean one; the kernel
    knows nothing of it, nor of the next two (`servofd.servo.catalogue`)."""
    run_field: float = 0.0
    """Which size."""
    run_condition: float = 0.0
    """Which condition."""
    own_1: float = math.nan
    """Parameters of an effect of the user's own; the kernel knows nothing of them."""
    own_2: float = math.nan
    own_3: float = math.nan
    own_4: float = math.nan

    @property
    def scales(self) -> tuple[float, float, float, float]:
        """By how much its poles are scaled: all, the slow one, the pair, and the damping of that."""
        return self.bandwidth_scale, self.slow_scale, self.pair_scale, self.damping_scale

    @property
    def is_linear_loop(self) -> bool:
        """Whether nothing needs shorter steps than the events themselves."""
        return self[8:28] == _PLAIN and self.lag_s == 0.0 and math.isinf(self.set_point_deg_s) and not self.is_held_back

    @property
    def is_held_back(self) -> bool:
        """Whether its shaft has a largest speed."""
        return min(self.speed_up_deg_s, self.speed_down_deg_s, self.speed_deg_s_per_v) < math.inf


_PLAIN = Physics()[8:28]
"""What a linear loop is from the dead band on, to the curvature of its linkage."""


def longest_step_s(physics: Physics) -> float:
    """Longest substep of the kernel [s]: none if the loop is linear, and the events themselves are steps enough."""
    if physics.is_linear_loop:
        return math.inf
    return _SHORT_SUBSTEP_S if physics.insensitive_deg > 0.0 or physics.is_held_back else _SUBSTEP_S


class Loop(NamedTuple):
    """Matrices of the loop, as the kernel needs them."""

    closed: FloatArray
    """From states (y, v, tau) and inputs (u, its slope, constant error, deceleration) to the states after 0..k grid
    steps while the error acts, as `servofd.servo.loop_steps.step_matrices` gives them."""
    opened: FloatArray
    """The same while it does not: inside a dead band, or saturated."""
    closed_rate: FloatArray
    """Of shape (3, 7): derivatives of the states while the error acts."""
    grid_s: float
    error_per_rate_s: float
    """Position error that drives a steady rate: a1/a0 [s]."""
    load_per_error: float
    """Deceleration that balances an error: K/q [1/s^2]."""
    order: int
    """Of the loop itself."""
    filters: bool = False
    """Whether the third state is the command that a slow pole before the loop lets through."""


_NEUTRAL = Physics()
_PLACED = 4
"""Coefficients of a polynomial of three poles."""


@dataclass(frozen=True, slots=True)
class Plant:
    """The linear servo to which effects are added."""

    transfer: TransferFunction
    neutral: Physics

    @property
    def dc_gain(self) -> float:
        """Gain at rest [deg/deg]."""
        return self.transfer.dc_gain

    @property
    def has_places(self) -> bool:
        """Whether its slow pole may act elsewhere: one of three, and real."""
        return len(self.transfer.denominator) == _PLACED

    def loop(self, physics: Physics = _NEUTRAL) -> Loop:
        """Matrices of the loop, its slow pole in its place, its poles and the damping of its fastest pair scaled."""
        place = physics.slow_place if self.has_places else INSIDE
        return _loop(self.transfer.denominator, physics.scales, physics.torque_share, place)

    def machine(self, physics: Physics) -> tuple[Physics, Loop]:
        """What the kernel runs: a slow pole after the loop is a lag of what is read."""
        if physics.slow_place == AFTER and self.has_places:
            physics = physics._replace(lag_s=1.0 / _slow_rad_s(self.transfer.denominator, physics.scales))
        return physics, self.loop(physics)


def scaled_transfer(transfer: TransferFunction, physics: Physics) -> TransferFunction:
    """Linear servo with its poles scaled as the effects say; the dc gain stays.

    Examples
    --------
    >>> from servofd.servo.library import servo_named
    >>> slow = scaled_transfer(servo_named("hs225bb-eq31").transfer, Physics(bandwidth_scale=0.5))
    >>> round(slow.bandwidth_rad_s, 2), round(slow.dc_gain, 9)
    (14.24, 1.0)
    """
    from servofd.servo.transfer import TransferFunction

    if physics.scales == (1.0, 1.0, 1.0, 1.0):
        return transfer
    scaled = _polynomial(transfer.denominator, physics.scales)
    return TransferFunction((transfer.dc_gain * float(scaled[-1]),), tuple(scaled.tolist()))


@lru_cache(maxsize=64)  # of many runs each asks for the same
def _slow_rad_s(denominator: tuple[float, ...], scales: tuple[float, float, float, float]) -> float:
    """Slow pole of three, with the poles scaled."""
    return split(_polynomial(denominator, scales))[0]


def _polynomial(denominator: tuple[float, ...], scales: tuple[float, float, float, float]) -> FloatArray:
    """Monic characteristic polynomial with its poles scaled: all of them, the slow one, the pair, its damping."""
    bandwidth, slow_scale, pair_scale, damping = scales
    monic = _damped(np.array(denominator) / denominator[0], damping)
    if slow_scale != 1.0 or pair_scale != 1.0:
        if monic.size == _PLACED:
            slow, (sum_rad_s, product) = split(monic)
            quadratic = np.array([1.0, pair_scale * sum_rad_s, pair_scale**2 * product])
            monic = np.polymul([1.0, slow_scale * slow], quadratic)
        else:
            monic = monic * pair_scale ** np.arange(monic.size)
    scaled: FloatArray = monic * bandwidth ** np.arange(monic.size)
    return scaled


def split(monic: FloatArray) -> tuple[float, tuple[float, float]]:
    """Slow pole of a monic polynomial of three [rad/s], and what the other two leave: s^2 + sum s + product."""
    roots = np.roots(monic)
    real = roots[np.abs(roots.imag) <= _TIED * np.abs(roots)].real
    slow = float(-real[np.argmin(np.abs(real))])
    # Deflated, not multiplied from roots: the polynomial stays what it was.
    total = float(monic[1]) - slow
    return slow, (total, float(monic[3]) / slow)


@lru_cache(maxsize=64)  # of a fast servo 0.8 MB each
def _loop(
    denominator: tuple[float, ...], scales: tuple[float, float, float, float], torque_share: float, place: float
) -> Loop:
    from servofd.servo.loop_steps import step_matrices

    monic = _polynomial(denominator, scales)
    slow = 0.0
    if place != INSIDE:
        slow, pair = split(monic)
        monic = np.array([1.0, *pair])
    order = monic.size - 1
    stiffness = float(monic[-1])
    filters = place == BEFORE
    closed = np.zeros((3, 7))
    torque = min(order, 2)  # row that the error drives
    closed[torque if order == 3 else order - 1, [0, 3, 5]] = -stiffness, stiffness, stiffness
    if order >= 2:
        closed[0, 1] = 1.0
        closed[1, 1] = -monic[1]
    load = stiffness
    if order == 3:
        q = torque_share * float(monic[1])
        p = float(monic[1]) - q
        closed[1, [1, 2]] = -p, 1.0
        closed[2, [1, 2]] = -(float(monic[2]) - p * q), -q
        load = stiffness / q
    if filters:
        closed[1, [2, 3]] = stiffness, 0.0
        closed[2, [2, 3]] = -slow, slow
    closed[min(order - 1, 1), 6] = 1.0
    opened = closed.copy()
    opened[order - 1, [0, 2, 3] if filters else [0, 3]] = 0.0
    fastest = max(float(np.abs(np.roots(monic)).max()), float(monic[1]), slow if filters else 0.0)
    grid_s = min(_FINEST_S, _FASTEST_TIMES_STEP / fastest)
    entries = min(round(_LONGEST_S / grid_s), _MOST_ENTRIES)
    return Loop(
        step_matrices(closed, grid_s, entries),
        step_matrices(opened, grid_s, entries),
        closed,
        grid_s,
        float(monic[-2]) / stiffness,
        load,
        order,
        filters,
    )


def _damped(monic: FloatArray, scale: float) -> FloatArray:
    """Characteristic polynomial with the damping of its fastest two poles scaled."""
    if scale == 1.0 or monic.size < 3:
        return monic
    roots = np.roots(monic)
    pair = np.argsort(np.abs(roots))[-2:]
    if monic.size == 4 and abs(roots[pair].sum().imag) > _TIED * abs(roots[pair[0]]):
        pair = np.flatnonzero(roots.imag != 0.0)
    rest = np.delete(roots, pair)
    quadratic = np.array([1.0, -scale * roots[pair].sum().real, np.prod(roots[pair]).real])
    damped: FloatArray = np.polymul(np.poly(rest).real, quadratic) if rest.size else quadratic
    return damped
