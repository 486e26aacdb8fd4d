"""Telemetry that repeats itself: rows keep coming, but nothing in them is new."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servofd.core.types import BoolArray, FloatArray

_SHORTEST_S = 0.5
_REPUBLISHED_S = 0.1
_LATE_BUS_S, _LATE_DEG = 0.25, 0.5
"""A bus that has lost a few answers goes on within this time; those of an ArduPilot's servos came up to 0.2 s late."""
_COMMAND_MOVES_DEG = 1.0
_EXPECTED_CHANGES = 3.0


def frozen_rows(
    time_s: FloatArray, position: FloatArray, siblings: Sequence[FloatArray], command_deg: FloatArray
) -> BoolArray:
    """Rows in which a dead telemetry repeats its last words.

    A driver that has lost its servo may send the last angle for seconds, with fresh time stamps: it looks like a
    jam. But a jammed servo still measures its voltage, current and temperature. A stretch is frozen if position
    and all siblings are the same to the last bit throughout, the command moved meanwhile, and the siblings, at
    the pace at which they change elsewhere, should have changed at least three times.

    Parameters
    ----------
    time_s, position : ndarray, shape (n,)
        Rows of the telemetry.
    siblings : sequence of ndarray, shape (n,)
        Other fields of the same rows.
    command_deg : ndarray, shape (n,)
        Command at each row [deg].

    Returns
    -------
    ndarray of bool, shape (n,)
        True where the row says nothing.

    Examples
    --------
    >>> time_s = np.arange(0.0, 10.0, 0.02)
    >>> moving = np.sin(time_s)
    >>> volts = np.round(5.0 + 0.01 * np.sin(50.0 * time_s), 2)
    >>> dead = (time_s > 4.0) & (time_s < 8.0)
    >>> last = np.flatnonzero(dead)[0]
    >>> position, supply = np.where(dead, moving[last], moving), np.where(dead, volts[last], volts)
    >>> rows = frozen_rows(time_s, position, [supply], 9 * moving)
    >>> bool(np.all(rows[dead])), int(np.count_nonzero(rows & ~dead)) < 3
    (True, True)
    >>> bool(frozen_rows(time_s, np.where(dead, 0.0, moving), [volts], 9 * moving).any())
    False
    """
    rows = np.zeros(time_s.size, dtype=bool)
    if not siblings or time_s.size < 2:
        return rows
    same_position = _same_as_before(position)
    same_sibling = np.all([_same_as_before(values) for values in siblings], axis=0)
    elsewhere = ~same_position
    changes = int(np.count_nonzero(~same_sibling[1:] & elsewhere[1:]))
    per_row = changes / max(int(np.count_nonzero(elsewhere[1:])), 1)
    firsts, lasts = _runs(same_position)
    long_enough = (time_s[lasts] - time_s[firsts] >= _SHORTEST_S) & ((lasts - firsts) * per_row >= _EXPECTED_CHANGES)
    for first, last in zip(firsts[long_enough], lasts[long_enough], strict=True):
        alive = not np.all(same_sibling[first + 1 : last + 1])
        if not alive and np.ptp(command_deg[first : last + 1]) >= _COMMAND_MOVES_DEG:
            rows[first : last + 1] = True
    return rows


def held_rows(time_s: FloatArray, position_deg: FloatArray, healthy_deg: FloatArray) -> BoolArray:
    """Rows in which a late bus repeats its last answer, for up to a quarter of a second, while a healthy servo moves.

    Examples
    --------
    >>> position_deg = np.array([0.0, 1.0, 1.0, 2.0, 2.0, 2.0])
    >>> held_rows(np.array([0.0, 0.1, 0.2, 0.3, 0.5, 0.7]), position_deg, np.arange(6.0)).tolist()
    [False, False, True, False, False, False]
    """
    rows = np.zeros(time_s.size, dtype=bool)
    if time_s.size < 2:
        return rows
    same = _same_as_before(position_deg)
    firsts, lasts = _runs(same)
    late = (time_s[lasts] - time_s[firsts] <= _LATE_BUS_S) & (
        np.abs(healthy_deg[lasts] - healthy_deg[firsts]) >= _LATE_DEG
    )
    rows[np.flatnonzero(same)] = np.repeat(late, lasts - firsts)
    return rows


def republished_rows(time_s: FloatArray, position: FloatArray, siblings: Sequence[FloatArray]) -> BoolArray:
    """Rows that only repeat the one before, because the servo answers more slowly than rows are written.

    Such a row has a fresh time stamp and an old position. Repetitions that last for 0.1 s and more are left
    alone: a surface at rest, or a jam.

    Examples
    --------
    >>> position = np.array([0.0, 1.0, 1.0, 2.0, 2.0, 3.0])
    >>> republished_rows(np.arange(6) * 0.02, position, []).tolist()
    [False, False, True, False, True, False]
    """
    rows = np.zeros(time_s.size, dtype=bool)
    if time_s.size < 2:
        return rows
    same = np.all([_same_as_before(values) for values in (position, *siblings)], axis=0)
    firsts, lasts = _runs(same)
    short = np.repeat(time_s[lasts] - time_s[firsts] < _REPUBLISHED_S, lasts - firsts)
    rows[np.flatnonzero(same)] = short
    return rows


@dataclass(slots=True)
class Republished:
    """What `republished_rows` leaves of the positions of a stream.

    A position that repeats the one before waits until it is known whether it goes on repeating.

    Examples
    --------
    >>> stream = Republished()
    >>> [len(stream.without([(0.02 * k, deg)])) for k, deg in enumerate([0.0, 1.0, 1.0, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0])]
    [1, 1, 0, 1, 0, 0, 0, 0, 5]
    """

    _begun: tuple[float, float] = (float("nan"), float("nan"))
    """Since when [s] a position is what it is."""
    _waiting: list[tuple[float, float]] = field(default_factory=list)

    def without(self, rows: list[tuple[float, float]]) -> list[tuple[float, float]]:
        """The next rows of time [s] and value, without those that only repeat; some may come later."""
        found = []
        for row in rows:
            if row[1] != self._begun[1]:
                self._begun = row
                self._waiting.clear()
                found.append(row)
                continue
            self._waiting.append(row)
            if row[0] - self._begun[0] >= _REPUBLISHED_S:
                found += self._waiting
                self._waiting.clear()
        return found


def _same_as_before(values: FloatArray) -> BoolArray:
    """True where a row repeats the one before to the last bit (a missing value repeats a missing one)."""
    same = np.zeros(values.size, dtype=bool)
    same[1:] = (values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))
    return same


def _runs(same: BoolArray) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First and last row of each stretch of repetitions, the row that is repeated included."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(np.int8)))
    return edges[::2] - 1, edges[1::2] - 1
