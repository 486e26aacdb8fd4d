"""Text tables: from bytes to a header and rows that all have the same number of cells.

Nothing is converted to numbers here. Lines are counted in one pass over the bytes, so that every complaint can name
the line, and the number parser behind this only meets well-formed rows.
"""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from logparsers.channels import check_names
from logparsers.errors import EmptyLog, LogError, MissingChannel, UnreadableLog
from logparsers.records import Damage

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["Grid", "header_cells", "read_grid"]

CONTROL = bytes(c for c in range(32) if c not in b"\t\n\f\r") + b"\x7f"
NO_CONTROL = bytes(c for c in range(256) if c not in CONTROL)
SAMPLE_BYTES = 1 << 16
"""As much of a table is looked at to tell decimal commas from decimal points."""


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """A table of text.

    Parameters
    ----------
    names : tuple of str
        Names of the columns.
    body : bytes
        Rows, one per line, without quotes.
    delimiter, decimal : str
        What separates cells, and what separates the fraction.
    row : ndarray of int, shape (n,)
        Number of every row, from 0, counting those that were dropped.
    line : ndarray of int, shape (n,)
        Line of every row in the file, from 1.
    damage : tuple of Damage
        Rows that were cut.
    """

    names: tuple[str, ...]
    body: bytes
    delimiter: str
    decimal: str
    row: NDArray[np.intp]
    line: NDArray[np.intp]
    damage: tuple[Damage, ...]


def read_grid(path: Path, content: bytes, columns: tuple[str, ...] = ()) -> Grid:
    r"""Find the header, the delimiter and the rows.

    Examples
    --------
    >>> from pathlib import Path
    >>> grid = read_grid(Path("a.csv"), b"# bench\ntime_s;x\n0,00;1\n0,02;2\n")
    >>> grid.names, grid.delimiter, grid.decimal, grid.line.tolist()
    (('time_s', 'x'), ';', ',', [3, 4])
    """
    text = _lines(path, content)
    start, skipped = _preamble(path, text)
    end = text.find(b"\n", start)
    first = text[start:] if end < 0 else text[start:end]
    delimiter = _delimiter(first)
    names = columns or _names(path, first.decode("utf-8", "replace"), delimiter, skipped + 1)
    rest = text[start:] if columns else text[start + len(first) + 1 :]
    skipped += not columns
    if delimiter == " ":  # any number of blanks separates
        rest, delimiter = re.sub(rb"[ \t]+", b"\t", re.sub(rb"(?m)^[ \t]+|[ \t]+$", b"", rest)), "\t"
    sample = rest[:SAMPLE_BYTES]
    comma = delimiter != "," and re.search(rb"\d,\d", sample) and not re.search(rb"\d\.\d", sample)
    if b'"' in rest:
        rest = _unquoted(path, rest, delimiter, skipped)
    return _rows(path, names, rest, delimiter, "," if comma else ".", skipped)


def header_cells(head: bytes) -> tuple[str, ...]:
    r"""Names in the first line that is neither blank nor a comment; none if there is no such line.

    Examples
    --------
    >>> header_cells(b"# by hand\n\ntime_s; x\n0;1\n")
    ('time_s', 'x')
    """
    path = Path("<head>")
    try:
        text = _lines(path, head.rpartition(b"\n")[0] or head)
        start, _ = _preamble(path, text)
        first = text[start:].partition(b"\n")[0]
        return _names(path, first.decode("utf-8", "replace"), _delimiter(first), 1)
    except LogError:
        return ()


def _delimiter(first: bytes) -> str:
    return next((d for d in ("\t", ";", ",") if d.encode() in first), " ")


def _lines(path: Path, content: bytes) -> bytes:
    """Check that this is text; every line ends with one newline, whatever the machine that wrote it."""
    text = content.removeprefix(b"\xef\xbb\xbf")
    if strange := text.translate(None, NO_CONTROL):
        at = text.index(strange[:1])
        line = text.count(b"\n", 0, at) + 1
        raise UnreadableLog(
            f"{path}: line {line} holds the byte 0x{strange[0]:02X}, which no text table has; export it again"
        )
    return text.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in text else text


def _preamble(path: Path, text: bytes) -> tuple[int, int]:
    """Where the first line that is neither blank nor a comment starts, and how many lines stand before it."""
    found = re.match(rb"(?:[ \t\f]*(?:#[^\n]*)?(?:\n|\Z))*+", text)
    start = found.end() if found else 0
    if start >= len(text):
        raise EmptyLog(f"{path}: no header and no row; a table needs a header line with time_s, and rows below it")
    return start, text.count(b"\n", 0, start)


