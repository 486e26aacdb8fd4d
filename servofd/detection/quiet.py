"""How long a surface in alarm has been quiet, and when the bank should look whether its alarm is over."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from servofd.core.types import BoolArray, FloatArray
    from servofd.detection.stream import Piece

_QUIET_SHARE = 0.5
"""Of its threshold, below which the residual of a surface in alarm is quiet."""
_QUIET_S = 0.75
"""After so long in quiet the bank looks whether an alarm is over,"""
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
    _asked_s: float = float("-inf")
    _asked: int = 0

    def follow(self, piece: Piece, stuck_deg: float) -> None:
        """Take the next samples, and where the surface is said to be stuck [deg]; NaN if nowhere."""
        residuals, level_deg = piece.residuals, piece.threshold.level_deg
        judged = residuals.settled
        loud = judged & ~(np.abs(residuals.residual_deg) < _QUIET_SHARE * level_deg)
        there = loud | (judged & ~(np.abs(residuals.measured_deg - stuck_deg) > level_deg))
        self.quiet_s = self._since_s(self.quiet_s, residuals.time_s, judged, loud)
        self.away_s = self._since_s(self.away_s, residuals.time_s, judged, there)

    def is_due(self, now_s: float) -> bool:
        """Whether the bank should look now [s]."""
        pause_s = min(_PAUSE_S * (1 + self._asked), _LONGEST_PAUSE_S)
        if now_s - self._asked_s < pause_s or now_s - self.quiet_s < _QUIET_S:
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
