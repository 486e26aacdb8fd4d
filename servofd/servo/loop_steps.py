"""One step of the position loop: its matrix, from the nearest one on a grid and a series in what is left."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from logparsers import compiled as compiler
from servofd.core.types import FloatArray

ROW = 8
"""Of a matrix: seven states and inputs, and one for the torque of a servo that sticks."""
_TERMS = 5
"""Of the series."""

_NO_LOSS = 1e-6
"""Of the torque [1/s]: below, a step keeps all of it; servos of lower order have none at all."""
_FAST = {"contract", "nsz", "arcp"}
compiled = partial(compiler.compiled, error_model="numpy", fastmath=_FAST, _nrt=False)
inner = partial(compiled, no_cpython_wrapper=True)
inlined = partial(compiler.compiled, error_model="numpy", fastmath=_FAST, _nrt=False, forceinline=True)
"""No reference counting inside: nothing here allocates, and it would take half of the time (measured). LLVM puts these
into the loop around them: numba's own inlining made it no faster, and took 5 s more to compile."""


@partial(compiler.compiled, error_model="numpy")
def step_matrices(rate: FloatArray, grid_s: float, count: int) -> FloatArray:
    """Matrices of 0..count grid steps, and their first derivatives over factorials, shape (count + 1, 5, 3 * ROW).

    Rows are one after the other, one per state; their last column is what is left of the torque of a servo that sticks,
    and what an error and its slope add to it. `rate` holds derivatives of the states, shape (3, 7).
    """
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
    steps = np.zeros((count + 1, _TERMS, 3 * ROW))
    for k in range(count + 1):
        for i in range(3):
            for j in range(size):
                if k == 0:
                    steps[k, 0, ROW * i + j] = 1.0 * (i == j)
                    continue
                # Inputs are constant but for the command, which has moved on by its slope before this step.
                total = one[i, j] if j > 2 else 0.0
                for m in range(3):
                    total += one[i, m] * steps[k - 1, 0, ROW * m + j]
                steps[k, 0, ROW * i + j] = total
            steps[k, 0, ROW * i + 4] += one[i, 3] * max(k - 1, 0) * grid_s
        _derive(steps[k], rate, k * grid_s)
        _wind_up(steps[k], rate, k * grid_s)
    return steps


@inner
def _derive(series: FloatArray, rate: FloatArray, h: float) -> None:
    """States after `h`: their derivatives over factorials."""
    for n in range(1, _TERMS):
        for i in range(3):
            at = ROW * i
            for j in range(ROW - 1):
                early = rate[i, 0] * series[n - 1, j] + rate[i, 1] * series[n - 1, ROW + j]
                series[n, at + j] = (early + rate[i, 2] * series[n - 1, 2 * ROW + j]) / n
            if n == 1:
                series[n, at + 3] += rate[i, 3]
                series[n, at + 4] += rate[i, 3] * h
                series[n, at + 5] += rate[i, 5]
                series[n, at + 6] += rate[i, 6]
            elif n == 2:  # of the inputs only the command changes, and only its slope is left
                series[n, at + 4] += 0.5 * rate[i, 3]


@inner
def _wind_up(series: FloatArray, rate: FloatArray, h: float) -> None:
    """Last column: the torque after `h` without motion, and its derivatives over factorials."""
    q, stiffness = max(-rate[2, 2], _NO_LOSS), rate[2, 5]
    share, filled, ramped = ROW - 1, 2 * ROW - 1, 3 * ROW - 1
    since = -math.expm1(-q * h) / q
    series[0, share], series[0, filled] = math.exp(-q * h), stiffness * since
    series[0, ramped] = stiffness * (h - since) / q
    for n in range(1, _TERMS):
        series[n, share] = -q * series[n - 1, share] / n
        series[n, filled] = (stiffness * series[0, share] if n == 1 else -q * series[n - 1, filled]) / n
        series[n, ramped] = series[n - 1, filled] / n


@compiled
def build(table: FloatArray, k: int, steps: FloatArray, grid_s: float, h: float) -> None:
    """Matrix of a step of length `h` in row `k` of a table, shape (p, 3 * ROW)."""
    nearest = min(int(h / grid_s + 0.5), steps.shape[0] - 1)
    rest = h - nearest * grid_s
    for j in range(3 * ROW):
        late = steps[nearest, 2, j] + rest * (steps[nearest, 3, j] + rest * steps[nearest, 4, j])
        table[k, j] = steps[nearest, 0, j] + rest * (steps[nearest, 1, j] + rest * late)


@inlined
def column(m: FloatArray, k: int, j: int) -> tuple[float, float, float]:
    """What all states after step `k` of a table owe to one state or input."""
    return m[k, j], m[k, ROW + j], m[k, 2 * ROW + j]


@inlined
def row(m: FloatArray, k: int, i: int, x: tuple[float, ...]) -> float:
    """One state after step `k` of a table, from states and inputs; those that are known last come last."""
    j = ROW * i
    early = (m[k, j] * x[0] + m[k, j + 1] * x[1]) + (m[k, j + 2] * x[2] + m[k, j + 3] * x[3] + m[k, j + 4] * x[4])
    return float(early + m[k, j + 6] * x[6] + m[k, j + 5] * x[5])


@inlined
def coasted(m: FloatArray, k: int, x: tuple[float, ...]) -> tuple[float, float, float]:
    """All states after step `k` of a table while the error does not act, and hence neither position nor command."""
    v, torque = ROW, 2 * ROW
    return (
        x[0] + m[k, 1] * x[1] + m[k, 2] * x[2] + m[k, 6] * x[6] + m[k, 5] * x[5],
        m[k, v + 1] * x[1] + m[k, v + 2] * x[2] + m[k, v + 6] * x[6] + m[k, v + 5] * x[5],
        m[k, torque + 1] * x[1] + m[k, torque + 2] * x[2] + m[k, torque + 6] * x[6] + m[k, torque + 5] * x[5],
    )


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
