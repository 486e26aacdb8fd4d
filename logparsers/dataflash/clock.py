"""The clock of a DataFlash log: where it stands still, jumps or begins again, and which stamps are wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from logparsers.records import Damage

A_FEW: Final = 64
"""Records that are taken one by one before the rest is tried as a whole again."""
LISTED: Final = 1000
"""Stretches, steps and notes that are listed one by one."""
NO_TIME: Final = -1
"""Stamp of a row that cannot be one."""
MOST_US: Final = 2**48
"""Latest time stamp [us]: more than eight years."""
CONFIRM: Final = 4
"""Records that must agree before a jump of the clock is believed."""
GAP_US: Final = 1_000_000
"""Silence of all messages that is worth a line in the report [us]."""
BACK_US: Final = 2_000_000
"""How far a stamp may go back [us]: some messages carry the time of their measurement, not of their writing."""
JUMP_US: Final = 86_400_000_000
"""Longest pause of a log [us], a day: a stamp that is further ahead is damaged."""
REBOOT_US: Final = 1_000_000
"""Pause that is put between two runs of the clock in one file [us]; the true one is unknown."""
AT_ONCE: Final = 1 << 16
"""Records that are followed as a whole at most."""


@dataclass(frozen=True, slots=True)
class Step:
    """The clock went from one time to another without passing between.

    `offset`: first record after it [bytes]. `before_us`, `after_us`: the vehicle's time before and after it [us].
    """

    offset: int
    before_us: int
    after_us: int


class Clock:
    """The clock that several messages share, and how times go on where it begins again or jumps ahead.

    `times_us`, `offsets` (shape (n_i,)): time stamps [us] and places [bytes] of the records of each message. `odd`:
    places of records whose stamp contradicts the records around them. `steps`: gaps and jumps, the first `LISTED`.
    """

    def __init__(self, times_us: Sequence[NDArray[np.int64]], offsets: Sequence[NDArray[Any]]) -> None:
        places = np.concatenate([np.zeros(0, np.int64), *offsets])
        order = np.argsort(places, kind="stable")
        self._places, times = places[order], np.concatenate([np.zeros(0, np.int64), *times_us])[order]
        self._times = np.where((times >= 0) & (times < MOST_US), times, NO_TIME)
        following = _Following(self._times)
        following.follow()
        self._odd_rows = following.odd
        self._step_rows = [row for row, _, _ in following.steps]
        self.odd = self._places[following.odd]
        self.steps = [Step(int(self._places[row]), *ends) for row, *ends in following.steps[:LISTED]]

    @cached_property
    def _believed(self) -> NDArray[np.int64]:
        """Latest stamp up to each record that is believed, since the clock began or jumped, shape (n,) [us]."""
        times = self._times.copy()
        times[self._odd_rows] = NO_TIME
        for first, last in pairwise([0, *self._step_rows, times.size]):
            np.maximum.accumulate(times[first:last], out=times[first:last])
        return times

    def around(self, begin: int, end: int, limit: int) -> tuple[float | None, float | None]:
        """Time before and after a stretch of the file, if a stamp follows it before a limit [s]."""
        first, last = np.searchsorted(self._places, [begin, end]).tolist()
        before = int(self._believed[first - 1]) if first else NO_TIME
        after = int(self._times[last]) if last < self._places.size and self._places[last] < limit else NO_TIME
        return self.seconds(before, begin), self.seconds(after, end)

    @cached_property
    def _runs(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Where a clock begins again [bytes]; what to add to it before the first such place, from it on, ... [us]."""
        again = [step for step in self.steps if not -BACK_US <= step.after_us - step.before_us <= JUMP_US]
        shifts = [0, *(step.before_us + REBOOT_US - step.after_us for step in again)]
        return np.array([step.offset for step in again], np.int64), np.cumsum(np.array(shifts, np.int64))

    def shift_us(self, offsets: NDArray[Any]) -> NDArray[np.int64] | np.int64:
        """What to add to the clock of the records at these places [us]; 0 if it never began again."""
        starts, shifts = self._runs
        return shifts[np.searchsorted(starts, offsets, side="right")] if starts.size else np.int64(0)

    def seconds(self, time_us: int, offset: int) -> float | None:
        """Time of a record at this place, on the time base of the log [s]; None of `NO_TIME`."""
        return None if time_us == NO_TIME else (time_us + int(self.shift_us(np.array(offset)))) / 1.0e6

    def damage(self) -> list[Damage]:
        """Each step, in words."""
        return [self._described(step) for step in self.steps]

    def _described(self, step: Step) -> Damage:
        ends = self.seconds(step.before_us, step.offset - 1), self.seconds(step.after_us, step.offset)
        before, after = step.before_us / 1.0e6, step.after_us / 1.0e6
        if step.after_us < step.before_us - BACK_US:
            note = f"the clock went back from {before:.3f} s to {after:.3f} s: reboot, or two logs in one file"
            return Damage("reboot", note, 1, *ends)
        if step.after_us > step.before_us + JUMP_US:
            note = f"the clock jumps from {before:.3f} s to {after:.3f} s; times run on one second after"
            return Damage("clock_jump", note, 1, *ends)
        return Damage("gap", f"nothing logged for {after - before:.3f} s", 1, *ends)


