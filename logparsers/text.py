"""Text tables: from bytes to columns that all have the same number of cells, and from these to numbers.

Lines are counted in one pass over the bytes, so that every complaint can name the line, and numpy only meets
well-formed rows; where it cannot convert them they are read cell by cell.
"""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from logparsers.channels import MOST_CHANNELS
from logparsers.errors import EmptyLog, MissingChannel, UnreadableLog
from logparsers.records import Damage, FloatArray, rows_text

CONTROL = bytes(c for c in range(32) if c not in b"\t\n\f\r") + b"\x7f"
"""Control characters, which no text has, apart from tabulator and ends of lines."""
NO_CONTROL = bytes(c for c in range(256) if c not in CONTROL)
NEWLINE, MARK = b"\n", b"\xef\xbb\xbf"
BLOCK_BYTES = 1 << 18
"""As much text is taken apart at a time."""
MOST_QUOTED = 1 << 22
"""Of a header with quotes, in which delimiters tell nothing [bytes]."""
SAMPLE_BYTES = 1 << 16
"""Part of a table that is searched for decimal commas [bytes]."""


@dataclass(frozen=True, eq=False)
class Grid:
    """A table of text.

    `names`: names of the columns. `blocks`: rows, one per line, without quotes: about `BLOCK_BYTES` in each.
    `delimiter`, `decimal`: what separates cells, and what separates the fraction. `row` (shape (n,)): number of each
    row among those that are not blank, from 0. `line` (shape (n,)): line of the file in which it stands, from 1.
    `damage`: rows that were cut, and are not among these.
    """

    names: tuple[str, ...]
    blocks: tuple[bytes | memoryview, ...]
    delimiter: str
    decimal: str
    row: NDArray[np.int32]
    line: NDArray[np.int32]
    damage: tuple[Damage, ...]


def read_grid(path: Path, content: bytes, columns: tuple[str, ...] = ()) -> Grid:
    r"""Find the header, the delimiter and the rows.

    Examples
    --------
    >>> grid = read_grid(Path("a.csv"), b"# bench\ntime_s;x\n0,00;1\n0,02;2\n")
    >>> grid.names, grid.delimiter, grid.decimal, grid.line[0].item()
    (('time_s', 'x'), ';', ',', 3)
    """
    _check_text(path, content)
    blocks = _blocks(content)
    start, skipped, first, block = _header(path, blocks)
    delimiter = _delimiter(first)
    names = columns or _names(path, first, delimiter, skipped + 1)
    rest: Iterator[bytes | memoryview] = chain(
        [memoryview(block)[start if columns else start + len(first) + 1 :]], blocks
    )
    skipped += not columns
    if delimiter == " ":  # any number of blanks separates
        rest, delimiter = map(_tabbed, rest), "\t"
    if b'"' in content:
        rest = _unquoted(path, rest, delimiter, skipped)
    return _rows(path, names, rest, delimiter, skipped)


def _delimiter(first: bytes) -> str:
    return next((d for d in ("\t", ";", ",") if d.encode() in first), " ")


def _check_text(path: Path, content: bytes) -> None:
    """Refuse what holds a character that no text has."""
    if strange := content.translate(None, NO_CONTROL):
        at = content.index(strange[:1])
        before = content[:at].replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        raise UnreadableLog(
            f"{path}: line {before.count(NEWLINE) + 1} holds the byte 0x{strange[0]:02X}, "
            "which no text table has; export it again"
        )


def _blocks(content: bytes) -> Iterator[bytes | memoryview]:
    """Whole lines, each of which ends with one newline whatever the machine that wrote it; not copied if it may be."""
    at = len(MARK) if content.startswith(MARK) else 0
    if b"\r" in content and NEWLINE not in content:
        content = content.replace(b"\r", NEWLINE)
    view, returns = memoryview(content), b"\r" in content
    while at < len(content):
        end = content.find(NEWLINE, at + BLOCK_BYTES) + 1 or len(content)
        block = view[at:end]
        yield bytes(block).replace(b"\r\n", NEWLINE).replace(b"\r", NEWLINE) if returns else block
        at = end


