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
from functools import cached_property
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
SHOWN = 5
"""Rows that are kept as they stand."""


MISSING = frozenset((b"", b"nan", b"-nan", b"+nan"))
"""What stands for no value, in small letters."""
MOST_KNOWN = 10_000
"""Texts of a column that are kept once, however often they come."""


class Cells:
    """One column, as far as its blocks were taken; `wants`: whether its texts are asked for.

    `values` (shape (n,)): numbers; NaN for a missing cell and for text. `texts` (shape (n,)): every cell as it stands.
    `strange`: how many cells are neither empty nor a number. `first_strange`: row and text of the first of them.
    `has_number`: True if at least one cell is a number.
    """

    def __init__(self, decimal: bytes, *, wants: bool) -> None:
        self.wants, self._decimal = wants, decimal
        self.strange, self.first_strange, self.has_number = 0, (0, ""), False
        self._values: list[FloatArray] = []
        self._texts: list[str] = []
        self._known: dict[bytes, str] = {}
        self._size = 0

    def take_numbers(self, values: FloatArray) -> None:
        """Take rows that are all numbers or missing; what holds no number takes no memory."""
        is_empty = bool(np.isnan(values).all())
        self._values.append(np.broadcast_to(np.nan, values.shape) if is_empty else values.copy())
        self.has_number |= not is_empty
        self._size += values.size

    def take(self, cells: list[bytes]) -> None:
        """Take rows in which there may be text."""
        numbers = [_number(cell, self._decimal) for cell in cells]
        odd = [row for row, number in enumerate(numbers) if number is None]
        if odd and not self.strange:
            self.first_strange = self._size + odd[0], cells[odd[0]].decode("utf-8", "replace").strip()
        self.strange += len(odd)
        self.take_numbers(np.array([np.nan if number is None else number for number in numbers]))
        if self.wants:
            self._texts += map(self._text, cells)

    def _text(self, cell: bytes) -> str:
        if (text := self._known.get(cell)) is None:
            word = cell.strip()
            text = "" if word.lower() in MISSING else word.decode("utf-8", "replace").strip()
            if len(self._known) < MOST_KNOWN:
                self._known[cell] = text
        return text

    @cached_property
    def values(self) -> FloatArray:
        """Asked for when all blocks were taken, which are let go."""
        blocks, self._values = self._values, []
        return np.concatenate(blocks) if self.has_number else np.broadcast_to(np.nan, self._size)

    @cached_property
    def texts(self) -> NDArray[np.object_]:
        """Asked for when all blocks were taken."""
        return np.array(self._texts, object)


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """A table of text.

    `names`: names of the columns. `cells`: columns that have a name, by it. `first`: the first rows, as they stand.
    `row` (shape (n,)): number of each row among those that are not blank, from 0. `line` (shape (n,)): line of the file
    in which it stands, from 1. `damage`: rows that were cut, and are not among these.
    """

    names: tuple[str, ...]
    cells: dict[str, Cells]
    first: tuple[tuple[str, ...], ...]
    row: NDArray[np.int32]
    line: NDArray[np.int32]
    damage: tuple[Damage, ...]


def read_grid(path: Path, content: bytes, columns: tuple[str, ...] = (), texts: Collection[str] = ()) -> Grid:
    r"""Find the header, the delimiter and the rows, and convert them.

    `columns`: names, if the first line is data. `texts`: columns of which the texts are wanted.

    Examples
    --------
    >>> grid = read_grid(Path("a.csv"), b"# bench\ntime_s;x\n0,00;1\n0,02;off\n")
    >>> grid.names, grid.line[0].item(), grid.cells["time_s"].values, grid.cells["x"].first_strange
    (('time_s', 'x'), 3, array([0.  , 0.02]), (1, 'off'))
    """
    _check_text(path, content)
    blocks = _blocks(content)
    start, skipped, first, block = _header(path, blocks)
    delimiter = next((each for each in "\t;," if each.encode() in first), " ")
    names = columns or _names(path, first, delimiter, skipped + 1)
    rest: Iterator[bytes] = chain([block[start if columns else start + len(first) + 1 :]], blocks)
    skipped += not columns
    if delimiter == " ":  # any number of blanks separates
        rest, delimiter = map(_tabbed, rest), "\t"
    if b'"' in content:
        rest = _unquoted(path, rest, delimiter, skipped)
    reading = _Reading(path, names, delimiter.encode(), texts, skipped + 1)
    for piece in filter(None, rest):
        reading.take(piece)
    return reading.done()


