"""Positions that are logged faster than they are refreshed: each is one reading, however often it stands in the log."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from servofd.aircraft.segment import Segment

_CLEAR, _SMALLEST = 3.0, 0.02
"""A jump of so many steps of the readings is motion or noise, which goes on; that quantile of all jumps is a step."""
_FEWEST, _ROWS = 30, 1.5
"""Jumps that tell, and rows from one to the next beyond which readings are held."""
_REGULAR = 0.6
"""Share of the jumps that follow the one before at the usual time, to a third of it or a multiple."""


def without_held(segment: Segment) -> tuple[Segment, str | None]:
    """A segment with each reading once, and a sentence about it if readings were held.

    Examples
    --------
    >>> from servofd.aircraft.segment import Segment
    >>> t = np.arange(0.0, 10.0, 0.01)
    >>> moved = np.sin(3.0 * t)
    >>> held = moved[5 * (np.arange(t.size) // 5)]
    >>> without_held(Segment("x", t, moved, t, held))[1]
    'positions are refreshed every 0.05 s and held in between: each is judged once (200 of 1000 rows)'
    >>> without_held(Segment("x", t, moved, t, np.round(moved, 1)))[1] is None
    True
    """
    known = np.isfinite(segment.measured_deg)
    time_s, deg = segment.measured_s[known], segment.measured_deg[known]
    jumps_deg = np.abs(np.diff(deg, prepend=np.nan))
    moved = np.flatnonzero(jumps_deg > 0.0)
    if moved.size < _FEWEST:
        return segment, None
    step_deg = float(np.quantile(jumps_deg[moved], _SMALLEST))
    clear = jumps_deg[moved] > _CLEAR * step_deg
    rows = np.diff(moved)[clear[1:] & clear[:-1]]
    if rows.size < _FEWEST or np.median(rows) <= _ROWS:
        return segment, None
    usual = float(np.median(rows))
    ratio = rows / usual
    if np.mean(np.abs(ratio - np.maximum(np.round(ratio), 1.0)) < 1.0 / 3.0) < _REGULAR:
        return segment, None
    # At rest a reading that stays is new as often as any.
    period_s = usual * float(np.median(np.diff(time_s)))
    kept = np.zeros(time_s.size, dtype=np.bool_)
    ends = np.append(moved, time_s.size)
    for first, last in zip(np.append(0, moved), ends, strict=True):
        if last > first:
            again_s = np.arange(time_s[first], time_s[last - 1] + 1e-9, period_s)
            again = np.minimum(np.searchsorted(time_s, again_s - 1e-9), last - 1)
            kept[again[:-1] if again.size > 1 and last - again[-1] < 0.5 * usual else again] = True
    said = f"positions are refreshed every {period_s:.3g} s and held in between: each is judged once"
    return (
        replace(segment, measured_s=time_s[kept], measured_deg=deg[kept]),
        f"{said} ({int(kept.sum())} of {time_s.size} rows)",
    )
