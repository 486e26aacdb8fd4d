"""After naming: suspicions that are sure become alarms, and what only seemed to end is put together again."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from servofd.detection.bank.classify import name_fault

if TYPE_CHECKING:
    from collections.abc import Iterable

    from servofd.detection.alarm import Episode
    from servofd.detection.bank.flight import Fault, Flight

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
        if result and _same(result[-1], fault) and not _recovered(flight, result[-1], fault):
            result[-1] = replace(result[-1], end_s=fault.end_s)
        else:
            result.append(fault)
    return tuple(result)


def _same(before: Fault, after: Fault) -> bool:
    return before.kind == after.kind and before.level == after.level


def _recovered(flight: Flight, before: Fault, after: Fault) -> bool:
    """Whether the surface was healthy between two faults."""
    if before.end_s is None:
        return False
    window = flight.window(before.end_s, after.start_s, None)
    return window is not None and name_fault(window).kind == "healthy"
