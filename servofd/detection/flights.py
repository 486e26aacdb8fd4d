"""Flights to calibrate from: what of each log is used, and cut into stretches with motion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from servofd.core.series import latest
from servofd.servo.loops import lagged_twice

if TYPE_CHECKING:
    from servofd.aircraft.series import Series
    from servofd.core.types import FloatArray

_SLOW_RAD_S = 12.6
"""Corner of the filter that a command passes before its motion counts: 2 Hz [rad/s]."""
_PIECES = 8
"""Parts of a long flight, of which each gives its stretch with most motion."""

Span = tuple[float, float]
"""From when to when [s], on the clock of the log."""


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """One surface in one log."""

    label: str
    """Name of the log, without folders; with the run, if the file holds several."""
    segment: Series

    def with_scale(self, gain: float, offset_deg: float) -> Flight:
        """Return the same flight with a position that reads in degrees of the command: (position - offset) / gain."""
        measured_deg = (self.segment.measured_deg - offset_deg) / gain
        return Flight(self.label, replace(self.segment, measured_deg=measured_deg))


def cropped(segment: Series, spans: tuple[Span, ...]) -> Series:
    """Keep what was measured within some spans; commands stay, they say where the servo was going.

    Examples
    --------
    >>> from servofd.aircraft.series import Series
    >>> t = np.arange(5.0)
    >>> cropped(Series("x", t, t, t, t), ((1.0, 3.0),)).measured_s
    array([1., 2., 3.])
    """
    if not spans:
        return segment
    inside = np.zeros(segment.measured_s.size, dtype=bool)
    for from_s, to_s in spans:
        inside |= (segment.measured_s >= from_s) & (segment.measured_s <= to_s)
    return segment.at(inside)


def busiest(segment: Series, most_samples: int) -> list[Series]:
    """Pieces of a flight with most motion, as a slow servo would move, of at most `most_samples` samples in all.

    Each eighth of the flight gives one: what a fault does to the commands must not draw all of them to itself.

    Examples
    --------
    >>> from servofd.aircraft.series import Series
    >>> t = np.arange(100.0)
    >>> long = Series("x", t, np.where(t > 50.0, 5.0, 0.0), t, t)
    >>> [piece.measured_s.size for piece in busiest(long, 40)]
    [5, 5, 5, 5, 5, 5, 5, 5]
    """
    size = segment.measured_s.size
    if size <= most_samples:
        return [segment]
    smooth_deg = _smoothed(asked_deg(segment), segment.period_s)
    travel_deg = np.cumsum(np.abs(np.diff(smooth_deg, prepend=smooth_deg[0])))
    length = most_samples // _PIECES
    pieces = []
    for rows in np.array_split(np.arange(size), _PIECES):
        gained_deg = travel_deg[rows[length - 1 :]] - travel_deg[rows[: rows.size - length + 1]]
        first = int(rows[0]) + int(np.argmax(gained_deg))
        pieces.append(_piece(segment, first, first + length))
    return pieces


def _piece(segment: Series, first: int, last: int) -> Series:
    """Measurements of some rows, with the commands in force from the first to the last of them."""
    from_s, to_s = (float(segment.measured_s[k]) for k in (first, last - 1))
    begin, end = np.searchsorted(segment.command_s, (from_s, to_s), side="right").tolist()
    return segment.at(slice(first, last), slice(max(begin - 1, 0), max(end, 1)))


def _smoothed(command_deg: FloatArray, period_s: float) -> FloatArray:
    """What a slow servo, two lags at 2 Hz, would make of a command: the fast end of a chirp moves no servo."""
    kept = float(np.exp(-_SLOW_RAD_S * period_s))
    return lagged_twice((1.0 - kept) ** 2 * (command_deg - command_deg[0]), kept)


def asked_deg(segment: Series) -> FloatArray:
    """Command in force at each measurement, shape (m,) [deg]."""
    return latest(segment.command_s, segment.command_deg, segment.measured_s)
