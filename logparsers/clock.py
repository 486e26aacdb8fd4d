"""Time stamps: put in order, with everything that was wrong about them on record."""

from __future__ import annotations

from bisect import bisect_left
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from logparsers.errors import ClockError
from logparsers.records import Damage, FloatArray, rows_text

FEW_ROWS = 5
"""Rows out of order that are dropped at least before a clock counts as broken."""
FEW_SHARE = 0.01
"""Rows out of order up to `FEW_ROWS`, or up to this share of all rows, are dropped; more is a broken clock."""

GAP_PERIODS = 5.0
"""Median periods that a gap is longer than."""
GAP_S = 0.1
"""A gap is also longer than this [s]: fast logs miss a few samples now and then."""

CLOCK_JUMP_S = 3600.0
"""No flight recorder pauses for an hour; a clock that is set by GPS jumps by years."""

LATE_S = 10.0
"""Messages overtake each other by less; a stamp that is further behind what was logged before it is wrong."""

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
YEARS = range(2000, 2100)
"""A clock that shows another year was never set."""

MOST_GAPS = 100
"""Of a log with many gaps the longest are listed; the others are summed up."""


def order(
    time_s: FloatArray, label: str, row_of: NDArray[np.intp] | None = None
) -> tuple[NDArray[np.bool_], FloatArray, tuple[Damage, ...]]:
    """Choose the rows whose time stamps rise strictly; drop as few rows as possible.

    `time_s` (shape (n,)): time stamps as they stand in the log [s]. `row_of` (shape (n,)): where each stamp stands in
    the file, from 0, for messages; as they are counted here if left out. Result: `kept` (shape (n,)): rows to keep.
    `time_s` (shape (m,)): their stamps [s], strictly rising, origin untouched. `damage`: rows without a stamp and rows
    out of order.
    """
    kept = np.isfinite(time_s)
    places = np.arange(time_s.size) if row_of is None else row_of
    damage = []
    if not kept.all():
        missing = np.flatnonzero(~kept)
        note = f"{missing.size} of {kept.size} rows without a time stamp left out, first row {places[missing[0]] + 1}"
        damage.append(Damage("non_finite", note, int(missing.size)))
    elif np.all(time_s[1:] > time_s[:-1]):
        return kept, time_s, ()
    rows = np.flatnonzero(kept)
    stamps = time_s[rows]
    if np.any(np.diff(stamps) <= 0.0):
        rising = _rising(stamps)
        damage.append(_disorder(stamps, places[rows], rising, label))
        kept[rows[~rising]] = False
    return kept, time_s[kept], tuple(damage)