def _check_text(path: Path, content: bytes) -> None:
    """Refuse what holds a character that no text has."""
    if strange := content.translate(None, NO_CONTROL):
        at = content.index(strange[:1])
        before = content[:at].replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        raise UnreadableLog(
            f"{path}: line {before.count(NEWLINE) + 1} holds the byte 0x{strange[0]:02X}, "
            "which no text table has; export it again"
        )


def _blocks(content: bytes) -> Iterator[bytes]:
    """Whole lines, each of which ends with one newline whatever the machine that wrote it."""
    at = len(MARK) if content.startswith(MARK) else 0
    if b"\r" in content and NEWLINE not in content:
        content = content.replace(b"\r", NEWLINE)
    while at < len(content):
        end = content.find(NEWLINE, at + BLOCK_BYTES) + 1 or len(content)
        yield content[at:end].replace(b"\r\n", NEWLINE).replace(b"\r", NEWLINE)
        at = end


def _header(path: Path, blocks: Iterator[bytes]) -> tuple[int, int, bytes, bytes]:
    """Find the first line that is neither blank nor a comment.

    Result: `start`, `skipped`: where in its block it begins, and how many lines stand before it.
    """
    skipped = 0
    for block in blocks:
        found = re.match(rb"(?:[ \t\f]*(?:#[^\n]*)?(?:\n|\Z))*+", block)
        start = found.end() if found else 0
        skipped += block.count(NEWLINE, 0, start)
        if start < len(block):
            return start, skipped, block[start:].partition(NEWLINE)[0], block
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


def _tabbed(block: bytes) -> bytes:
    return re.sub(rb"[ \t]+", b"\t", re.sub(rb"(?m)^[ \t]+|[ \t]+$", b"", block))


def _unquoted(path: Path, blocks: Iterable[bytes], delimiter: str, skipped: int) -> Iterator[bytes]:
    """Take quotes off; what they protected becomes a blank. Lines stay lines."""
    texts = (block.decode("utf-8", "replace") for block in blocks)
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


