"""Records of bench tests: several runs with one servo, several servos of one kind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from servofd.aircraft.segment import Segment
    from servofd.core.types import FloatArray

_FAR_AWAY_S = 60.0
"""The servo rests for so long before a run that nothing is left of how it came there."""
_STEP_SHARE = 0.1
"""Of the range of a run: a position further from the first command than this, apart from the offset of the whole run,
was asked for by an earlier one."""
_GAP_PERIODS = 10.0
_REGULAR = 0.01
"""Of a period: stamps that differ by less are those of a regular clock, rounded."""


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One test with one servo, prepared for simulation.

    Parameters
    ----------
    servo : int
        Which servo of several; runs of one servo share their offset.
    command_s, command_deg : ndarray, shape (n,)
        Commands that hold until the next, the first long before the test [s], [deg].
    measured_s, measured_deg : ndarray, shape (m,)
        Position, without missing values.
    """

    servo: int
    command_s: FloatArray
    command_deg: FloatArray
    measured_s: FloatArray
    measured_deg: FloatArray

    @property
    def span_deg(self) -> float:
        """Range of the command or of the position, whichever is larger [deg]."""
        return max(float(np.ptp(self.command_deg)), float(np.ptp(self.measured_deg)))


@dataclass(frozen=True, slots=True, eq=False)
class Uniform:
    """The same test on uniform time stamps, for the frequency response only."""

    command_deg: FloatArray
    measured_deg: FloatArray
    sample_time_s: float
    resampled: bool
    """True if the stamps were not uniform already: positions were interpolated, commands held."""


def prepared(segment: Segment, servo: int = 0) -> Run:
    """Prepare a segment: rest before it, no missing values.

    Examples
    --------
    >>> from servofd.aircraft.segment import Segment
    >>> run = prepared(Segment("x", np.arange(3.0), np.ones(3), np.arange(3.0), np.array([0.0, np.nan, 1.0])))
    >>> run.measured_deg
    array([0., 1.])
    """
    known = np.isfinite(segment.measured_deg)
    measured_s, measured_deg = segment.measured_s[known], segment.measured_deg[known]
    first_deg, rest_deg = float(segment.command_deg[0]), float(np.median(measured_deg[:3]))
    span_deg = max(float(np.ptp(segment.command_deg)), float(np.ptp(measured_deg)))
    offset_deg = float(np.mean(measured_deg) - np.mean(segment.command_deg))
    if abs(rest_deg - first_deg - offset_deg) <= _STEP_SHARE * span_deg:
        rest_deg = first_deg
    begin_s = min(float(segment.command_s[0]), float(measured_s[0])) - _FAR_AWAY_S
    return Run(
        servo,
        np.append(begin_s, segment.command_s),
        np.append(rest_deg, segment.command_deg),
        measured_s,
        measured_deg,
    )


def longest_uniform(run: Run) -> Uniform:
    """Longest stretch without a gap, on uniform stamps at the pace of the commands or the measurements.

    Positions between two stamps are interpolated, commands held, if the stamps are not uniform already.

    Examples
    --------
    >>> from servofd.aircraft.segment import Segment
    >>> t = np.arange(100) / 50.0
    >>> longest_uniform(prepared(Segment("x", t, np.sin(t), t, np.sin(t)))).resampled
    False
    """
    steps_s = np.diff(run.measured_s)
    period_s = float(np.median(steps_s))
    if run.command_s.size > 3:
        period_s = min(period_s, float(np.median(np.diff(run.command_s[1:]))))
    ends = np.concatenate([[0], np.flatnonzero(steps_s > _GAP_PERIODS * np.median(steps_s)) + 1, [run.measured_s.size]])
    longest = int(np.argmax(np.diff(ends)))
    stretch = slice(ends[longest], ends[longest + 1])
    measured_s, measured_deg = run.measured_s[stretch], run.measured_deg[stretch]
    regular = bool(
        np.array_equal(run.measured_s, run.command_s[1:])
        and np.all(np.abs(np.diff(measured_s) - period_s) <= _REGULAR * period_s)
    )
    grid_s = measured_s
    if not regular:
        grid_s = measured_s[0] + period_s * np.arange(int((measured_s[-1] - measured_s[0]) / period_s) + 1)
        measured_deg = np.interp(grid_s, measured_s, measured_deg)
    held = np.searchsorted(run.command_s, grid_s + 1e-9, side="right") - 1
    return Uniform(run.command_deg[held], measured_deg, period_s, not regular)
