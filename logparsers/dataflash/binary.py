"""The binary form (``.bin``): an index of record offsets per message, and columns gathered when asked for.

A record is ``A3 95 type payload`` with the length its type was given; there is no checksum. The only
evidence is the chain: behind a sound record the next one begins. Where the chain breaks, a record that hides
the beginning of another, sound one is itself damage (cut short, or a header that never was one).

A stride follows a sound chain by whole arrays, thirty times as fast as record by record.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from logparsers.dataflash.clock import A_FEW, LISTED
from logparsers.dataflash.file import DataFlashFile, Stretch
from logparsers.dataflash.formats import FMT, HEADER_SIZE, Field, Layout, decode_text, is_consistent, parse_fmt
from logparsers.texts import split_rows

LAYOUT_LIMIT: Final = 2048
"""Message definitions that are taken: a log has at most 255 types, while forged ones could define a new one every 89
bytes."""

HEAD: Final = b"\xa3\x95"
STRIDE: Final = (1 << 12, 1 << 19)
"""Bytes of a stride, at first and at most: each eight times as long as the one before, as long as nothing stops it."""
NO_RECORD, CUT, TAIL = "no_record", "cut_record", "truncated"
"""Kinds of damaged stretches: bytes that no record begins with, and records cut by another or by the end of the log."""


class Walk:
    """One walk over one log.

    `define`: called where a FMT record stands that differs from the one in force, before what follows it. `strides`:
    False walks record by record.
    """

    def __init__(self, data: memoryview, define: Callable[[int], None], *, strides: bool = True) -> None:
        self._data, self._size, self._raw = data, len(data), np.frombuffer(data, np.uint8)
        self._define, self._strides = define, strides
        self._length, self._slot, self._defined = [0] * 256, [0] * 256, [-1] * 256
        self._header = re.compile(HEAD)
        self._at: list[int] = []
        self._slots: list[int] = []
        self._taken: list[tuple[NDArray[Any], NDArray[np.int16]]] = []
        self.is_settled = False
        """Whether definitions are passed over."""
        self.stretches: list[tuple[int, int, str]] = []
        """Damaged bytes, the first `LISTED` of them: begin, end, kind."""
        self.more_stretches = (0, 0)
        """Those beyond: how many, how many bytes."""

    def know(self, kind: int, length: int, slot: int, at: int) -> None:
        """Take records of a type to be that long [bytes], and note them under a number; `at`: its definition."""
        is_new, self._length[kind] = not self._length[kind], length
        self._slot[kind], self._defined[kind] = slot, at
        if is_new:
            known = bytes(kind for kind in range(256) if self._length[kind])
            self._header = re.compile(HEAD + b"[" + re.escape(known) + b"]")

    def run(self) -> tuple[NDArray[Any], NDArray[np.int16]]:
        """Where each record begins, shape (n,), and the number of its type."""
        data, size, at = self._data, self._size, 0
        few, stride, doubt, defined = 0 if self._strides else size, STRIDE[0], False, -1
        while at + HEADER_SIZE <= size:
            if not few:
                end = self._strode(at, min(at + stride, size))
                stride = min(stride << 3, STRIDE[1]) if end > at + stride - 256 else STRIDE[0]
                few, at = 0 if end > at else A_FEW, end
                continue
            if not self._begins(at):
                start, at = at, self._next(at)
                self._hurt(start, at, NO_RECORD)
                doubt = True  # right behind damage, no sound record before it confirms a record
                continue
            kind = data[at + 2]
            end = at + self._length[kind]
            if doubt or not (end == size or self._begins(end)):
                inner = self._hidden(at, end)
                if inner >= 0 or end > size:
                    start, at = at, inner if inner >= 0 else size
                    self._hurt(start, at, CUT if inner >= 0 else TAIL)
                    continue
            if kind == FMT.type and at != defined and self._is_new(at):
                self._define(at)
                defined = at
                continue  # what it defines may begin within it
            self._at.append(at)
            self._slots.append(self._slot[kind])
            few, at, doubt = few - 1, end, False
        if at < size:
            self._hurt(at, size, TAIL)
        self._keep()
        offsets, slots = zip(*self._taken, strict=True)
        return np.concatenate(offsets), np.concatenate(slots)

    def _keep(self, at: NDArray[np.int64] | None = None, kinds: NDArray[np.uint8] | None = None) -> None:
        """Note the records walked one by one, and then those of a stride."""
        small = np.uint32 if self._size < 1 << 32 else np.int64
        self._taken.append((np.array(self._at, small), np.array(self._slots, np.int16)))
        self._at, self._slots = [], []
        if at is not None and kinds is not None:
            self._taken.append((at.astype(small), np.array(self._slot, np.int16)[kinds]))

    def _begins(self, at: int) -> bool:
        """Tell whether a known message type begins here."""
        data = self._data
        if at + HEADER_SIZE > self._size or data[at] != HEAD[0] or data[at + 1] != HEAD[1]:
            return False
        return self._length[data[at + 2]] > 0

    def _next(self, at: int) -> int:
        """Where a known message type begins behind `at`; the end of the log if nowhere."""
        found = self._header.search(self._data, at + 1)
        return found.start() if found else self._size

    def _hidden(self, at: int, end: int) -> int:
        """Find a record inside ``(at, end)`` with a better claim to these bytes than that at `at`, or -1."""
        found = -1
        inner, stop = self._next(at), min(end, self._size - 2)
        while inner < stop:
            after = inner + self._length[self._data[inner + 2]]
            if after == self._size or self._begins(after):
                found = inner
                stop = min(after, self._size - 2)  # which may itself hide a better one
            inner = self._next(inner)
        return found if found < end else -1

    def _is_new(self, at: int) -> bool:
        """Tell whether the definition at `at` differs from the one in force, and counts."""
        before = self._defined[self._data[at + HEADER_SIZE]]
        return not self.is_settled and (
            before < 0 or self._data[before : before + FMT.length] != self._data[at : at + FMT.length]
        )

    def _hurt(self, start: int, stop: int, kind: str) -> None:
        more, size = self.more_stretches
        if self.stretches and self.stretches[-1][1] == start and not more:  # what resynchronising left in pieces
            self.stretches[-1] = (self.stretches[-1][0], stop, self.stretches[-1][2])
        elif len(self.stretches) < LISTED:
            self.stretches.append((start, stop, kind))
        else:
            self.more_stretches = (more + 1, size + stop - start)

    def _strode(self, begin: int, stop: int) -> int:
        """Take the records up to `stop` that a walk would take without a word; where they end."""
        piece, length = self._raw[begin:stop], np.array(self._length)
        at = np.flatnonzero((piece[:-2] == HEAD[0]) & (piece[1:-1] == HEAD[1]))
        kinds = piece[at + 2]
        known = length[kinds] > 0
        at, kinds = at[known], kinds[known]
        if not at.size or at[0] != 0:
            return begin
        sound = _chained(at, at + length[kinds], self._size - begin)
        at, kinds = at[sound] + begin, kinds[sound]
        new = next((k for k in np.flatnonzero(kinds == FMT.type).tolist() if self._is_new(int(at[k]))), at.size)
        self._keep(at[:new], kinds[:new])
        return int(at[new - 1] + length[kinds[new - 1]]) if new else begin


def _chained(at: NDArray[np.int64], ends: NDArray[np.int64], size: int) -> NDArray[np.int64]:
    """Which of the places that look like records are a chain from the first on, each confirmed by the next."""
    broken = np.flatnonzero(ends[:-1] != at[1:])
    runs, first = [], 0
    while first < at.size:
        place = int(np.searchsorted(broken, first))
        last = int(broken[place]) if place < broken.size else at.size - 1
        follower = int(np.searchsorted(at, ends[last]))
        is_followed = ends[last] == size or (follower < at.size and at[follower] == ends[last])
        runs.append(np.arange(first, last + is_followed))
        first = follower if is_followed else at.size
    return np.concatenate(runs)


class BinaryFile(DataFlashFile):
    """A binary DataFlash log; `strides`: False walks over the records one by one."""

    def __init__(self, source: str, data: memoryview, *, strides: bool = True) -> None:
        super().__init__(source, data)
        self._names: dict[int, str] = {}
        self._walk = Walk(data, self._redefine, strides=strides)
        self._define(FMT, -1)
        offsets, slots = self._walk.run()
        self._offsets = {name: offsets[rows] for name, rows in split_rows(list(self.layouts), slots).items()}
        self.more_stretches = self._walk.more_stretches
        self.stretches = [
            Stretch(start, stop - start, self._kind(start, stop) if kind == NO_RECORD else kind)
            for start, stop, kind in self._walk.stretches
        ]
        del self._walk  # its buffers are large
        self._apply_units()

    def count(self, name: str) -> int:
        """As of `DataFlashFile`."""
        return len(self.offsets(name))

    def offsets(self, name: str) -> NDArray[Any]:
        """As of `DataFlashFile`."""
        return self._offsets.get(name, np.zeros(0, np.uint32))

    def _read(self, name: str, fields: Sequence[str], rows: NDArray[np.intp] | None) -> dict[str, NDArray[Any]]:
        layout = self.layouts[name]
        offsets = self.offsets(name) if rows is None else self.offsets(name)[rows]
        return {f: _finish(layout, layout.fields[f], self._gathered(layout.fields[f], offsets)) for f in fields}

    def _gathered(self, column: Field, offsets: NDArray[Any]) -> NDArray[Any]:
        """Copy one column out of its records: as bytes, which numpy gathers fastest wherever they lie."""
        if not len(offsets):
            return np.empty((0, *column.dtype.shape), column.decoded)
        size = column.dtype.itemsize
        anywhere = np.ndarray(
            (self._size - column.offset - size + 1,), f"V{size}", self._data, column.offset, strides=(1,)
        )
        values = anywhere[offsets].view(column.dtype.base).reshape(len(offsets), *column.dtype.shape)
        with np.errstate(invalid="ignore"):  # signalling NaN
            scaled: NDArray[Any] = values if column.divisor is None else values / column.divisor
            return scaled.astype(column.decoded, copy=False)

    def _redefine(self, at: int) -> None:
        """Take over the FMT record at `at`, unless it contradicts itself."""
        layout = parse_fmt(bytes(self._data[at : at + FMT.length]))
        if layout is not None and layout.type == FMT.type:  # firmwares define the definition as they like
            return
        if layout is None:
            self._note(f"byte {at}: not a message definition; ignored")
        elif layout.type in self._names and not is_consistent(layout):
            self._note(f"byte {at}: contradictory second definition of type {layout.type}; ignored")
        else:
            self._define(layout, at)
            if len(self.layouts) == LAYOUT_LIMIT:
                self._walk.is_settled = True
                self._note(f"byte {at}: {LAYOUT_LIMIT} message definitions; further ones are ignored")

    def _define(self, layout: Layout, at: int) -> None:
        if not is_consistent(layout):
            self._note(f"byte {at}: definition of {layout.name} disagrees with itself; read as far as it goes")
        name, turn = layout.name, 1
        while name in self.layouts and not _alike(self.layouts[name], layout):
            turn += 1
            name = f"{layout.name}~{turn}"
        self.layouts[name] = dataclasses.replace(layout, name=name)
        self._names[layout.type] = name
        self._walk.know(layout.type, layout.length, list(self.layouts).index(name), at)

    def _note(self, text: str) -> None:
        if len(self._notes) < LISTED:
            self._notes.append(text)

    def _kind(self, start: int, stop: int) -> str:
        """What stands where no record begins."""
        sample = np.frombuffer(self._data[start : min(stop, start + 4096)], np.uint8)
        if sample.max() == 0:
            return "zeros"
        if sample.min() == 255:
            return "erased"
        return "unknown_type" if bytes(sample[:2]) == HEAD else "garbage"


def _alike(a: Layout, b: Layout) -> bool:
    return (a.length, a.format, a.columns) == (b.length, b.format, b.columns)


def _finish(layout: Layout, column: Field, values: NDArray[Any]) -> NDArray[Any]:
    """Decode text; the contents of files that are logged in pieces stay bytes."""
    if not column.is_text:
        return values
    if layout.name == "FILE" and column.character == "Z" and column.name == "Data":
        return values.view(f"V{values.itemsize}")
    return decode_text(values)
