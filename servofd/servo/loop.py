r"""The linear loop of a servo as matrices: what its states are after any step.

With k = ωn², c = 2ζωn of the fast pair and the slow pole a of a servo of three, the states are the shaft y, its speed v
and a third one, w; docs/explain.md, equations E1 to E4:

==========  ==================================================================================================
before      y' = v,  v' = -k y - c v + k w,  w' = a (u - w): the slow pole filters the command
inside      y' = v,  v' = -(a₂ - q) v + w,  w' = -K y - (a₁ - (a₂ - q) q) v - q w + K u: w is the motor's torque
after       y' = v,  v' = -k y - c v + k u,  w' = a (y - w): it filters what the loop moves
==========  ==================================================================================================

A constant `push` adds to the error that drives the loop, a constant `pull` to the acceleration. A servo with zeros or
more poles is a chain of integrators (observable canonical form) whose first state is the deflection.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from servofd.core.types import FloatArray
from servofd.servo.transfer import TransferFunction

BEFORE, INSIDE, AFTER = -1.0, 0.0, 1.0
"""Places of a servo's slow pole: a filter of the command, a part of the position loop, a filter of what it moves."""

_TIED = 1e-9
"""Relative imaginary part below which a computed root is real."""
_COARSEST_S = 2.5e-4
"""Grid of the steps whose matrices are kept; what is left of a step is a series in at most half of it."""
_FASTEST_TIMES_GRID = 0.05
"""Of the fastest pole: seven terms of the series in half a step of the grid then leave 1e-16."""
_LONGEST_S, _MOST = 0.02, 256
"""Longest step that is kept, and how many."""
MOST_POLES = 3
"""Of a servo on which effects can act, which has as many states; one of more is simulated, and nothing acts inside."""
_FINER, _TERMS, _SQUARINGS = 16.0, 9, 4
"""Series of a sixteenth of a step of the grid: its next term is below 1e-20."""


class Loop(NamedTuple):
    """One linear servo, as the stepper needs it."""

    a: FloatArray
    """Derivatives of the states over the states, shape (n * n,), row by row."""
    b: FloatArray
    """The same over command, push and pull, shape (n * 3,)."""
    rest: FloatArray
    """States of a shaft at rest at 1, shape (n,)."""
    gain: float
    """Deflection at rest for each degree of command."""
    error_s: float
    """Position error that drives a steady speed: deg for each deg/s of deflection."""
    per_error: float
    """Deceleration that balances an error [1/s^2]."""
    leaves: int
    """Which of the states leaves the servo."""
    filters: bool
    """Whether the third state is the command that a slow pole lets through."""
    stretch: FloatArray
    """Power of a scale of time by which each state grows, shape (n,)."""
    natural_rad_s: float
    """Of the loop: how fast what acts on it matters."""
    is_physical: bool
    """Whether effects can act inside."""
    grid_s: float = 0.0
    steps: FloatArray = np.zeros((0, 0))
    """States after 0..k steps of the grid, shape (k + 1, n * (n + 4)), from states, command, slope, push and pull."""


class Scales(NamedTuple):
    """How the poles of a servo differ from those of its type, and where the slow one of three acts."""

    bandwidth: float = 1.0
    slow: float = 1.0
    pair: float = 1.0
    damping: float = 1.0
    place: float = INSIDE
    torque_share: float = 0.8
    """Share of the damping that acts on the torque; it matters for loads and friction alone."""


def scaled(transfer: TransferFunction, scales: Scales) -> TransferFunction:
    """The servo with its poles scaled; the dc gain stays."""
    if scales[:4] == (1.0, 1.0, 1.0, 1.0):
        return transfer
    if len(transfer.numerator) > 1:
        return transfer.with_bandwidth_scaled(scales.bandwidth)
    denominator = transfer.denominator
    if len(denominator) <= MOST_POLES + 1:
        polynomial = _monic(len(denominator) - 1, _poles(denominator, scales))
    else:
        polynomial = _damped(np.array(denominator) / denominator[0], scales.damping)
        polynomial *= scales.bandwidth ** np.arange(polynomial.size)
    return TransferFunction((transfer.dc_gain * float(polynomial[-1]),), tuple(polynomial.tolist()))


