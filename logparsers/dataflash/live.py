"""A DataFlash log that comes in blocks over a live link: put in order, asked for again, and decoded row by row."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Final

_HEAD: Final = b"\xa3\x95"
_FMT, _FMT_SIZE, _HEAD_SIZE = 128, 89, 3
_CODES: Final = {
    "a": "64s", "b": "b", "B": "B", "h": "h", "H": "H", "i": "i", "I": "I", "f": "f", "d": "d", "g": "e",
    "n": "4s", "N": "16s", "Z": "64s", "c": "h", "C": "H", "e": "i", "E": "I", "L": "i", "M": "B", "q": "q", "Q": "Q",
}  # fmt: skip
_SCALES: Final = dict.fromkeys("cCeE", 0.01) | {"L": 1e-7}
_INSTANCE: Final = "#"
_PATIENCE_S, _AGAIN_S = 2.0, 0.2
_MOST_AHEAD: Final = 2_000
_MOST_NACKS: Final = 20
_REMEMBERED: Final = 1024
"""Blocks that may come again because their acknowledgement was lost: autopilots keep 40, or some hundreds, of them."""

Answer = tuple[int, bool]
"""Number of a block, and whether it arrived."""


@dataclass(frozen=True, slots=True)
class LiveRow:
    """Numbers of one row, by the names of their channels."""

    time_s: float
    values: dict[str, float]


@dataclass(slots=True)
class _Format:
    name: str
    layout: struct.Struct
    columns: list[str]
    codes: str
    instance: int | None = None


class RowDecoder:
    r"""Decodes rows as bytes come in; skips what is no row.

    Examples
    --------
    >>> fmt = b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", 9, 13, b"RCOU", b"QH", b"TimeUS,C1")
    >>> decoder = RowDecoder()
    >>> decoder.feed(fmt), decoder.feed(b"\xa3\x95\x09" + struct.pack("<QH", 2_000_000, 1500))
    ([], [LiveRow(time_s=2.0, values={'RCOU.C1': 1500.0})])
    """

    def __init__(self) -> None:
        self._formats: dict[int, _Format] = {}
        self._instances: dict[int, int] = {}
        self._rest = b""

    def feed(self, data: bytes) -> list[LiveRow]:
        """Rows that these bytes complete."""
        rows = []
        for record in self.records(data):
            known = self._formats.get(record[2])
            row = self._row(known, record[_HEAD_SIZE:]) if known is not None and record[2] != _FMT else None
            rows += [row] if row is not None else []
        return rows

    def records(self, data: bytes) -> list[bytes]:
        """Whole records that these bytes complete, as they are."""
        data, at, found = self._rest + data, 0, []
        while True:
            at = data.find(_HEAD, at)
            if at < 0 or at + _HEAD_SIZE > len(data):
                break
            kind = data[at + 2]
            known = self._formats.get(kind)
            size = _FMT_SIZE if kind == _FMT else (_HEAD_SIZE + known.layout.size if known else 0)
            if size == 0:
                at += 2
                continue
            if at + size > len(data):
                break
            if kind == _FMT:
                self._learn(data[at + _HEAD_SIZE : at + size])
            found.append(data[at : at + size])
            at += size
        self._rest = data[at:] if at >= 0 else data[-1:]
        return found

    def lose(self) -> None:
        """Bytes are missing here."""
        self._rest = b""

    def _learn(self, body: bytes) -> None:
        number, size, name, codes, columns = struct.unpack("<BB4s16s64s", body)
        text = _text(codes)
        if any(code not in _CODES for code in text):
            return
        layout = struct.Struct("<" + "".join(_CODES[code] for code in text))
        if layout.size + _HEAD_SIZE == size:
            names = _text(columns).split(",")
            self._formats[number] = _Format(_text(name), layout, names, text, self._instances.get(number))

    def _row(self, known: _Format, body: bytes) -> LiveRow | None:
        fields = known.layout.unpack(body)
        if known.name == "FMTU":
            units = _text(fields[2])
            if _INSTANCE in units:
                self._instances[fields[1]] = units.index(_INSTANCE)
                if fields[1] in self._formats:
                    self._formats[fields[1]].instance = units.index(_INSTANCE)
            return None
        if known.columns[0] != "TimeUS" or known.codes[0] != "Q":
            return None
        which = ""
        if known.instance is not None and known.instance < len(fields):
            value = fields[known.instance]
            which = f"[{_text(value) if isinstance(value, bytes) else value}]"
        values = {
            f"{known.name}{which}.{column}": float(value) * _SCALES.get(code, 1.0)
            for column, code, value in list(zip(known.columns, known.codes, fields, strict=False))[1:]
            if not isinstance(value, bytes)
        }
        return LiveRow(fields[0] / 1e6, values)


class BlockStream:
    """Puts numbered blocks in order, and says what to answer.

    Examples
    --------
    >>> stream = BlockStream()
    >>> stream.take(0, b"a", 0.0), stream.take(2, b"c", 0.0), stream.take(1, b"b", 0.1)
    ([b'a'], [], [b'b', b'c'])
    >>> stream.answers(0.1)
    [(0, True), (2, True), (1, True)]
    """

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
