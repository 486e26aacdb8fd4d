"""From columns of numbers to a `FlightLog`: the last step of every reader."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from logparsers import clock
from logparsers.channels import Made, as_float
from logparsers.errors import EmptyLog
from logparsers.records import Channel, Damage, FlightLog, FloatArray, own, rows_text


@dataclass(frozen=True, slots=True, eq=False)
class Column:
    """One series before its time stamps are put in order.

    `name`: name of the channel. `values` (shape (n,)): one value per row, in `unit`; integers stay integers until the
    channel is looked up. `unit`: unit of the values. `origin`: where in the file they stand.
    """

    name: str
    values: NDArray[Any]
    unit: str
    origin: str


def assemble(
    path: Path,
    *,
    kind: str,
    time_s: FloatArray,
    columns: Iterable[Column],
    damage: tuple[Damage, ...] = (),
    run: str = "",
) -> FlightLog:
    """Put the rows in order, blank what is not finite, and record both.

    `kind`: format of the log, ``"faser"`` or ``"table"``. `time_s` (shape (n,)): time stamp of every row [s].
    """
    label = f"{path} (run {run})" if run else str(path)
    columns = tuple(columns)
    apart = _written_apart(columns)
    time_s, columns, row_of, repeated = join_rows(time_s, columns)
    kept, stamps, disorder = clock.order(time_s, label, row_of)
    if not stamps.size:
        raise EmptyLog(f"{label}: none of its {time_s.size} rows has a time stamp; a log needs at least one sample")
    found = [*damage, *disorder, *repeated, *clock.gaps(stamps)]
    series = {column.name: column for column in columns}
    chosen = slice(None) if kept.all() else kept
    for column in series.values():
        values = column.values[chosen]
        blank = ~np.isfinite(values)
        if blank.any() and column.name not in apart:
            found.append(_non_finite(column.name, stamps, values, blank))
    ends = float(stamps[0]), float(stamps[-1])
    channels = from_columns(stamps, None if kept.all() else kept, series)
    return FlightLog(path, kind, channels, tuple(found), run, span_s=ends)


def join_rows(
    time_s: FloatArray, columns: tuple[Column, ...]
) -> tuple[FloatArray, tuple[Column, ...], NDArray[np.intp], tuple[Damage, ...]]:
    """Make one row of the rows of one time stamp; put rows in order where no column's own stamps fall.

    Loggers write what comes from several sources in rows of their own, each with the cells of the others left empty:
    such rows may share a stamp, or pass each other by a little.

    `time_s` (shape (n,)): time stamp of every row [s]; not finite where there is none. `columns`: their cells; not
    finite where there is none. Result: `time_s` (shape (m,)): m <= n. `row_of` (shape (m,)): the row that each stamp
    stood in.
    """
    row_of = np.arange(time_s.size)
    if np.all(time_s[1:] > time_s[:-1]):
        return time_s, columns, row_of, ()
    if all(np.all(np.diff(time_s[np.isfinite(column.values) & np.isfinite(time_s)]) >= 0.0) for column in columns):
        row_of = np.argsort(time_s, kind="stable")  # rows without a stamp come last
        time_s = time_s[row_of]
    starts = np.flatnonzero(np.concatenate([[True], np.diff(time_s) != 0.0]))
    if starts.size == time_s.size:
        return time_s, tuple(replace(column, values=column.values[row_of]) for column in columns), row_of, ()
    row = np.arange(time_s.size)
    another = np.zeros(time_s.size, dtype=np.bool_)
    joined = []
    for column in columns:
        values = column.values[row_of]
        given = np.isfinite(values)
        first = np.minimum.reduceat(np.where(given, row, time_s.size), starts)
        first = np.where(first < time_s.size, first, starts)
        joined.append(replace(column, values=values[first]))
        another |= given & (values != np.repeat(values[first], np.diff(starts, append=time_s.size)))
    return time_s[starts], tuple(joined), row_of[starts], _repeated(time_s, another, row_of)


def _written_apart(columns: tuple[Column, ...]) -> frozenset[str]:
    """Columns that never stand in one row with some other: their empty cells are the other's rows, and no damage."""
    names: dict[bytes, list[str]] = {}
    for column in columns:
        given = np.isfinite(column.values)
        if given.any() and not given.all():
            names.setdefault(np.packbits(given).tobytes(), []).append(column.name)
    patterns = {bits: np.frombuffer(bits, np.uint8) for bits in names}
    return frozenset(
        name
        for bits, members in names.items()
        if any(not np.any(patterns[bits] & other) for other in patterns.values())
        for name in members
    )


def _repeated(time_s: FloatArray, another: NDArray[np.bool_], row_of: NDArray[np.intp]) -> tuple[Damage, ...]:
    rows = np.flatnonzero(another)
    if not rows.size:
        return ()
    note = f"{rows_text(rows.size)} with a time stamp again but other values left out, first row {row_of[rows[0]] + 1}"
    return (Damage("out_of_order", note, int(rows.size), float(time_s[rows[0]]), float(time_s[rows[-1]])),)


def from_columns(time_s: FloatArray, kept: NDArray[np.bool_] | None, columns: Mapping[str, Column]) -> Made:
    """Channels of rows that share a clock, made of the columns of a file when they are looked up.

    `time_s` (shape (m,)): stamps of the rows that are kept [s]. `kept` (shape (n,)): which they are; None: all.
    `columns`: by name, n values each.
    """
    stamps = own(time_s)

    def made(name: str) -> Channel:
        column = columns[name]
        floats = as_float(column.values if kept is None else column.values[kept])
        floats[np.isinf(floats)] = np.nan
        floats.setflags(write=False)
        return Channel(name, stamps, floats, column.unit, column.origin)

    return Made(columns, made)


def _non_finite(name: str, stamps: FloatArray, values: FloatArray, blank: NDArray[np.bool_]) -> Damage:
    count, infinite = int(blank.sum()), int(np.isinf(values).sum())
    note = f"{name}: {count} of {values.size} values are missing" + (f", {infinite} infinite" if infinite else "")
    first, last = int(blank.argmax()), blank.size - 1 - int(blank[::-1].argmax())
    return Damage("non_finite", note, count, float(stamps[first]), float(stamps[last]))
