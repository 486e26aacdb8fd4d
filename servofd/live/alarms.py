"""Alarms as they are published: each has one id from its beginning to its end, and a severity.

The detector says what it sees of a surface at each moment. What leaves the monitor follows four rules: a fault is one
alarm, however often it is judged; a surface has a second alarm only for a second fault; an alarm ends once; and what
has ended does not return.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

from logparsers.protocol import Severity
from servofd.detection.event import Event, EventKind
from servofd.detection.kinds import KINDS

if TYPE_CHECKING:
    from servofd.aircraft.schema import Surface
    from servofd.detection.verdict import Fault

_CRITICAL, _WARNING = 1.0 / 3.0, 0.1
"""Shares of a surface's travel: an aircraft can be flown with the loss of less than the first, and no pilot of it
notices less than the second."""
_TRAVEL_DEG: Final = 50.0
"""Where nothing says how far a surface moves: the FASER surfaces' +-25 deg."""
_ECHO_S: Final = 1.0
"""What the detector sees again within so long of an alarm's time is the same fault."""


@dataclass(slots=True)
class Alarm:
    """One fault of one surface, as it was published."""

    id: str
    surface: str
    raised_s: float
    """When it was published, by the vehicle's clock [s]."""
    kind: str = "unknown"
    residual_deg: float = math.nan
    fault: Fault | None = None
    end_s: float | None = None
    """None while it stands, infinite where the vehicle has booted meanwhile [s]."""
    boot: int = 1
    dismissed: bool = False
    """Whether a working servo explains it."""
    severity: Severity = Severity.NOTICE

    @property
    def since_s(self) -> float:
        """Best estimate of the onset [s]."""
        return self.raised_s if self.fault is None else self.fault.start_s

    def covers(self, fault: Fault) -> bool:
        """Whether this may be the same fault, seen now that more of it is known."""
        begin_s, end_s = min(self.since_s, self.raised_s) - _ECHO_S, math.inf if self.end_s is None else self.end_s
        return begin_s <= max(fault.start_s, fault.alarm_s) and fault.start_s <= end_s

    def dated(self, fault: Fault | None) -> Fault | None:
        """The same fault, seen by what tells nothing of before this was raised, with the onset that is known."""
        is_late = fault is not None and fault.start_s > self.raised_s
        return replace(fault, start_s=min(fault.start_s, self.since_s)) if fault is not None and is_late else fault


def over(fault: Fault | None) -> str:
    """What is said once a fault is over."""
    by_current = fault is not None and fault.witness == "current"
    return "draws as a good servo again" if by_current else "moves as commanded again"


def travel_deg(surface: Surface) -> float:
    """How far a surface moves from stop to stop [deg], as far as its file says."""
    known = surface.calibrated.reach_deg if surface.calibrated is not None else None
    limits = known or surface.position_limit_deg or surface.command_saturation_deg
    return _TRAVEL_DEG if limits is None else limits[1] - limits[0]


def severity_of(kind: str, fault: Fault | None, residual_deg: float, travel_deg: float) -> Severity:
    """What a fault does to the aircraft: control lost, control worse, or something to look at on the ground.

    `kind`: of the fault; `unknown` until it has a name. `fault`: its parameters, where it has a name. `residual_deg`:
    by how much the surface is off [deg]; NaN where nothing measures that. `travel_deg`: from stop to stop [deg].

    Examples
    --------
    >>> severity_of("unknown", None, 0.1, 50.0).name, severity_of("unknown", None, -7.0, 50.0).name
    ('NOTICE', 'WARNING')
    >>> severity_of("stuck", None, 0.1, 50.0).name
    'CRITICAL'
    """
    sizes = {} if fault is None else {name: abs(estimate.value) for name, estimate in fault.parameters.items()}
    known = KINDS.get(kind, KINDS["unknown"])
    if known.severity != "by size":
        return Severity.CRITICAL if known.severity == "critical" else Severity.WARNING
    if kind == "loss_of_effectiveness":
        share = abs(1.0 - sizes["gain"]) if "gain" in sizes else 1.0
    else:
        is_sized = known.size_deg in sizes
        share = (sizes[known.size_deg] if is_sized else abs(residual_deg)) / travel_deg
        share = min(share, _CRITICAL * 0.999) if is_sized else share
    if math.isnan(share):
        return Severity.WARNING
    return Severity.CRITICAL if share >= _CRITICAL else Severity.WARNING if share >= _WARNING else Severity.NOTICE