class _Poles(NamedTuple):
    """Poles of a servo of one to three: the slow one of three [rad/s], and s^2 + total s + product of the others."""

    slow: float
    total: float
    product: float

    @property
    def fastest(self) -> float:
        """Size of the fastest [rad/s]."""
        apart = 0.25 * self.total * self.total - self.product
        return max(self.slow, math.sqrt(self.product) if apart < 0.0 else 0.5 * self.total + math.sqrt(apart))

    def in_order(self) -> _Poles:
        """The same with the slowest of the real ones as the slow one: a pair that is damped enough has a slower."""
        apart = 0.25 * self.total * self.total - self.product
        if self.slow == 0.0 or apart < 0.0:
            return self
        large = 0.5 * self.total + math.sqrt(apart)
        small = self.product / large
        return self if small >= self.slow else _Poles(small, self.slow + large, self.slow * large)


def _poles(denominator: tuple[float, ...], scales: Scales) -> _Poles:
    """Poles of a servo of one to three, scaled."""
    slow, total, product = _as_known(denominator)
    if len(denominator) > 2:
        total *= scales.damping
    slow, total, product = _Poles(slow, total, product).in_order()
    pair = scales.pair * scales.bandwidth
    return _Poles(slow * scales.slow * scales.bandwidth, total * pair, product * pair * pair)


@lru_cache(maxsize=64)
def _as_known(denominator: tuple[float, ...]) -> _Poles:
    monic = np.array(denominator) / denominator[0]
    if monic.size > MOST_POLES:
        slow, pair = split(monic)
        return _Poles(slow, *pair)
    return _Poles(0.0, float(monic[1]), float(monic[2]) if monic.size == MOST_POLES else 0.0)


def _monic(order: int, poles: _Poles) -> FloatArray:
    """Characteristic polynomial of one to three poles."""
    slow, total, product = poles
    return np.array([1.0, slow + total, slow * total + product, slow * product][: order + 1])


def split(monic: FloatArray) -> tuple[float, tuple[float, float]]:
    """Slow pole of a monic polynomial of three [rad/s], and what the other two leave: s^2 + sum s + product."""
    roots = np.roots(monic)
    real = roots[np.abs(roots.imag) <= _TIED * np.abs(roots)].real
    slow = float(-real[np.argmin(np.abs(real))])
    # Deflated, not multiplied from roots: the polynomial stays what it was.
    total = float(monic[1]) - slow
    return slow, (total, float(monic[3]) / slow)


def _damped(monic: FloatArray, scale: float) -> FloatArray:
    """Characteristic polynomial of more than three poles with the damping of its fastest two scaled."""
    if scale == 1.0:
        return monic
    roots = np.roots(monic)
    pair = np.argsort(np.abs(roots))[-2:]
    rest = np.delete(roots, pair)
    quadratic = np.array([1.0, -scale * roots[pair].sum().real, np.prod(roots[pair]).real])
    return np.polymul(np.poly(rest).real, quadratic)


@lru_cache(maxsize=512)  # of many runs each asks for the same
def loop_of(transfer: TransferFunction, scales: Scales, grid_s: float = _COARSEST_S) -> Loop:
    """Matrices of a servo with its poles scaled, on a grid of steps [s] or a finer one."""
    order = len(transfer.denominator) - 1
    is_physical = len(transfer.numerator) == 1 and 1 <= order <= MOST_POLES
    poles = _poles(transfer.denominator, scales) if is_physical else None
    loop = _physical(order, transfer.dc_gain, poles, scales) if poles else _canonical(scaled(transfer, scales))
    fastest = poles.fastest if poles else loop.natural_rad_s
    # Halved until it is fine enough, so that servos whose poles differ a little share one grid.
    grid_s *= 0.5 ** max(math.ceil(math.log2(grid_s * fastest / _FASTEST_TIMES_GRID)), 0)
    count = min(round(_LONGEST_S / grid_s), _MOST)
    return loop._replace(grid_s=grid_s, steps=_steps(loop.a, loop.b, loop.rest.size, grid_s, count))


