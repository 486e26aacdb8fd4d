"""Flights to calibrate from: what of each log is used, and cut into stretches with motion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from servofd.segment import Segment
    from servofd.types import FloatArray, IntArray

__all__ = ["Flight", "Span", "asked_deg", "busiest", "cropped"]

_SLOW_RAD_S = 12.6

Span = tuple[float, float]
"""From when to when [s], on the clock of the log."""


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """One surface in one log."""

    label: str
    """Name of the log, without folders; with the run, if the file holds several."""
    segment: Segment

    def with_scale(self, gain: float, offset_deg: float) -> Flight:
        """Return the same flight with a position that reads in degrees of the command: (position - offset) / gain."""
        measured_deg = (self.segment.measured_deg - offset_deg) / gain
        return Flight(self.label, replace(self.segment, measured_deg=measured_deg))


def cropped(segment: Segment, spans: tuple[Span, ...]) -> Segment:
    """Keep what was measured within some spans; commands stay, they say where the servo was going.

    Examples
    --------
    >>> from servofd.segment import Segment
    >>> t = np.arange(5.0)
    >>> cropped(Segment("x", t, t, t, t), ((1.0, 3.0),)).measured_s
    array([1., 2., 3.])
    """
    if not spans:
        return segment
    inside = np.zeros(segment.measured_s.size, dtype=bool)
    for from_s, to_s in spans:
        inside |= (segment.measured_s >= from_s) & (segment.measured_s <= to_s)
    return replace(segment, measured_s=segment.measured_s[inside], measured_deg=segment.measured_deg[inside])


def busiest(flight: Flight, most_samples: int) -> Flight:
    """Stretch of a flight with most motion, as a slow servo would move, of at most so many samples.

    Examples
    --------
    >>> from servofd.segment import Segment
    >>> t = np.arange(6.0)
    >>> busiest(Flight("a", Segment("x", t, np.array([0, 0, 0, 5, 0, 5.0]), t, t)), 3).segment.measured_s
    array([3., 4., 5.])
    """
    segment = flight.segment
    size = segment.measured_s.size
    if size <= most_samples:
        return flight
    smooth_deg = _smoothed(asked_deg(segment), segment.period_s)
    travel_deg = np.cumsum(np.abs(np.diff(smooth_deg, prepend=smooth_deg[0])))
    begin = int(np.argmax(travel_deg[most_samples - 1 :] - travel_deg[: size - most_samples + 1]))
    rows: IntArray = np.arange(begin, begin + most_samples)
    from_s, to_s = (float(segment.measured_s[k]) for k in (rows[0], rows[-1]))
    first, last = np.searchsorted(segment.command_s, (from_s, to_s), side="right").tolist()
    part = slice(max(first - 1, 0), max(last, 1))
    return Flight(
        flight.label,
        replace(
            segment,
            command_s=segment.command_s[part],
            command_deg=segment.command_deg[part],
            measured_s=segment.measured_s[rows],
            measured_deg=segment.measured_deg[rows],
        ),
    )


def _smoothed(command_deg: FloatArray, period_s: float) -> FloatArray:
    """What a slow servo, two lags at 2 Hz, would make of a command: the fast end of a chirp moves no servo."""
    from scipy.signal import lfilter

    kept = float(np.exp(-_SLOW_RAD_S * period_s))
    smooth_deg: FloatArray = lfilter([(1.0 - kept) ** 2], [1.0, -2.0 * kept, kept**2], command_deg - command_deg[0])
    return smooth_deg


def asked_deg(segment: Segment) -> FloatArray:
    """Command in force at each measurement, shape (m,) [deg]."""
    held = np.searchsorted(segment.command_s, segment.measured_s, side="right") - 1
    command_deg: FloatArray = segment.command_deg[np.maximum(held, 0)]
    return command_deg