def _header(path: Path, blocks: Iterator[bytes | memoryview]) -> tuple[int, int, bytes, bytes | memoryview]:
    """Find the first line that is neither blank nor a comment.

    Result: `start`, `skipped`: where in its block it begins, and how many lines stand before it.
    """
    skipped = 0
    for block in blocks:
        found = re.match(rb"(?:[ \t\f]*(?:#[^\n]*)?(?:\n|\Z))*+", block)
        start = found.end() if found else 0
        skipped += bytes(block[:start]).count(NEWLINE)
        if start < len(block):
            return start, skipped, bytes(block[start:]).partition(NEWLINE)[0], block
    raise EmptyLog(f"{path}: no header and no row; a table needs a header line with time_s, and rows below it")


def _names(path: Path, header: bytes, delimiter: str, line: int) -> tuple[str, ...]:
    if b'"' not in header or len(header) > MOST_QUOTED:  # before so many words are made of it
        check_names(path, len(header.split()) if delimiter == " " else header.count(delimiter.encode()) + 1)
    try:
        text = header.decode("utf-8", "replace").strip(" ")
        cells = next(csv.reader([text], delimiter=delimiter, skipinitialspace=True))
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


def check_names(path: Path, count: int) -> None:
    """Refuse a file of more names than a log has.

    UnreadableLog if there are more than `MOST_CHANNELS`.

    Examples
    --------
    >>> check_names(Path("a.csv"), 12)
    """
    if count > MOST_CHANNELS:
        raise UnreadableLog(f"{path}: {count} columns, and a log has at most {MOST_CHANNELS}; export fewer")


def _is_number(cell: str) -> bool:
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True


def _tabbed(block: bytes | memoryview) -> bytes:
    return re.sub(rb"[ \t]+", b"\t", re.sub(rb"(?m)^[ \t]+|[ \t]+$", b"", block))


def _unquoted(
    path: Path, blocks: Iterable[bytes | memoryview], delimiter: str, skipped: int
) -> Iterator[bytes | memoryview]:
    """Take quotes off; what they protected becomes a blank. Lines stay lines."""
    texts = (bytes(block).decode("utf-8", "replace") for block in blocks)
    lines = (line for text in texts for line in io.StringIO(text, newline=""))
    reader = csv.reader(lines, delimiter=delimiter, strict=True)
    protected = re.compile(rf"[{delimiter}\n]")
    rows: list[str] = []
    line = size = 0
    try:
        for cells in reader:
            rows.append(delimiter.join(protected.sub(" ", cell) for cell in cells))
            size += len(rows[-1]) + 1
            rows.extend([""] * (reader.line_num - line - 1))
            line = reader.line_num
            if size > BLOCK_BYTES:
                yield ("\n".join(rows) + "\n").encode()
                rows, size = [], 0
    except csv.Error as error:
        raise UnreadableLog(f"{path}: line {skipped + line + 1}: {error}; close every quote that is opened") from error
    yield "\n".join(rows).encode()


