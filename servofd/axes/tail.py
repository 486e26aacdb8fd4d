"""How often healthy flights exceed a level that no calibration flight reached."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from servofd.types import FloatArray

_PRIOR_INDEX, _PRIOR_WEIGHT = 2.5, 4.0
_FAULT_PER_HOUR = 0.01
"""Once in a hundred hours is called a fault wrongly."""


@dataclass(frozen=True, slots=True)
class Tail:
    """Power law of the largest statistic of a flight (Hill 1975) above the median flight's.

    Parameters
    ----------
    base : float
        Statistic of the median flight.
    index : float
        How steeply the rate falls.
    rate_per_hour : float
        How often a flight exceeds `base`.
    days : int
        Calibrated.
    """

    base: float
    index: float
    rate_per_hour: float
    days: int

    def per_hour(self, level: float) -> float:
        """False alarms an hour at a level.

        Examples
        --------
        >>> Tail(0.5, 2.0, 10.0, 4).per_hour(1.0)
        2.5
        """
        return self.rate_per_hour * min(1.0, math.pow(level / self.base, -self.index))

    def level(self, per_hour: float) -> float:
        """Level for a rate; never below what calibration flights reached.

        Examples
        --------
        >>> Tail(0.5, 2.0, 10.0, 4).level(0.1)
        5.0
        """
        return max(1.0, self.base * math.pow(self.rate_per_hour / per_hour, 1.0 / self.index))

    def fault_level(self) -> float | None:
        """Level that is wrong once in a hundred hours; None where the days are too few to tell."""
        return None if self.days < _LEAST_DAYS else self.level(_FAULT_PER_HOUR)


_LEAST_DAYS = 2
_FEW_DAYS = {1: 17.0, 2: 6.0, 3: 1.5}
"""Flights of one day tell too little of the next: false alarms at the same multiple of the calibration's largest
statistic, over those after four days. Measured on five days of a real aircraft (ALFA): 35.6, 12.1, 3.1 and 2.1 an hour
after one to four."""


def tail_of(tops: FloatArray, hours: FloatArray, *, days: int) -> Tail:
    """Tail from the largest statistic of each flight.

    Parameters
    ----------
    tops : ndarray, shape (n,)
        Largest statistic of each flight, judged by a model without its day.
    hours : ndarray, shape (n,)
        Length of each.
    days : int
        On which they were flown.
    """
    seen = tops[tops > 0.0]
    base = float(np.median(seen)) if seen.size else 1.0
    above = seen[seen >= base]
    logs = float(np.sum(np.log(above / base)))
    index = (above.size + _PRIOR_WEIGHT) / (logs + _PRIOR_WEIGHT / _PRIOR_INDEX)
    total = float(hours.sum())
    return Tail(base, index, _FEW_DAYS.get(days, 1.0) * above.size / max(total, 1e-9), days)
