"""Loops over samples that the compiler takes, and what they are given."""

from __future__ import annotations

from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from logparsers import compiled as compiler
from servofd.core.types import FloatArray

Kind = TypeVar("Kind", np.float64, np.int8, np.bool_)

compiled = partial(compiler.compiled, error_model="numpy", fastmath={"contract"}, _nrt=False)
inner = partial(compiled, no_cpython_wrapper=True)
"""No reference counting inside: nothing here allocates, and it would take 9/10 of the time (measured). What only other
compiled functions call needs no door for Python, which takes as long to compile as the function."""


def fixed(values: NDArray[Kind]) -> NDArray[Kind]:
    """The same values, contiguous and read-only: compiled for them alone, a function is compiled once."""
    view = np.ascontiguousarray(values).view()
    view.setflags(write=False)
    return view


@compiled
def _play(values: FloatArray, half_width: float, start: float, result: FloatArray) -> None:
    held = start
    for k in range(values.size):
        held = min(max(held, values[k] - half_width), values[k] + half_width)
        result[k] = held


def play(values: FloatArray, width: float, start: float) -> FloatArray:
    """Follow `values` only when they would leave a zone of full width `width` around the result.

    `values` (shape (n,)): signal. `start`: result before the first sample. Result (shape (n,)): never further than half
    the width from the signal.

    Examples
    --------
    >>> play(np.array([0.0, 1.0, 3.0, 2.0, -1.0]), 2.0, 0.0)
    array([0., 0., 2., 2., 0.])
    """
    result = np.empty(values.size)
    _play(fixed(np.asarray(values, dtype=float)), width / 2.0, start, result)
    return result


@compiled
def _lagged_twice(values: FloatArray, lag: float, result: FloatArray) -> None:
    first = second = 0.0
    for k in range(values.size):
        result[k] = values[k] + first
        first, second = second + 2.0 * lag * result[k], -lag * lag * result[k]


def lagged_twice(values: FloatArray, lag: float) -> FloatArray:
    """Values through two equal lags, shape (n,) (scipy.signal, which has a function for it, takes a second to load).

    Each keeps `lag` of what it was from one value to the next; a constant comes out 1 / (1 - lag)^2 times as large.

    Examples
    --------
    >>> lagged_twice(np.array([1.0, 0.0, 0.0]), 0.5)
    array([1.  , 1.  , 0.75])
    """
    result = np.empty(values.size)
    _lagged_twice(fixed(values), lag, result)
    return result