@dataclass(slots=True)
class Alarms:
    """Alarms of one vehicle."""

    vehicle: int
    """Its system id, with which the ids of its alarms begin."""
    travels_deg: Mapping[str, float] = field(default_factory=dict)
    boot: int = 1
    """Which one of the vehicle's boots this is, of those that were received."""
    all: list[Alarm] = field(default_factory=list)
    """In the order in which they were raised."""

    def standing(self, surface: str) -> Alarm | None:
        """The gravest alarm of a surface that stands; of several alike, the latest."""
        alarms = [alarm for alarm in self.all if alarm.surface == surface and alarm.end_s is None]
        return min(reversed(alarms), key=lambda alarm: alarm.severity, default=None)

    @property
    def gravest(self) -> Severity | None:
        """Severity of the gravest alarm that stands; None if none does."""
        return min((alarm.severity for alarm in self.all if alarm.end_s is None), default=None)

    def publish(self, events: Iterable[Event]) -> list[Event]:
        """What to publish of that which the detector saw."""
        return [each for event in events for each in self._reported(event)]

    def begin_anew(self, event: Event) -> list[Event]:
        """End what stands, for the vehicle has booted, as an event says: whether it lasts is seen anew."""
        reports = []
        for alarm in self.all:
            if alarm.end_s is None:
                alarm.end_s = math.inf
                text = "the vehicle has restarted: whether it lasts is not known"
                clear = replace(event, surface=alarm.surface, event="clear", kind=alarm.kind, text=text)
                reports.append(self._published(clear, alarm.id, Severity.NOTICE))
        self.boot += 1
        return [*reports, self._published(event, "", Severity.WARNING)]

    def _reported(self, event: Event) -> list[Event]:
        if event.event not in ("alarm", "named", "clear"):
            return [self._published(event, "", Severity.WARNING)]
        of_surface = [alarm for alarm in self.all if alarm.surface == event.surface and alarm.boot == self.boot]
        open_ = [alarm for alarm in of_surface if alarm.end_s is None]
        same = next((a for a in reversed(open_) if event.fault is None or a.covers(event.fault)), None)
        if event.event != "alarm":  # of the one that stands, however early its onset is put now
            same = same or next(reversed(open_), None)
        if event.event == "clear":
            return self._cleared(same, event)
        if same is not None:
            return self._named(same, event)
        known = [alarm for alarm in of_surface if not alarm.dismissed]  # what was taken back has to be reported anew
        if event.event == "named" or (event.fault is not None and any(a.covers(event.fault) for a in known)):
            return []
        number = 1 + sum(alarm.surface == event.surface for alarm in self.all)
        alarm = Alarm(f"{self.vehicle}/{event.surface}/{number}", event.surface, event.time_s, boot=self.boot)
        self.all.append(alarm)
        self._learn(alarm, event)
        return [self._published(event, alarm.id, alarm.severity)]

    def _named(self, alarm: Alarm, event: Event) -> list[Event]:
        """A name that is new, or graver, of an alarm that stands; or what another witness says of it."""
        is_told = event.fault is not None and event.fault.other not in ("", alarm.fault and alarm.fault.other)
        if event.kind == "unknown" or (event.kind == alarm.kind and not is_told):
            return []
        event = replace(event, fault=alarm.dated(event.fault))
        self._learn(alarm, event)
        return [self._published(event, alarm.id, alarm.severity, "named")]

    def _cleared(self, alarm: Alarm | None, event: Event) -> list[Event]:
        if alarm is None:
            return []
        alarm.end_s, alarm.dismissed = event.time_s, event.kind == "healthy"
        named: list[Event] = []
        if not alarm.dismissed:  # a name that was reported stays; one that comes so late is reported before the end
            named = self._named(alarm, event) if alarm.kind == "unknown" else []
            ended = alarm.dated(event.fault)
            if ended is not None:
                known = ended if event.kind == alarm.kind else alarm.fault or ended
                ended = alarm.fault = replace(known, kind=alarm.kind, end_s=ended.end_s)
            event = replace(event, kind=alarm.kind, fault=ended)
        return [*named, self._published(event, alarm.id, Severity.NOTICE)]

    def _learn(self, alarm: Alarm, event: Event) -> None:
        alarm.kind, alarm.fault = event.kind, event.fault
        if event.event == "alarm" and math.isnan(alarm.residual_deg):
            alarm.residual_deg = event.residual_deg
        travel = self.travels_deg.get(event.surface, _TRAVEL_DEG)
        alarm.severity = severity_of(event.kind, event.fault, event.residual_deg, travel)

    def _published(self, event: Event, alarm: str, severity: Severity, what: EventKind | None = None) -> Event:
        whose = replace(event, id=alarm, severity=severity, vehicle=self.vehicle, boot=self.boot)
        return whose if what is None else replace(whose, event=what)
