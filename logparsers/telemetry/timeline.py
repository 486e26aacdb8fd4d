"""One time base for a telemetry log: seconds since the vehicle's first boot.

Three clocks meet in a telemetry log. The vehicle stamps most messages with its time since boot (exact, but
the counter overflows, and restarts with the vehicle). The receiver stamps every frame when it arrives
(late by the link, and its clock may be set). A companion computer may use a third. Pure functions of
arrays; no clock is read here.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray

from logparsers.records import FloatArray

IntArray = NDArray[np.int64]

BACKWARD_S = 1.0
"""A counter that falls by more, and stays there, has restarted: links reorder by less."""
FORWARD_S = 5.0
"""A clock that gains more on the other at once has been set: nothing arrives before it was sent."""
_PERSISTS = 20
"""Samples that must confirm a restart."""
_AT_LEAST = 3
"""How many of these the file must hold."""
_YOUNG_S = 120.0
"""Time within which a vehicle sends again after its restart [s]; a later one is a clock that was set back."""
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


@dataclass(frozen=True, slots=True)
class Break:
    """A place where clocks do not run on.

    `kind`: ``"reboot"`` (the counter restarted), ``"clock_jump"`` (it was set, either way) or ``"arrival_jump"`` (the
    receiver's clock was set). `index`: first sample after it.
    """

    kind: str
    index: int


def find_breaks(stamp_s: FloatArray, arrival_s: FloatArray) -> list[Break]:
    """Restarts and jumps of two clocks that should advance together.

    `stamp_s`, `arrival_s` (shape (n,)): unwrapped device time and despiked arrival time, in the order of the file [s].
    """
    if stamp_s.size < 2:
        return []
    step, lapse = np.diff(stamp_s), np.diff(arrival_s)
    lead = stamp_s - arrival_s  # falls with delay, rises only if a clock is set
    before = _best_of(lead[:-1][::-1])[::-1]
    after = _best_of(lead[1:])
    fell = (step < -BACKWARD_S) & (after < before - BACKWARD_S)  # not just one message that came late
    fell[step.size - _AT_LEAST + 1 :] = False
    kinds: dict[int, str] = {}
    for i in (int(row) for row in np.flatnonzero(fell)):
        fresh = stamp_s[i + 1] < min(stamp_s[i] / 2, max(lapse[i], 0.0) + _YOUNG_S)
        kinds[i + 1] = "reboot" if fresh else "clock_jump"
    edges = [0, *sorted(kinds), stamp_s.size]
    for first, last in pairwise(edges):
        part = lead[first:last]
        best = np.maximum.accumulate(part)
        later = np.maximum.accumulate(part[::-1])[::-1]
        gained = np.flatnonzero(np.diff(best) > FORWARD_S)
        dropped = np.flatnonzero((later[1:] < best[:-1] - FORWARD_S) & (np.diff(part) < -FORWARD_S))
        for i in (int(row) + first for row in gained):
            kinds[i + 1] = "arrival_jump" if lapse[i] < -BACKWARD_S else "clock_jump"
        for i in (int(row) + first for row in dropped):
            kinds[i + 1] = "arrival_jump"
    return [Break(kind, index) for index, kind in sorted(kinds.items())]


def _best_of(lead_s: FloatArray) -> FloatArray:
    """Highest of each value and the few that follow it."""
    padded = np.pad(lead_s, (0, _PERSISTS - 1), constant_values=-np.inf)
    highest: FloatArray = sliding_window_view(padded, _PERSISTS).max(axis=1)
    return highest


@dataclass(frozen=True, slots=True, eq=False)
class Timeline:
    """One time base for a whole log: seconds since the vehicle's first boot.

    `positions` (shape (k,)): file position at which each part begins [bytes]; the first is 0. `shift_s` (shape (k,)):
    what to add to a device stamp of that part [s]: 0 until the first restart. `offset_s`, `drift` (shape (k,)): a
    message stamped ``t`` on the timeline arrives at ``t + offset_s + drift * t`` or later [s], [s/s].
    """

    positions: IntArray
    shift_s: FloatArray
    offset_s: FloatArray
    drift: FloatArray

    def part(self, positions: ArrayLike) -> IntArray:
        """Index of the part each file position lies in."""
        found = np.searchsorted(self.positions, np.asarray(positions, dtype=np.int64), side="right") - 1
        return np.maximum(found, 0)

    def from_arrival(self, arrival_s: ArrayLike, positions: ArrayLike) -> FloatArray:
        """Arrival times put on the timeline; each is late by what its frame waited.

        `arrival_s`, `positions` (shape (n,)): arrival time [s] and file position [bytes]. Result (shape (n,)): time on
        the timeline [s].
        """
        part = self.part(positions)
        late: FloatArray = np.asarray(arrival_s, dtype=np.float64) - self.offset_s[part]
        return late / (1.0 + self.drift[part])


def build_timeline(stamp_s: ArrayLike, arrival_s: ArrayLike, positions: ArrayLike) -> tuple[Timeline, list[Break]]:
    """Timeline of a log from the messages of its vehicle that carry time since boot.

    `stamp_s` (shape (n,)): unwrapped device time in the order of the file [s]; n may be 0. `arrival_s` (shape (n,)):
    despiked arrival time [s]. `positions` (shape (n,)): file positions, rising [bytes].
    """
    stamp, arrival = np.asarray(stamp_s, dtype=np.float64), np.asarray(arrival_s, dtype=np.float64)
    where = np.asarray(positions, dtype=np.int64)
    if stamp.size == 0:
        zero = np.zeros(1)
        return Timeline(np.zeros(1, dtype=np.int64), zero, zero, zero), []
    breaks = find_breaks(stamp, arrival)
    kinds = {b.index: b.kind for b in breaks}
    edges = [0, *kinds, stamp.size]
    rows: list[tuple[int, float, float, float]] = []
    for first, last in pairwise(edges):
        offset, drift = lower_line(stamp[first:last], arrival[first:last] - stamp[first:last])
        if not rows:
            rows.append((0, 0.0, offset, drift))
            continue
        _, shift, before, slope = rows[-1]
        ended = float(np.max(stamp[edges[len(rows) - 1] : first])) + shift
        if kinds[first] != "arrival_jump":
            predicted = (arrival[first] - before) / (1.0 + slope)
            begun = (arrival[first] - offset) / (1.0 + drift)
            shift = max(predicted - begun, ended - float(np.min(stamp[first:last])) + 1e-6)
        rows.append((int(where[first]), shift, offset - shift * (1.0 + drift), drift))
    starts, *columns = (np.array(column) for column in zip(*rows, strict=True))
    return Timeline(starts.astype(np.int64), *columns), breaks


def place(
    counter: ArrayLike, tick_s: float, *, bits: int, arrival_s: ArrayLike, positions: ArrayLike, timeline: Timeline
) -> FloatArray:
    """Put the stamped messages of one stream on the timeline.

    `counter` (shape (n,)): raw stamps. `bits`: width of the counter: 32 or 64. `arrival_s`, `positions` (shape (n,)):
    despiked arrival time [s] and file position [bytes]. Result (shape (n,)): stamps of the vehicle's own clock are
    kept exactly (whole overflows and restarts added). A clock of its own is shifted, so that the fastest message of
    the stream took as long as the vehicle's. A stamp of 0, or stamps that never move, were not filled in and give
    arrival time.
    """
    raw, where = np.asarray(counter), np.asarray(positions)
    expected = timeline.from_arrival(arrival_s, where)
    if raw.size == 0 or (raw.size > 1 and raw.min() == raw.max()) or not raw.any():
        return expected
    filled = raw > 0
    shift = timeline.shift_s[timeline.part(where)]
    stamp = raw.astype(np.int64) if bits < 64 else raw.astype(np.float64)
    own = stamp * tick_s
    if bits < 64:
        overflows = np.rint((expected - shift - own) / (tick_s * 2.0**bits))
        own = (stamp + overflows.astype(np.int64) * (1 << bits)) * tick_s
    own += shift
    strayed = np.abs(own - expected) > 2 * FORWARD_S
    if np.mean(strayed[filled]) < 0.5:
        return np.where(strayed | ~filled, expected, own)
    foreign = unwrap(raw[filled], bits=bits, elapsed=expected[filled] / tick_s).astype(np.float64) * tick_s
    placed = expected.copy()
    placed[filled] = _place_foreign(foreign, expected[filled], where[filled])
    return placed


def _place_foreign(stamp_s: FloatArray, expected_s: FloatArray, where: IntArray) -> FloatArray:
    """Shift a clock that is not the vehicle's onto the timeline, by the arrival of its fastest messages."""
    line, _ = build_timeline(stamp_s, expected_s, where)
    part = line.part(where)
    stamp = stamp_s + line.shift_s[part]
    placed: FloatArray = stamp + line.offset_s[part] + line.drift[part] * stamp
    return placed