def _disorder(stamps: FloatArray, rows: NDArray[np.intp], rising: NDArray[np.bool_], label: str) -> Damage:
    dropped = np.flatnonzero(~rising)
    worst = int(np.argmin(np.diff(stamps)))
    if dropped.size > min(max(FEW_ROWS, FEW_SHARE * stamps.size), (stamps.size - 1) // 2):
        verb = "runs backwards" if stamps[worst + 1] < stamps[worst] else "stands still"
        raise ClockError(
            f"{label}: time {verb} at row {rows[worst + 1] + 1} ({stamps[worst]:.6g} s -> {stamps[worst + 1]:.6g} s), "
            f"{dropped.size} of {stamps.size} rows are out of order; split the log there"
        )
    note = f"{rows_text(dropped.size)} left out for time stamps that do not rise, first row {rows[dropped[0]] + 1}"
    sound = np.flatnonzero(rising)
    before, after = np.searchsorted(sound, [dropped[0], dropped[-1]])
    start = stamps[sound[max(before - 1, 0)]]
    end = stamps[sound[min(after, sound.size - 1)]]
    return Damage("out_of_order", note, int(dropped.size), float(start), float(end))


def _rising(stamps: FloatArray) -> NDArray[np.bool_]:
    """Longest strictly rising subsequence, so that one stamp far ahead costs one row and not all that follow."""
    tails: list[float] = []
    tail_rows: list[int] = []
    before = np.empty(stamps.size, dtype=np.intp)
    for row, stamp in enumerate(stamps.tolist()):
        place = bisect_left(tails, stamp)
        before[row] = tail_rows[place - 1] if place else -1
        if place == len(tails):
            tails.append(stamp)
            tail_rows.append(row)
        elif tails[place] != stamp:  # of equal stamps the first stays
            tails[place], tail_rows[place] = stamp, row
    kept = np.zeros(stamps.size, dtype=np.bool_)
    row = tail_rows[-1]
    while row >= 0:
        kept[row] = True
        row = int(before[row])
    return kept


def rise(time_s: FloatArray, sound: NDArray[np.bool_] | None = None) -> tuple[NDArray[np.intp], Damage | None]:
    """Choose rows of a telemetry series, in an order in which their time stamps never fall.

    Links and loggers let messages overtake each other, so that rows which came late are sorted in, unlike those of
    a table (see `order`). Rows of one stamp keep their order. What is left out is counted.

    `time_s` (shape (n,)): time stamps in the order of the file [s]. `sound` (shape (n,)): False for rows that are known
    to be wrong. Result: `rows` (shape (m,)): m <= n. `damage`: rows that came late or were left out.
    """
    usable = np.isfinite(time_s)
    if sound is not None:
        usable &= sound
    rows = np.flatnonzero(usable)
    stamps = time_s if rows.size == time_s.size else time_s[rows]
    step = np.diff(stamps)
    if step.size and step.min() < -LATE_S:  # some stamp is wrong; which, tells the longest series without it
        rising = _rising(stamps)
        before = np.maximum.accumulate(np.where(rising, stamps, -np.inf))
        near = rising | ((stamps <= before) & (stamps > before - LATE_S))
        rows, stamps = rows[near], stamps[near]
        step = np.diff(stamps)
    late = int(np.count_nonzero(step < 0.0))
    if late:
        rows = rows[np.argsort(stamps, kind="stable")]
    dropped = time_s.size - rows.size
    if not late and not dropped:
        return rows, None
    words = [f"{rows_text(late)} sorted in that came late"] if late else []
    words += [f"{rows_text(dropped)} left out that came twice or with a wrong stamp"] if dropped else []
    where = (float(time_s[rows].min()), float(time_s[rows].max())) if rows.size else (None, None)
    return rows, Damage("out_of_order", ", ".join(words), late + dropped, *where)


APART_S = 1e-9
"""A thousandth of what the clocks of autopilots resolve."""


def apart(time_s: FloatArray) -> FloatArray:
    """Set rows of one stamp apart, in their order: by a nanosecond, or by less where the next stamp is nearer.

    A vehicle logs all items of a mission within one microsecond; each is a row.

    `time_s` (shape (n,)): stamps that never fall [s]. Result (shape (n,)): stamps that rise strictly.
    """
    fresh = np.diff(time_s, prepend=-np.inf) > 0.0
    if fresh.all():
        return time_s
    begins = np.flatnonzero(fresh)
    sizes = np.diff(begins, append=time_s.size)
    step_s = np.minimum(APART_S, np.diff(time_s[begins], append=np.inf) / sizes)
    place = np.arange(time_s.size)
    risen: FloatArray = time_s + (place - np.repeat(begins, sizes)) * np.repeat(step_s, sizes)
    if np.all(risen[1:] > risen[:-1]):
        return risen
    # Stamps since 1970 resolve 240 ns: neighbours in float64, whose bits count up with what they stand for.
    bits = np.abs(risen).view(np.int64) * np.where(risen < 0.0, -1, 1)
    bits = np.maximum.accumulate(bits - place) + place
    return np.copysign(np.abs(bits).view(np.float64), bits)


def gaps(time_s: FloatArray) -> tuple[Damage, ...]:
    """Find where samples are missing.

    `time_s` (shape (n,)): strictly rising time stamps [s]. Result: ``"gap"`` or, beyond `CLOCK_JUMP_S`,
    ``"clock_jump"``, in order of time; `count` is the number of samples that the median period would have put there.
    Beyond `MOST_GAPS` the shortest are summed up in the last entry.
    """
    if time_s.size < 3:
        return ()
    intervals = np.diff(time_s)
    period = float(np.median(intervals))
    found = np.flatnonzero(intervals > max(GAP_PERIODS * period, GAP_S))
    longest = found[np.argsort(-intervals[found], kind="stable")]
    listed, rest = np.sort(longest[: MOST_GAPS - 1]), np.sort(longest[MOST_GAPS - 1 :])
    damage = [_gap(time_s, int(place), period) for place in listed]
    if rest.size:
        missing = _samples(float(intervals[rest].sum()), period) - int(rest.size) + 1
        note = f"{rest.size} shorter gaps, together {intervals[rest].sum():.3f} s"
        damage.append(Damage("gap", note, missing, float(time_s[rest[0]]), float(time_s[rest[-1] + 1])))
    return tuple(damage)


def _gap(time_s: FloatArray, place: int, period_s: float) -> Damage:
    start, end = float(time_s[place]), float(time_s[place + 1])
    missing = _samples(end - start, period_s)
    if end - start > CLOCK_JUMP_S:
        return Damage("clock_jump", f"the clock jumps forward by {end - start:.3f} s", missing, start, end)
    return Damage("gap", f"no samples for {end - start:.3f} s", missing, start, end)


def _samples(missing_s: float, period_s: float) -> int:
    """Samples between two stamps; forged stamps lie further apart than any integer counts."""
    return round(min(missing_s / period_s, 1e15)) - 1


def utc_date(unix_s: float) -> datetime | None:
    """Date of a time since 1970; None if no clock that was set can have shown it.

    `unix_s`: time since 1970-01-01, UTC [s].
    """
    try:
        date = EPOCH + timedelta(seconds=unix_s)
    except (OverflowError, ValueError):  # beyond the year 9999, or no number
        return None
    return date if date.year in YEARS else None
