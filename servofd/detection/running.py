"""The median of all that came so far, in a fixed amount of memory."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servofd.servo.state import compiled

_PER_OCTAVE, _LOWEST_OCTAVE, _BINS = 16, -20, 640
"""From 1e-6 to 1e6, within 2.2 %."""


class RunningMedian(NamedTuple):
    """A histogram of logarithms, and where its middle is."""

    counts: NDArray[np.int64]
    place: NDArray[np.int64]
    """Of shape (3,): bin of the median, how many values lie below that, how many there are."""


def new_running_median() -> RunningMedian:
    """Of nothing yet."""
    return RunningMedian(np.zeros(_BINS, dtype=np.int64), np.zeros(3, dtype=np.int64))


@compiled
def with_value(median: RunningMedian, value: float) -> float:
    """Add a value above zero, and tell the median of all.

    Examples
    --------
    >>> median = new_running_median()
    >>> [round(with_value(median, value), 1) for value in (1.0, 9.0, 1.0)]
    [1.0, 1.0, 1.0]
    """
    counts, place = median
    octave = np.log2(max(value, 1e-300))
    bin_ = int(min(max((octave - _LOWEST_OCTAVE) * _PER_OCTAVE, 0.0), _BINS - 1.0))
    counts[bin_] += 1
    place[2] += 1
    if bin_ < place[0]:
        place[1] += 1
    while place[1] > (place[2] - 1) // 2:
        place[0] -= 1
        place[1] -= counts[place[0]]
    while place[1] + counts[place[0]] <= (place[2] - 1) // 2:
        place[1] += counts[place[0]]
        place[0] += 1
    result: float = 2.0 ** ((place[0] + 0.5) / _PER_OCTAVE + _LOWEST_OCTAVE)
    return result
