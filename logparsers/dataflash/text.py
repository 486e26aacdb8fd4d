"""The text form (``.log``): one message per line, name first, commas between values, already scaled."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from logparsers.dataflash.clock import LISTED, MOST_US
from logparsers.dataflash.file import DataFlashFile, Stretch
from logparsers.dataflash.formats import DICTIONARY, FMT, Field, define
from logparsers.texts import split_rows

NAME_SIZE: Final = 4
"""Characters of a message's name at most."""
BYTES_AT_ONCE: Final = 1 << 20
"""Bytes in which the ends of lines are looked for at once."""
LINES_AT_ONCE: Final = 1 << 13
"""Lines whose names are compared at once."""
BAD: Final = -1
LOOP_US: Final = 100_000
"""ArduPilot of 2012 to 2014 logged attitude from its loop of 10 Hz unless another rate was set."""
GPS_CLOCKS: Final = ("T", "TimeMS", "Time")
"""Columns of GPS that count milliseconds, since boot or since the week began."""
SPIKE_MS: Final = 60_000.0
"""One stamp of GPS that is so far from the middle of itself and its neighbours is damage."""
STAMP: Final = "TimeUS"
COMMA, NEWLINE = ord(","), ord("\n")


class TextFile(DataFlashFile):
    """A text DataFlash log: which lines belong to which message."""

    def __init__(self, source: str, data: memoryview) -> None:
        super().__init__(source, data)
        self.layouts["FMT"] = FMT
        self._lines: dict[str, NDArray[np.int64]] = {}
        self._starts, commas, names = _lines(np.frombuffer(data, np.uint8))
        self._index(commas, names)
        self._spread_us: NDArray[np.int64] | None = None
        self._spread: frozenset[str] = frozenset()
        self._give_stamps()
        self._apply_units()

    def count(self, name: str) -> int:
        """As of `DataFlashFile`."""
        return len(self._lines.get(name, ()))

    def offsets(self, name: str) -> NDArray[Any]:
        """As of `DataFlashFile`."""
        offsets: NDArray[np.int64] = self._starts[self._lines.get(name, np.zeros(0, np.int64))]
        return offsets

    def _read(self, name: str, fields: Sequence[str], rows: NDArray[np.intp] | None) -> dict[str, NDArray[Any]]:
        layout = self.layouts[name]
        lines = self._lines.get(name, np.zeros(0, np.int64))
        lines = lines if rows is None else lines[rows]
        found: dict[str, NDArray[Any]] = {}
        given = name in self._spread  # a stamp that is not written stands before the cells that are
        if given and self._spread_us is not None and STAMP in fields:
            found[STAMP] = self._spread_us[lines]
        wanted = [layout.fields[f] for f in fields if f not in found]
        cells: list[list[bytes]] = [[] for _ in wanted]
        for line in lines.tolist() if wanted else ():
            parts = self._line(line).split(b",", len(layout.columns))
            for column, into in zip(wanted, cells, strict=True):
                into.append(parts[column.position + 1 - given].strip())
        found |= {c.name: _parse(c, column) for c, column in zip(wanted, cells, strict=True)}
        return {field: found[field] for field in fields}

    def _line(self, line: int) -> bytes:
        stop = self._starts[line + 1] if line + 1 < len(self._starts) else self._size
        return bytes(self._data[self._starts[line] : stop])

    def _index(self, commas: NDArray[Any], names: NDArray[Any]) -> None:
        keys, codes = np.unique(names, return_inverse=True)
        groups = split_rows(keys.tolist(), codes)
        good = np.zeros(len(names), np.bool_)
        for line in groups.get(_key(b"FMT"), np.zeros(0, np.int64)).tolist():
            good[line] = self._define(line)
        self._lines["FMT"] = np.flatnonzero(good)
        for name, layout in self.layouts.items():
            lines = groups.get(_key(name.encode()))
            if lines is not None and name != "FMT":
                lines = lines[commas[lines] >= len(layout.columns)]
                good[lines] = True
                self._lines[name] = lines
        begin = int(np.argmax(good)) if good.any() else 0
        self._said = tuple(filter(None, (self._line(line).decode("utf-8", "replace").strip() for line in range(begin))))
        for line in (begin + np.flatnonzero(~good[begin:])).tolist():
            raw = self._line(line)
            if raw.strip():
                self._damaged(int(self._starts[line]), len(raw))

    def _define(self, line: int) -> bool:
        parts = [p.strip() for p in self._line(line).decode("latin-1").split(",")]
        if len(parts) < 6 or not parts[1].isdecimal() or not parts[2].isdecimal():
            return False
        name, columns = parts[3], ",".join(parts[5:])
        if not 0 < len(name) <= NAME_SIZE or len(parts[1]) > 3 or len(parts[2]) > 3:
            return False
        layout = define(type=int(parts[1]), name=name, length=255, format=parts[4], columns=columns)
        if name == "FMT":
            return True
        fields = {
            n: dataclasses.replace(f, character="Z") if f.character == "M" else f for n, f in layout.fields.items()
        }
        layout = dataclasses.replace(layout, fields=fields)
        known = self.layouts.setdefault(name, layout)
        if (known.format, known.columns) != (layout.format, layout.columns):
            self._notes.append(f"byte {self._starts[line]}: second definition of {name}; ignored")
        return True

    def _damaged(self, offset: int, length: int) -> None:
        if len(self.stretches) < LISTED:
            self.stretches.append(Stretch(offset, length, "bad_line"))
        else:
            self.more_stretches = (self.more_stretches[0] + 1, self.more_stretches[1] + length)

    def _give_stamps(self) -> None:
        """Spread the lines of a log without stamps: between the times of GPS, or at the rate of the loop."""
        named = [name for name in self._lines if name != "FMT" and self.count(name)]
        if any(self.layouts[name].is_timed for name in named):
            return
        bare = [name for name in named if self.layouts[name].clock is None and name not in DICTIONARY]
        if not bare:
            return
        known, time_us = self._anchors()
        how = "between those of GPS"
        if known.size < 2:
            paced = max(bare, key=self.count)
            known, how = self._lines[paced], f"as if {paced} came at {1_000_000 // LOOP_US} Hz"
            time_us = LOOP_US * np.arange(1, known.size + 1)
        if known.size > 1:
            pace_us = (time_us[-1] - time_us[0]) / (known[-1] - known[0])
            lines = np.arange(self._starts.size)
            beyond = np.where(lines < known[0], lines - known[0], np.maximum(lines - known[-1], 0))
            spread = np.interp(lines, known, time_us) + pace_us * beyond
            self._spread_us = np.maximum(spread, 0.0).astype(np.int64)
        else:
            self._spread_us = np.full(self._starts.size, LOOP_US)
        self._spread = frozenset(bare)
        for name in bare:
            old = self.layouts[name]
            columns = ",".join((STAMP, *old.columns))
            new = define(type=old.type, name=name, length=old.length, format="Q" + old.format, columns=columns)
            self.layouts[name] = dataclasses.replace(new, fields={
                n: dataclasses.replace(f, character=old.fields[n].character) if n in old.fields else f
                for n, f in new.fields.items()
            })  # fmt: skip
        rows = sum(map(self.count, bare))
        self._notes.append(f"no time stamps in {rows} rows: spread {how}; times, rates and the duration are estimates")

    def _anchors(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Lines of GPS and their times as long as those rise [us]; from 0 unless they count from boot."""
        layout = self.layouts.get("GPS")
        clock = next((name for name in GPS_CLOCKS if layout and name in layout.fields), "")
        if not clock or layout is None or not layout.fields[clock].is_number or not self.count("GPS"):
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        ms = self.column("GPS", clock).astype(np.float64)
        rows = np.flatnonzero((ms > 0.0) & (ms < MOST_US / 1000))
        middle = np.median([ms[rows], *(np.roll(ms[rows], step) for step in (1, -1))], axis=0)
        rows = rows[np.abs(ms[rows] - middle) < SPIKE_MS] if rows.size > 2 else rows
        rows = rows[np.flatnonzero(np.diff(np.maximum.accumulate(ms[rows]), prepend=0.0) > 0.0)]
        time_us = (1000.0 * ms[rows]).astype(np.int64)
        lines: NDArray[np.int64] = self._lines["GPS"][rows]
        return lines, time_us if clock == "T" or not rows.size else time_us - time_us[0]


def _key(name: bytes) -> int:
    return int.from_bytes(name.ljust(NAME_SIZE, b"\0"), "big")


def _lines(raw: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[Any], NDArray[Any]]:
    """Where each line begins, how many commas it has, and its name as a number (`BAD` without one)."""
    breaks = [at + np.flatnonzero(raw[at : at + BYTES_AT_ONCE] == NEWLINE) for at in range(0, len(raw), BYTES_AT_ONCE)]
    starts = np.concatenate([np.zeros(1, np.int64), *(b + 1 for b in breaks)])
    starts = starts[starts < len(raw)]
    commas = np.zeros(len(starts), np.int64)
    names = np.full(len(starts), BAD, np.int64)
    for begin in range(0, len(starts), LINES_AT_ONCE):
        here = starts[begin : begin + LINES_AT_ONCE]
        stop = int(starts[begin + LINES_AT_ONCE]) if begin + LINES_AT_ONCE < len(starts) else len(raw)
        block = raw[here[0] : stop]
        commas[begin : begin + len(here)] = np.add.reduceat(block == COMMA, here - here[0], dtype=np.int64)
        heads = raw[np.minimum(here[:, None] + np.arange(NAME_SIZE + 1), len(raw) - 1)]
        comma = np.argmax(heads == COMMA, axis=1)
        letters = np.where(np.arange(NAME_SIZE) < comma[:, None], heads[:, :NAME_SIZE], 0).astype(np.int64)
        key = letters @ (256 ** np.arange(NAME_SIZE - 1, -1, -1))
        names[begin : begin + len(here)] = np.where(comma > 0, key, BAD)
    return starts, commas, names


def _parse(column: Field, cells: list[bytes]) -> NDArray[Any]:
    """Turn cells into numbers where the format says number."""
    if not column.is_number:
        return np.array([c.decode("utf-8", "replace") for c in cells], np.str_)
    whole = column.divisor is None and column.character not in "fdg"
    kinds = ([np.uint64] if column.character == "Q" else [np.int64]) if whole else []
    for kind in (*kinds, np.float64):
        try:
            return np.array(cells or [], np.bytes_).astype(kind)
        except (ValueError, OverflowError):
            continue
    return np.array([_number(c) for c in cells], np.float64)


def _number(cell: bytes) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")
