"""The binary form (``.bin``): an index of record offsets per message, and columns gathered when asked for."""

from __future__ import annotations

import dataclasses
from array import array
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from logparsers.dataflash import scan
from logparsers.dataflash.formats import FMT, Field, Layout, decode_text, is_consistent, parse_fmt
from logparsers.dataflash.store import LISTED, Step, Store, Stretch

LAYOUT_LIMIT: Final = 2048
"""Message definitions that are taken: a log has at most 255 types, while forged ones could define a new one every 89
bytes."""


class BinaryStore(Store):
    """Index of a binary DataFlash log.

    `data`: the log; it is kept, and read from when columns are asked for. `strides`: False walks over the records one
    by one.
    """

    def __init__(self, data: memoryview, *, strides: bool = True) -> None:
        super().__init__(len(data))
        self._data = data
        self._pieces: dict[str, list[NDArray[Any]]] = {}
        self._names: dict[int, str] = {}
        self._odd = array("q")
        self._bad: list[tuple[int, int, int, int]] = []
        self._walk = scan.Walk(data, strides)
        self._define(FMT, 0)
        self._walk.defined[FMT.type] = -1
        self._index()
        self._describe_stretches()
        self.apply_units()
        del self._walk  # its buffers are large

    def count(self, name: str) -> int:
        """As of `Store`."""
        return sum(len(p) for p in self._pieces.get(name, ()))

    def offsets(self, name: str) -> NDArray[Any]:
        """As of `Store`."""
        pieces = self._pieces.get(name, [])
        if len(pieces) != 1:
            pieces = [np.concatenate(pieces) if pieces else np.zeros(0, np.uint32)]
            pieces[0].sort()  # two types may share one name
            self._pieces[name] = pieces
        return pieces[0]

    def read(self, name: str, fields: Sequence[str], rows: NDArray[np.intp] | None = None) -> dict[str, NDArray[Any]]:
        """As of `Store`."""
        layout = self.layouts[name]
        offsets = self.offsets(name) if rows is None else self.offsets(name)[rows]
        return {f: _finish(layout, layout.fields[f], self._gathered(layout.fields[f], offsets)) for f in fields}

    def _gathered(self, column: Field, offsets: NDArray[Any]) -> NDArray[Any]:
        """Copy one column out of its records: as bytes, which numpy gathers fastest wherever they lie."""
        if not len(offsets):
            return np.empty((0, *column.dtype.shape), column.decoded)
        size = column.dtype.itemsize
        anywhere = np.ndarray(
            (self.size - column.offset - size + 1,), f"V{size}", self._data, column.offset, strides=(1,)
        )
        values = anywhere[offsets].view(column.dtype.base).reshape(len(offsets), *column.dtype.shape)
        with np.errstate(invalid="ignore"):  # signalling NaN
            scaled: NDArray[Any] = values if column.divisor is None else values / column.divisor
            return scaled.astype(column.decoded, copy=False)

    def _index(self) -> None:
        why = scan.FULL
        while why != scan.END:
            why, n = self._walk.run()
            self._collect(n)
            if why == scan.NEW_FORMAT:
                self._redefine(self._walk.state[scan.AT])
        scan.finish(self._walk.state, self._walk.odd, self._walk.steps)
        self._take_events()
        self.odd = np.array(self._odd, np.int64)

    def _collect(self, n: int) -> None:
        """Sort a batch of records by message."""
        self._take_events()
        if not n:
            return
        types = self._walk.types[:n]
        small = np.uint32 if self.size < 1 << 32 else np.int64
        order = np.argsort(types, kind="stable")
        offsets = self._walk.offsets[:n][order].astype(small)
        ends = np.cumsum(np.bincount(types, minlength=256))
        for kind in np.flatnonzero(np.diff(ends, prepend=0)):
            begin = ends[kind - 1] if kind else 0
            # a copy: a view would keep the whole batch alive
            self._pieces.setdefault(self._names[int(kind)], []).append(offsets[begin : ends[kind]].copy())

    def _take_events(self) -> None:
        walk = self._walk
        room = LISTED - len(self._bad)
        bad = _fours(walk.bad)
        more, size = self.more_stretches
        for start, stop, kind, before in bad:
            last = self._bad[-1] if self._bad else None
            if last is not None and last[1] == start and not more:  # what resynchronising left in pieces
                self._bad[-1] = (last[0], stop, last[2], last[3])
            elif room > 0:
                self._bad.append((start, stop, kind, before))
                room -= 1
            else:
                more, size = more + 1, size + stop - start
        self.more_stretches = (more, size)
        self._odd.extend(four[0] for four in _fours(walk.odd))
        for at, before, after, _ in _fours(walk.steps):
            if len(self.steps) < LISTED:
                self.steps.append(Step(at, before, after))
        for events in (walk.bad, walk.odd, walk.steps):
            events[0] = 0

    def _redefine(self, at: int) -> None:
        """Take over the FMT record at `at`, unless it contradicts itself."""
        self._walk.state[scan.DONE_FMT] = at
        layout = parse_fmt(bytes(self._data[at : at + FMT.length]))
        if layout is not None and layout.type == FMT.type:  # firmwares define the definition as they like
            return
        if layout is None:
            self._note(f"byte {at}: not a message definition; ignored")
            return
        known = self.layouts.get(self._names.get(layout.type, ""))
        if known is not None and not is_consistent(layout):
            self._note(f"byte {at}: contradictory second definition of type {layout.type}; ignored")
            return
        self._define(layout, at)
        if len(self.layouts) == LAYOUT_LIMIT:
            self._walk.state[scan.SETTLED] = 1
            self._note(f"byte {at}: {LAYOUT_LIMIT} message definitions; further ones are ignored")

    def _define(self, layout: Layout, at: int) -> None:
        if not is_consistent(layout):
            self._note(f"byte {at}: definition of {layout.name} disagrees with itself; read as far as it goes")
        layout = dataclasses.replace(layout, name=self._free_name(layout))
        kind = layout.type
        self.layouts[layout.name] = layout
        self._names[kind] = layout.name
        self._walk.length[kind] = layout.length
        self._walk.defined[kind] = at
        first = layout.clock and layout.clock[0] == layout.columns[0]
        self._walk.clock[kind] = 0 if not first else 1 if layout.clock == ("TimeUS", 1) else 2

    def _free_name(self, layout: Layout) -> str:
        """Keep the name, or make it ``NAME~2`` if the name is taken by another layout."""
        name, turn = layout.name, 1
        while name in self.layouts and not _alike(self.layouts[name], layout):
            turn += 1
            name = f"{layout.name}~{turn}"
        return name

    def _note(self, text: str) -> None:
        if len(self.notes) < LISTED:
            self.notes.append(text)

    def _describe_stretches(self) -> None:
        for start, stop, kind, before in self._bad:
            after = self._time_after(stop)
            what = self._kind(start, stop, kind)
            self.stretches.append(Stretch(start, stop - start, what, None if before < 0 else before, after))

    def _kind(self, start: int, stop: int, kind: int) -> str:
        if kind != scan.BAD_HEADER:
            return "cut_record" if kind == scan.BAD_CUT else "truncated"
        sample = np.frombuffer(self._data[start : min(stop, start + 4096)], np.uint8)
        if sample.max() == 0:
            return "zeros"
        if sample.min() == 255:
            return "erased"
        return "unknown_type" if bytes(sample[:2]) == b"\xa3\x95" else "garbage"

    def _time_after(self, at: int) -> int | None:
        """Time of the first timed record from `at` on, if one comes soon."""
        walk = self._walk
        for _ in range(32):
            if not scan.is_header(self._data, at, self.size, walk.length):
                return None
            kind = self._data[at + 2]
            if at + walk.length[kind] > self.size:
                return None
            if walk.clock[kind]:
                time = scan.read_time(self._data, at, walk.clock[kind])
                return None if time == scan.NO_TIME else time
            at += walk.length[kind]
        return None


def _fours(events: Sequence[int]) -> list[tuple[int, int, int, int]]:
    """Take apart what `scan.put` wrote."""
    fill = events[0]
    values = list(events[1 : fill + 1])
    return list(zip(values[0::4], values[1::4], values[2::4], values[3::4], strict=True))


def _alike(a: Layout, b: Layout) -> bool:
    return (a.length, a.format, a.columns) == (b.length, b.format, b.columns)


def _finish(layout: Layout, column: Field, values: NDArray[Any]) -> NDArray[Any]:
    """Decode text; the contents of files that are logged in pieces stay bytes."""
    if not column.is_text:
        return values
    return (
        values.view(f"V{values.itemsize}")
        if layout.name == "FILE" and column.character == "Z" and column.name == "Data"
        else decode_text(values)
    )