def _physical(order: int, gain: float, poles: _Poles, scales: Scales) -> Loop:
    """Derivatives of shaft, speed and third state."""
    a, b, monic = np.zeros((3, 3)), np.zeros((3, 3)), _monic(order, poles)
    stiffness, error_s = float(monic[-1]), float(monic[-2] / monic[-1])
    per_error, natural_rad_s, leaves, filters = stiffness, poles.fastest, 0, False
    stretch: FloatArray = np.array([0.0, 1.0, 0.0])
    if order == 1:
        a[0, 0], b[0] = -stiffness, (stiffness, stiffness, 1.0)
        natural_rad_s = stiffness
    elif order == 2 or scales.place != INSIDE:
        slow, damping, stiffness = poles.in_order()
        a[0, 1] = 1.0
        a[1, :2], b[1] = (-stiffness, -damping), (stiffness, stiffness, 1.0)
        filters = order == MOST_POLES and scales.place == BEFORE
        if filters:
            a[1, 2], b[1, 0], a[2, 2], b[2, 0] = stiffness, 0.0, -slow, slow
        elif order == MOST_POLES:
            a[2, 0], a[2, 2], leaves = slow, -slow, 2
        error_s, per_error, natural_rad_s = damping / stiffness, stiffness, math.sqrt(stiffness)
    else:
        q = scales.torque_share * float(monic[1])
        p = float(monic[1]) - q
        a[0, 1] = 1.0
        a[1, 1:], a[2] = (-p, 1.0), (-stiffness, -(float(monic[2]) - p * q), -q)
        b[1, 2], b[2, :2] = 1.0, stiffness
        per_error, stretch = stiffness / q, np.array([0.0, 1.0, 2.0])
    rest: FloatArray = np.array([1.0, 0.0, float(leaves == 2 or filters)])
    error_s /= gain
    return Loop(a.ravel(), b.ravel(), rest, gain, error_s, per_error, leaves, filters, stretch, natural_rad_s, True)


def _canonical(transfer: TransferFunction) -> Loop:
    """Derivatives of a chain of integrators whose first state is the deflection."""
    bottom, gain = np.array(transfer.denominator) / transfer.denominator[0], transfer.dc_gain
    n = bottom.size - 1
    top = np.zeros(n)
    top[n - len(transfer.numerator) :] = np.array(transfer.numerator) / transfer.denominator[0]
    a: FloatArray = np.eye(n, k=1)
    a[:, 0] = -bottom[1:]
    b = np.zeros((n, 3))
    b[:, 0] = top / gain
    # The companion's states at rest: each is what the one before it and the command leave of the balance.
    rest = np.asarray(-np.linalg.solve(a, top) / gain, dtype=float)
    fastest = float(np.abs(transfer.poles_rad_s).max())
    stretch: FloatArray = np.arange(n, dtype=float)
    error_s, per_error = float(bottom[-2] / bottom[-1]) / gain, float(bottom[-1])
    return Loop(a.ravel(), b.ravel(), rest, gain, error_s, per_error, 0, False, stretch, fastest, False)


def _steps(a: FloatArray, b: FloatArray, n: int, grid_s: float, count: int) -> FloatArray:
    """States after 0..count steps of the grid, from states and inputs: Taylor's series of a small step, then powers."""
    whole, inputs = np.zeros((n + 4, n + 4)), b.reshape(n, 3)
    whole[:n, :n], whole[:n, n], whole[:n, n + 2 :] = a.reshape(n, n), inputs[:, 0], inputs[:, 1:]
    whole[n, n + 1] = 1.0  # the command runs on at its slope
    one, term = np.eye(n + 4), np.eye(n + 4)
    for k in range(1, _TERMS):
        term = term @ whole * (grid_s / _FINER / k)
        one += term
    for _ in range(_SQUARINGS):
        one = one @ one
    powers = np.stack([np.eye(n + 4), one])
    while len(powers) <= count:
        powers = np.concatenate([powers, powers[1:] @ powers[-1]])
    return np.ascontiguousarray(powers[: count + 1, :n].reshape(count + 1, -1))
