"""Where model and filter have to start anew, and which samples may be judged."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from logparsers.compiled import compiled
from servofd.core.types import BoolArray, FloatArray

if TYPE_CHECKING:
    from servofd.aircraft.segment import Segment

RESTART_NONE, RESTART_FILTER, RESTART_ALL = 0, 1, 2


class StartsMemory(NamedTuple):
    """What one piece of a stream leaves to the next."""

    state: FloatArray
    """Of shape (4,): whether servo and filter have started, the last position that was used [s], the last start [s]."""
    cursor: NDArray[np.int64]
    """Of shape (1,): next command."""


def new_starts_memory() -> StartsMemory:
    """Memory before the first sample."""
    return StartsMemory(np.array([0.0, 0.0, -np.inf, -np.inf]), np.zeros(1, dtype=np.int64))


class Starts(NamedTuple):
    """All arrays of shape (n,), one entry per measurement time."""

    measured_deg: FloatArray
    """NaN where there was no position, or no recent command to judge it by."""
    restart: NDArray[np.int8]
    """What has to start anew at this sample: nothing, the filter, or model and filter."""
    settled: BoolArray
    """True where a position is there and the last start lies far enough back."""


def find_starts(segment: Segment, longest_gap_s: float, blanking_s: float, fresh_s: float = np.inf) -> Starts:
    """Mark the samples of a segment.

    Parameters
    ----------
    longest_gap_s : float
        Longest interval without commands, or without positions, that is bridged [s].
    blanking_s : float
        How long after a start nothing is judged [s].
    fresh_s : float
        Age of a command beyond which the next one is known to have been lost [s].

    Examples
    --------
    >>> from servofd.aircraft.segment import Segment
    >>> time_s = np.array([0.0, 0.1, 0.2, 5.0, 5.1, 5.2])
    >>> starts = find_starts(Segment("x", time_s, time_s, time_s, time_s), 0.3, 0.15)
    >>> starts.restart.tolist(), starts.settled.tolist()
    ([2, 0, 0, 2, 0, 0], [False, False, True, False, False, True])
    """
    return mark_starts(
        new_starts_memory(),
        segment.command_s,
        segment.measured_s,
        segment.measured_deg,
        longest_gap_s,
        fresh_s,
        blanking_s,
    )


def mark_starts(
    memory: StartsMemory,
    command_s: FloatArray,
    measured_s: FloatArray,
    measured_deg: FloatArray,
    longest_gap_s: float,
    fresh_s: float,
    blanking_s: float,
) -> Starts:
    """Mark the next samples, of shape (n,); the memory moves on with them, `command_s` are all commands so far."""
    state, cursor = memory
    size = measured_s.size
    starts = Starts(np.empty(size), np.empty(size, dtype=np.int8), np.empty(size, dtype=bool))
    _mark(
        command_s,
        measured_s,
        measured_deg,
        longest_gap_s,
        fresh_s,
        blanking_s,
        state,
        cursor,
        starts.measured_deg,
        starts.restart,
        starts.settled,
    )
    return starts


@compiled
def _mark(
    command_s: FloatArray,
    measured_s: FloatArray,
    measured_deg: FloatArray,
    longest_gap_s: float,
    fresh_s: float,
    blanking_s: float,
    state: FloatArray,
    cursor: NDArray[np.int64],
    usable_deg: FloatArray,
    restart: NDArray[np.int8],
    settled: BoolArray,
) -> None:
    c = cursor[0]
    servo_known, filter_known = state[0] != 0.0, state[1] != 0.0
    last_used_s, last_start_s = state[2], state[3]
    for k in range(measured_s.size):
        now = measured_s[k]
        while c < command_s.size and command_s[c] <= now:
            # What the servo did while no command was logged for long, nobody knows.
            if c > 0 and command_s[c] - command_s[c - 1] > longest_gap_s:
                servo_known = False
            c += 1
        commanded = c > 0 and now - command_s[c - 1] <= longest_gap_s
        usable = commanded and np.isfinite(measured_deg[k])
        restart[k] = RESTART_NONE
        if commanded and not servo_known:
            restart[k] = RESTART_ALL
            servo_known, filter_known = True, usable
        elif usable and (not filter_known or now - last_used_s > longest_gap_s):
            restart[k] = RESTART_FILTER
            filter_known = True
        if restart[k] != RESTART_NONE:
            last_start_s = now
        if usable:
            last_used_s = now
        usable_deg[k] = measured_deg[k] if usable else np.nan
        # Inside a hole the command is made up from the one after it; at the end of a log there is none.
        made_up = c > 0 and now - command_s[c - 1] > fresh_s
        settled[k] = usable and now - last_start_s >= blanking_s and not made_up
    state[0], state[1], state[2], state[3] = servo_known, filter_known, last_used_s, last_start_s
    cursor[0] = c
