"""From columns of numbers to a `FlightLog`: the last step of every reader."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from logparsers import clock
from logparsers.errors import EmptyLog
from logparsers.records import Channel, Damage, FlightLog

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from logparsers.records import FloatArray

__all__ = ["Column", "assemble"]


@dataclass(frozen=True, slots=True, eq=False)
class Column:
    """One series before its time stamps are put in order.

    Parameters
    ----------
    name : str
        Name of the channel.
    values : ndarray, shape (n,)
        One value per row, in `unit`.
    unit : str
        Unit of the values.
    origin : str
        Where in the file they stand.
    """

    name: str
    values: FloatArray
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
    channels = {}
    for column in columns:
        values = column.values[kept]
        blank = ~np.isfinite(values)
        if blank.any():
            found.append(_non_finite(column.name, stamps, values, np.flatnonzero(blank)))
            values[blank] = np.nan
        channels[column.name] = Channel(column.name, stamps, values, column.unit, column.origin)
    return FlightLog(path, kind, channels, tuple(found), run)


def _non_finite(name: str, stamps: FloatArray, values: FloatArray, rows: np.ndarray) -> Damage:
    infinite = int(np.isinf(values[rows]).sum())
    note = f"{name}: {rows.size} of {values.size} values are missing" + (f", {infinite} infinite" if infinite else "")
    return Damage("non_finite", note, int(rows.size), float(stamps[rows[0]]), float(stamps[rows[-1]]))
