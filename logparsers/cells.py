"""Cells to numbers: numpy does the work, and a table with cells that it cannot convert is looked at cell by cell."""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Collection

    from numpy.typing import NDArray

    from logparsers.records import FloatArray
    from logparsers.text import Grid

MISSING = frozenset((b"", b"nan", b"-nan", b"+nan"))
"""What stands for no value, in small letters."""
MOST_KNOWN = 10_000
"""Texts of a column that are kept once, however often they come."""


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """One column.

    `values` (shape (n,)): numbers; NaN for a missing cell and for text. `texts` (shape (n,)): every cell as it stands,
    for columns that were asked for as text; else empty. `strange`: how many cells are neither empty nor a number.
    `first_strange`: row and text of the first of them. `has_number`: True if at least one cell is a number.
    """

    values: FloatArray
    texts: NDArray[np.object_]
    strange: int
    first_strange: tuple[int, str]
    has_number: bool


def convert(grid: Grid, texts: Collection[str] = ()) -> dict[str, Cells]:
    r"""Convert every column that has a name.

    Examples
    --------
    >>> from pathlib import Path
    >>> from logparsers.text import read_grid
    >>> cells = convert(read_grid(Path("a.csv"), b"time_s,x\n0,1\n1,NaN\n2,off\n"))["x"]
    >>> cells.values, cells.strange, cells.first_strange
    (array([ 1., nan, nan]), 1, (2, 'off'))
    """
    delimiter = grid.delimiter.encode()
    columns = {place: _Column(grid, wants=name in texts) for place, name in enumerate(grid.names) if name}
    top = bytes(grid.blocks[0]).partition(b"\n")[0].split(delimiter)
    plain = [p for p, column in columns.items() if column.texts is None and _number(top[p], grid.decimal) is not None]
    at = 0
    for block in grid.blocks:
        body = bytes(block)
        table = _numbers(body, grid, delimiter, plain) if plain else None
        others = columns.keys() - set(plain) if table is not None else columns.keys()
        if table is not None:
            rows = len(table)
            for k, place in enumerate(plain):
                columns[place].numbers(at, table[:, k])
        if others:
            cells = body.removesuffix(b"\n").replace(b"\n", delimiter).split(delimiter)
            rows = len(cells) // len(grid.names)
            for place in others:
                columns[place].cells(at, cells[place :: len(grid.names)])
        at += rows
    return {grid.names[place]: column.done() for place, column in columns.items()}


def texts_of(grid: Grid, names: Collection[str]) -> dict[str, NDArray[np.object_]]:
    r"""Texts of some columns.

    Examples
    --------
    >>> from pathlib import Path
    >>> from logparsers.text import read_grid
    >>> texts_of(read_grid(Path("a.csv"), b"time_s,x\n0,on\n1,off\n"), ["x"])["x"].tolist()
    ['on', 'off']
    """
    chosen = tuple(name if name in names else "" for name in grid.names)
    found = convert(replace(grid, names=chosen), names) if names else {}
    return {name: cells.texts for name, cells in found.items()}


class _Column:
    """One column while it is being read, block by block."""

    def __init__(self, grid: Grid, *, wants: bool) -> None:
        self._size, self._decimal = grid.size, grid.decimal
        self._values: FloatArray | None = None
        self.texts: NDArray[np.object_] | None = np.empty(grid.size, object) if wants else None
        self._known: dict[bytes, str] = {}
        self._strange, self._first = 0, (0, "")

    def numbers(self, at: int, values: FloatArray) -> None:
        """Take rows that are all numbers or missing."""
        if self._values is None and not np.isnan(values).all():
            self._values = np.full(self._size, np.nan)
        if self._values is not None:
            self._values[at : at + values.size] = values

    def cells(self, at: int, cells: list[bytes]) -> None:
        """Take rows in which there may be text."""
        numbers = [_number(cell, self._decimal) for cell in cells]
        self.numbers(at, np.array([np.nan if number is None else number for number in numbers]))
        odd = [row for row, number in enumerate(numbers) if number is None]
        if odd and not self._strange:
            self._first = at + odd[0], cells[odd[0]].decode("utf-8", "replace").strip()
        self._strange += len(odd)
        if self.texts is not None:
            self.texts[at : at + len(cells)] = [self._text(cell) for cell in cells]

    def _text(self, cell: bytes) -> str:
        if (text := self._known.get(cell)) is None:
            word = cell.strip()
            text = "" if word.lower() in MISSING else word.decode("utf-8", "replace").strip()
            if len(self._known) < MOST_KNOWN:
                self._known[cell] = text
        return text

    def done(self) -> Cells:
        """All of it; what holds no number takes no memory."""
        values = np.broadcast_to(np.nan, self._size) if self._values is None else self._values
        texts = np.empty(0, object) if self.texts is None else self.texts
        return Cells(values, texts, self._strange, self._first, self._values is not None)


def _numbers(body: bytes, grid: Grid, delimiter: bytes, places: list[int]) -> FloatArray | None:
    """Columns in which every cell is a number or empty, of shape (rows, columns); None of any others."""
    rows = body.count(b"\n") + (not body.endswith(b"\n"))
    if grid.decimal != ".":
        body = body.replace(grid.decimal.encode(), b".")
    empty = delimiter * 2
    if empty in body or delimiter + b"\n" in body or b"\n" + delimiter in body or body.startswith(delimiter):
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
    return table if table.shape[0] == rows else None


def _number(cell: bytes, decimal: str) -> float | None:
    """Value of a cell; None of text, as which 1_000 counts: Python reads it as a number, a log does not write it."""
    try:
        return float(cell if decimal == "." else cell.replace(decimal.encode(), b".")) if b"_" not in cell else None
    except ValueError:
        return np.nan if cell.strip().lower() in MISSING else None