def _names(path: Path, header: str, delimiter: str, line: int) -> tuple[str, ...]:
    try:
        cells = next(csv.reader([header.strip(" ")], delimiter=delimiter, skipinitialspace=True))
    except csv.Error as error:
        raise UnreadableLog(f"{path}: line {line}, the header, cannot be read: {error}") from error
    names = tuple(cell.strip() for cell in cells)
    if all(map(_is_number, names)):
        raise MissingChannel(f"{path}: line {line} is data, no header; name its columns in a table layout")
    check_names(path, len(names))
    twice = next((name for name, times in Counter(names).items() if name and times > 1), None)
    if twice is not None:
        raise UnreadableLog(f"{path}: line {line}: the header has two columns {twice!r}; give each a name of its own")
    return names


def _is_number(cell: str) -> bool:
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True


def _unquoted(path: Path, rest: bytes, delimiter: str, skipped: int) -> bytes:
    """Take quotes off; what they protected becomes a blank. Lines stay lines."""
    reader = csv.reader(io.StringIO(rest.decode("utf-8", "replace"), newline=""), delimiter=delimiter, strict=True)
    rows = []
    line = 0
    try:
        for cells in reader:
            rows.append(delimiter.join(re.sub(rf"[{delimiter}\n]", " ", cell) for cell in cells))
            rows.extend([""] * (reader.line_num - line - 1))
            line = reader.line_num
    except csv.Error as error:
        raise UnreadableLog(f"{path}: line {skipped + line + 1}: {error}; close every quote that is opened") from error
    return "\n".join(rows).encode()


def _rows(path: Path, names: tuple[str, ...], body: bytes, delimiter: str, decimal: str, skipped: int) -> Grid:
    starts, ends, cells = _measure(body, delimiter)
    solid = np.flatnonzero(ends > starts)
    names, cells = _even(names, body, ends[solid], cells[solid], delimiter)
    line = solid + skipped + 1
    if np.any(cells > len(names)):
        worst = int(np.argmax(cells > len(names)))
        raise UnreadableLog(
            f"{path}: line {line[worst]} has {cells[worst]} cells, but the table has {len(names)} columns "
            f"({_shown(names)}); was a line lost, or two joined?"
        )
    needed = len(names) - (names[-1] == "" and len(names) > 1)  # a delimiter that ends the header may end rows or not
    whole = cells >= needed
    if not whole.any():
        what = "no row below the header" if not solid.size else f"no row with {needed} cells"
        raise EmptyLog(f"{path}: {what} ({_shown(names)}); a log needs at least one sample")
    if not (whole.all() and (cells == len(names)).all() and solid.size == starts.size):
        body = _joined(body, starts[solid[whole]], ends[solid[whole]], len(names) - cells[whole], delimiter)
    cut = line[~whole]
    return Grid(names, body, delimiter, decimal, np.flatnonzero(whole), line[whole], _cut(cut, needed))


def _measure(body: bytes, delimiter: str) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Where every line starts and ends, and how many cells it has."""
    codes = np.frombuffer(body, np.uint8)
    ends = np.flatnonzero(codes == ord("\n"))
    if not body.endswith(b"\n"):
        ends = np.append(ends, len(body))
    starts = np.concatenate([[0], ends[:-1] + 1]).astype(np.intp)
    marks = np.flatnonzero(codes == ord(delimiter))
    cells = np.searchsorted(marks, ends) - np.searchsorted(marks, starts) + 1
    return starts, ends, cells


def _even(
    names: tuple[str, ...], body: bytes, ends: NDArray[np.intp], cells: NDArray[np.intp], delimiter: str
) -> tuple[tuple[str, ...], NDArray[np.intp]]:
    """Some loggers end every row, but not the header, with a delimiter: that is one more column without a name."""
    if ends.size and np.all(cells == len(names) + 1):
        last = np.frombuffer(body, np.uint8)[ends - 1]
        if np.all(last == ord(delimiter)):
            return (*names, ""), cells
    return names, cells


def _joined(
    body: bytes, starts: NDArray[np.intp], ends: NDArray[np.intp], lacking: NDArray[np.intp], delimiter: str
) -> bytes:
    mark = delimiter.encode()
    spans = zip(starts.tolist(), ends.tolist(), lacking.tolist(), strict=True)
    return b"\n".join(body[start:end] + mark * more for start, end, more in spans)


def _cut(lines: NDArray[np.intp], needed: int) -> tuple[Damage, ...]:
    if not lines.size:
        return ()
    return (
        Damage(
            "truncated", f"{lines.size} rows have fewer than {needed} cells, first line {lines[0]}", int(lines.size)
        ),
    )


def _shown(names: tuple[str, ...]) -> str:
    return ", ".join(names[:8]) + (" ..." if len(names) > 8 else "")
