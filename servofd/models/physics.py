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

from servofd.errors import DesignError

if TYPE_CHECKING:
    from servofd.models.effects import Plan
    from servofd.models.servo_model import ServoModel
    from servofd.models.transfer import TransferFunction
    from servofd.types import FloatArray

__all__ = ["LOOSE_FIELDS", "RATE_FIELDS", "Loop", "Physics", "Plant", "longest_step_s", "plant_of", "scaled_transfer"]

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
    "follow_up_deg_s",
    "follow_down_deg_s",
    "set_point_deg_s",
    "deg_s_per_v",
)
"""Sizes of `Physics` that limit a speed."""
LOOSE_FIELDS = {"backlash_deg": 0.5, "deadband_deg": 0.5, "insensitive_deg": 0.5, "friction_deg": 1.0}
"""Sizes of `Physics` within which a surface rests anywhere, and the share of each that it may be off to either side."""


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
    """Rate of an output that follows the linear motion (`servofd.models.effects.RateLimit`)."""
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
    own_1: float = math.nan
    """Parameters of an effect of the user's own; the kernel knows nothing of them."""
    own_2: float = math.nan
    own_3: float = math.nan
    own_4: float = math.nan

    @property
    def is_linear_loop(self) -> bool:
        """Whether nothing needs shorter steps than the events themselves."""
        return self[8:28] == _PLAIN and self.lag_s == 0.0 and math.isinf(self.set_point_deg_s)


_PLAIN = Physics()[8:28]
"""What a linear loop is from the dead band on, to the curvature of its linkage."""


def longest_step_s(physics: Physics) -> float:
    """Longest substep of the kernel [s]: none if the loop is linear, and the events themselves are steps enough."""
    if physics.is_linear_loop:
        return math.inf
    return _SHORT_SUBSTEP_S if physics.insensitive_deg > 0.0 else _SUBSTEP_S


class Loop(NamedTuple):
    """Matrices of the loop, as the kernel needs them."""

    closed: FloatArray
    """From states (y, v, tau) and inputs (u, its slope, constant error, deceleration) to the states after 0..k grid
    steps while the error acts, as `servofd.models.loop_steps.step_matrices` gives them."""
    opened: FloatArray
    """The same while it does not: inside a dead band, or saturated."""
    closed_rate: FloatArray
    """Of shape (3, 7): derivatives of the states while the error acts."""
    grid_s: float
    error_per_rate_s: float
    """Position error that drives a steady rate: a1/a0 [s]."""
    load_per_error: float
    """Deceleration that balances an error: K/q [1/s^2]."""
    effort_per_torque: float
    """Error that a torque is worth: q/K; 0 if the servo has no such state."""
    order: int


@dataclass(frozen=True, slots=True)
class Plant:
    """The linear servo to which effects are added."""

    transfer: TransferFunction
    neutral: Physics

    @property
    def dc_gain(self) -> float:
        """Gain at rest [deg/deg]."""
        return self.transfer.dc_gain

    def loop(
        self, bandwidth_scale: float = 1.0, damping_scale: float = 1.0, torque_share: float = _TORQUE_SHARE
    ) -> Loop:
        """Matrices of the loop with its poles scaled, and the damping of its fastest pair."""
        return _loop(self.transfer.denominator, bandwidth_scale, damping_scale, torque_share)


def plant_of(model: ServoModel) -> Plant:
    """Position loop with the poles, the delay and the limits of a servo model.

    Raises
    ------
    DesignError
        If the servo has zeros or more than three poles.

    Examples
    --------
    >>> from servofd.models.servo_model import ServoModel
    >>> from servofd.servos import servo_named
    >>> plant = plant_of(ServoModel.of(servo_named("hs225bb-eq31")))
    >>> round(plant.loop().error_per_rate_s, 5)  # 332 deg/s need 18.1 deg of error
    0.05449
    """
    plan, transfer = model.plan, model.transfer
    if len(transfer.numerator) != 1 or not 2 <= len(transfer.denominator) <= 4:
        raise DesignError(
            f"a servo of order {len(transfer.denominator) - 1} with {len(transfer.numerator) - 1} zeros cannot be "
            "explained: servos of one to three poles and no zeros can"
        )
    return Plant(transfer, neutral_of(plan))


def neutral_of(plan: Plan) -> Physics:
    """Delay and limits of a servo, and its effects if it has any."""
    return plan.physics or Physics(
        delay_s=plan.delay_s,
        follow_up_deg_s=plan.rate_up_deg_s,
        follow_down_deg_s=plan.rate_down_deg_s,
        lower_deg=plan.lower_deg,
        upper_deg=plan.upper_deg,
    )


def scaled_transfer(transfer: TransferFunction, physics: Physics) -> TransferFunction:
    """Linear servo with its poles scaled as the effects say; the dc gain stays.

    Examples
    --------
    >>> from servofd.servos import servo_named
    >>> slow = scaled_transfer(servo_named("hs225bb-eq31").transfer, Physics(bandwidth_scale=0.5))
    >>> round(slow.bandwidth_rad_s, 2), round(slow.dc_gain, 9)
    (14.24, 1.0)
    """
    from servofd.models.transfer import TransferFunction

    if physics.bandwidth_scale == 1.0 and physics.damping_scale == 1.0:
        return transfer
    denominator = np.array(transfer.denominator) / transfer.denominator[0]
    scales = physics.bandwidth_scale ** np.arange(denominator.size)
    scaled = _damped(denominator, physics.damping_scale) * scales
    return TransferFunction((transfer.dc_gain * float(scaled[-1]),), tuple(scaled.tolist()))


@lru_cache(maxsize=64)  # of a fast servo 0.8 MB each
def _loop(denominator: tuple[float, ...], bandwidth_scale: float, damping_scale: float, torque_share: float) -> Loop:
    from servofd.models.loop_steps import step_matrices

    order = len(denominator) - 1
    monic = _damped(np.array(denominator) / denominator[0], damping_scale) * bandwidth_scale ** np.arange(order + 1)
    stiffness = float(monic[-1])
    closed = np.zeros((3, 7))
    torque = min(order, 2)  # row that the error drives
    closed[torque if order == 3 else order - 1, [0, 3, 5]] = -stiffness, stiffness, stiffness
    if order >= 2:
        closed[0, 1] = 1.0
        closed[1, 1] = -monic[1]
    effort, load = 0.0, stiffness
    if order == 3:
        q = torque_share * float(monic[1])
        p = float(monic[1]) - q
        closed[1, [1, 2]] = -p, 1.0
        closed[2, [1, 2]] = -(float(monic[2]) - p * q), -q
        effort, load = q / stiffness, stiffness / q
    closed[min(order - 1, 1), 6] = 1.0
    opened = closed.copy()
    opened[order - 1, [0, 3]] = 0.0
    fastest = max(float(np.abs(np.roots(monic)).max()), float(monic[1]))
    grid_s = min(_FINEST_S, _FASTEST_TIMES_STEP / fastest)
    entries = min(round(_LONGEST_S / grid_s), _MOST_ENTRIES)
    return Loop(
        step_matrices(closed, grid_s, entries),
        step_matrices(opened, grid_s, entries),
        closed,
        grid_s,
        float(monic[-2]) / stiffness,
        load,
        effort,
        order,
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
