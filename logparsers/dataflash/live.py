"""A DataFlash log that comes in blocks over a live link: put in order, asked for again, and decoded row by row."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Final

import numpy as np

from logparsers.dataflash.formats import CHARACTERS, FMT, HEADER_SIZE, Layout, is_consistent, parse_fmt, with_units

_HEAD: Final = b"\xa3\x95"
_FMTU: Final = "QBNN"
_WIDE: Final = {"d": "d", "q": "q", "Q": "Q"}
_PATIENCE_S, _AGAIN_S = 2.0, 0.2
"""A missing block is given up after the first time, and asked for again after each of the second [s]."""
_MOST_AHEAD: Final = 2_000
"""Blocks ahead of a missing one that are kept; a stream that begins later than this is joined in the middle."""
_MOST_NACKS: Final = 20
"""Missing blocks that are asked for at once."""
_REMEMBERED: Final = 1024
"""Blocks that may come again because their acknowledgement was lost: autopilots keep 40, or some hundreds, of them."""

Answer = tuple[int, bool]
"""Number of a block, and whether it arrived."""


@dataclass(frozen=True, slots=True)
class LiveRow:
    """Numbers of one row, by the names of their channels."""

    time_s: float
    values: dict[str, float]


class RowDecoder:
    r"""Decodes rows as bytes come in; skips what is no row."""

    def __init__(self) -> None:
        self._layouts: dict[int, Layout] = {FMT.type: FMT}
        self._cells: dict[int, tuple[struct.Struct, list[tuple[str, int, float]]]] = {}
        """How to take a record apart, and which cells are numbers: name, place, and what they are divided by."""
        self._units: dict[int, tuple[str, str]] = {}
        """What FMTU says of the columns of each type of message, be it defined before or after."""
        self._rest = b""

    def feed(self, data: bytes) -> list[LiveRow]:
        """Rows that these bytes complete."""
        return [row for record in self.records(data) if (row := self._row(record)) is not None]

    def records(self, data: bytes) -> list[bytes]:
        """Whole records that these bytes complete, as they are."""
        data, at, found = self._rest + data, 0, []
        while True:
            at = data.find(_HEAD, at)
            if at < 0 or at + HEADER_SIZE > len(data):
                break
            known = self._layouts.get(data[at + 2])
            if known is None:
                at += len(_HEAD)
                continue
            if at + known.length > len(data):
                break
            found.append(data[at : at + known.length])
            if known is FMT:
                self._learn(parse_fmt(found[-1]))
            at += known.length
        self._rest = data[at:] if at >= 0 else data[-1:]
        return found

    def lose(self) -> None:
        """Bytes are missing here."""
        self._rest = b""

    def _learn(self, layout: Layout | None) -> None:
        if layout is not None and layout.type != FMT.type and is_consistent(layout):
            layout = with_units(layout, *self._units.get(layout.type, ("", "")), {}, {})
            fields = [f for f in layout.fields.values() if f.is_number and f.position and f.name != layout.instance]
            numbers = [(f.name, f.position, f.divisor or 1.0) for f in fields]
            self._layouts[layout.type] = layout
            self._cells[layout.type] = struct.Struct("<" + "".join(map(_struct_code, layout.format))), numbers

    def _row(self, record: bytes) -> LiveRow | None:
        layout = self._layouts[record[2]]
        if layout is FMT:
            return None
        unpacker, numbers = self._cells[layout.type]
        cells = unpacker.unpack_from(record, HEADER_SIZE)
        if layout.name == "FMTU" and layout.format == _FMTU:
            _, kind, units, multipliers = cells
            self._units[kind] = _text(units), _text(multipliers)
            self._learn(self._layouts.get(kind))
        if layout.clock != ("TimeUS", 1):
            return None
        head = layout.name
        if layout.instance is not None:
            of = layout.fields[layout.instance]
            head += f"[{_text(cells[of.position]) if of.is_text else cells[of.position]}]"
        values = {f"{head}.{name}": cells[place] / divisor for name, place, divisor in numbers}
        return LiveRow(cells[0] / 1e6, values)


def _struct_code(character: str) -> str:
    """How `struct` takes a column from the bytes of a record."""
    stored = np.dtype(CHARACTERS[character][0])
    return stored.char if stored.kind in "iuf" and stored.itemsize < 8 else _WIDE.get(character, f"{stored.itemsize}s")


class BlockStream:
    """Puts numbered blocks in order, and says what to answer."""

    def __init__(self) -> None:
        self._next = 0
        self._early: dict[int, bytes] = {}
        self._lately: dict[int, bytes] = {}
        """Latest blocks that were given, by their numbers; empty for those that never came."""
        self._again: dict[int, bytes] = {}
        """Of these, what has come again since the latest new one: copies, or a new beginning that begins alike."""
        self._answers: list[Answer] = []
        self._missing_since_s, self._asked_s = math.inf, -math.inf
        self.received = self.lost = self.restarts = 0
        """Blocks that came, and that never did; how often the autopilot began anew, with block 0."""
        self.begun = False

    def take(self, number: int, data: bytes, now_s: float) -> list[bytes]:
        """Blocks that are in order now; an empty one stands for what is lost."""
        self._answers.append((number, True))
        ready = []
        if not self.begun:
            self.begun, self._next = True, number if number > _MOST_AHEAD else 0
        elif self._began_anew(number, data):
            self._next, self.restarts = 0, self.restarts + 1
            self._early, self._again = self._again, {}
            self._lately.clear()
            ready.append(b"")
        if number < self._next:
            self._again[number] = data
            return ready
        self._again.clear()
        self._early[number] = data
        whole = self._in_order()
        if not self._early:
            self._missing_since_s = math.inf
        elif math.isinf(self._missing_since_s) or whole:
            self._missing_since_s = now_s
        ready += whole
        if self._early and (now_s - self._missing_since_s > _PATIENCE_S or len(self._early) > _MOST_AHEAD):
            first = min(self._early)
            self.lost += first - self._next
            for never in range(max(self._next, first - _REMEMBERED), first):
                self._remember(never, b"")
            self._next, self._missing_since_s = first, now_s
            ready += [b"", *self._in_order()]
        return ready

    def _began_anew(self, number: int, data: bytes) -> bool:
        """Whether this block is neither new, nor one of the latest once more, nor one that was given up."""
        if number >= self._next:
            return False
        known = self._lately.get(number)
        return known is None or known not in (b"", data)

    def _remember(self, number: int, data: bytes) -> None:
        self._lately[number] = data
        if len(self._lately) > _REMEMBERED:
            del self._lately[next(iter(self._lately))]

    def answers(self, now_s: float) -> list[Answer]:
        """Acknowledgements, and requests for what is missing."""
        answers, self._answers = self._answers, []
        if self._early and now_s - self._asked_s >= _AGAIN_S:
            self._asked_s = now_s
            gap = range(self._next, min(*self._early, self._next + _MOST_NACKS))
            answers += [(number, False) for number in gap]
        return answers

    def _in_order(self) -> list[bytes]:
        ready = []
        while self._next in self._early:
            ready.append(self._early.pop(self._next))
            self._remember(self._next, ready[-1])
            self._next += 1
            self.received += 1
        return ready


def _text(raw: bytes) -> str:
    return raw.split(b"\0", 1)[0].decode("ascii", "replace")
