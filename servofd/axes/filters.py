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
        """A channel behind the filter, shape (n,), which begins at rest on its first value."""
        out: FloatArray = _passed(self.top, self.bottom, np.ascontiguousarray(values, dtype=np.float64))
        return out


def low_pass(corner_hz: float, rate_hz: float, damping: float) -> tuple[Section, Section]:
    """A low-pass filter, and the same of the derivative, by the bilinear transform."""
    corner, twice = 2.0 * math.pi * corner_hz, 2.0 * rate_hz
    first = twice**2 + 2.0 * damping * corner * twice + corner**2
    bottom = 2.0 * (corner**2 - twice**2) / first, (twice**2 - 2.0 * damping * corner * twice + corner**2) / first
    low, slope = corner**2 / first, corner**2 * twice / first
    return Section((low, 2.0 * low, low), bottom), Section((slope, 0.0, -slope), bottom)


def warped(corner_hz: float, rate_hz: float) -> float:
    """Corner for the bilinear transform to have one at a frequency [Hz]."""
    return rate_hz / math.pi * math.tan(math.pi * corner_hz / rate_hz)


@compiled
def _passed(top: tuple[float, float, float], bottom: tuple[float, float], values: FloatArray) -> FloatArray:
    rest = (top[0] + top[1] + top[2]) / (1.0 + bottom[0] + bottom[1]) * values[0]
    later = top[2] * values[0] - bottom[1] * rest
    soon, out = top[1] * values[0] - bottom[0] * rest + later, np.empty(values.size)
    for k in range(values.size):
        out[k] = top[0] * values[k] + soon
        soon = top[1] * values[k] - bottom[0] * out[k] + later
        later = top[2] * values[k] - bottom[1] * out[k]
    return out
