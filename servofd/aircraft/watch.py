"""The marks of `servofd.aircraft.marks` sample by sample: rows of a stream wait until the rules have decided them."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servofd.aircraft.marks import (
    ASKED_DEG,
    LAST_WITH_VALUE,
    NO_OTHERS,
    TINY_DEG,
    Rows,
    is_young,
    last_change_s,
    marked,
    moved,
    new_bus,
    refresh_of,
    standing,
)
from servofd.core.series import latest, stretches
from servofd.core.types import FloatArray, Marks

if TYPE_CHECKING:
    from servofd.aircraft.schema import Surface

STANDS_STILL_S: Final = 1.0
"""A bus that stands still for so long is reported [s]: where any surface is, is not known then."""
_KEPT_S, _KEPT_ROWS, _MOST_ROWS = 1.5, 100, 250
"""The rules look back by half a second and 34 fresh readings; what is older is dropped when 250 rows are there."""
_ROWS_FOR_REFRESH = 200
"""How often it is looked anew whether rows are written more often than readings are refreshed."""


class New(NamedTuple):
    """What came of one surface: commands and positions [deg], each by its times [s], before any fitted correction."""

    command_s: FloatArray
    command_deg: FloatArray
    time_s: FloatArray
    position_deg: FloatArray
    other: Marks = np.zeros(0, dtype=np.int8)
    """Whether other values of its telemetry changed, as `standing` takes it; left out where there are none."""

    @staticmethod
    def of(surface: Surface, commands: tuple[FloatArray, FloatArray], positions: tuple[FloatArray, FloatArray]) -> New:
        """The same of commands and positions as they were logged, each times [s] and values."""
        asked_deg, read_deg = surface.command.plain_deg(commands[1]), positions[1]
        if surface.measured is not None:
            read_deg = surface.measured.plain_deg(read_deg)
        given, known = np.isfinite(asked_deg), np.isfinite(read_deg)
        return New(commands[0][given], asked_deg[given], positions[0][known], read_deg[known])


class Bus:
    """Tells of rows of several surfaces, as they come, whether the telemetry of all of them stands still."""

    def __init__(self, names: Sequence[str]) -> None:
        self._index = {name: k for k, name in enumerate(names)}
        self._memory = new_bus(len(self._index))
        self._asked: dict[str, tuple[float, float]] = {}
        self._read: dict[str, float] = {}
        self.stood_s: list[tuple[float, float]] = []
        """From which last change of a reading until when it stood, each time in the rows that came last [s]."""

    def take(self, new: Mapping[str, New], *, is_all: bool = False) -> dict[str, Marks]:
        """Take what came of some surfaces; of each of their rows, what `standing` says.

        Of a whole log (`is_all`) a bus that is known to stand has stood since a reading changed last, however late that
        shows.

        Examples
        --------
        >>> time_s = np.arange(0.0, 5.0, 0.02)
        >>> def servo(phase):
        ...     asked_deg = 9.0 * np.sin(2.0 * time_s + phase)
        ...     read_deg = np.where((time_s > 3.0) & (time_s < 3.5), asked_deg[150], asked_deg)
        ...     return New(time_s, asked_deg, time_s, read_deg)
        >>> rows = Bus(["a", "b"]).take({"a": servo(0.0), "b": servo(1.0)}, is_all=True)["a"]
        >>> float(time_s[rows == 1].min()), float(time_s[rows == 1].max())
        (3.02, 3.62)
        """
        columns = [self._columns(name, each) for name, each in new.items()]
        if not columns:
            return {}
        unsorted = [np.concatenate(each) for each in zip(*columns, strict=True)]
        order = np.argsort(unsorted[1], kind="stable")
        who, time_s, moved_deg, asked_deg, other = (each[order] for each in unsorted)
        changed_s, stands = last_change_s(self._memory), np.zeros(time_s.size, dtype=np.int8)
        standing(self._memory, who, time_s, moved_deg, asked_deg, other, stands)
        self.stood_s = [
            (float(time_s[:first][moved_deg[:first] != 0.0].max(initial=changed_s)), float(time_s[end - 1]))
            for first, end in stretches(stands != 0)
        ]
        if is_all:
            changed = np.maximum.accumulate(np.where(moved_deg > 0.0, np.arange(time_s.size), -1))
            for k in np.flatnonzero((stands[1:] == 1) & (stands[:-1] != 1)).tolist():
                stands[changed[k] + 1 : k + 1] = 1
        return {name: stands[who == self._index[name]] for name in new}

    def _columns(self, name: str, new: New) -> tuple[NDArray[Any], ...]:
        """Number of the servo, time, motion and command of each new row, and whether other values changed with it."""
        before = self._asked.get(name)
        command_s, command_deg = new.command_s, new.command_deg
        if before is not None:
            command_s, command_deg = np.append(before[0], command_s), np.append(before[1], command_deg)
        if command_s.size:
            self._asked[name] = float(command_s[-1]), float(command_deg[-1])
        asked_deg = latest(command_s, command_deg, new.time_s) if command_s.size else np.zeros(new.time_s.size)
        moved_deg = moved(new.position_deg)
        if new.time_s.size:
            moved_deg[0] = abs(new.position_deg[0] - self._read.get(name, np.inf))
            self._read[name] = float(new.position_deg[-1])
        other = new.other if new.other.size else np.full(new.time_s.size, NO_OTHERS, dtype=np.int8)
        return np.full(new.time_s.size, self._index[name]), new.time_s, moved_deg, asked_deg, other


@dataclass(slots=True)
class Watch:
    """What the marks leave of the positions of one surface, as they come."""

    _rows: list[tuple[float, float, float, int]] = field(default_factory=list)
    """Times [s], positions, commands [deg] and whether the bus stood still, of the last rows."""
    _values: list[float] = field(default_factory=list)
    """What is passed on of each."""
    _waiting: int = 0
    """How many of the last rows are not decided."""
    _run: tuple[float, int] = (float("-inf"), 0)
    """Since when the reading is what it is [s], and how often it has repeated."""
    _step_deg: float = float("inf")
    _refresh_s: float = 0.0
    _seen: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=3 * _ROWS_FOR_REFRESH))
    _count: int = 0

    def take(
        self,
        time_s: FloatArray,
        position_deg: FloatArray,
        asked_deg: FloatArray,
        values: FloatArray | None = None,
        stands: Marks | None = None,
    ) -> list[tuple[float, float]]:
        """Take rows, of shape (n,), and pass on those that are decided and count: their times [s] and `values`.

        `time_s`, `position_deg`, `asked_deg`: as `Rows` has them; a position that is no number is not passed on.
        `values`: what is passed on; positions if left out. `stands`: whether the bus stood still; never if left out.
        """
        passed: list[tuple[float, float]] = []
        flags = stands.tolist() if stands is not None else [0] * time_s.size
        columns = time_s.tolist(), position_deg.tolist(), asked_deg.tolist(), flags
        values_deg = (position_deg if values is None else values).tolist()
        for row, value in zip(zip(*columns, strict=True), values_deg, strict=True):
            if np.isfinite(row[1]) and not (self._rows and row[0] <= self._rows[-1][0]):
                passed += self._next(row, value)
        passed += self._decided(final=False) if self._waiting else []
        if len(self._rows) > _MOST_ROWS and not self._waiting:
            self._forget()
        return passed

    def finish(self) -> list[tuple[float, float]]:
        """What still waited, at the end of the stream."""
        return self._decided(final=True) if self._waiting else []

    def _next(self, row: tuple[float, float, float, int], value: float) -> list[tuple[float, float]]:
        """Take one row; pass it on at once if nothing about it is odd."""
        before = self._rows[-1] if self._rows else None
        self._rows.append(row)
        self._values.append(value)
        self._follow(row)
        jump_deg = float("inf") if before is None else abs(row[1] - before[1])
        is_same = jump_deg == 0.0
        self._run = (self._run[0], self._run[1] + 1) if is_same else (row[0], 0)
        is_plain = ASKED_DEG >= jump_deg > 0.0
        if is_same and self._refresh_s == 0.0:
            is_plain = not is_young(row[0] - self._run[0], self._run[1])
        echoes = abs(row[1] - row[2]) <= TINY_DEG * max(1.0, abs(row[2]))
        if self._waiting or not is_plain or echoes or row[3]:
            self._waiting += 1
            return []
        return [(row[0], value)]

    def _follow(self, row: tuple[float, float, float, int]) -> None:
        """Look now and then how often readings are refreshed."""
        self._seen.append(row[:2])
        self._count += 1
        if self._refresh_s == 0.0 and self._count % _ROWS_FOR_REFRESH == 0:
            self._refresh_s = refresh_of(*np.array(self._seen).T)

    def _decided(self, *, final: bool) -> list[tuple[float, float]]:
        """What of the waiting rows is decided and counts."""
        time_s, position_deg, asked_deg, stands = (np.array(each) for each in zip(*self._rows, strict=True))
        first = len(self._rows) - self._waiting
        rows = Rows(
            time_s, position_deg, asked_deg, np.full(time_s.size, NO_OTHERS, dtype=np.int8), stands.astype(np.int8),
            self._step_deg, self._refresh_s, first,
        )  # fmt: skip
        why, decided = marked(rows, final=final)
        decided = max(decided, first)
        counts = (why <= LAST_WITH_VALUE).tolist()
        passed = [(self._rows[k][0], self._values[k]) for k in range(first, decided) if counts[k]]
        self._waiting = len(self._rows) - decided
        return passed

    def _forget(self) -> None:
        """Drop the oldest rows; of their motion the smallest step is remembered."""
        time_s, position_deg = np.array(self._rows, dtype=float).T[:2]
        kept = min(int(np.searchsorted(time_s, time_s[-1] - _KEPT_S)), time_s.size - _KEPT_ROWS)
        steps_deg = np.abs(np.diff(position_deg[: kept + 1]))
        self._step_deg = min(self._step_deg, float(steps_deg[steps_deg > TINY_DEG].min(initial=np.inf)))
        del self._rows[:kept], self._values[:kept]