class _Following:
    """A clock that is followed; an unlikely step waits until `CONFIRM` records agree on it."""

    def __init__(self, times: NDArray[np.int64]) -> None:
        self._times, self._now, self._waiting = times, NO_TIME, list[int]()
        self.odd: list[int] = []
        """Rows whose stamp is wrong."""
        self.steps: list[tuple[int, int, int]] = []
        """Gaps and jumps: row, from, to."""

    def follow(self) -> None:
        """Follow all of it: by whole arrays as long as it runs on, and row by row from where it does not."""
        row, stride, single = 0, A_FEW, 0
        while row < self._times.size:
            if not single and self._now != NO_TIME and not self._waiting:
                count = self._runs_on(row, stride)
                stride, single = (min(8 * stride, AT_ONCE) if count == stride else A_FEW), 0 if count else A_FEW
                row += count
            else:
                self._watch(row, int(self._times[row]))
                row, single = row + 1, max(single - 1, 0)
        # At the end fewer than `CONFIRM` records may tell of a gap, but not of a reboot.
        if self._waiting and self._now != NO_TIME and self._times[self._waiting[0]] < self._now:
            self._reject()
        self._settle()

    def _runs_on(self, row: int, most: int) -> int:
        """How many rows from here on have likely stamps; the clock is theirs then."""
        times = self._times[row : row + most]
        latest = np.maximum.accumulate(np.append(self._now, times))
        step = times - latest[:-1]
        unlikely = np.flatnonzero((times == NO_TIME) | (step < -BACK_US) | (step > GAP_US))
        count = int(unlikely[0]) if unlikely.size else times.size
        self._now = int(latest[count])
        return count

    def _watch(self, row: int, time: int) -> None:
        if time == NO_TIME:
            self.odd.append(row)
            return
        if self._now != NO_TIME and -BACK_US <= time - self._now <= GAP_US:
            self._reject()
            self._now = max(self._now, time)
            return
        if self._waiting and not -BACK_US <= time - self._times[self._waiting[-1]] <= JUMP_US:
            self._reject()
        self._waiting.append(row)
        if len(self._waiting) == CONFIRM:
            self._settle()

    def _reject(self) -> None:
        """Disbelieve the waiting time stamps: they came and went, so those records are damaged."""
        self.odd += self._waiting
        self._waiting.clear()

    def _settle(self) -> None:
        """Believe the waiting time stamps: the clock did jump, or nothing was logged for a while."""
        for row in self._waiting:
            time = int(self._times[row])
            step = time - self._now
            if self._now != NO_TIME and not -BACK_US <= step <= GAP_US:
                self.steps.append((row, self._now, time))
            if self._now == NO_TIME or step > 0 or step < -BACK_US:
                self._now = time
        self._waiting.clear()
