"""What all fits share: estimates with intervals, a robust line, and errors that are correlated."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from servofd.core.types import FloatArray

Z_95: Final = 1.96
"""Standard deviations of a 95 % interval."""
MAD_TO_SIGMA: Final = 1.4826
"""From the median size of normal errors to their standard deviation."""
LEAST_DIVISOR: Final = 1e-300
"""Least sum of squares that is divided by, so that signals of zeros give a number."""


class Estimate(NamedTuple):
    """A number with its 95 % interval.

    Examples
    --------
    >>> four = Estimate.of(4.0, 0.05)
    >>> four.low.__round__(3), four.high.__round__(3)
    (3.902, 4.098)
    """

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, value: float, deviation: float) -> Estimate:
        """Estimate with a standard deviation."""
        return cls(float(value), float(value - Z_95 * deviation), float(value + Z_95 * deviation))

    @property
    def deviation(self) -> float:
        """Standard deviation."""
        return (self.high - self.low) / (2.0 * Z_95)


def line(
    x: FloatArray, y: FloatArray, *, near: tuple[float, float] = (1e-6, 0.1), rounds: int = 8
) -> tuple[float, float]:
    """Slope and offset of y over x by small absolute deviations.

    Least squares, reweighted a few times; deviations within `near` (in the unit of y, and as a share of the mean one)
    count alike.

    Examples
    --------
    >>> x = np.arange(100.0)
    >>> slope, offset = line(x, np.where(x < 90, 2.0 * x + 1.0, 0.0))
    >>> round(slope, 1)
    2.0
    """
    weight = np.full(x.size, 1.0)
    slope, offset = 1.0, 0.0
    for _ in range(rounds):
        total = weight.sum()
        centre_x, centre_y = float(weight @ x) / total, float(weight @ y) / total
        weighted = weight * (x - centre_x)
        slope = float(weighted @ (y - centre_y)) / max(float(weighted @ (x - centre_x)), 1e-12)
        offset = centre_y - slope * centre_x
        deviation = np.abs(y - slope * x - offset)
        weight = 1.0 / (deviation + near[0] + near[1] * float(deviation.mean()))
    return slope, offset


def correlation_factor(errors: Sequence[FloatArray], lags: int) -> float:
    """Long-run variance over variance (Bartlett's window), at least 1: how many neighbours tell as much as one.

    Examples
    --------
    >>> white = np.random.default_rng(0).standard_normal(20_000)
    >>> round(correlation_factor([white], 20), 1), round(correlation_factor([np.repeat(white, 3)], 50))
    (1.0, 3)
    """
    total = sum(float(e @ e) for e in errors)
    if total == 0.0:
        return 1.0
    later = [[float(e[lag:] @ e[:-lag]) if lag < e.size else 0.0 for lag in range(1, lags + 1)] for e in errors]
    products = np.sum(later, axis=0) / total
    return max(1.0, 1.0 + 2.0 * float((1.0 - np.arange(1, lags + 1) / (lags + 1)) @ products))
