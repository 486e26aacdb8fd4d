"""From columns of numbers to a `FlightLog`: the last step of every reader."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from logparsers import clock
from logparsers.errors import EmptyLog
from logparsers.records import Channel, Damage, FlightLog, own

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from numpy.typing import NDArray

    from logparsers.records import FloatArray

__all__ = ["Column", "Columns", "assemble"]


@dataclass(frozen=True, slots=True, eq=False)
class Column:
    """One series before its time stamps are put in order.

    Parameters
    ----------
    name : str
        Name of the channel.
    values : ndarray, shape (n,)
        One value per row, in `unit`; integers stay integers until the channel is looked up.
    unit : str
        Unit of the values.
    origin : str
        Where in the file they stand.
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

    Parameters
    ----------
    path : Path
        The file.
    kind : str
        Format of the log, ``"faser"`` or ``"table"``.
    time_s : ndarray, shape (n,)
        Time stamp of every row [s].
    columns : iterable of Column
        What was recorded, n values each.
    damage : tuple of Damage
        What the reader found already.
    run : str
        Which experiment.

    Raises
    ------
    EmptyLog
        If no row has a time stamp.
    ClockError
        If the time stamps cannot be put in order.

    Examples
    --------
    >>> from pathlib import Path
    >>> stamps = np.arange(3.0)
    >>> column = Column("de", np.array([0.1, np.inf, 0.3]), "rad", "de")
    >>> assemble(Path("a.mat"), kind="faser", time_s=stamps, columns=[column])
    <FlightLog a.mat: faser, 2.0 s, 1 channels, 1 non_finite>
    """
    label = f"{path} (run {run})" if run else str(path)
    kept, stamps, disorder = clock.order(time_s, label)
    if not stamps.size:
        raise EmptyLog(f"{label}: none of its {time_s.size} rows has a time stamp; a log needs at least one sample")
    found = [*damage, *disorder, *clock.gaps(stamps)]
    series = {column.name: column for column in columns}
    for column in series.values():
        blank = ~np.isfinite(column.values) & kept
        if blank.any():
            rows = np.flatnonzero(blank[kept])
            found.append(_non_finite(column.name, stamps, column.values[kept], rows))
    ends = float(stamps[0]), float(stamps[-1])
    return FlightLog(path, kind, Columns(stamps, None if kept.all() else kept, series), tuple(found), run, span_s=ends)


class Columns(Mapping[str, Channel]):
    """Channels of rows that share a clock, made of the columns of a file when they are looked up.

    Parameters
    ----------
    time_s : ndarray, shape (m,)
        Stamps of the rows that are kept [s].
    kept : ndarray of bool, shape (n,), or None
        Which they are; None: all.
    columns : Mapping[str, Column]
        By name, n values each.
    """

    def __init__(self, time_s: FloatArray, kept: NDArray[np.bool_] | None, columns: Mapping[str, Column]) -> None:
        self._time_s, self._kept, self._columns = own(time_s), kept, columns

    def __getitem__(self, name: str) -> Channel:
        column = self._columns[name]
        values = column.values if self._kept is None else column.values[self._kept]
        floats = values.astype(np.float64)
        floats[np.isinf(floats)] = np.nan
        floats.setflags(write=False)
        return Channel(name, self._time_s, floats, column.unit, column.origin)

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        return len(self._columns)


def _non_finite(name: str, stamps: FloatArray, values: FloatArray, rows: np.ndarray) -> Damage:
    infinite = int(np.isinf(values[rows]).sum())
    note = f"{name}: {rows.size} of {values.size} values are missing" + (f", {infinite} infinite" if infinite else "")
    return Damage("non_finite", note, int(rows.size), float(stamps[rows[0]]), float(stamps[rows[-1]]))
