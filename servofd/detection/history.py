"""What a monitor remembers of one surface: the last minutes of what was evaluated, in a fixed amount of memory."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.detection.residual import Commands, Residuals
from servofd.detection.threshold import Threshold

if TYPE_CHECKING:
    from servofd.core.types import BoolArray, FloatArray
    from servofd.detection.probability import CusumDesign
    from servofd.detection.threshold import ThresholdKind

_DROPPED = 4
"""One part in so many is dropped when the room is full."""


class History:
    """Evaluated samples, the latest of them; `capacity` at most.

    Examples
    --------
    >>> history = History(8)
    >>> for k in range(10):
    ...     history.append(np.full((History.ROWS, 1), float(k)))
    >>> history.first_s, history.last_s, history.size
    (3.0, 9.0, 7)
    """

    ROWS = 13

    def __init__(self, capacity: int) -> None:
        self._rows = np.zeros((self.ROWS, capacity))
        self.size = 0
        self.is_whole = True
        """False once something had to be dropped."""

    def append(self, rows: FloatArray) -> None:
        """Add samples, of shape (`ROWS`, n)."""
        capacity, count = self._rows.shape[1], rows.shape[1]
        if self.size + count > capacity:
            kept = max(min(self.size, capacity - capacity // _DROPPED - count), 0)
            self._rows[:, :kept] = self._rows[:, self.size - kept : self.size].copy()
            self.size, self.is_whole = kept, False
        count = min(count, capacity)
        self._rows[:, self.size : self.size + count] = rows[:, rows.shape[1] - count :]
        self.size += count

    @property
    def first_s(self) -> float:
        """Time of the oldest sample [s]; NaN without any."""
        return float(self._rows[0, 0]) if self.size else float("nan")

    @property
    def last_s(self) -> float:
        """Time of the latest sample [s]; NaN without any."""
        return float(self._rows[0, self.size - 1]) if self.size else float("nan")

    @staticmethod
    def packed(residuals: Residuals, threshold: Threshold, suspicious: BoolArray) -> FloatArray:
        """Rows of a piece, of shape (`ROWS`, n)."""
        rows = (
            residuals.time_s,
            residuals.simulated_deg,
            residuals.measured_deg,
            residuals.residual_deg,
            residuals.settled,
            residuals.immobile_deg,
            residuals.restart,
            threshold.level_deg,
            threshold.tolerance_deg,
            threshold.saturated_deg,
            threshold.sigma_deg,
            threshold.drift,
            suspicious,
        )
        packed = np.empty((len(rows), residuals.time_s.size))
        for place, row in enumerate(rows):
            packed[place] = row
        return packed

    def before(self, since_s: float, each: int) -> FloatArray:
        """One in `each` of the positions before an instant [s], of shape (n,) [deg]."""
        return self._rows[2, : np.searchsorted(self._rows[0, : self.size], since_s) : each].copy()

    def snapshot(
        self, kind: ThresholdKind, cusum: CusumDesign, since_s: float = -np.inf
    ) -> tuple[Residuals, Threshold, BoolArray]:
        """Residuals, threshold and suspicious samples since an instant [s], copied."""
        first = int(np.searchsorted(self._rows[0, : self.size], since_s))
        rows = self._rows[:, first : self.size].copy()
        time_s, simulated_deg, measured_deg, residual_deg, settled, immobile_deg, restart = rows[:7]
        level_deg, tolerance_deg, saturated_deg, sigma_deg, drift, suspicious = rows[7:]
        residuals = Residuals(
            time_s, simulated_deg, measured_deg, residual_deg, settled != 0.0, immobile_deg, restart.astype(np.int8)
        )
        threshold = Threshold(kind, level_deg, tolerance_deg, saturated_deg, sigma_deg, cusum, drift)
        return residuals, threshold, suspicious != 0.0


class CommandBuffer:
    """Commands of one surface as they are logged and as they reach the servo, with what was lost put back.

    The same as `servofd.detection.residual.commands_at_servo`, command by command.
    """

    def __init__(self, capacity: int) -> None:
        self._rows = np.zeros((3, capacity))
        self.size = 0

    def append(self, time_s: float, command_deg: float, slope_deg_s: float) -> int:
        """Add one, and tell how many of the oldest had to be dropped."""
        dropped = 0
        if self.size == self._rows.shape[1]:
            dropped = self.size // _DROPPED
            self._rows[:, : self.size - dropped] = self._rows[:, dropped : self.size].copy()
            self.size -= dropped
        self._rows[:, self.size] = time_s, command_deg, slope_deg_s
        self.size += 1
        return dropped

    def bend(self, command_deg: float, step_s: float) -> None:
        """Let the latest command run straight to the next one, which comes so much later."""
        if self.size:
            self._rows[2, self.size - 1] = (command_deg - self._rows[1, self.size - 1]) / step_s

    @property
    def time_s(self) -> FloatArray:
        """Of shape (n,) [s]."""
        return self._rows[0, : self.size]

    def commands(self) -> Commands:
        """The same without copies."""
        effective_s, command_deg, slope_deg_s = self._rows[:, : self.size]
        return Commands(effective_s, command_deg, slope_deg_s)

    def copied(self) -> Commands:
        """The same, to be kept."""
        effective_s, command_deg, slope_deg_s = self._rows[:, : self.size].copy()
        return Commands(effective_s, command_deg, slope_deg_s)
