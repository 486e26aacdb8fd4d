"""A position that moves before its command: two columns that were swapped."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.calibrating.flights import asked_deg

if TYPE_CHECKING:
    from servofd.calibrating.flights import Flight

__all__ = ["runs_ahead"]

_LEAD_S, _LONGEST_S = 0.01, 1.0
_ALIKE = 0.3
"""Correlation of the two speeds below which nobody leads anybody."""
_MOST_SAMPLES = 60_000


def runs_ahead(flight: Flight) -> str:
    """Say by how much the position leads the command; nothing if it does not.

    Examples
    --------
    >>> from servofd.calibrating.flights import Flight
    >>> from servofd.segment import Segment
    >>> t = np.arange(2000) / 100.0
    >>> command_deg = 10.0 * np.sin(t**1.5)
    >>> runs_ahead(Flight("a.csv", Segment("x", t, command_deg, t, np.roll(command_deg, -5))))
    'a.csv: the position moves 50 ms before the command: are the two columns swapped?'
    """
    from scipy.signal import correlate, correlation_lags

    segment = flight.segment
    known = np.isfinite(segment.measured_deg)
    time_s, period_s = segment.measured_s[known], segment.period_s
    if time_s.size < 3:
        return ""
    grid_s = time_s[0] + period_s * np.arange(min(int((time_s[-1] - time_s[0]) / period_s), _MOST_SAMPLES))
    speeds = [
        np.diff(np.interp(grid_s, time_s, values))
        for values in (segment.measured_deg[known], asked_deg(segment)[known])
    ]
    power = float(np.sqrt(np.prod([speed @ speed for speed in speeds])))
    if power == 0.0:
        return ""
    lag_s = correlation_lags(speeds[0].size, speeds[1].size) * period_s
    near = np.abs(lag_s) <= _LONGEST_S
    alike = np.abs(correlate(*speeds))[near] / power
    lead_s = -float(lag_s[near][np.argmax(alike)])
    if alike.max() < _ALIKE or lead_s < max(_LEAD_S, 1.5 * period_s):
        return ""
    return f"{flight.label}: the position moves {1e3 * lead_s:.0f} ms before the command: are the two columns swapped?"
