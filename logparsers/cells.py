"""Cells to numbers: pandas does the work, and what it cannot convert is looked at one by one."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Collection

    from logparsers.records import FloatArray
    from logparsers.text import Grid

__all__ = ["Cells", "convert"]

MISSING = ("", "nan", "NaN", "NAN", "Nan", "-nan", "-NaN")
"""What stands for no value, as far as pandas is told; other spellings are understood too, only slower."""


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

    Parameters
    ----------
    grid : Grid
        Well-formed rows.
    texts : collection of str
        Columns whose texts are wanted, too.

    Returns
    -------
    dict of str to Cells
        By name, in the order of the header.

    Examples
    --------
    >>> from pathlib import Path
    >>> from logparsers.text import read_grid
    >>> cells = convert(read_grid(Path("a.csv"), b"time_s,x\n0,1\n1,NaN\n2,off\n"))["x"]
    >>> cells.values, cells.strange, cells.first_strange
    (array([ 1., nan, nan]), array([2]), 'off')
    """
    import pandas as pd

    frame = pd.read_csv(
        io.BytesIO(grid.body),
        sep=grid.delimiter,
        decimal=grid.decimal,
        header=None,
        names=list(range(len(grid.names))),
        usecols=[place for place, name in enumerate(grid.names) if name],
        index_col=False,
        dtype={place: str for place, name in enumerate(grid.names) if name in texts},
        na_values=list(MISSING),
        keep_default_na=False,
        skipinitialspace=True,
        skip_blank_lines=False,
        quoting=3,  # csv.QUOTE_NONE
        encoding_errors="replace",
        low_memory=False,
    )
    named = ((place, name) for place, name in enumerate(grid.names) if name)
    return {name: _cells(frame[place].to_numpy(), grid.decimal, wanted=name in texts) for place, name in named}


def _cells(column: np.ndarray[Any, Any], decimal: str, *, wanted: bool) -> Cells:
    if column.dtype.kind in "iuf" and not wanted:
        values = column.astype(np.float64)
        return Cells(values, (), np.empty(0, dtype=np.intp), "", not np.isnan(values).all())
    texts = tuple("" if isinstance(cell, float) and np.isnan(cell) else str(cell).strip() for cell in column)
    numbers = [_number(text, decimal) for text in texts]
    strange = np.array([row for row, number in enumerate(numbers) if number is None], dtype=np.intp)
    values = np.array([np.nan if number is None else number for number in numbers])
    first = texts[strange[0]] if strange.size else ""
    return Cells(values, texts if wanted else (), strange, first, not np.isnan(values).all())


def _number(text: str, decimal: str) -> float | None:
    if text.lower() in ("", "nan", "-nan", "+nan"):
        return np.nan
    if "_" in text:  # Python reads 1_000 as a number, a log does not write it
        return None
    try:
        return float(text.replace(decimal, "."))
    except ValueError:
        return None
