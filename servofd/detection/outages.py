"""Moments in which a servo gets no command: it holds the last one that arrived, and obeys again when one comes.

The position rests while a good servo would move, and catches up at once. A jam does not catch up, play rests only where
the motion turns.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from servofd.core.types import BoolArray, FloatArray

_AT_REST: Final = 3
"""Least readings of an outage: fewer rest by chance."""
LONGEST_S: Final = 4.0
"""Of an outage: what rests for longer is a jam that came loose."""
_AWAY: Final = 3.0
"""Standard deviations by which a good servo would be elsewhere at its end."""
_SEARCHED_S: Final = 0.6
"""Before the position rests, the command that it stays at arrived: as long as a slow servo takes to get there."""


class Outage(NamedTuple):
    """A moment without commands."""

    from_s: float
    """When the command that is held was sent,"""
    to_s: float
    """and when the next one arrived."""


def outages_in(
    time_s: FloatArray,
    measured_deg: FloatArray,
    error_deg: FloatArray,
    sigma_deg: FloatArray,
    still_deg: float,
    commands: tuple[FloatArray, FloatArray],
    delay_s: float,
) -> tuple[Outage, ...]:
    """Return the moments in which a position rests that a good servo would leave, and after which it is right again.

    `time_s`, `measured_deg`, `error_deg` (what a good servo does not do) and its `sigma_deg` have the shape (m,);
    `still_deg` is how far apart readings of a position at rest are; `commands` are times, and values in degrees of the
    position, (n,); `delay_s` is how late the servo is.
    """
    found: list[Outage] = []
    for first, last in _rests(measured_deg, still_deg):
        away = np.abs(error_deg[first : last + 1]) > _AWAY * sigma_deg[first : last + 1]
        if not away.any() or time_s[last] - time_s[first] > LONGEST_S:
            continue
        command_s, command_deg = commands
        level_deg = float(np.median(measured_deg[first : last + 1]))
        sent = slice(*np.searchsorted(command_s, (time_s[first] - delay_s - _SEARCHED_S, time_s[first])).tolist())
        if sent.start == sent.stop:
            continue
        apart_deg = np.abs(command_deg[sent] - level_deg)
        closest = sent.start + int(np.flatnonzero(apart_deg <= apart_deg.min() + still_deg)[-1])
        to_s = float(time_s[min(last + 1, time_s.size - 1)]) - delay_s
        if found and command_s[closest] <= found[-1].to_s:
            found[-1] = Outage(found[-1].from_s, to_s)
        elif to_s > command_s[closest]:
            found.append(Outage(float(command_s[closest]), to_s))
    return tuple(found)


def _rests(measured_deg: FloatArray, still_deg: float) -> list[tuple[int, int]]:
    """First and last places of readings that stay where they are, before others that move on."""
    found: list[tuple[int, int]] = []
    first = 0
    low = high = float(measured_deg[0]) if measured_deg.size else 0.0
    for place, value in enumerate(measured_deg.tolist()):
        low, high = min(low, value), max(high, value)
        if high - low > 2.0 * still_deg:
            if place - first >= _AT_REST:
                found.append((first, place - 1))
            first, low, high = place, value, value
    return found


def held(
    commands: tuple[FloatArray, FloatArray, FloatArray], outages: tuple[Outage, ...]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the commands that arrived: times, values and slopes, (n,) each; within an outage the last one is held."""
    command_s, command_deg, slope_deg_s = commands[0], commands[1].copy(), commands[2].copy()
    for from_s, to_s in outages:
        lost: BoolArray = (command_s > from_s) & (command_s < to_s)
        before = np.searchsorted(command_s, from_s, side="right") - 1
        if before >= 0:
            command_deg[lost], slope_deg_s[lost] = command_deg[before], 0.0
            slope_deg_s[before] = 0.0
    return command_s, command_deg, slope_deg_s
