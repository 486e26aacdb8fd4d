"""When an alarm is raised, and when it has been disproved: sample by sample, in flight and in audits alike."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servofd.detection.running import RunningMedian, new_running_median, with_value
from servofd.servo.state import compiled

if TYPE_CHECKING:
    from servofd.core.types import BoolArray, FloatArray

QUIET_SHARE = 0.5
_TRAVEL_TO_CLEAR = 20.0


class LatchMemory(NamedTuple):
    """What one piece of a stream leaves to the next."""

    level: RunningMedian
    state: FloatArray
    """Of shape (6,): play of the immobile residual [deg], travel and travel at the last loud sample [thresholds],
    samples in a row beyond the level with their sign, whether an alarm stands, and the group of loud samples."""


class Latched(NamedTuple):
    """All of shape (n,), one entry per judged sample."""

    alarm: BoolArray
    """True where an alarm is raised."""
    clear: BoolArray
    """True where the alarm that stands has been disproved."""
    group: NDArray[np.int64]
    """Number of the group of loud samples; -1 where it is quiet."""


def new_latch_memory() -> LatchMemory:
    """Memory before the first sample."""
    return LatchMemory(new_running_median(), np.array([np.nan, 0.0, np.nan, 0.0, 0.0, 0.0]))


def latch(
    memory: LatchMemory,
    residual_deg: FloatArray,
    level_deg: FloatArray,
    immobile_deg: FloatArray,
    persistence: int,
    fixed_deg: float,
) -> Latched:
    """Follow the next judged samples, each of shape (n,); `fixed_deg` is a constant level, NaN if it varies.

    Examples
    --------
    An alarm, which a second one joins before the surface has proved to be well:

    >>> residual_deg = np.array([0.0, 2.0, 0.0, 2.0])
    >>> latch(new_latch_memory(), residual_deg, np.full(4, 1.5), np.zeros(4), 1, 1.5).alarm.tolist()
    [False, True, False, False]
    """
    size = residual_deg.size
    result = Latched(np.zeros(size, dtype=bool), np.zeros(size, dtype=bool), np.full(size, -1, dtype=np.int64))
    _latch(memory, residual_deg, level_deg, immobile_deg, float(persistence), fixed_deg, *result)
    return result


@compiled
def _latch(
    memory: LatchMemory,
    residual_deg: FloatArray,
    level_deg: FloatArray,
    immobile_deg: FloatArray,
    persistence: float,
    fixed_deg: float,
    alarm: BoolArray,
    clear: BoolArray,
    group: NDArray[np.int64],
) -> None:
    state = memory.state
    held, travel, loud_travel, row, stands, number = state[0], state[1], state[2], state[3], state[4], state[5]
    for k in range(residual_deg.size):
        # What a large move is, is told by the usual level so far; and by this one, while the command is lively.
        typical = fixed_deg if not np.isnan(fixed_deg) else with_value(memory.level, level_deg[k])
        typical = max(typical, level_deg[k])
        moved = held if not np.isnan(held) else immobile_deg[k]
        moved = min(max(moved, immobile_deg[k] - typical), immobile_deg[k] + typical)
        travel += abs(moved - held) / typical if not np.isnan(held) else 0.0
        held = moved
        size = abs(residual_deg[k])
        proved = travel - loud_travel >= _TRAVEL_TO_CLEAR
        if stands != 0.0 and proved:
            clear[k], stands = True, 0.0
        if size >= QUIET_SHARE * level_deg[k]:
            if proved:
                number += 1.0
            loud_travel = travel
            group[k] = int(number)
        side = 0.0 if size < level_deg[k] else (1.0 if residual_deg[k] > 0.0 else -1.0)
        row = row + side if row * side > 0.0 else side
        if abs(row) >= persistence and stands == 0.0:
            alarm[k], stands = True, 1.0
    state[0], state[1], state[2], state[3], state[4], state[5] = held, travel, loud_travel, row, stands, number
