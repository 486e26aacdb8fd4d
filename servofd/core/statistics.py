"""What all fits share: estimates with intervals, and errors that are correlated."""

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
