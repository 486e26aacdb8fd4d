"""Cells to numbers: numpy does the work, and a table with cells that it cannot convert is looked at cell by cell."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Collection

    from logparsers.records import FloatArray
    from logparsers.text import Grid

__all__ = ["Cells", "convert"]

MISSING = frozenset((b"", b"nan", b"-nan", b"+nan"))
"""What stands for no value, in small letters."""
BLOCK_BYTES = 1 << 20
"""As much text is taken apart at a time."""


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """One column.

    Parameters
    ----------
    values : ndarray, shape (n,)
        Numbers; NaN for a missing cell and for text.
    texts : tuple of str
        Every cell as it stands, for columns that were asked for as text; else empty.
    strange : ndarray of int, shape (m,)
        Rows whose cell is neither empty nor a number.
    first_strange : str
        Text of the first of them.
    has_number : bool
        True if at least one cell is a number.
    """

    values: FloatArray
    texts: tuple[str, ...]
    strange: np.ndarray
    first_strange: str
    has_number: bool


def convert(grid: Grid, texts: Collection[str] = ()) -> dict[str, Cells]:
    r"""Convert every column that has a name.

    Examples
    --------
    >>> from pathlib import Path
    >>> from logparsers.text import read_grid
    >>> cells = convert(read_grid(Path("a.csv"), b"time_s,x\n0,1\n1,NaN\n2,off\n"))["x"]
    >>> cells.values, cells.strange, cells.first_strange
    (array([ 1., nan, nan]), array([2]), 'off')
    """
    delimiter, named = grid.delimiter.encode(), {name: place for place, name in enumerate(grid.names) if name}
    top = grid.body.partition(b"\n")[0].split(delimiter)
    plain = [p for name, p in named.items() if name not in texts and _number(top[p], grid.decimal) is not None]
    table = _numbers(grid, delimiter, plain)
    done = set() if table is None else set(plain)
    rest = [place for place in named.values() if place not in done]
    found = {} if table is None else {place: _of_numbers(table[:, k]) for k, place in enumerate(plain)}
    found |= _cell_by_cell(grid, delimiter, rest, {named[name] for name in texts if name in named}) if rest else {}
    return {name: found[place] for name, place in named.items()}


def _numbers(grid: Grid, delimiter: bytes, places: list[int]) -> FloatArray | None:
    """Columns in which every cell is a number or empty, of shape (rows, columns); None of any others."""
    body = grid.body if grid.decimal == "." else grid.body.replace(grid.decimal.encode(), b".")
    empty = delimiter * 2
    if empty in body or delimiter + b"\n" in body or b"\n" + delimiter in body:
        lines = b"\n" + body.rstrip(b"\n") + b"\n"
        for mark, after in ((delimiter, delimiter), (delimiter, delimiter), (delimiter, b"\n"), (b"\n", delimiter)):
            lines = lines.replace(mark + after, mark + b"nan" + after)
        body = lines[1:]
    try:
        table: FloatArray = np.loadtxt(
            io.BytesIO(body), delimiter=grid.delimiter, usecols=places, comments=None, ndmin=2, encoding="latin-1"
        )
    except ValueError:
        return None
    return table if places and table.shape[0] == grid.row.size else None


def _of_numbers(values: FloatArray) -> Cells:
    return Cells(values.copy(), (), np.empty(0, dtype=np.intp), "", not np.isnan(values).all())


def _cell_by_cell(grid: Grid, delimiter: bytes, places: list[int], wanted: set[int]) -> dict[int, Cells]:
    """Columns in which cells may be missing, or text."""
    width, at = len(grid.names), 0
    values: dict[int, list[FloatArray]] = {place: [] for place in places}
    texts: dict[int, list[str]] = {place: [] for place in places}
    strange: dict[int, list[int]] = {place: [] for place in places}
    first: dict[int, str] = {}
    rows = 0
    while at < len(grid.body):
        end = grid.body.find(b"\n", at + BLOCK_BYTES) + 1 or len(grid.body)
        cells = grid.body[at:end].removesuffix(b"\n").replace(b"\n", delimiter).split(delimiter)
        at = end
        for place in places:
            column = cells[place::width]
            numbers = [_number(cell, grid.decimal) for cell in column]
            values[place].append(np.array([np.nan if number is None else number for number in numbers]))
            odd = [row for row, number in enumerate(numbers) if number is None]
            if odd and place not in first:
                first[place] = column[odd[0]].decode("utf-8", "replace").strip()
            strange[place] += [rows + row for row in odd]
            if place in wanted:
                texts[place] += [
                    "" if cell.strip().lower() in MISSING else cell.decode("utf-8", "replace").strip()
                    for cell in column
                ]
        rows += len(cells) // width
    return {place: _column(values[place], texts[place], strange[place], first.get(place, "")) for place in places}


def _column(values: list[FloatArray], texts: list[str], strange: list[int], first: str) -> Cells:
    numbers = np.concatenate(values)
    return Cells(numbers, tuple(texts), np.array(strange, dtype=np.intp), first, not np.isnan(numbers).all())


def _number(cell: bytes, decimal: str) -> float | None:
    """Value of a cell; None of text, as which 1_000 counts: Python reads it as a number, a log does not write it."""
    try:
        return float(cell if decimal == "." else cell.replace(decimal.encode(), b".")) if b"_" not in cell else None
    except ValueError:
        return np.nan if cell.strip().lower() in MISSING else None
