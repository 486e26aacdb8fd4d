"""How long a surface in alarm has been quiet, and when the bank should look whether its alarm is over."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from servofd.core.types import BoolArray, FloatArray
    from servofd.detection.stream import Piece

QUIET_SHARE = 0.5
"""Of its threshold, below which the residual of a surface in alarm is quiet."""
QUIET_S = 0.75
"""After so long in quiet the bank looks whether an alarm is over,"""
_OVER_S, _AS_FAST = 1.25, 0.7
"""In flights of an ArduPlane alarms of faults that had ended were taken back after 0.8 to 1.5 s, but for two of eleven,
in which the bank saw no end."""
_PAUSE_S, _LONGEST_PAUSE_S = 0.4, 1.5
"""and again after pauses that grow with each look in vain."""


@dataclass(slots=True)
class Quiet:
    """How long the residual of a surface in alarm has been quiet.

    Examples
    --------
    >>> quiet = Quiet(quiet_s=10.0)
    >>> [quiet.is_due(at_s) for at_s in (10.5, 10.8, 10.9, 11.8)]
    [False, True, False, True]
    """

    quiet_s: float = float("inf")
    """Since when it is quiet [s]; infinite if it is not."""
    away_s: float = float("inf")
    """Since when it is, elsewhere than where it was stuck [s]."""
    _loudest_deg_s: float = 0.0
    """How fast the servo was asked to move where the residual passed its threshold."""
    _quiet_deg_s: float = 0.0
    """The same since it is quiet."""
    _asked_s: float = float("-inf")
    _asked: int = 0

    def follow(self, piece: Piece, stuck_deg: float) -> None:
        """Take the next samples, and where the surface is said to be stuck [deg]; NaN if nowhere."""
        residuals, level_deg = piece.residuals, piece.threshold.level_deg
        judged = residuals.settled
        loud = judged & ~(np.abs(residuals.residual_deg) < QUIET_SHARE * level_deg)
        there = loud | (judged & ~(np.abs(residuals.measured_deg - stuck_deg) > level_deg))
        passed = judged & (np.abs(residuals.residual_deg) >= level_deg)
        speed_deg_s = np.abs(np.diff(residuals.simulated_deg, append=np.nan)) / np.diff(residuals.time_s, append=np.nan)
        speed_deg_s = np.nan_to_num(speed_deg_s)
        self._loudest_deg_s = max(self._loudest_deg_s, float(speed_deg_s[passed].max(initial=0.0)))
        self.quiet_s = self._since_s(self.quiet_s, residuals.time_s, judged, loud)
        earlier_deg_s = 0.0 if loud.any() else self._quiet_deg_s
        calm = judged & (residuals.time_s >= self.quiet_s)
        self._quiet_deg_s = max(earlier_deg_s, float(speed_deg_s[calm].max(initial=0.0)))
        self.away_s = self._since_s(self.away_s, residuals.time_s, judged, there)

    def is_over(self, now_s: float) -> bool:
        """Whether motion as fast as that which passed the threshold has left the residual quiet for long enough."""
        return now_s - self.quiet_s >= _OVER_S and self._quiet_deg_s >= _AS_FAST * self._loudest_deg_s > 0.0

    def is_due(self, now_s: float) -> bool:
        """Whether the bank should look now [s]."""
        pause_s = min(_PAUSE_S * (1 + self._asked), _LONGEST_PAUSE_S)
        if now_s - self._asked_s < pause_s or now_s - self.quiet_s < QUIET_S:
            return False
        self._asked_s, self._asked = now_s, self._asked + 1
        return True

    @staticmethod
    def _since_s(since_s: float, time_s: FloatArray, judged: BoolArray, ends: BoolArray) -> float:
        last = np.flatnonzero(ends)
        if last.size:
            since_s, time_s, judged = np.inf, time_s[last[-1] + 1 :], judged[last[-1] + 1 :]
        begun = np.flatnonzero(judged)
        return min(since_s, float(time_s[begun[0]])) if begun.size else since_s
