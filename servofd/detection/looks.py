"""The alarm of one surface: what raises it, the looks that name it, and its end.

An alarm leaves at once. What it is, the bank tells from a copy of the last minutes (`servofd.detection.event.Look`),
which may be judged by another thread; how samples come is no matter of this module (`servofd.detection.monitor`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from servofd.detection.event import QUIET_S, Alarm, Event, Look
from servofd.detection.faults import AGAIN_S, LOOKS_BACK_S, LOOKS_S
from servofd.detection.kinds import STANDS_STILL
from servofd.detection.stream import BY_OTHER, BY_WINDOWS, Remembered
from servofd.detection.verdict import EVEN, EXPLAINED, SURE
from servofd.servo.context import NO_CONTEXT, Context

if TYPE_CHECKING:
    from servofd.aircraft.schema import Surface
    from servofd.core.types import FloatArray
    from servofd.detection.event import EventKind
    from servofd.detection.faults import Found
    from servofd.detection.stream import Following, Piece
    from servofd.detection.verdict import Fault


_NAMED_S = 2.0
"""A name follows its alarm within this time, or is reported where it is sure [s]."""
_LOOKS_S = (*LOOKS_S[1:], 6.0)
"""How long after an alarm the bank looks at it; the last one that may name it leaves the bank time to think,"""
_LOOKS_AGAIN_S = 30.0
"""and how often after that: sooner while no name is likely, after as long as the alarm has stood."""
_AGAIN_S = 1.0
"""When a look has found nothing of a fault that one before has named, the next one follows so much later [s]."""
_OTHER_S, _OTHER_UNTIL_S = 5.0, 60.0
"""How often a current is asked about a position that stands still, and until how long after its alarm [s]."""
_MOVED_DEG = 1.0
"""A surface that is further from where it was taken to be stuck, and from what is known of that, is looked at anew."""
_TOLD = 0.8
"""A name of this probability is reported with the first look, others from the second one on."""


@dataclass(slots=True)
class Looks:
    """What stands, and when the bank looks at it next."""

    name: str
    surface: Surface
    problem: str = field(default="", init=False)
    """Why nothing is concluded from what is read; empty if there is no reason."""
    stream: Following | None = field(default=None, init=False)
    """What is looked at; None while it has not begun."""
    context: Context = field(default=NO_CONTEXT, init=False)
    suspicions: tuple[Fault, ...] = field(default=(), init=False)
    """What the last look found that is no fault."""
    alarm: Alarm | None = field(default=None, init=False)
    """The one that stands."""
    _doubtful: Alarm | None = field(default=None, init=False)
    """One that windows alone have raised and no look has confirmed: it is not reported yet."""
    _crossed: tuple[float, float, float] | None = field(default=None, init=False)
    """When the residual crossed its threshold [s], both then [deg], of an alarm that is not raised yet."""
    _finished: list[Fault] = field(default_factory=list, init=False)
    _passing: list[Fault] = field(default_factory=list, init=False)
    """Over before a look could name them."""
    _from_s: float = field(default=-np.inf, init=False)
    """Since when the last fault is over [s]: what was before is not judged again."""
    _due_s: list[float] = field(default_factory=list, init=False)

    @property
    def quantity(self) -> Literal["position", "current"]:
        """What is read of it."""
        return "current" if self.surface.is_told_by_current else "position"

    @property
    def standing(self) -> str:
        """Kind of the fault that stands; empty if there is none."""
        return self.alarm.kind if self.alarm is not None else ""

    @property
    def is_calm(self) -> bool:
        """Whether no alarm stands, and none is looked into."""
        return self.alarm is None and self._doubtful is None

    @property
    def next_s(self) -> float:
        """When the bank looks next, as far as is known now [s]."""
        asked_s = self.alarm.quiet.asked_again_s if self.alarm is not None else np.inf
        return min([asked_s, *self._due_s])

    @property
    def faults(self) -> tuple[Fault, ...]:
        """What was found so far, in order of time; each as the last look at it found."""
        stands = self.alarm.fault if self.alarm is not None else None
        return (*self._finished, *(() if stands is None else (stands,)))

    @property
    def has_fault(self) -> bool:
        """Whether any alarm was raised that the tolerances of a working servo do not explain."""
        return self.alarm is not None or bool(self._finished)

    def _taken(self, piece: Piece) -> list[Event]:
        """The alarm that the next samples raise; when they, or their quiet, are to be looked at is noted."""
        residuals = piece.residuals
        is_by_other = self._crossed_in(piece)
        events = self._raised()
        if self.alarm is not None:
            self.alarm.quiet.follow(piece)
            last_s = float(residuals.time_s[-1])
            due_s = [] if is_by_other else self.alarm.quiet.due_s(last_s)
            soon_s = last_s + _AGAIN_S
            if min(self._due_s, default=np.inf) > soon_s and _has_moved(self.alarm.fault, residuals.measured_deg):
                due_s = [*due_s, soon_s]
            self._due_s = sorted([*self._due_s, *due_s])
        return events

    def _taken_back(self, from_s: float, until_s: float) -> list[Event]:
        """Take back an alarm between two times at which the telemetry of all surfaces turns out to have stood [s]."""
        if self._crossed is not None and from_s < self._crossed[0] <= until_s:
            self._crossed = None
        alarm = self.alarm or self._doubtful
        if alarm is None or self.stream is None or not from_s < alarm.raised_s <= until_s:
            return []
        is_reported = self.alarm is not None
        self.stream.history.forget(from_s, until_s)
        self._from_s = until_s  # a look that is under way may not raise it again
        self._over(until_s)
        text = f"positions of all servos stood still from {from_s:.1f} to {until_s:.1f} s"
        return [Event(until_s, self.name, "clear", "unknown", text=text)] if is_reported else []

    def _begin_looks(self) -> None:
        """Begin anew, because the stream does; what was found is kept."""
        if self.alarm is not None and self.alarm.fault is not None:
            self._finished.append(self.alarm.fault)
        self.problem = ""
        self._over(np.nan)
        self.stream = None

    def due(self) -> Look | None:
        """What the bank should look at now, if anything."""
        history = self.stream.history if self.stream is not None else None
        if history is None or not self._due_s or not history.last_s >= self._due_s[0]:
            return None
        at_s = history.first_from(self._due_s[0])  # what has come since is for the next look
        while self._due_s and self._due_s[0] <= at_s:
            last_s = self._due_s.pop(0)
        if not self._due_s and self.alarm is not None:
            fault, age_s = self.alarm.fault, last_s - self.alarm.raised_s
            is_likely = fault is not None and fault.probability >= EVEN
            self._due_s.append(last_s + (_LOOKS_AGAIN_S if is_likely else min(age_s, _LOOKS_AGAIN_S)))
        return self.look(at_s)

    def events_of(self, look: Look, found: Found) -> list[Event]:
        """Take what the bank made of a look.

        A fault that only the bank finds is one event, an alarm with its name. Later than `_NAMED_S` after the alarm a
        name that is sure takes the place of another one; all else is kept for the report.
        """
        self.problem = found.against
        faults, suspicions = ((), ()) if found.against else (found.faults, found.suspicions)
        self.suspicions = (*self._passing, *suspicions)
        alarm, events, is_seen = self.alarm, [], False
        for fault in faults:
            before_s = np.inf if alarm is None else alarm.raised_s
            # An earlier look has seen it end, or it was over before anything was raised: what a fault leaves behind.
            is_new = fault.alarm_s >= self._from_s and (fault.end_s is None or not fault.end_s < before_s < np.inf)
            if is_new and (alarm is not None or fault.end_s is None or fault.kind != "unknown"):
                events += self._seen(look, fault)
                is_seen = True
        if alarm is not None and alarm is self.alarm:
            events += self._doubted(alarm, look) if not is_seen else []
        if self.alarm is None:
            events += self._raised()
        if self.stream is not None and self.stream.latched and self.alarm is None and not self._due_s:
            self._over(look.at_s)
        return events

    def _seen(self, look: Look, fault: Fault) -> list[Event]:
        """What a fault changes: an alarm is raised, has a name, or is over."""
        events, alarm = [], self.alarm
        if fault.alarm_s > look.at_s:  # by its current, after the last of its positions
            look = look._replace(at_s=fault.alarm_s + _LOOKS_S[1])
        if alarm is None:
            alarm = self.alarm = self._doubtful or Alarm(fault.alarm_s)
            self._doubtful = None
            if not self._may_be_named(look, alarm, fault):
                return [replace(self._event(look, "alarm", fault), kind="unknown", fault=None)]
            events.append(self._event(look, "alarm", fault))
            alarm.reported = fault.kind
        elif fault.kind != alarm.reported and (look.at_s - alarm.raised_s <= _NAMED_S or fault.probability >= SURE):
            if not self._may_be_named(look, alarm, fault):
                return events
            events.append(self._event(look, "named", fault))
            alarm.reported = fault.kind
        elif alarm.fault is not None and fault.other not in ("", alarm.fault.other):
            events.append(self._event(look, "named", fault))
            alarm.reported = fault.kind
        alarm.kind, alarm.fault, alarm.in_vain = fault.kind, fault, 0
        self._look_later(look, fault)
        is_asked = self.stream is not None and self.stream.is_of_two and fault.kind in STANDS_STILL
        soon_s = look.at_s + _OTHER_S
        if is_asked and not fault.other and alarm.raised_s + _OTHER_UNTIL_S > soon_s < min(self._due_s, default=np.inf):
            self._due_s = sorted([*self._due_s, soon_s])
        if fault.end_s is not None:
            is_nameless = fault.kind == alarm.reported == "unknown"
            is_passing = is_nameless and fault.end_s - fault.start_s < _NAMED_S
            (self._passing if is_passing else self._finished).append(fault)
            self.suspicions = (*self._passing, *(one for one in self.suspicions if one not in self._passing))
            self._from_s = max(fault.end_s, fault.alarm_s) + AGAIN_S
            self._over(look.at_s)
            events.append(self._event(look, "clear", fault))
        return events

    @staticmethod
    def _may_be_named(look: Look, alarm: Alarm, fault: Fault) -> bool:
        """Whether its name may be reported: a quarter of a second admits several, a moment later it is known which."""
        age_s = look.at_s - alarm.raised_s
        return age_s >= _LOOKS_S[1] or fault.end_s is not None or (age_s > 0.0 and fault.probability >= _TOLD)

    def _doubted(self, alarm: Alarm, look: Look) -> list[Event]:
        """What a look changes that finds no fault: the alarm is over, or its name is checked once more."""
        alarm.in_vain += 1
        if self._is_explained(alarm, look.at_s):
            self._over(look.at_s)
            kind, text = ("unknown", self.problem) if self.problem else ("healthy", EXPLAINED)
            return [Event(look.at_s, self.name, "clear", kind, text=text)]
        if alarm.fault is not None and alarm.in_vain == 1:
            self._due_s = sorted([*self._due_s, look.at_s + _AGAIN_S])
        return []

    def _over(self, now_s: float) -> None:
        """No alarm stands any more, and the tests begin anew; where they mean nothing, a look tells when they do."""
        self.alarm = self._doubtful = self._crossed = None
        self._due_s = [now_s + _LOOKS_AGAIN_S] if self.problem else []
        if self.stream is not None and not self.problem:
            self.stream.again()

    def _is_explained(self, alarm: Alarm, now_s: float) -> bool:
        """Whether a working servo explains an alarm of which a look says nothing, or is quiet since.

        One look that finds nothing does not take back what another one has named.
        """
        before = [fault for fault in self.suspicions if fault.alarm_s <= alarm.raised_s]
        healthy = bool(before) and (before[-1].end_s is None or before[-1].end_s >= alarm.raised_s)
        is_quiet = now_s - alarm.quiet.since_s >= QUIET_S
        healthy = is_quiet or (healthy and now_s - alarm.raised_s >= _NAMED_S)
        return bool(self.problem) or (healthy and (alarm.fault is None or alarm.in_vain > 1))

    def _look_later(self, look: Look, fault: Fault) -> None:
        """Put off the next look at a fault with a name: past its first seconds if that is sure, then for a while."""
        if fault.kind == "unknown" or not fault.probability >= EVEN:
            return
        named_s = fault.alarm_s + _NAMED_S
        if fault.probability >= SURE and look.at_s - fault.alarm_s >= _LOOKS_S[1]:
            self._due_s = [at_s for at_s in self._due_s if not at_s < named_s] or [fault.alarm_s + _LOOKS_AGAIN_S]
        if look.at_s >= fault.alarm_s + _LOOKS_S[-2] and self._due_s == [fault.alarm_s + _LOOKS_S[-1]]:
            self._due_s = [fault.alarm_s + _LOOKS_AGAIN_S]

    def _crossed_in(self, piece: Piece) -> bool:
        """Keep what a piece raises until it is looked at; whether the alarm that stands comes from another witness."""
        residuals, level_deg = piece.residuals, piece.threshold.level_deg
        known = self.alarm.fault if self.alarm is not None else None
        is_by_other = known is not None and known.witness != self.quantity
        is_told = is_by_other or (known is not None and known.other != "")
        for k in np.flatnonzero(piece.alarm).tolist():
            time_s = float(residuals.time_s[k])
            if piece.alarm[k] == BY_OTHER:
                if not is_told:
                    self._doubtful = self._doubtful or (Alarm(time_s) if self.alarm is None else None)
                    self._due_s = sorted([*self._due_s, time_s])
            elif piece.alarm[k] != BY_WINDOWS:
                self._crossed = self._crossed or (time_s, float(residuals.residual_deg[k]), float(level_deg[k]))
            elif self.alarm is None and self._crossed is None:
                self._doubtful = Alarm(time_s)
                self._due_s = [time_s + after_s for after_s in LOOKS_S]
            if is_by_other and piece.alarm[k] != BY_OTHER:
                self._due_s = sorted([*self._due_s, *(time_s + after_s for after_s in _LOOKS_S)])
        return is_by_other

    def _raised(self) -> list[Event]:
        """The alarm of a residual over its threshold, once all looks are made that were due before it."""
        if self._crossed is None or (self.alarm is None and min(self._due_s, default=np.inf) < self._crossed[0]):
            return []
        (time_s, residual_deg, level_deg), self._crossed = self._crossed, None
        if self.alarm is not None:
            return []
        self.alarm, self._doubtful = Alarm(time_s), None
        self._due_s = [time_s + after_s for after_s in _LOOKS_S]
        return [Event(time_s, self.name, "alarm", "unknown", residual_deg, level_deg)]

    def look(self, until_s: float = np.inf) -> Look | None:
        """A copy of what is not judged for good, until then [s]; None while nothing was evaluated."""
        stream, alarm, from_s = self.stream, self.alarm or self._doubtful, self._from_s
        if stream is None or stream.history.size == 0:
            return None
        if alarm is not None:
            from_s = max(from_s, alarm.raised_s - LOOKS_BACK_S)
        residuals, threshold = stream.history.snapshot(self.surface.threshold, from_s, until_s)
        residuals, commands = replace(residuals, context=self.context), stream.logged.copied(from_s)
        names = alarm.names if alarm is not None else {}
        find = stream.finder(Remembered(residuals, threshold, commands), names, until_s)
        return Look(float(residuals.time_s[-1]), residuals, threshold, find)

    def _event(self, look: Look, event: EventKind, fault: Fault) -> Event:
        numbers = float(look.residuals.residual_deg[-1]), float(look.threshold.level_deg[-1])
        if "current" in (self.quantity, fault.witness):  # amperes are no degrees
            numbers = float("nan"), float("nan")
        return Event(look.at_s, self.name, event, fault.kind, *numbers, fault=fault)


def _has_moved(fault: Fault | None, measured_deg: FloatArray) -> bool:
    """Whether a surface that was taken for one that stands still has moved to some positions (n,) [deg]."""
    stands = None if fault is None else fault.parameters.get("position_deg")
    if stands is None:
        return False
    away_deg = np.abs(measured_deg - stands.value) - (stands.high - stands.low)
    return bool(np.nanmax(away_deg, initial=0.0) > _MOVED_DEG)
