"""One step of the position loop: matrices of the steps that recur, a series for those that do not."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from numba import njit

from servofd.types import FloatArray

__all__ = ["build", "coasted", "compiled", "inlined", "moved", "row", "sine", "step_matrices", "wound_up"]

_NO_LOSS = 1e-6
"""Of the torque [1/s]: below, a step keeps all of it; servos of lower order have none at all."""
_FAST = {"contract", "nsz", "arcp"}
compiled = partial(njit, cache=True, nogil=True, error_model="numpy", fastmath=_FAST, _nrt=False)()
inlined = partial(njit, cache=True, nogil=True, error_model="numpy", fastmath=_FAST, _nrt=False, forceinline=True)()
"""No reference counting inside: nothing here allocates, and it would take half of the time (measured). LLVM puts these
into the loop around them: numba's own inlining made it no faster, and took 5 s more to compile."""


@njit(cache=True, error_model="numpy")
def step_matrices(rate: FloatArray, grid_s: float, count: int) -> FloatArray:
    """States after 1..count grid steps, shape (count, 3, 7), from their derivatives, shape (3, 7)."""
    size = 7
    whole, one, term = np.zeros((size, size)), np.eye(size), np.eye(size)
    # Entry by entry: to assign a slice, with its words for shapes that do not fit, takes seconds to compile.
    for i in range(3):
        for j in range(size):
            whole[i, j] = rate[i, j]
    whole[3, 4] = 1.0  # the command runs on at its slope
    fine = grid_s / 16.0
    for k in range(1, 9):
        term = term @ whole * (fine / k)
        one += term
    for _ in range(4):
        one = one @ one
    steps = np.zeros((count, 3, size))
    for i in range(3):
        for j in range(size):
            steps[0, i, j] = one[i, j]
    for k in range(1, count):
        for i in range(3):
            # Inputs are constant but for the command, which has moved on by its slope before this step.
            for j in range(size):
                total = steps[0, i, j] if j > 2 else 0.0
                for m in range(3):
                    total += steps[0, i, m] * steps[k - 1, m, j]
                steps[k, i, j] = total
            steps[k, i, 4] += steps[0, i, 3] * k * grid_s
    return steps


@inlined
def row(m: FloatArray, k: int, i: int, x: tuple[float, ...]) -> float:
    """One state after step `k` of a table, from states and inputs; those that are known last come last."""
    early = (m[k, i, 0] * x[0] + m[k, i, 1] * x[1]) + (m[k, i, 2] * x[2] + m[k, i, 3] * x[3] + m[k, i, 4] * x[4])
    return float(early + m[k, i, 6] * x[6] + m[k, i, 5] * x[5])


@inlined
def coasted(m: FloatArray, k: int, x: tuple[float, ...]) -> tuple[float, float, float]:
    """All states after step `k` of a table while the error does not act, and hence neither position nor command."""
    return (
        x[0] + m[k, 0, 1] * x[1] + m[k, 0, 2] * x[2] + m[k, 0, 6] * x[6] + m[k, 0, 5] * x[5],
        m[k, 1, 1] * x[1] + m[k, 1, 2] * x[2] + m[k, 1, 6] * x[6] + m[k, 1, 5] * x[5],
        m[k, 2, 1] * x[1] + m[k, 2, 2] * x[2] + m[k, 2, 6] * x[6] + m[k, 2, 5] * x[5],
    )


@inlined
def _slope(r: FloatArray, x: tuple[float, ...]) -> tuple[float, float, float]:
    """Derivatives of the three states; most entries of the matrix are zero by construction."""
    return (
        r[0, 0] * x[0] + r[0, 1] * x[1] + r[0, 3] * x[3] + r[0, 5] * x[5] + r[0, 6] * x[6],
        r[1, 0] * x[0] + r[1, 1] * x[1] + r[1, 2] * x[2] + r[1, 3] * x[3] + r[1, 5] * x[5] + r[1, 6] * x[6],
        r[2, 0] * x[0] + r[2, 1] * x[1] + r[2, 2] * x[2] + r[2, 3] * x[3] + r[2, 5] * x[5],
    )


@inlined
def moved(
    steps: FloatArray, rate: FloatArray, grid_s: float, h: float, x: tuple[float, ...]
) -> tuple[float, float, float]:
    """States after `h`: the nearest number of grid steps from the table, and a series from there, on or back."""
    count = min(int(h / grid_s + 0.5), steps.shape[0])
    rest = h - count * grid_s
    y, v, torque = x[0], x[1], x[2]
    if count > 0:
        k = count - 1
        y, v, torque = row(steps, k, 0, x), row(steps, k, 1, x), row(steps, k, 2, x)
    # Only the first derivative sees the inputs, the second the command's slope; then they are used up.
    u = x[3] + x[4] * count * grid_s
    d1 = _slope(rate, (y, v, torque, u, 0.0, x[5], x[6]))
    d2 = _slope(rate, (d1[0], d1[1], d1[2], x[4], 0.0, 0.0, 0.0))
    d3 = _slope(rate, (d2[0], d2[1], d2[2], 0.0, 0.0, 0.0, 0.0))
    half, third = 0.5 * rest, rest / 3.0
    return (
        y + rest * (d1[0] + half * (d2[0] + third * d3[0])),
        v + rest * (d1[1] + half * (d2[1] + third * d3[1])),
        torque + rest * (d1[2] + half * (d2[2] + third * d3[2])),
    )


@inlined
def wound_up(rate: FloatArray, left: FloatArray, grid_s: float, h: float) -> tuple[float, float, float]:
    """Torque after `h` without motion: its share that is left, and per error and slope of the error that act on it."""
    q, stiffness = max(-rate[2, 2], _NO_LOSS), rate[2, 5]
    count = min(int(h / grid_s + 0.5), left.size - 1)
    rest = q * (h - count * grid_s)
    share = left[count] * (1.0 - rest * (1.0 - rest * (0.5 - rest * (1.0 / 6.0 - rest / 24.0))))
    filled = (1.0 - share) / q
    return share, stiffness * filled, stiffness * (h - filled) / q


@inlined
def sine(angle: float) -> float:
    """Sine to 1e-9, by its series: a call would cost the loop around it its registers."""
    if abs(angle) > 0.5 * math.pi:
        angle -= 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)
        if abs(angle) > 0.5 * math.pi:
            angle = math.copysign(math.pi, angle) - angle
    z = angle * angle
    late = (1.0 / 362880.0 - z * (1.0 / 39916800.0)) + z * z * (1.0 / 6227020800.0)
    early = (-1.0 / 6.0 + z * (1.0 / 120.0)) + z * z * (z * late - 1.0 / 5040.0)
    return angle + angle * z * early


@compiled
def build(
    table: FloatArray, k: int, steps: FloatArray, rate: FloatArray, left: FloatArray, grid_s: float, h: float
) -> None:
    """Matrix of a step of length `h`, column by column; and what winds up the torque of a servo that sticks."""
    table[k, 0, 7], table[k, 1, 7], table[k, 2, 7] = wound_up(rate, left, grid_s, h)
    for j in range(7):
        unit = (
            1.0 * (j == 0),
            1.0 * (j == 1),
            1.0 * (j == 2),
            1.0 * (j == 3),
            1.0 * (j == 4),
            1.0 * (j == 5),
            1.0 * (j == 6),
        )
        table[k, 0, j], table[k, 1, j], table[k, 2, j] = moved(steps, rate, grid_s, h, unit)
