"""Who watches a surface. Of one with two witnesses the position may tell nothing: then its current is watched alone.

The monitor of both goes on meanwhile, with whatever comes, and takes over again as soon as it can judge a position.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from servofd.aircraft.pace import WARM_UP_S
from servofd.core.types import FloatArray, Marks
from servofd.detection.event import Event
from servofd.detection.monitor import SurfaceMonitor

Rows = tuple[FloatArray, FloatArray]
"""Times and values of one channel in order of time, shape (n,) each."""

_BLIND_S: Final = WARM_UP_S + 2.0
"""Positions that come at all have shown their pace by then, and currents as well: so much of these is kept [s]."""


@dataclass(slots=True)
class Witnesses:
    """The monitor of a surface, or one of its current alone, which is `made` anew each time if it has two witnesses."""

    of_both: SurfaceMonitor
    made: Callable[[], SurfaceMonitor] | None = None
    alone: SurfaceMonitor | None = None
    """The one of its current, while no position is judged."""
    past: list[SurfaceMonitor] = field(default_factory=list)
    """Those of its current that found something, and whose time is over."""
    _kept: deque[tuple[float, Rows, Rows]] = field(default_factory=deque)
    """Commands and currents of the last seconds, each after their latest time [s]; none before the current changed."""
    _first_a: float = math.nan
    """The first current that was read [A]: until another is, no servo moves, as before a vehicle is armed."""

    @property
    def watching(self) -> SurfaceMonitor:
        """The one that knows more."""
        is_of_current = self.alone is not None and (self.alone.is_watched or bool(self.alone.standing))
        return self.alone if self.alone is not None and is_of_current else self.of_both

    @property
    def both(self) -> list[SurfaceMonitor]:
        """The monitors that are fed."""
        return [self.of_both] if self.alone is None else [self.of_both, self.alone]

    def feed(
        self, asked: Rows, read: Rows, drawn: Rows, stands: Marks | None, stood_s: Sequence[tuple[float, float]]
    ) -> list[Event]:
        """Take what has come since; arguments as of `SurfaceMonitor.feed`."""
        events = self.of_both.feed(asked, read, stands, stood_s, drawn)
        if self.made is None:
            return events
        self._keep(asked, drawn)
        if self.of_both.is_watched or self.of_both.suspended or self.of_both.standing:
            if self.alone is not None and self.alone.is_calm:
                self.past += [self.alone] if self.alone.faults or self.alone.suspicions else []
                self.alone = None
        elif self.alone is None and self._is_known:
            self.alone = self.made()
            _, asked_each, drawn_each = zip(*self._kept, strict=True)
            asked, drawn = _joined(asked_each), _joined(drawn_each)
        if self.alone is not None:
            why = self.of_both.unjudged
            self.alone.stands_in = f"{why}: watched by its current"
            self.alone.unseen = why if self.of_both.is_heard else ""
            events += self.alone.feed(asked, drawn)
        return events

    def _keep(self, asked: Rows, drawn: Rows) -> None:
        """Add to the commands and currents of the last seconds."""
        if drawn[1].size and math.isnan(self._first_a):
            self._first_a = float(drawn[1][0])
        has_changed = bool(self._kept) or bool(np.any(drawn[1] != self._first_a))
        if has_changed and (asked[0].size or drawn[0].size):
            self._kept.append((max(float(times[-1]) for times, _ in (asked, drawn) if times.size), asked, drawn))
        while len(self._kept) > 1 and self._kept[-1][0] - self._kept[1][0] >= _BLIND_S:
            self._kept.popleft()

    @property
    def _is_known(self) -> bool:
        """Whether so much of its current is known that it can be watched at once."""
        is_long = bool(self._kept) and self._kept[-1][0] - self._kept[0][0] >= _BLIND_S
        return is_long and any(drawn[0].size for *_, drawn in self._kept)

    def silence(self, now_s: float) -> list[Event]:
        """Tell, once in each outage, what has stopped, by the vehicle's newest message [s]; one witness at a time."""
        return next(filter(None, (monitor.silence(now_s) for monitor in self.both)), [])


def _joined(rows: Sequence[Rows]) -> Rows:
    return np.concatenate([times for times, _ in rows]), np.concatenate([values for _, values in rows])
