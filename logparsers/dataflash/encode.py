"""Write binary DataFlash logs: for simulated flights, and for tests of whoever reads them."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from logparsers.dataflash.formats import FMT, HEADER_SIZE, Layout, define, stored_size
from logparsers.interleave import interleave, places

FIRST_FREE_TYPE: Final = 129
"""First type number that is given to messages; 128 is that of FMT."""
UNITS: Final[Mapping[str, str]] = {
    "-": "", "?": "UNKNOWN", "#": "instance", "s": "s", "d": "deg", "k": "deg/s", "%": "%", "v": "V",
    "A": "A", "O": "degC", "Y": "us", "m": "m", "n": "m/s", "P": "Pa", "o": "m/s/s", "E": "rad/s",
    "D": "deglatitude", "U": "deglongitude", "h": "degheading", "t": "N.m", "S": "satellites", "b": "B",
}  # fmt: skip
MULTIPLIERS: Final[Mapping[str, float]] = {
    "-": 0.0, "?": 1.0, "0": 1.0, "A": 1e-1, "B": 1e-2, "C": 1e-3, "F": 1e-6, "G": 1e-7,
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """All rows of one message.

    `name`: up to four characters. `format`: one format character per column. `columns` (shape (n,)): in the unit a
    reader shall see: scaled characters (``c``, ``L``, ...) are scaled here. The first column orders the log; it should
    be ``TimeUS``. `units`, `multipliers`: one id per column, for FMTU; empty to leave it out.
    """

    name: str
    format: str
    columns: Mapping[str, ArrayLike]
    units: str = ""
    multipliers: str = ""

    def layout(self, kind: int) -> Layout:
        """Lay out the records with type number `kind`."""
        length = stored_size(self.format) or 0
        columns = ",".join(self.columns)
        return define(type=kind, name=self.name, length=length, format=self.format, columns=columns)


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """A log and where its rows are, for whoever sends it row by row.

    `content`: definitions, then all rows in the order of time. `ends` (shape (n,)): where each row ends; the
    definitions end where the first row begins. `time_us` (shape (n,)): when each row was written [us]. `named` (shape
    (n,)): message of each row.
    """

    content: bytes
    ends: NDArray[np.int64]
    time_us: NDArray[np.int64]
    named: NDArray[np.str_]


def encode(messages: Sequence[Message], *, start_us: int | None = None) -> bytes:
    """Write a log: definitions first, then all rows in the order of time.

    `start_us`: time of the definitions [us]; None for that of the first row. Result: the content of a ``.bin`` file.
    """
    return encode_rows(messages, start_us=start_us).content


def encode_rows(messages: Sequence[Message], *, start_us: int | None = None) -> Rows:
    """Write a log as `encode` does, and remember its rows."""
    clocks = [np.asarray(next(iter(m.columns.values())), np.int64) for m in messages]
    if start_us is None:
        start_us = min((int(c.min()) for c in clocks if c.size), default=0)
    everything = [*_dictionary(messages, start_us), *messages]
    layouts = [m.layout(FIRST_FREE_TYPE + i) for i, m in enumerate(everything)]
    head = b"".join(_fmt_record(layout) for layout in (FMT, *layouts))
    records = [_records(m, layout) for m, layout in zip(everything, layouts, strict=True)]
    times = [np.asarray(next(iter(m.columns.values())), np.int64) for m in everything]
    lengths = [np.full(len(r), r.dtype.itemsize) for r in records]
    starts = np.concatenate(places(times, lengths)[0])
    order = np.argsort(starts)
    ends = len(head) + (starts + np.concatenate(lengths))[order]
    named = np.repeat([m.name for m in everything], [len(r) for r in records])[order]
    return Rows(head + interleave(times, records), ends, np.concatenate(times)[order], named)


def _dictionary(messages: Sequence[Message], start_us: int) -> list[Message]:
    """Make UNIT, MULT and FMTU rows for the messages that have units."""
    described = [(i, m) for i, m in enumerate(messages) if m.units]
    if not described:
        return []

    def at(n: int) -> NDArray[np.int64]:
        return np.full(n, start_us, np.int64)

    units: Mapping[str, ArrayLike] = {
        "TimeUS": at(len(UNITS)),
        "Id": [ord(c) for c in UNITS],
        "Label": list(UNITS.values()),
    }
    scales: Mapping[str, ArrayLike] = {
        "TimeUS": at(len(MULTIPLIERS)),
        "Id": [ord(c) for c in MULTIPLIERS],
        "Mult": list(MULTIPLIERS.values()),
    }
    rows: Mapping[str, ArrayLike] = {
        "TimeUS": at(len(described)),
        "FmtType": [FIRST_FREE_TYPE + 3 + i for i, _ in described],
        "UnitIds": [m.units for _, m in described],
        "MultIds": [m.multipliers for _, m in described],
    }
    return [Message("UNIT", "QbZ", units), Message("MULT", "Qbd", scales), Message("FMTU", "QBNN", rows)]


def _fmt_record(layout: Layout) -> bytes:
    texts = (layout.name, layout.format, ",".join(layout.columns))
    return struct.pack("<3sBB4s16s64s", b"\xa3\x95\x80", layout.type, layout.length, *(t.encode() for t in texts))


def _records(message: Message, layout: Layout) -> NDArray[Any]:
    """All rows of one message, packed."""
    first = np.atleast_1d(np.asarray(next(iter(message.columns.values()))))
    fields = list(layout.fields.values())
    record = np.dtype(
        {
            "names": ["header", *(f.name for f in fields)],
            "formats": ["V3", *(f.dtype for f in fields)],
            "offsets": [0, *(f.offset for f in fields)],
            "itemsize": layout.length,
        }
    )
    rows = np.zeros(len(first), record)
    rows.view(np.uint8).reshape(len(first), layout.length)[:, :HEADER_SIZE] = (0xA3, 0x95, layout.type)
    for field in fields:
        values = np.asarray(message.columns[field.name])
        if field.divisor is not None:
            values = np.rint(values * field.divisor)
        if field.is_text and values.dtype.kind == "U":
            values = np.char.encode(values, "utf-8")
        rows[field.name] = values.astype(field.dtype.base)
    return rows
