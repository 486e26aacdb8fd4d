"""Counters that overflow and arrival times that are late: the arithmetic of clocks, on arrays alone."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_ABSURD_S = 3 * 86_400.0
"""Longest wait between two messages [s]: three days."""
_BINS = 512
"""Parts of a log with one lowest point each, under which a line is drawn."""
_DRIFT_LIMIT = 1e-3
"""Largest drift between two clocks that is believed; crystals are 10 to 100 times better."""
_DRIFT_SPAN_S = 60.0
"""Length of a log below which drift cannot be distinguished from delay [s]."""


def despike(time_s: ArrayLike) -> FloatArray:
    """Replace time stamps that stand out by more than 5 s from both neighbours by one of these.

    `time_s` (shape (n,)): arrival times in the order of the file [s]; NaN where unknown. Result (shape (n,)): finite
    unless nothing is known.
    """
    time = np.array(time_s, dtype=np.float64)
    known = np.flatnonzero(np.isfinite(time))
    if known.size < time.size and known.size:
        last = np.searchsorted(known, np.arange(time.size), side="right") - 1
        time = time[known[np.maximum(last, 0)]]
    if time.size < 3:
        return time
    before, after = time[:-2], time[2:]
    middle = np.clip(time[1:-1], np.minimum(before, after), np.maximum(before, after))
    clean = time.copy()
    clean[1:-1] = np.where(np.abs(time[1:-1] - middle) > 5.0, middle, time[1:-1])
    for end, neighbour in ((0, 1), (-1, -2)):  # an end has one neighbour: only the absurd can be recognised
        if abs(clean[end] - clean[neighbour]) > _ABSURD_S:
            clean[end] = clean[neighbour]
    return clean


def unwrap(counter: ArrayLike, *, bits: int = 32, elapsed: ArrayLike | None = None) -> IntArray:
    """Count on where a counter overflowed.

    `counter` (shape (n,)): raw counts in the order of the file. `bits`: width of the counter; 64 never overflows.
    `elapsed` (shape (n,)): another clock in the same ticks, of any offset: tells how often the counter overflowed in a
    gap. Result (shape (n,)): equal to `counter` modulo ``2**bits``, and to its first value at the start; small steps
    back (messages that overtook each other) stay steps back.
    """
    raw = np.asarray(counter)
    if bits >= 64 or raw.size == 0:
        return raw.astype(np.int64)
    period = 1 << bits
    counts = raw.astype(np.int64)
    step = counts[1:] - counts[:-1]
    expected: FloatArray = np.zeros(step.shape)
    if elapsed is not None:
        expected = np.diff(np.asarray(elapsed, dtype=np.float64))
    step += period * np.rint((expected - step) / period).astype(np.int64)
    return np.concatenate([raw[:1].astype(np.int64), raw[:1].astype(np.int64) + np.cumsum(step)])


def lower_line(x: ArrayLike, y: ArrayLike) -> tuple[float, float]:
    """Line under all points, as close to them as one line can be: the fastest link, not the average one.

    The edge of the lower convex hull above the mean of `x` minimises the summed distance to the points
    among all lines below them (Moon, Skelly and Towsley, INFOCOM 1999). Delays are never negative, so that
    edge is not moved by congestion.

    `x`, `y` (shape (n,)): device time [s], and how much later than it each message arrived [s]; n > 0. Result:
    `offset`: height of the line at ``x = 0`` [s]. `slope`: drift of one clock against the other [s/s]; 0 where less
    than a minute is known.
    """
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    span = float(np.ptp(x))
    if span < _DRIFT_SPAN_S:
        return float(np.min(y)), 0.0
    cells = np.minimum(((x - np.min(x)) * (_BINS / span)).astype(np.int64), _BINS - 1)
    order = np.lexsort((y, cells))
    lowest = order[np.concatenate([[True], np.diff(cells[order]) > 0])]
    lowest = lowest[np.argsort(x[lowest], kind="stable")]
    hull: list[tuple[float, float]] = []
    for point in zip(x[lowest].tolist(), y[lowest].tolist(), strict=True):
        while len(hull) > 1 and _turns_down(hull[-2], hull[-1], point):
            hull.pop()
        hull.append(point)
    middle = float(np.mean(x))
    for (x0, y0), (x1, y1) in pairwise(hull):
        if x0 <= middle <= x1 and x1 > x0:
            slope = (y1 - y0) / (x1 - x0)
            if abs(slope) <= _DRIFT_LIMIT:
                return y0 - slope * x0, slope
    return float(np.min(y)), 0.0


def _turns_down(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
    return (b[1] - a[1]) * (c[0] - a[0]) >= (c[1] - a[1]) * (b[0] - a[0])
