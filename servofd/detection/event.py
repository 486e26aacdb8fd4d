"""What a monitor says of a surface, and what it remembers of an alarm that stands."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from logparsers.protocol import Severity

if TYPE_CHECKING:
    from collections.abc import Callable

    from servofd.core.types import FloatArray
    from servofd.detection.faults import Found, Named
    from servofd.detection.residual import Residuals, Threshold
    from servofd.detection.stream import Piece
    from servofd.detection.verdict import Fault
    from servofd.servo.context import Context

QUIET_S = 0.75
"""After so long in quiet the bank looks whether an alarm is over,"""
QUIET_SHARE = 0.5
"""where below this share of its threshold a residual is quiet,"""
_PAUSE_S, _LONGEST_PAUSE_S = 0.4, 1.5
"""and again after pauses that grow with each look in vain."""


@dataclass(slots=True)
class Quiet:
    """How long the residual of a surface in alarm has been quiet."""

    since_s: float = float("inf")
    """Since when it is quiet [s]; infinite if it is not."""
    _asked_s: float = float("-inf")
    _asked: int = 0

    def follow(self, piece: Piece) -> None:
        """Take the next samples."""
        residuals, level_deg = piece.residuals, piece.threshold.level_deg
        judged, time_s = residuals.settled, residuals.time_s
        last = np.flatnonzero(judged & ~(np.abs(residuals.residual_deg) < QUIET_SHARE * level_deg))
        if last.size:
            self.since_s, time_s, judged = np.inf, time_s[last[-1] + 1 :], judged[last[-1] + 1 :]
        begun = np.flatnonzero(judged)
        if begun.size:
            self.since_s = min(self.since_s, float(time_s[begun[0]]))

    @property
    def asked_again_s(self) -> float:
        """When the bank should look next if it stays quiet [s]; infinite while it is not quiet."""
        return max(self._asked_s + min(_PAUSE_S * (1 + self._asked), _LONGEST_PAUSE_S), self.since_s + QUIET_S)

    def due_s(self, now_s: float) -> list[float]:
        """When the bank should have looked by now [s], if it should."""
        due_s = self.asked_again_s
        if now_s < due_s:
            return []
        self._asked_s, self._asked = due_s, self._asked + 1
        return [due_s]


EventKind = Literal["alarm", "clear", "named", "no_data", "link_lost", "link_restored"]


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened, on the clock of the vehicle."""

    time_s: float
    surface: str
    event: EventKind
    kind: str = ""
    """Of the fault; `unknown` until the bank has named it, `healthy` for an alarm that a working servo explains."""
    residual_deg: float = float("nan")
    threshold_deg: float = float("nan")
    text: str = ""
    """More, in words."""
    fault: Fault | None = None
    id: str = ""
    """Of the alarm that it begins, names or ends (`servofd.live.alarms`); empty where it does none of these."""
    severity: Severity = Severity.INFO
    vehicle: int = 0
    """Its system id; 0 where there is none, as in a log of another kind."""
    boot: int = 1
    """Of the vehicle, whose time it is: the first that was received is 1."""


class Reading(NamedTuple):
    """Where a surface stands."""

    time_s: float
    command_deg: float
    measured_deg: float
    residual_deg: float
    threshold_deg: float
    settled: bool


class Inputs(NamedTuple):
    """What samples were evaluated with."""

    asked_deg: FloatArray
    """Command at each of them, shape (n,) [deg]."""
    command_s: FloatArray
    """Commands that have come since the samples before, shape (m,) [s],"""
    command_deg: FloatArray
    """and what they asked for [deg]."""
    context: Context
    is_current: bool = False
    """Whether they are of the current beside a position [A]."""


class Look(NamedTuple):
    """A copy of what is known of a surface."""

    at_s: float
    residuals: Residuals
    threshold: Threshold
    find: Callable[[], Found]
    """Faults and suspicions; depends on nothing else."""


@dataclass(slots=True)
class Alarm:
    """An alarm that stands."""

    raised_s: float
    kind: str = "unknown"
    reported: str = "unknown"
    """The name that was published; `kind` is what the last look takes it for."""
    fault: Fault | None = None
    quiet: Quiet = field(default_factory=Quiet)
    names: dict[float, Named] = field(default_factory=dict)
    """What the looks at it have fitted."""
    in_vain: int = 0
    """How many looks in a row have found no fault."""
