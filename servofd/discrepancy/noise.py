"""How large the disagreement would be if the model were right: the noise floor, from the data themselves."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.estimate.statistics import MAD_TO_SIGMA

if TYPE_CHECKING:
    from servofd.core.types import BoolArray, FloatArray
    from servofd.discrepancy.record import Record

_THIRD = 20.0**0.5
"""Standard deviation of third differences (1, -3, 3, -1) of white noise."""
_GOLDEN = 0.6180339887498949
"""Multiples of it fill the unit interval evenly (Weyl)."""
_MEDIAN_OF_THIRD = 3.02
"""Relative standard deviation of the squared floor, times the root of the number of differences (2000 simulations)."""
_LAGS, _PER_LAG = 25, 4
SMALLEST_DEG = 1e-6


def noise_floor_deg(record: Record, error_deg: FloatArray) -> float:
    """Standard deviation of what no servo could follow, from third differences of the error [deg].

    Motion is smooth, noise is not; the median of the differences ignores the few samples at which motion is not.

    Examples
    --------
    >>> from servofd.discrepancy.record import record_of
    >>> from servofd.servo.servo_model import ServoModel
    >>> from servofd.aircraft.segment import Segment
    >>> from servofd.servo.library import servo_named
    >>> t = np.arange(0.0, 60.0, 0.01)
    >>> noise = 0.1 * np.random.default_rng(0).standard_normal(t.size)
    >>> record = record_of(Segment("x", t, 0.0 * t, t, noise), ServoModel.of(servo_named("s9254")))
    >>> round(noise_floor_deg(record, noise), 2)
    0.1
    """
    third = np.diff(error_deg, 3)[_joined(record)]
    if third.size < 8:
        return SMALLEST_DEG
    if record.step_deg:
        # At rest all differences are whole steps of the converter; spread over one, their median is on no tooth.
        third = third + record.step_deg * (_GOLDEN * np.arange(third.size) % 1.0 - 0.5)
    spread = MAD_TO_SIGMA * float(np.median(np.abs(third - np.median(third)))) / _THIRD
    return max(spread, SMALLEST_DEG)


def floor_uncertainty(record: Record) -> float:
    """Relative standard deviation of the square of the noise floor, by chance."""
    return _MEDIAN_OF_THIRD / float(np.sqrt(max(int(_joined(record).sum()), 1)))


def _joined(record: Record) -> BoolArray:
    """Where four samples in a row count, shape (n - 3,)."""
    counts = record.counts
    return counts[3:] & counts[2:-1] & counts[1:-2] & counts[:-3]


def long_run_factor(error_deg: FloatArray) -> float:
    """How much the memory of an error widens the variance of its mean, at least 1.

    Examples
    --------
    >>> long_run_factor(np.random.default_rng(0).standard_normal(4000)) < 1.3
    True
    """
    power = float(error_deg @ error_deg)
    lags = min(_LAGS, error_deg.size // _PER_LAG)
    if power <= 0.0:
        return 1.0
    total = 1.0
    for lag in range(1, lags + 1):
        total += 2.0 * (1.0 - lag / (lags + 1)) * float(error_deg[lag:] @ error_deg[:-lag]) / power
    return max(1.0, total)
