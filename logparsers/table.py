"""Text tables: bench records, exported logs, and servofd's own plain tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from logparsers.assemble import Column, assemble
from logparsers.errors import EmptyLog, MissingChannel, UnreadableLog, decoding
from logparsers.records import Damage
from logparsers.text import read_grid
from logparsers.texts import split_rows
from logparsers.units import COMMANDS, SECONDS, faser_unit, is_faser, suffix_unit

if TYPE_CHECKING:
    from logparsers.only import Only
    from logparsers.records import FlightLog, FloatArray
    from logparsers.source import Source
    from logparsers.text import Cells, Grid

MOST_RUNS = 10_000
"""A column that tells more experiments apart holds measurements."""


@dataclass(frozen=True, slots=True)
class TableLayout:
    """How to read a text table that does not use servofd's own column names.

    Parameters
    ----------
    columns : tuple of str
        Names for a file without a header line, in order; its first line is data then.
    time : str
        Name of the time column.
    time_unit : {"s", "ms", "us", "ns"}
        Unit of the time column.
    sample_rate_hz : float or None
        Rate of a file without a time column [Hz]; every run starts at 0 s.
    run : str
        Column that tells separate experiments apart; they are never joined.
    where : mapping of str to str
        Keep only rows in which these columns hold exactly these texts.
    units : mapping of str to str
        Units of columns whose names do not tell them.

    Raises
    ------
    ValueError
        If the unit of time is unknown, the rate is not positive, or a name stands twice.

    Examples
    --------
    >>> TableLayout(columns=("meas", "pwm", "cmd"), sample_rate_hz=1000.0).time
    'time_s'
    """

    columns: tuple[str, ...] = ()
    time: str = "time_s"
    time_unit: Literal["s", "ms", "us", "ns"] = "s"
    sample_rate_hz: float | None = None
    run: str = ""
    where: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "columns", tuple(self.columns))
        for name in ("where", "units"):
            object.__setattr__(self, name, dict(getattr(self, name)))
        if self.time_unit not in SECONDS:
            raise ValueError(f"time_unit is one of {', '.join(SECONDS)}, not {self.time_unit!r}")
        if self.sample_rate_hz is not None and not 0.0 < self.sample_rate_hz < np.inf:
            raise ValueError(f"sample_rate_hz must be positive, not {self.sample_rate_hz}")
        if len(set(self.columns)) < len(self.columns):
            raise ValueError(f"columns must differ, not {', '.join(self.columns)}")


def read_table(source: Source, layout: TableLayout | None, _: Only) -> tuple[FlightLog, ...]:
    r"""Read a text table, one log per run.

    `layout`: how to read it; without one the header has ``time_s`` and perhaps ``run``, or the names of a FASER log.
    """
    texts = {*layout.where, layout.run} if layout else {"run"}
    with decoding(source.path, "text table"):
        grid = read_grid(source.path, source.content(), layout.columns if layout else (), texts)
    kind = "table"
    if layout is None:
        kind = _guess(source.path, grid)
        clock = next((name for name in _CLOCKS if name in grid.names), _CLOCKS[0])
        run = "run" if kind == "table" and "run" in grid.names else ""
        layout = TableLayout(time="time" if kind == "faser" else clock, run=run)
    _check_names(source.path, grid, layout)
    return _Reading(source.path, grid, layout, kind).logs()


_CLOCKS = ("time_s", "t_s")


def _guess(path: Path, grid: Grid) -> Literal["faser", "table"]:
    """Tell apart the two headers that need no layout."""
    if any(name in grid.names for name in _CLOCKS):
        return "table"
    if "time" in grid.names and any(is_faser(name) for name in grid.names):
        return "faser"
    raise MissingChannel(
        f"{path}: no column 'time_s' (nor FASER's 'time' and {COMMANDS[0]!r}) in {', '.join(grid.names[:12])}; "
        "name the time column, or a sample rate, in a table layout"
    )


def _check_names(path: Path, grid: Grid, layout: TableLayout) -> None:
    asked = [*layout.where, layout.run, *layout.units]
    if layout.sample_rate_hz is None:
        asked.append(layout.time)
    for name in asked:
        if name and name not in grid.names:
            hint = " or give sample_rate_hz" if name == layout.time else ""
            raise MissingChannel(f"{path}: no column {name!r}; its columns are {', '.join(grid.names[:16])}{hint}")


@dataclass(frozen=True, slots=True, eq=False)
class _Reading:
    """One table while it is being read: what its steps share."""

    path: Path
    grid: Grid
    layout: TableLayout
    kind: str

    def logs(self) -> tuple[FlightLog, ...]:
        damage = list(self.grid.damage)
        columns = []
        for name, cells in self.grid.cells.items():
            if self._is_channel(name, cells, damage):
                columns.append(Column(name, cells.values, self._unit(name), name))
        if not columns:
            hint = damage[-1].note if damage else "a log needs at least one"
            raise MissingChannel(f"{self.path}: no column of numbers beside the time; {hint}")
        return tuple(self._log(run, rows, columns, tuple(damage)) for run, rows in self._runs().items())

    def _is_channel(self, name: str, cells: Cells, damage: list[Damage]) -> bool:
        """Judge a column by its text; the clock is one whose text is fatal, but no channel."""
        if cells.strange:
            row, text = cells.first_strange
            where = f"line {self.grid.line[row]}, column {name!r}: {text[:40]!r} is not a number"
            if self._must_be_numeric(name):
                raise UnreadableLog(f"{self.path}: {where}; missing cells are empty or nan")
            is_size = cells.has_number or bool(self._unit(name)) or name.startswith("load_")
            if is_size and name not in (*self.layout.where, self.layout.run):
                note = f"column left out, {cells.strange} cells are text, first in {where}"
                damage.append(Damage("not_numeric", note, cells.strange))
            return False
        return name not in (self.layout.time, self.layout.run)

    def _must_be_numeric(self, name: str) -> bool:
        named = name == self.layout.time or name in self.layout.units
        return named or name.endswith(("_cmd_deg", "_pos_deg")) or (self.kind == "faser" and is_faser(name))

    def _unit(self, name: str) -> str:
        known = faser_unit(name) if self.kind == "faser" else suffix_unit(name)
        return self.layout.units.get(name, known)

    def _runs(self) -> dict[str, NDArray[np.intp] | None]:
        """Rows of every run, in the order of the file; None: all there are."""
        if not self.layout.run and not self.layout.where:
            return {"": None}
        kept = np.ones(self.grid.row.size, dtype=np.bool_)
        for name, text in self.layout.where.items():
            kept &= self.grid.cells[name].texts == text
            if not kept.any():
                known = ", ".join(dict.fromkeys(self.grid.cells[name].texts[:100_000]))[:120]
                raise EmptyLog(f"{self.path}: no row where {name} is {text!r}; that column holds {known}")
        rows = np.flatnonzero(kept)
        if not self.layout.run:
            return {"": rows}
        texts = self.grid.cells[self.layout.run].texts[rows]
        places: dict[str, int] = {}
        codes = np.fromiter((places.setdefault(text, len(places)) for text in texts), np.int32, texts.size)
        if len(places) > MOST_RUNS:
            raise UnreadableLog(f"{self.path}: column {self.layout.run!r} has {len(places)} different texts: not runs")
        return {text: rows[members] for text, members in split_rows(list(places), codes).items()}

    def _log(
        self, run: str, rows: NDArray[np.intp] | None, columns: list[Column], damage: tuple[Damage, ...]
    ) -> FlightLog:
        mine = columns if rows is None else [replace(column, values=column.values[rows]) for column in columns]
        time_s = self._time_s(rows)
        return assemble(self.path, kind=self.kind, time_s=time_s, columns=mine, damage=damage, run=run)

    def _time_s(self, rows: NDArray[np.intp] | None) -> FloatArray:
        if self.layout.time in self.grid.cells:
            time = self.grid.cells[self.layout.time].values
            return (time if rows is None else time[rows]) * SECONDS[self.layout.time_unit]
        rate = self.layout.sample_rate_hz or np.nan
        row = self.grid.row if rows is None else self.grid.row[rows]
        stamps: FloatArray = (row - row[0]) / rate  # a lost row leaves its place
        return stamps