class _Reading:
    """A table while its blocks are taken: keeps the rows that have all their cells, and knows which lines they are."""

    def __init__(self, path: Path, names: tuple[str, ...], delimiter: bytes, texts: Collection[str], line: int) -> None:
        self._path, self._names, self._mark, self._line = path, names, delimiter, line
        self._texts, self._needed, self._decimal = texts, len(names), b"."
        self._columns: dict[int, Cells] = {}
        self._plain: list[int] = []
        """Columns whose first cell is a number."""
        self._first: tuple[tuple[str, ...], ...] = ()
        self._lines = [np.zeros(0, np.int32)]
        self._wholes = [np.zeros(0, np.bool_)]

    def take(self, block: bytes) -> None:
        """Rows, one per line, without quotes."""
        lines = block.removesuffix(NEWLINE).split(NEWLINE)
        counts = [line.count(self._mark) + 1 if line else 0 for line in lines]
        widths = np.array(counts)
        solid = np.flatnonzero(widths)
        if solid.size and not sum(map(len, self._lines)):
            self._begin([lines[k] for k in solid.tolist()], widths[solid])
        if np.any(widths > len(self._names)):
            worst = int(np.argmax(widths > len(self._names)))
            raise UnreadableLog(
                f"{self._path}: line {self._line + worst} has {widths[worst]} cells, but the table has "
                f"{len(self._names)} columns ({_shown(self._names)}); was a line lost, or two joined?"
            )
        whole = widths[solid] >= self._needed
        ends = {width: self._mark * (len(self._names) - width) for width in (self._needed, len(self._names))}
        rows = [lines[k] + ends[counts[k]] for k in solid[whole].tolist()]
        if rows:
            self._convert(rows)
        self._lines.append((solid + self._line).astype(np.int32))
        self._wholes.append(whole)
        self._line += len(lines)

    def _begin(self, rows: list[bytes], widths: NDArray[np.intp]) -> None:
        """See what the first rows tell: how fractions are written, and whether each ends with a delimiter.

        Some loggers end every row, but not the header, with one: that is one more column without a name. What ends the
        header may end rows or not.
        """
        if np.all(widths == len(self._names) + 1) and all(row.endswith(self._mark) for row in rows):
            self._names = (*self._names, "")
        self._needed = len(self._names) - (self._names[-1] == "" and len(self._names) > 1)
        sample = NEWLINE.join(rows)[:SAMPLE_BYTES]
        if self._mark != b"," and re.search(rb"\d,\d", sample) and not re.search(rb"\d\.\d", sample):
            self._decimal = b","

    def _convert(self, rows: list[bytes]) -> None:
        if not self._columns:
            named = {place: name for place, name in enumerate(self._names) if name}
            self._columns = {place: Cells(self._decimal, wants=name in self._texts) for place, name in named.items()}
            top = rows[0].split(self._mark)
            numbers = (place for place in named if _number(top[place], self._decimal) is not None)
            self._plain = [place for place in numbers if not self._columns[place].wants]
            first = (row.decode(errors="replace") for row in rows[:SHOWN])
            self._first = tuple(tuple(row.split(self._mark.decode())) for row in first)
        table = self._numbers(rows) if self._plain else None
        others = self._columns.keys() - set(() if table is None else self._plain)
        if table is not None:
            for k, place in enumerate(self._plain):
                self._columns[place].take_numbers(table[:, k])
        if others:
            cells = self._mark.join(rows).split(self._mark)
            for place in others:
                self._columns[place].take(cells[place :: len(self._names)])

    def _numbers(self, rows: list[bytes]) -> FloatArray | None:
        """Plain columns if every cell in them is a number or empty, of shape (rows, columns)."""
        mark, body = self._mark, NEWLINE.join([b"", *rows, b""])
        if self._decimal != b".":
            body = body.replace(self._decimal, b".")
        for begin, end in ((mark, mark), (mark, mark), (mark, NEWLINE), (NEWLINE, mark)):
            if begin + end in body:
                body = body.replace(begin + end, begin + b"nan" + end)
        try:
            table: FloatArray = np.loadtxt(
                io.BytesIO(body[1:]), delimiter=mark.decode(), usecols=self._plain, comments=None, ndmin=2,
                encoding="latin-1",
            )  # fmt: skip
        except ValueError:
            return None
        return table if table.shape[0] == len(rows) else None

    def done(self) -> Grid:
        """All of it."""
        line, is_whole = np.concatenate(self._lines), np.concatenate(self._wholes)
        if not is_whole.any():
            what = f"no row with {self._needed} cells" if line.size else "no row below the header"
            raise EmptyLog(f"{self._path}: {what} ({_shown(self._names)}); a log needs at least one sample")
        damage: tuple[Damage, ...] = ()
        if cut := line[~is_whole].tolist():
            note = f"{rows_text(len(cut))} with fewer than {self._needed} cells, first line {cut[0]}"
            damage = (Damage("truncated", note, len(cut)),)
        cells = {self._names[place]: column for place, column in self._columns.items()}
        row = np.flatnonzero(is_whole).astype(np.int32)
        return Grid(self._names, cells, self._first, row, line[row], damage)


def _shown(names: tuple[str, ...]) -> str:
    return ", ".join(names[:8]) + (" ..." if len(names) > 8 else "")


def _number(cell: bytes, decimal: bytes) -> float | None:
    """Value of a cell; None of text, as which 1_000 counts: Python reads it as a number, a log does not write it."""
    try:
        return float(cell if decimal == b"." else cell.replace(decimal, b".")) if b"_" not in cell else None
    except ValueError:
        return np.nan if cell.strip().lower() in MISSING else None
