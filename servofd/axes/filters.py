"""Filters of second order, without `scipy.signal`, which takes longer to load than a flight to read and to judge."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from logparsers.compiled import compiled
from servofd.core.types import FloatArray


class Section(NamedTuple):
    """A rational function of z: coefficients of 1, 1/z and 1/z^2 above the line, and of 1/z and 1/z^2 below it."""

    top: tuple[float, float, float]
    bottom: tuple[float, float]

    def passed(self, values: FloatArray) -> FloatArray:
        """A channel behind the filter, shape (n,), which begins at rest on its first value.

        Examples
        --------
        >>> low_pass(1.0, 10.0, 0.8)[0].passed(np.array([2.0, 2.0])).round(9)
        array([2., 2.])
        """
        out = np.empty(values.size)
        rest = sum(self.top) / (1.0 + sum(self.bottom)) * float(values[0]) if values.size else 0.0
        first = float(values[0]) if values.size else 0.0
        later = self.top[2] * first - self.bottom[1] * rest
        state = (self.top[1] * first - self.bottom[0] * rest + later, later)
        _pass(*self.top, *self.bottom, *state, np.ascontiguousarray(values, dtype=np.float64), out)
        return out


def low_pass(corner_hz: float, rate_hz: float, damping: float) -> tuple[Section, Section]:
    """A low-pass filter, and the same of the derivative, by the bilinear transform.

    Butterworth's filter, whose corner is where it is said to be, has a damping of half the square root of two and a
    corner that `warped` moves.
    """
    corner, twice = 2.0 * math.pi * corner_hz, 2.0 * rate_hz
    first = twice**2 + 2.0 * damping * corner * twice + corner**2
    bottom = 2.0 * (corner**2 - twice**2) / first, (twice**2 - 2.0 * damping * corner * twice + corner**2) / first
    low, slope = corner**2 / first, corner**2 * twice / first
    return Section((low, 2.0 * low, low), bottom), Section((slope, 0.0, -slope), bottom)


def warped(corner_hz: float, rate_hz: float) -> float:
    """Corner for the bilinear transform to have one at a frequency [Hz]."""
    return rate_hz / math.pi * math.tan(math.pi * corner_hz / rate_hz)


@compiled
def _pass(
    top0: float,
    top1: float,
    top2: float,
    bottom1: float,
    bottom2: float,
    state1: float,
    state2: float,
    values: FloatArray,
    out: FloatArray,
) -> None:
    for k in range(values.size):
        value = values[k]
        passed = top0 * value + state1
        state1 = top1 * value - bottom1 * passed + state2
        state2 = top2 * value - bottom2 * passed
        out[k] = passed
