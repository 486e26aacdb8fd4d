"""For how long the positions of a stream were judged."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from servofd.aircraft.segment import OUTAGE_S

if TYPE_CHECKING:
    from servofd.core.types import BoolArray, FloatArray


@dataclass(slots=True)
class JudgedTime:
    """Time between positions that had a value, where they were judged.

    Examples
    --------
    >>> judged = JudgedTime()
    >>> time_s, measured_deg = np.array([0.0, 0.5, 1.0, 9.0]), np.array([1.0, np.nan, 2.0, 3.0])
    >>> judged.take(time_s, measured_deg, np.array([False, False, True, True]))
    >>> judged.seconds
    2.0
    """

    seconds: float = 0.0
    _latest_s: float = float("nan")

    def take(self, time_s: FloatArray, measured_deg: FloatArray, settled: BoolArray) -> None:
        """Count the next samples, arrays of shape (n,)."""
        valued = np.isfinite(measured_deg)
        if not valued.any():
            return
        valued_s = time_s[valued]
        begin_s = self._latest_s if np.isfinite(self._latest_s) else valued_s[0]
        steps_s = np.minimum(np.diff(valued_s, prepend=begin_s), OUTAGE_S)
        self.seconds += float(steps_s[settled[valued]].sum())
        self._latest_s = float(valued_s[-1])
