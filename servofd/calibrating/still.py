"""A position that stands still while its command moves: a jam that needs no model to be seen."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from servofd.calibrating.flights import asked_deg

if TYPE_CHECKING:
    from servofd.calibrating.flights import Flight
    from servofd.types import FloatArray

__all__ = ["stands_still"]

_WINDOW_S, _REACTION_S = 2.0, 0.5
"""Motion asked for in the first 1.5 s must have begun by the end of the window, however slow the servo."""
_ASKED, _LEAST_ASKED_DEG = 0.15, 2.0
_STILL = 0.02
"""Shares of the ranges of command and position in the whole flight."""
_FEWEST_SAMPLES = 10


def stands_still(flight: Flight) -> str:
    """Say where a surface does not move although it is told to; nothing if it always does.

    Examples
    --------
    >>> from servofd.calibrating.flights import Flight
    >>> from servofd.segment import Segment
    >>> t = np.arange(0.0, 20.0, 0.02)
    >>> command_deg = 10.0 * np.sin(2.0 * t)
    >>> measured_deg = np.where((t > 10.0) & (t < 15.0), 3.0, command_deg)
    >>> stands_still(Flight("a.csv", Segment("rudder", t, command_deg, t, measured_deg)))
    'a.csv: stands still at 3.0 deg from 10.0 to 15.0 s while the command moves by 20 deg'
    """
    segment = flight.segment
    known = np.isfinite(segment.measured_deg)
    time_s, measured_deg, command_deg = (
        values[known] for values in (segment.measured_s, segment.measured_deg, asked_deg(segment))
    )
    if time_s.size < _FEWEST_SAMPLES:
        return ""
    still_deg = _STILL * _range_deg(measured_deg)
    moved_deg = max(_ASKED * _range_deg(command_deg), _LEAST_ASKED_DEG)
    windows = []
    for start_s in np.arange(time_s[0], time_s[-1] - _WINDOW_S, _REACTION_S):
        first, asked, last = np.searchsorted(time_s, (start_s, start_s + _WINDOW_S - _REACTION_S, start_s + _WINDOW_S))
        if last - first < _FEWEST_SAMPLES or asked <= first:
            continue
        if np.ptp(measured_deg[first:last]) < still_deg and np.ptp(command_deg[first:asked]) > moved_deg:
            windows.append((int(first), int(last)))
    if not windows:
        return ""
    first, last = (
        windows[0][0],
        next((b[1] for b, c in itertools.pairwise(windows) if c[0] > b[1]), windows[-1][1]),
    )
    at_deg = float(np.median(measured_deg[first:last]))
    return _told(flight.label, time_s, measured_deg, command_deg, (first, last), at_deg, still_deg)


def _told(
    label: str,
    time_s: FloatArray,
    measured_deg: FloatArray,
    command_deg: FloatArray,
    rows: tuple[int, int],
    at_deg: float,
    still_deg: float,
) -> str:
    """The same in words, from where the position arrived there until it left."""
    first, last = rows
    while first > 0 and abs(measured_deg[first - 1] - at_deg) < still_deg:
        first -= 1
    while last < time_s.size and abs(measured_deg[last] - at_deg) < still_deg:
        last += 1
    return (
        f"{label}: stands still at {at_deg:.1f} deg from {time_s[first]:.1f} to {time_s[last - 1]:.1f} s while the "
        f"command moves by {np.ptp(command_deg[first:last]):.0f} deg"
    )


def _range_deg(values_deg: FloatArray) -> float:
    low, high = np.percentile(values_deg, [1.0, 99.0])
    return float(high - low)