def _rows(
    path: Path, names: tuple[str, ...], blocks: Iterable[bytes | memoryview], delimiter: str, skipped: int
) -> Grid:
    """Keep the rows that have all their cells, and know which lines they are."""
    kept: list[bytes | memoryview] = []
    solids: list[NDArray[np.int32]] = []
    wholes: list[NDArray[np.bool_]] = []
    decimal, lines = "", skipped + 1
    needed = len(names)
    for block in blocks:
        if not len(block):
            continue
        starts, ends, cells = _measure(block, delimiter)
        solid = np.flatnonzero(ends > starts)
        if solid.size and not solids:
            names = _even(names, block, ends[solid], cells[solid], delimiter)
            needed = len(names) - (names[-1] == "" and len(names) > 1)  # what ends the header may end rows or not
            decimal = _decimal(bytes(block[:SAMPLE_BYTES]), delimiter)
        cells = cells[solid]
        if np.any(cells > len(names)):
            worst = int(np.argmax(cells > len(names)))
            raise UnreadableLog(
                f"{path}: line {lines + solid[worst]} has {cells[worst]} cells, but the table has "
                f"{len(names)} columns ({_shown(names)}); was a line lost, or two joined?"
            )
        whole = cells >= needed
        is_even = whole.all() and (cells == len(names)).all() and solid.size == starts.size
        if is_even:
            kept.append(block)
        elif whole.any():
            spans = starts[solid[whole]], ends[solid[whole]]
            kept.append(_joined(block, *spans, len(names) - cells[whole], delimiter))
        if solid.size:
            solids.append((solid + lines).astype(np.int32))
            wholes.append(whole)
        lines += starts.size
    line, is_whole = np.concatenate([np.zeros(0, np.int32), *solids]), np.concatenate([np.zeros(0, np.bool_), *wholes])
    if not is_whole.any():
        what = f"no row with {needed} cells" if solids else "no row below the header"
        raise EmptyLog(f"{path}: {what} ({_shown(names)}); a log needs at least one sample")
    row = np.flatnonzero(is_whole).astype(np.int32)
    return Grid(names, tuple(kept), delimiter, decimal, row, line[row], _cut(line[~is_whole], needed))


def _decimal(sample: bytes, delimiter: str) -> str:
    """What separates the fraction, by the first rows."""
    return "," if delimiter != "," and re.search(rb"\d,\d", sample) and not re.search(rb"\d\.\d", sample) else "."


def _measure(body: bytes | memoryview, delimiter: str) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Where every line starts and ends, and how many cells it has."""
    codes = np.frombuffer(body, np.uint8)
    ends = np.flatnonzero(codes == ord("\n"))
    if codes[-1] != ord("\n"):
        ends = np.append(ends, codes.size)
    starts = np.concatenate([[0], ends[:-1] + 1]).astype(np.intp)
    marks = np.flatnonzero(codes == ord(delimiter))
    cells = np.searchsorted(marks, ends) - np.searchsorted(marks, starts) + 1
    return starts, ends, cells


def _even(
    names: tuple[str, ...], body: bytes | memoryview, ends: NDArray[np.intp], cells: NDArray[np.intp], delimiter: str
) -> tuple[str, ...]:
    """Some loggers end every row, but not the header, with a delimiter: that is one more column without a name."""
    if np.all(cells == len(names) + 1) and np.all(np.frombuffer(body, np.uint8)[ends - 1] == ord(delimiter)):
        return (*names, "")
    return names


def _joined(
    body: bytes | memoryview,
    starts: NDArray[np.intp],
    ends: NDArray[np.intp],
    lacking: NDArray[np.intp],
    delimiter: str,
) -> bytes:
    mark, body = delimiter.encode(), bytes(body)
    spans = zip(starts.tolist(), ends.tolist(), lacking.tolist(), strict=True)
    return b"".join(body[start:end] + mark * more + NEWLINE for start, end, more in spans)


def _cut(lines: NDArray[np.int32], needed: int) -> tuple[Damage, ...]:
    if not lines.size:
        return ()
    return (
        Damage(
            "truncated",
            f"{rows_text(lines.size)} with fewer than {needed} cells, first line {lines[0]}",
            int(lines.size),
        ),
    )


def _shown(names: tuple[str, ...]) -> str:
    return ", ".join(names[:8]) + (" ..." if len(names) > 8 else "")


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


class _Column:
    """One column while it is being read, block by block."""

    def __init__(self, grid: Grid, *, wants: bool) -> None:
        self._size, self._decimal = grid.row.size, grid.decimal
        self._values: FloatArray | None = None
        self.texts: NDArray[np.object_] | None = np.empty(grid.row.size, object) if wants else None
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
