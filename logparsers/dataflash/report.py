"""What was found wrong with a DataFlash log, in the words every reader uses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from logparsers.dataflash.scan import BACK_US
from logparsers.dataflash.store import Step, Store, Stretch
from logparsers.records import Damage

REBOOT_US: Final = 1_000_000
"""Pause that is put between two runs of the clock in one file [us]; the true one is unknown."""
JUMP_US: Final = 86_400_000_000
"""Longest pause of a log [us], a day: a stamp that is further ahead is damaged."""
PAGE: Final = 528
"""Bytes that boards which log to flash pages leave unused at the end at most."""
WORDS: Final = {
    "zeros": "zeros",
    "erased": "erased memory (FF)",
    "garbage": "no record",
    "cut_record": "a record that is cut short",
    "unknown_type": "a message whose definition is missing",
    "truncated": "the file ends inside a record",
    "bad_line": "not a complete line of a known message",
}


def describe(store: Store, boots: Boots) -> tuple[Damage, ...]:
    """List everything that is wrong with a log.

    Result: kind ``"corrupt"`` or ``"truncated"`` (`count`: bytes), ``"gap"``, ``"reboot"``, and ``"bad_format"``.
    Unused space at the end of the last flash page is not damage.
    """
    damage = [_stretch(s, boots) for s in store.stretches if not _is_padding(s, store.size)]
    number, size = store.more_stretches
    if number:
        damage.append(Damage("corrupt", f"{number} more damaged stretches, {size} bytes", size))
    damage += [_step(s, boots) for s in store.steps]
    damage += [Damage("bad_format", note) for note in store.notes]
    return tuple(damage)


@dataclass(frozen=True)
class Boots:
    """How a log goes on where its clock begins again, or jumps ahead: one second after the last record before.

    Examples
    --------
    >>> boots = Boots([Step(400, 9_000_000, 2_000_000)])
    >>> [boots.shift_us(np.array([399, 400])).tolist()], boots.seconds(2_000_000, 400)
    ([[0, 8000000]], 10.0)
    """

    steps: Sequence[Step]

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

    def seconds(self, time_us: int | None, offset: int) -> float | None:
        """Time of a record at this place, on the time base of the log [s]."""
        return None if time_us is None else (time_us + int(self.shift_us(np.array(offset)))) / 1.0e6


def _is_padding(stretch: Stretch, size: int) -> bool:
    at_end = stretch.offset + stretch.length == size
    return at_end and stretch.length <= PAGE and stretch.kind in ("zeros", "erased")


def _stretch(stretch: Stretch, boots: Boots) -> Damage:
    kind = "truncated" if stretch.kind == "truncated" else "corrupt"
    note = f"{stretch.length} bytes at byte {stretch.offset}: {WORDS[stretch.kind]}"
    end = stretch.offset + stretch.length
    before, after = boots.seconds(stretch.before_us, stretch.offset), boots.seconds(stretch.after_us, end)
    return Damage(kind, note, stretch.length, before, after)


def _step(step: Step, boots: Boots) -> Damage:
    ends = boots.seconds(step.before_us, step.offset - 1), boots.seconds(step.after_us, step.offset)
    before, after = step.before_us / 1.0e6, step.after_us / 1.0e6
    if step.after_us < step.before_us - BACK_US:
        note = f"the clock went back from {before:.3f} s to {after:.3f} s: reboot, or two logs in one file"
        return Damage("reboot", note, 1, *ends)
    if step.after_us > step.before_us + JUMP_US:
        note = f"the clock jumps from {before:.3f} s to {after:.3f} s; times run on one second after"
        return Damage("clock_jump", note, 1, *ends)
    return Damage("gap", f"nothing logged for {after - before:.3f} s", 1, *ends)
