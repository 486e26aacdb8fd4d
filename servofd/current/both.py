"""Two witnesses of one servo, its position and its current: what they tell together, of a log and in flight.

A servo that stands still while it pushes, or without power, is one fault that both tell of. Where the position stands
still and the current says that it moves, the sensor of the position is at fault; where the position follows and the
current says that it stands still, that of the current.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from servofd.core.types import FloatArray
from servofd.current.judge import faults_of, pushed, tells_motion
from servofd.current.model import Seen
from servofd.detection.faults import Found, Named
from servofd.detection.kinds import STANDS_STILL
from servofd.detection.stream import BY_OTHER, Following, Piece, Remembered
from servofd.detection.verdict import Fault, by_gravity

if TYPE_CHECKING:
    from servofd.current.stream import CurrentStream, OfCurrent
    from servofd.detection.seen import HealthyStream, Pace
    from servofd.servo.context import Context

AGREE_S: Final = 15.0
"""Two witnesses tell of one event if they notice it within so much of each other."""
_AT_REST: Final = ("blocked", "unpowered")
"""What a current tells of a servo that stands still."""
_AGAIN_S: Final = 5.0
"""Time between a look that makes nothing of what a current raises and the next: two of the shortest windows [s]."""


class Beside(NamedTuple):
    """What two witnesses tell of each other."""

    position: tuple[Fault, ...]
    current: tuple[Fault, ...]
    is_denied: bool = False
    """Whether the position follows, and the sensor of the current is at fault."""


def beside(
    seen: Seen,
    current: Sequence[Fault],
    position: Sequence[Fault],
    where: tuple[FloatArray, FloatArray],
    *,
    follows: bool,
) -> Beside:
    """Faults of a position and of the current beside it, each as the other leaves it.

    `where` is the position, times [s] and deflections [deg]; `follows` is whether it was judged and is well.
    """
    if follows and any(one.kind in _AT_REST for one in current):
        return Beside(tuple(position), (), is_denied=True)
    still = next((one for one in position if one.kind in STANDS_STILL), None)
    if still is None or current:
        return Beside(tuple(position), tuple(current))
    pushes = pushed(seen, still, where)
    if pushes is None and tells_motion(seen, still.start_s, np.inf if still.end_s is None else still.end_s):
        return Beside(tuple(replace(one, is_of_sensor=one is still) for one in position), ())
    return Beside(tuple(position), () if pushes is None else (pushes,))


def confirmed(positions: Sequence[Fault], currents: Sequence[Fault]) -> tuple[list[Fault], list[Fault]]:
    """Faults that a position tells, those made surer that its current tells as well; and what it tells beside them.

    A servo that stands still while it pushes, or without power, is one fault. Two witnesses that err independently
    multiply their odds, and what only one of them takes for possible is none of its alternatives any more.
    """
    found, left = list(positions), list(currents)
    for place, fault in enumerate(found):
        until_s = np.inf if fault.end_s is None else fault.end_s
        same = [c for c in left if c.kind in _AT_REST and fault.start_s - AGREE_S <= c.start_s <= until_s]
        if fault.kind in STANDS_STILL and same:
            wrong, other = 1.0 - fault.probability, 1.0 - same[0].probability
            right = fault.probability * same[0].probability
            lasts = same[0].kind == "unpowered" and same[0].end_s is None  # though the air moves its surface
            found[place] = replace(
                fault,
                # What the position shows after the current has raised it had begun before: the current tells when.
                start_s=fault.start_s if fault.start_s <= same[0].alarm_s else same[0].start_s,
                alarm_s=min(fault.alarm_s, same[0].alarm_s),
                end_s=None if lasts else fault.end_s,
                probability=right / (right + wrong * other),
                alternatives=(),
                confirmed_by=same[0],
            )
            left = [c for c in left if c not in same]
    return found, left


def agree(known: Sequence[Fault], left: Sequence[Fault]) -> bool:
    """Whether faults of a position and of its current that are of different kinds are of one event."""
    return any(abs(a.start_s - b.start_s) <= AGREE_S for a in known for b in left)


@dataclass(frozen=True, slots=True)
class OfBoth:
    """Position and current of a healthy servo, beside which a stream of both is seen."""

    position: HealthyStream
    current: OfCurrent

    @property
    def stands_loss(self) -> bool:
        """As of its position."""
        return self.position.stands_loss

    @property
    def slowest_hz(self) -> float:
        """As of its position."""
        return self.position.slowest_hz

    @property
    def needs(self) -> frozenset[str]:
        """What acts on either."""
        return self.position.needs | self.current.needs

    def stream(self, pace: Pace) -> Following:
        """See a stream beside it."""
        often_s = min(pace.period_s, self.current.known.noise.period_s)
        return BothStream(self.position.stream(pace), self.current.stream(pace._replace(period_s=often_s)))


class BothStream(Following):
    """One surface that is watched by its position and by its current."""

    is_of_two = True

    def __init__(self, position: Following, current: CurrentStream) -> None:
        self._position, self._current = position, current
        self.history, self.logged = position.history, position.logged
        self.latched = 0
        self._rests_s = -np.inf
        """Until when there is no look at what the current raises [s]."""

    def commands(self, time_s: FloatArray, command_deg: FloatArray) -> None:
        """Add commands [deg], of shape (n,)."""
        self._position.commands(time_s, command_deg)
        self._current.commands(time_s, command_deg)

    def position(self, time_s: float, measured_deg: float) -> None:
        """Add a position."""
        self._position.position(time_s, measured_deg)

    def drawn(self, time_s: float, current: float) -> None:
        """Add a reading of the current, in the unit of its channel."""
        self._current.position(time_s, current)

    @property
    def is_waiting(self) -> bool:
        """Whether any position waits for a command."""
        return self._position.is_waiting

    def lost_share(self, since_s: float) -> float:
        """Share of the commands that were lost since then [s]."""
        return self._position.lost_share(since_s)

    def surroundings(self, context: Context) -> None:
        """Airspeed and supply, as far as they are known by now."""
        self._position.surroundings(context)
        self._current.surroundings(context)

    def again(self) -> None:
        """Begin the tests anew, because the alarm that stood is over."""
        if self._position.latched:
            self._position.again()
        self.latched = 0

    def evaluate(self, *, final: bool = False) -> Piece | None:
        """Evaluate both; what the current raises stands at the end of a piece of the position."""
        drawn, piece = self._current.evaluate(final=final), self._position.evaluate(final=final)
        self.beside = drawn
        if piece is not None and self._current.latched and piece.residuals.time_s[-1] >= self._rests_s:
            self._rests_s, self.latched = float(piece.residuals.time_s[-1]) + _AGAIN_S, BY_OTHER
            piece.alarm[-1] = piece.alarm[-1] or BY_OTHER
            self._current.again()
        self.latched = max(self.latched, self._position.latched)
        return piece

    def finder(self, seen: Remembered, names: dict[float, Named], until_s: float) -> Callable[[], Found]:
        """What an audit finds in a copy of what is remembered of both."""
        first_s = float(seen.residuals.time_s[0])
        drawn = self._current.remembered(seen.residuals.context, first_s, until_s)
        position = self._position.finder(seen, names, until_s)
        return position if drawn is None else partial(self._both, position, drawn, seen)

    def _both(self, position: Callable[[], Found], drawn: Remembered, seen: Remembered) -> Found:
        """Of faults that stand at once the gravest: of a surface one alarm stands."""
        found, readings = position(), self._current.seen(drawn)
        where = seen.residuals.time_s, seen.residuals.measured_deg
        current = faults_of(readings)
        since_s = min((one.start_s for one in current), default=np.inf)
        is_judged = bool(np.any(seen.residuals.settled[where[0] >= since_s]))
        follows = is_judged and not found.faults and not found.suspicions
        both = beside(readings, [one for one in current if one.level == "fault"], found.faults, where, follows=follows)
        known, left = confirmed(both.position, both.current)
        suspicions = (*found.suspicions, *(one for one in current if one.level == "suspect" and not both.is_denied))
        return found._replace(faults=tuple(one_at_a_time([*known, *left])), suspicions=suspicions)


def one_at_a_time(faults: Sequence[Fault]) -> list[Fault]:
    """Of faults that overlap the gravest, in order of time, with what the current says beside the position."""
    kept: list[Fault] = []
    for fault in by_gravity(faults):
        graver = next((k for k, one in enumerate(kept) if _overlap(fault, one)), None)
        if graver is None:
            kept.append(fault)
        elif (fault.witness, kept[graver].witness, kept[graver].other) == ("current", "position", ""):
            kept[graver] = replace(kept[graver], confirmed_by=fault)
    return sorted(kept, key=lambda one: one.start_s)


def _overlap(one: Fault, other: Fault) -> bool:
    first, second = sorted((one, other), key=lambda each: each.start_s)
    return first.end_s is None or first.end_s > second.start_s
