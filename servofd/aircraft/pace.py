"""At which pace a stream comes: what passes between two samples, between two that were sent, and what is a gap."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from servofd.core.types import FloatArray

OUTAGE_S = 1.0
"""Longer steps are pauses of a link."""
_FEWEST_STEPS, _SHORTEST, _WHOLE = 20, 10.0, 1.5
"""Where more than half is lost, the shortest steps (this percentile) are whole, and most of them are longer."""
WARM_UP_S, WARM_UP_STEPS = 10.0, 100
"""A monitor in flight learns the pace of a stream from so many intervals, or from as many as there are by then [s]."""
SAME_PACE, _STEPS_FOR_PACE = 1.5, 10_000
"""Ratio of two paces that are the same, and intervals that tell the usual one, or the period, of a long log."""

SLOWEST_RATE_HZ = 8.0
"""Feedback of nominally 10 Hz, whose pace jitters, is judged; below, samples are further apart than a servo takes for
5 deg (0.1 s at the slowest of the library), and a jam looks like a delay."""
SLOWEST_LEFT_HZ = 4.0
"""The same of a calibrated servo, whose delay is known, where only a link loses what would be more."""
TOO_MANY_LOST = "more than half of all commands and positions are lost; a servo that is not calibrated cannot be judged"

_HOLDS: Final = 1.5
"""A gap of so many periods holds a lost command."""
_GAP_PERIODS = 2.5
"""Median periods beyond which a command is missing."""
_SHORTEST_GAP_S = 0.05
"""No gap is shorter than this [s]."""
_RARELY = 0.98
"""Intervals between commands of which fewer than one in fifty is longer are the rhythm, and no gap."""
_LOST_SAMPLE = (1.5, 1.75)
"""An interval at least this many times the median holds a lost sample: the more, the more the time stamps jitter."""
_LOW_QUANTILE, _TRIANGLE = 5.0, 1.0 - 0.1**0.5
"""Two uniform jitters make a triangular one; its lower 5 % lie beyond this share of its half width."""
_FEW_INTERVALS = 1.25
"""A quantile of a hundred intervals scatters by a tenth."""
_FEWEST_COMMANDS = 3
"""Commands that have a period."""
_MOST_KEPT = 60.0
"""A log that has lost three commands in ten has the right interval in seven of ten, give or take a few."""
_REGULAR_SPREAD, _UNEVEN_SPREAD, _AT_ONCE = 0.35, 0.45, 0.4
"""From the lower quarter of all intervals to that quantile within this share of the median: a regular log. In a hundred
intervals of 10 ms it is 0.18 to 0.43 if stamps are off by up to 3 ms and a fifth is lost (400 draws), but then hardly
one is shorter than the last share of the median, as some are where commands come as they please."""


def pace_steps(time_s: FloatArray) -> FloatArray:
    """Intervals that tell the pace of a stream [s], from time stamps [s] of shape (n,).

    Those of the warm-up, so that a monitor in flight works with the same numbers as an audit of the whole log; all of
    them if the pace changed after that.
    """
    last = int(np.searchsorted(time_s, time_s[:1] + WARM_UP_S, side="right").sum()) - 1
    first_s = np.diff(time_s[: 1 + max(1, min(WARM_UP_STEPS, last))])
    if first_s.size == 0:
        return first_s
    every = 1 + (time_s.size - 1) // _STEPS_FOR_PACE
    early_s, usual_s = float(np.median(first_s)), float(np.median(time_s[1::every] - time_s[:-1:every]))
    same = early_s <= SAME_PACE * usual_s and usual_s <= SAME_PACE * early_s
    return first_s if same else np.diff(time_s)


def sent_period_s(time_s: FloatArray) -> float | None:
    """Period of a steady stream of which more than half is lost [s], from stamps of what arrived [s]; else None."""
    steps_s = _unbroken(time_s)
    if not steps_s.size:
        return None
    shortest_s = float(np.percentile(steps_s, _SHORTEST))
    halves = np.array_split(steps_s, 2)  # a stream whose rate has changed loses nothing
    return shortest_s if all(np.median(half) > _WHOLE * shortest_s for half in halves) else None


def link_period_s(time_s: FloatArray) -> float | None:
    """Period of what a steady stream brings some of [s], from stamps of what arrived [s]; None if it is none."""
    steps_s = _unbroken(time_s)
    if not steps_s.size:
        return None
    single = steps_s <= _WHOLE * float(np.percentile(steps_s, _SHORTEST))  # nothing was lost in between
    period_s = float(np.median(steps_s[single]))
    lasts = all(np.mean(half) >= _SINGLE for half in np.array_split(single, 2))
    if not (lasts and 0.0 < period_s <= _BRIDGED_S):
        return None
    periods = steps_s / period_s
    if np.mean(np.abs(periods - np.maximum(np.round(periods), 1.0)) <= _WHOLE_PERIODS) < _STEADY:
        return None
    return period_s / max(int(np.ceil(period_s / _FRAME_S - _NEARLY)), 1)


def _unbroken(time_s: FloatArray) -> FloatArray:
    """Intervals of a stream without its pauses [s]; none where they are too few to tell its period."""
    steps_s = np.diff(time_s)
    steps_s = steps_s[steps_s <= OUTAGE_S]
    return steps_s if steps_s.size >= _FEWEST_STEPS else steps_s[:0]


_FRAME_S: Final = 0.02
"""An autopilot moves its servos so often or oftener: a link that brings fewer of its commands has lost the others."""
_NEARLY: Final = 0.3
"""Share of that period by which a link may be slower, as one of 40 Hz is."""
_BRIDGED_S: Final = 0.105
"""Longest period of a stream of which what was lost is put back: the quarter of a second that is bridged holds two
periods of 10 Hz, whose stamps are not exact."""
_SINGLE: Final = 0.05
"""Least share of intervals without a loss in each half of the first ones; a stream whose rate has changed has none."""
_WHOLE_PERIODS, _STEADY = 0.25, 0.8
"""Commands are steady if this share of their intervals is a whole number of periods, to within a quarter of one."""


class Rhythm(NamedTuple):
    """Period of the commands of a log, and which of them were lost."""

    period_s: float
    longest_s: float
    """A longer interval holds a lost command."""

    @classmethod
    def of_link(cls, period_s: float) -> Rhythm:
        """Of commands that are sent steadily over a link."""
        return cls(period_s, _HOLDS * period_s)


NO_RHYTHM: Final = Rhythm(float("inf"), float("inf"))
"""Commands come as they please, and no interval is a loss."""


def rhythm(command_s: FloatArray) -> Rhythm:
    """Rhythm of commands with time stamps [s] of shape (n,).

    Infinite where commands come as they please, and no interval is a loss.
    """
    if command_s.size < _FEWEST_COMMANDS:
        return NO_RHYTHM
    some_s = pace_steps(command_s)
    some_s = some_s[:: 1 + some_s.size // _STEPS_FOR_PACE]
    low_s, quarter_s, period_s, upper_s = np.percentile(some_s, [_LOW_QUANTILE, 25.0, 50.0, _MOST_KEPT]).tolist()
    most = _UNEVEN_SPREAD if low_s > _AT_ONCE * period_s else _REGULAR_SPREAD
    if upper_s - quarter_s > most * period_s:
        return NO_RHYTHM
    jitter_s = _FEW_INTERVALS * (period_s - low_s) / _TRIANGLE
    least, most = (share * period_s for share in _LOST_SAMPLE)
    return Rhythm(period_s, min(max(period_s + jitter_s, least), most))


def gap_s(command_s: FloatArray) -> float:
    """Longest time between commands that is no gap [s]."""
    steps_s = np.diff(command_s[: WARM_UP_STEPS + 1])
    if not steps_s.size:
        return _SHORTEST_GAP_S
    usual_s = max(_GAP_PERIODS * float(np.median(steps_s)), 1.2 * float(np.quantile(steps_s, _RARELY)))
    return max(_SHORTEST_GAP_S, min(usual_s, 10.0 * float(np.median(steps_s))))
