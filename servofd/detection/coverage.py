"""How much of a flight a verdict stands on: time in which the surface moved, and streams that stopped."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servofd.aircraft.segment import Segment
    from servofd.core.types import BoolArray, FloatArray
    from servofd.detection.residual import Residuals

_BIN_S = 1.0
_MOVES_DEG = 0.5
_CLEARLY_MOVES_DEG = 2.0
_JUDGED = 0.4
"""Share of the usual samples from which on a second counts as judged."""
_FEWEST_S = 3.0
_LEAST = 0.5
_STOPS_S, _STOPS_SHARE = 3.0, 0.1


class Coverage(NamedTuple):
    """What of a flight was judged."""

    moving_share: float
    """Share of the seconds in which the surface was asked to move, or did, that was judged."""
    uncommanded_s: float
    """Time for which the position moved clearly while there was no command [s]."""
    stopped: str
    """Which stream stopped long before the other, and when; empty if none did."""

    @property
    def problem(self) -> str:
        """Why this is too little to clear a surface; empty if it is not."""
        if self.stopped:
            return self.stopped
        if self.moving_share < _LEAST:
            return f"judged for only {self.moving_share:.0%} of the time in which it moved or was asked to"
        return ""

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader should know of it."""
        moved = f"the position moved for {self.uncommanded_s:.0f} s without any command in the log"
        return (moved,) if self.uncommanded_s >= _FEWEST_S else ()


def coverage(segment: Segment, residuals: Residuals) -> Coverage:
    """What of a flight was judged.

    Examples
    --------
    >>> from servofd.detection.residual import ResidualGenerator
    >>> from servofd.servo.servo_model import ServoModel
    >>> from servofd.aircraft.segment import Segment
    >>> from servofd.servo.library import servo_named
    >>> time_s = np.arange(0.0, 40.0, 0.02)
    >>> motion = 5.0 * np.sin(time_s)
    >>> segment = Segment("x", time_s[:400], motion[:400], time_s, motion)
    >>> residuals = ResidualGenerator(ServoModel.of(servo_named("s9254")), 50.0).run(segment)
    >>> coverage(segment, residuals).problem
    'no command after 8.0 s although the other stream goes on for 32.0 s'
    """
    measured = np.isfinite(segment.measured_deg)
    if not measured.any() or segment.command_s.size == 0:
        return Coverage(1.0, 0.0, "")
    first_s = float(min(segment.command_s[0], segment.measured_s[0]))
    last_s = float(max(segment.command_s[-1], segment.measured_s[-1]))
    position_s = segment.measured_s[measured]
    streams = segment.command_s, position_s, residuals.time_s[residuals.settled]
    bins = [_bins(each, first_s) for each in streams]
    seconds = np.unique(np.concatenate([each[np.diff(each, prepend=-1) > 0] for each in bins]))
    command, position, settled = (np.searchsorted(seconds, each) for each in bins)
    asked = _spans(command, segment.command_deg, seconds.size)
    moved = _spans(position, segment.measured_deg[measured], seconds.size)
    is_judged = np.bincount(settled, minlength=seconds.size) >= _JUDGED * _BIN_S / max(segment.period_s, 1e-9)
    commanded = np.bincount(command, minlength=seconds.size) > 0
    moving: BoolArray = (asked >= _MOVES_DEG) | (moved >= _CLEARLY_MOVES_DEG)
    total = int(np.count_nonzero(moving))
    share = float(np.count_nonzero(moving & is_judged)) / total if total * _BIN_S >= _FEWEST_S else 1.0
    alone = float(np.count_nonzero(~commanded & (moved >= _CLEARLY_MOVES_DEG))) * _BIN_S
    return Coverage(share, alone, _stopped(segment, position_s, first_s, last_s))


def _stopped(segment: Segment, position_s: FloatArray, first_s: float, last_s: float) -> str:
    longest_s = max(_STOPS_S, _STOPS_SHARE * (last_s - first_s))
    for what, time_s in (("command", segment.command_s), ("position", position_s)):
        if last_s - time_s[-1] > longest_s:
            return (
                f"no {what} after {time_s[-1]:.1f} s although the other stream goes on for {last_s - time_s[-1]:.1f} s"
            )
    return ""


def _bins(time_s: FloatArray, first_s: float) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return ((time_s - first_s) / _BIN_S).astype(np.int64)


def _spans(where: NDArray[np.intp], values_deg: FloatArray, bins: int) -> FloatArray:
    """How far a stream moves in each second [deg]; what happens from one to the next belongs to the later."""
    low, high = np.full(bins, np.inf), np.full(bins, -np.inf)
    for edge, values in ((where, values_deg), (where[1:], values_deg[:-1])):
        np.minimum.at(low, edge, values)
        np.maximum.at(high, edge, values)
    return np.where(high >= low, high - low, 0.0)
