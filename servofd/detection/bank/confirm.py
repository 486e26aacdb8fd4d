"""After naming: suspicions that are sure become alarms, and what only seemed to end is put together again."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from servofd.detection.bank.classify import name_fault

if TYPE_CHECKING:
    from collections.abc import Iterable

    from servofd.detection.alarm import Episode
    from servofd.detection.bank.isolate import Fault, Flight

__all__ = ["SURE", "confirmed", "joined"]

SURE = 0.95
"""Probability from which a name counts as certain."""


def confirmed(named: tuple[Fault, ...], episode: Episode) -> tuple[Fault, ...]:
    """Turn a suspicion into an alarm if the bank can name it for sure.

    The alarm is raised when the name is: with the last sample of the window that told it. A crossing of the threshold
    before that remains the alarm.
    """
    first = named[0]
    if first.named_s is None or first.probability < SURE or first.kind in ("healthy", "unknown"):
        return named
    if episode.level == "suspect":
        return (replace(first, level="fault", alarm_s=first.named_s), *named[1:])
    return named


def joined(flight: Flight, faults: Iterable[Fault]) -> tuple[Fault, ...]:
    """Join neighbours of one kind unless the surface was healthy in between.

    A small lasting fault may stay below half of its threshold for a while, which looks like an end.
    """
    result: list[Fault] = []
    for fault in faults:
        before = result[-1] if result else None
        if before is None or before.end_s is None or before.kind != fault.kind or before.level != fault.level or _recovered(flight, before.end_s, fault.start_s):
            result.append(fault)
        else:
            result[-1] = replace(before, end_s=fault.end_s)
    return tuple(result)


def _recovered(flight: Flight, from_s: float, until_s: float) -> bool:
    window = flight.window(from_s, until_s, None)
    return window is not None and name_fault(window).kind == "healthy"
