"""The play operator: what is left of a signal after a dead zone, at the heart of dead bands and backlash."""

from __future__ import annotations

import numpy as np

from logparsers.compiled import compiled
from servofd.core.types import FloatArray
from servofd.servo.state import fixed


@compiled
def _play(values: FloatArray, half_width: float, start: float, result: FloatArray) -> None:
    held = start
    for k in range(values.size):
        held = min(max(held, values[k] - half_width), values[k] + half_width)
        result[k] = held


def play(values: FloatArray, width: float, start: float) -> FloatArray:
    """Follow `values` only when they would leave a zone of full width `width` around the result.

    Parameters
    ----------
    values : ndarray, shape (n,)
        Signal.
    start : float
        Result before the first sample.

    Returns
    -------
    ndarray, shape (n,)
        Never further than half the width from the signal.

    Examples
    --------
    >>> play(np.array([0.0, 1.0, 3.0, 2.0, -1.0]), 2.0, 0.0)
    array([0., 0., 2., 2., 0.])
    """
    result = np.empty(values.size)
    _play(fixed(np.asarray(values, dtype=float)), width / 2.0, start, result)
    return result
