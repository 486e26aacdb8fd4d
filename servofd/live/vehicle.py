"""One vehicle of a link: its clock, its channels and the monitors of its surfaces."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from logparsers.codec import Received
from logparsers.protocol import NO_INDEX, Component
from servofd.aircraft.outputs import output_of
from servofd.aircraft.schema import Aircraft, Surface
from servofd.aircraft.watch import Bus, New
from servofd.core.errors import ConfigError
from servofd.current.both import OfBoth
from servofd.current.judge import is_witness
from servofd.current.stream import OfCurrent, motion_model
from servofd.detection.causes import cause_of_alarms
from servofd.detection.event import Event, Look
from servofd.detection.monitor import SurfaceMonitor
from servofd.detection.seen import Healthy, HealthyStream
from servofd.detection.verdict import CommonCause
from servofd.live.alarms import Alarms, Published, travel_deg
from servofd.live.alerts import Alerts
from servofd.live.channels import ChannelTable, Surroundings
from servofd.live.clock import VehicleClock
from servofd.live.requests import LOG_SILENCE_S, RemoteLog, Requests
from servofd.live.settings import Settings, rescaled
from servofd.live.witnesses import Rows, Witnesses

if TYPE_CHECKING:
    from servofd.live.axes import AxisWatch

Samples = tuple[list[float], list[float]]
"""Times and values of one channel."""

_SILENCE_S = 2.0
"""A vehicle without any message for longer is lost [s]."""
_GAP_S = 1.0
"""Longer than any pause between two messages of a vehicle on the link."""
_JUMP_S = 1.0
"""Left out after a parameter has changed: pulses jump, at an instant that is not known exactly."""
_NAMED_S, _SAME_S = 2.0, 5.0
"""Alarms have their names so soon, and onsets of one cause are put so near to each other by later looks [s]."""
_READ_FIRST_S = 10.0
"""Parameters without a place that come so early answer whoever reads them at the start (in a replay, the monitor that
recorded it): ArduPilot answers a name in the same way as it tells of a change."""
_NONE = np.zeros(0)
_REORDERED, _LATEST_S = 160, 0.5
"""A sequence number so far ahead, of 256, is an old frame that came late, if one has come so shortly before [s]: over a
link with jitter of 50 ms frames of an autopilot's once-a-second volley are 60 behind."""
_DISORDER_S, _LONGEST_WAIT_S = 30.0, 0.5
"""So long messages that overtake each other are remembered; whatever comes later than the latter is left out."""
_REMEMBERED = 128
"""Samples of a channel, to tell copies: 2.5 s at 50 Hz."""
_COUNT_S = 5.0
"""How often the rates of messages are counted [s]."""
_READS = 3
"""Times that missing parameters are asked for."""
_CHECK_S = 0.1
"""How often the vehicle is checked for silence [s]."""


@dataclass(slots=True)
class Losses:
    """Frames of one sender that never came, by its sequence numbers."""

    received: int = 0
    lost: int = 0
    _next: int | None = None
    _latest_s: float = -math.inf

    def count(self, sequence: int, arrival_s: float) -> None:
        """Take the number of a frame, and when it arrived [s]."""
        self.received += 1
        ahead = 0 if self._next is None else (sequence - self._next) % 256
        is_late, self._latest_s = arrival_s - self._latest_s < _LATEST_S, arrival_s
        if is_late and ahead >= _REORDERED:
            # It came late, and was counted as lost; or twice.
            self.lost = max(self.lost - 1, 0)
            return
        self.lost += ahead
        self._next = (sequence + 1) % 256

    @property
    def share(self) -> float:
        """Of all frames that were sent."""
        return self.lost / max(self.received + self.lost, 1)


class Disorder:
    """How far behind each other messages of one vehicle come that overtake themselves on their way.

    In order, nothing waits; else samples wait for as long as any was behind its successor in the last half minute.
    """

    def __init__(self) -> None:
        self._recent: dict[str, deque[float]] = {}
        self._last_s: dict[str, float] = {}
        self._newest_s = self._begun_s = -math.inf
        self._behind_s = self._before_s = 0.0

    def take(self, channel: str, time_s: float) -> bool:
        """Take the time of a sample [s]; False if it is a copy of one that came before."""
        recent = self._recent.get(channel)
        if recent is None:
            recent = self._recent[channel] = deque(maxlen=_REMEMBERED)
        newest_s = self._last_s.get(channel, -math.inf)
        if time_s > newest_s:
            recent.append(time_s)
            self._last_s[channel] = time_s
            self._newest_s = max(self._newest_s, time_s)
            return True
        if time_s in recent:
            return False
        recent.append(time_s)
        behind_s = newest_s - time_s
        if behind_s <= _LONGEST_WAIT_S:
            self._behind_s = max(self._behind_s, behind_s)
        return True

    def known_s(self) -> float:
        """Until when all samples are there [s]."""
        if not self._newest_s - self._begun_s < _DISORDER_S:
            self._begun_s, self._before_s, self._behind_s = self._newest_s, self._behind_s, 0.0
        behind_s = max(self._behind_s, self._before_s)
        return self._newest_s - behind_s if behind_s > 0.0 else math.inf


@dataclass(slots=True)
class Vehicle:
    """A vehicle, and what is known of it."""

    system: int
    aircraft: Aircraft
    clock: VehicleClock = field(default_factory=VehicleClock)
    losses: dict[int, Losses] = field(default_factory=dict)
    monitors: dict[str, SurfaceMonitor] = field(default_factory=dict)
    past: list[SurfaceMonitor] = field(default_factory=list)
    """Those of the boots before."""
    witnesses: dict[str, Witnesses] = field(default_factory=dict)
    """Of surfaces with a position and a current: of `monitors` theirs is the one that knows more."""
    began_s: list[float] = field(default_factory=lambda: [0.0])
    """When each of its boots began, on a time line that they have in common [s]."""
    received_s: float = float("-inf")
    """Arrival of the latest message [s]."""
    now_s: float = float("nan")
    """Its own time [s], as its newest message tells it."""
    is_lost: bool = False
    has_positions: bool = False
    """Whether it has sent any measured position."""
    log: RemoteLog | None = None
    """Its own log, where its channels are in that."""
    is_stream: bool = True
    """False where samples of any channel are given directly."""
    messages: set[str] = field(init=False)
    """Messages that carry its channels."""
    seldom: set[str] = field(init=False)
    """Messages that tell of airspeed and supply, if its servos depend on them."""
    news: list[str] = field(default_factory=list)
    """What is to be reported of it, and then forgotten."""
    causes: list[CommonCause] = field(default_factory=list)
    """What alarms of its latest boot have in common."""
    _watched_s: float = math.nan
    """When the first surface was watched [s]."""
    axes: AxisWatch | None = None
    """Its axes, if the aircraft file knows its motion."""
    requests: Requests = field(init=False)
    alerts: Alerts = field(init=False)
    alarms: Alarms = field(init=False)
    """What is published of its faults."""
    synced_s: float = float("-inf")
    """When it was last asked for the time [s, receiver's clock]."""
    settings: Settings = field(init=False)
    _table: ChannelTable = field(init=False)
    _read: set[str] = field(default_factory=set)
    """Parameters that were asked for,"""
    _reads: int = 0
    """and how often: an autopilot without such servos does not answer."""
    _met_s: float = float("inf")
    """Arrival of the first message [s]."""
    _held_s: dict[str, float] = field(default_factory=dict)
    """Until when samples of a surface are left out [s]."""
    _needs: list[str] = field(init=False)
    _around: Surroundings = field(init=False)
    _is_news: bool = False
    _counted_s: float = float("-inf")
    _checked_s: float = float("-inf")
    _routes: dict[str, list[tuple[str, int]]] = field(default_factory=dict)
    _early: list[tuple[Received, float]] = field(default_factory=list)
    _samples: dict[str, tuple[Samples, Samples, Samples]] = field(default_factory=dict)
    """What waits of each surface: commands, what it is watched by, and the current beside its position."""
    _disorder: Disorder = field(default_factory=Disorder)
    _bus: Bus = field(init=False)

    def __post_init__(self) -> None:
        for name, surface in self.aircraft.surfaces.items():
            if not surface.watched_channel or (surface.measured is None and name in self.aircraft.sharing_current):
                continue
            if surface.can_be_watched:
                self.monitors[name] = self._monitor(name, surface)
            elif self.is_stream and ChannelTable([surface.command.channel, surface.watched_channel]).unknown:
                continue
            self._routes.setdefault(surface.command.channel, []).append((name, 0))
            self._routes.setdefault(surface.watched_channel, []).append((name, 1))
            if name in self.monitors and isinstance(self.monitors[name].beside, OfBoth):
                self._routes.setdefault(surface.beside_channel, []).append((name, 2))
                self.witnesses[name] = self._witnesses(self.monitors[name])
        self._bus = self._new_bus()
        streamed: set[str] = set()
        if self.aircraft.motion is not None:
            from servofd.live.axes import STREAMED, AxisWatch

            self.axes, streamed = AxisWatch(self.aircraft.motion), set(STREAMED)
        if not self.monitors and self.axes is None:
            raise ConfigError(
                "the aircraft file names no measured channel, and no calibrated current of one servo alone: nothing "
                "can be watched; one current of several servos is judged after the flight, by 'servofd audit'"
            )
        self.settings = Settings({name: output_of(self.aircraft.surfaces[name]) for name in self.monitors})
        self.messages = ChannelTable(self._routes).messages
        self._needs = sorted({need for m in self.monitors.values() for need in m.needs})
        self._around = Surroundings(self._needs)
        beside = ChannelTable(self._around.channels)
        self.seldom = beside.messages - self.messages
        self.messages |= streamed - {"VFR_HUD"}
        self.seldom |= streamed & {"VFR_HUD"}
        self._table = ChannelTable([*self._routes, *(n for n in self._around.channels if n not in beside.unknown)])
        self.requests = Requests(self.system, self.messages, self.seldom)
        self.alerts = Alerts([*self.monitors, *(self.axes.model.axes if self.axes is not None else ())])
        travels = {name: travel_deg(self.aircraft.surfaces[name]) for name in self.monitors}
        self.alarms = Alarms(self.system, travels)
        if self._table.unknown and self.is_stream:
            raise ConfigError(
                f"channel {self._table.unknown[0]!r} is none of a MAVLink stream; write for example "
                "SERVO_OUTPUT_RAW.servo2_raw or NAMED_VALUE_FLOAT[SRVP2].value"
            )

    def _monitor(self, name: str, surface: Surface) -> SurfaceMonitor:
        known, model = surface.healthy_current, motion_model(self.aircraft, name)
        beside: HealthyStream | None = None
        if surface.current is not None and known is not None:
            beside = OfCurrent(name, model, surface.current, known)
            if not surface.is_told_by_current:
                is_two = name not in self.aircraft.sharing_current and is_witness(known)
                beside = OfBoth(Healthy(surface, model), beside) if is_two else None
        monitor = SurfaceMonitor(name, surface, model, beside)
        monitor.is_periodic = self.is_stream
        if not self.is_stream:
            monitor.patience_s = LOG_SILENCE_S
        return monitor

    def _witnesses(self, of_both: SurfaceMonitor) -> Witnesses:
        """Its monitor, and whoever watches its current where that tells nothing."""

        def made() -> SurfaceMonitor:
            return self._monitor(of_both.name, of_both.surface.model_copy(update={"measured": None}))

        return Witnesses(of_both, made)

    @property
    def every(self) -> list[SurfaceMonitor]:
        """All monitors of its latest boot: of two witnesses those that do not watch now as well."""
        single = [monitor for name, monitor in self.monitors.items() if name not in self.witnesses]
        return [*single, *(one for each in self.witnesses.values() for one in each.both)]

    @property
    def judges(self) -> list[SurfaceMonitor]:
        """Those that have found something, or may."""
        return [*(one for each in self.witnesses.values() for one in each.past), *self.every]

    def _new_bus(self) -> Bus:
        """That of the positions, watched or not: currents may well stand still together."""
        return Bus([name for name, surface in self.aircraft.surfaces.items() if surface.measured is not None])

    @property
    def channels(self) -> list[str]:
        """Names of its channels: commands first, after what both depend on."""
        mine = sorted(self._routes, key=lambda channel: min(role for _, role in self._routes[channel]))
        return [*self._around.channels, *mine, *(self.axes.channels if self.axes is not None else ())]

    def receive(self, message: Received, arrival_s: float) -> list[Published]:
        """Events of the link that a message of this vehicle causes; all others come with `evaluate`."""
        if not self._table.obeys(message):
            self.news += self._table.news
            self._table.news.clear()
            return []
        events = self.silence(arrival_s)  # so that an outage counts even between two calls
        if self.is_lost:
            self.is_lost = False
            text = f"vehicle {self.system} sends again after {arrival_s - self.received_s:.1f} s"
            events.append(Event(self.now_s, "", "link_restored", text=text))
        if message.component not in self.losses:
            self.losses[message.component] = Losses()
        self.losses[message.component].count(message.sequence, arrival_s)
        self.received_s = arrival_s
        self._met_s = min(self._met_s, arrival_s)
        if message.name == "PARAM_VALUE" and message.component == Component.AUTOPILOT1:
            events += self._set(message.fields)
        if not self.clock.is_set(arrival_s) and not self.clock.is_reference(message):
            if message.name in self._table.messages:
                self._early.append((message, arrival_s))
            return self.alarms.publish(events)
        restarts = self.clock.restarts
        time_s = self.clock.time_s(message, arrival_s)
        reports: list[Published] = []
        if self.clock.restarts != restarts:
            reports, events = self._begin_anew(events, 0.0 if time_s is None else time_s), []
        early, self._early = self._early, []
        for before, at_s in early:
            self._sort(before, self.clock.time_s(before, at_s))
        if time_s is not None:
            self._advance(time_s)
            self._sort(message, time_s)
            if self.axes is not None:
                self.axes.receive(message.name, message.fields, time_s)
        if self.log is not None:
            self.give(self.log.receive(message, arrival_s))
        return reports + self.alarms.publish(events)

    def _begin_anew(self, events: list[Event], time_s: float) -> list[Published]:
        """Events of the boot that has ended, and that another begins, whose time it is."""
        events = [*events, *self.finish()]
        self.past += self.judges
        self.began_s.append(self.began_s[-1] + max(self.now_s, 0.0))
        surfaces = {name: monitor.surface for name, monitor in self.monitors.items()}
        surfaces |= {name: each.of_both.surface for name, each in self.witnesses.items()}
        self.monitors = {name: self._monitor(name, surface) for name, surface in surfaces.items()}
        self.witnesses = {name: self._witnesses(self.monitors[name]) for name in self.witnesses}
        self.now_s, self._checked_s, self._disorder = time_s, -math.inf, Disorder()
        self._samples.clear()
        self._held_s.clear()
        self._bus, self._around = self._new_bus(), Surroundings(self._needs)
        self._watched_s = math.nan
        self.causes.clear()
        if self.axes is not None:
            self.axes.restart()
        text = f"vehicle {self.system} has restarted; the monitor begins anew"
        return self.alarms.publish(events) + self.alarms.begin_anew(Event(time_s, "", "no_data", text=text))

    def _set(self, fields: Mapping[str, Any]) -> list[Event]:
        """A parameter: what was evaluated is, the rest is calibrated anew, or not watched any more."""
        is_answer = fields["param_id"] in self._read or self.received_s - self._met_s <= _READ_FIRST_S
        is_news = fields["param_index"] == NO_INDEX and not is_answer
        self._read.discard(fields["param_id"])
        change = self.settings.receive(str(fields["param_id"]), float(fields["param_value"]), is_news=is_news)
        if change is None:
            return []
        self.news.append(change.text)
        events = self.evaluate()
        for monitor in self.every:
            if monitor.name not in change.surfaces:
                continue
            known = rescaled(monitor.surface.command, change.scale)
            if known is not None:
                monitor.surface = monitor.surface.model_copy(update={"command": known})
            self._held_s[monitor.name] = self.now_s + _JUMP_S
            events += monitor.suspend(change.text if change.suspends or known is None else "", self.now_s)
        return events

    def unread(self) -> tuple[str, ...]:
        """Parameters to ask for now: the answer is no news."""
        self._reads += 1
        names = self.settings.missing() if self._reads <= _READS else ()
        self._read.update(names)
        return names

    def _advance(self, time_s: float) -> None:
        """Its time goes on; while nothing at all came, no surface has fallen silent."""
        missed_s = time_s - self.now_s
        if missed_s > _GAP_S:
            for monitor in self.every:
                monitor.excuse(missed_s, time_s)
        if not missed_s <= 0.0:
            self.now_s = time_s

    def rates_hz(self, arrival_now_s: float) -> dict[str, float]:
        """How often each message came, once every few seconds; empty in between, and while nothing comes at all."""
        span_s = arrival_now_s - self._counted_s
        if span_s < _COUNT_S:
            return {}
        counts, self._counted_s = self._table.counted(), arrival_now_s
        if self.is_lost or not span_s < 2.0 * _COUNT_S or arrival_now_s - self.received_s > _SILENCE_S:
            return {}
        return {message: count / span_s for message, count in counts.items()}

    def give(self, channels: Iterable[tuple[str, float, float]]) -> None:
        """Take samples of its own log: channel, time since its latest boot [s] and value as logged."""
        for channel, stamp_s, value in channels:
            self._advance(stamp_s)
            self._add(channel, stamp_s, value)
            if self.axes is not None:
                self.axes.add(channel, stamp_s, value)

    def rests(self, for_s: float) -> bool:
        """Whether nothing is looked into for so long [s], and something of every surface waits to be evaluated."""
        waiting = [(self._samples.get(name), 2 if m.stands_in else 1) for name, m in self.monitors.items()]
        return all(m.rests(for_s) for m in self.monitors.values()) and all(
            each and each[0][0] and each[read][0] for each, read in waiting
        )

    def evaluate(self, *, final: bool = True) -> list[Event]:
        """Evaluate what was received since; all of it, or what cannot wait for the next position."""
        ready, events = self._ready(final=final), []
        if self._is_news:
            context, self._is_news = self._around.context(), False
            for monitor in self.monitors.values():
                monitor.surroundings(context)
        surfaces = self.aircraft.surfaces | {name: monitor.surface for name, monitor in self.monitors.items()}
        stands = self._bus.take(
            {
                name: New.of(surfaces[name], *now[:2])
                for name, now in ready.items()
                if surfaces[name].measured is not None
            }
        )
        if ready and not math.isfinite(self._watched_s):
            self._watched_s = self.now_s
        for name, (asked, read, drawn) in ready.items():
            if name in self.witnesses:
                both = self.witnesses[name]
                events += both.feed(asked, read, drawn, stands.get(name), self._bus.stood_s)
                self.monitors[name] = both.watching
            elif name in self.monitors:
                events += self.monitors[name].feed(asked, read, stands.get(name), self._bus.stood_s)
        if self.now_s - self._checked_s >= _CHECK_S:
            self._checked_s = self.now_s
            for name, monitor in self.monitors.items():
                events += self.witnesses.get(name, monitor).silence(self.now_s)
        if self.axes is not None and math.isfinite(self.now_s):
            events += self.axes.due(self.now_s)
        return events

    def _ready(self, *, final: bool) -> dict[str, tuple[Rows, Rows, Rows]]:
        """Commands, positions and currents of each surface that are evaluated now; all others wait."""
        samples, self._samples = self._samples, {}
        known_s, ready = self._disorder.known_s(), {}
        for name, (commands, positions, drawn) in samples.items():
            monitor = None if final else self.monitors.get(name)
            read = drawn if monitor is not None and monitor.stands_in else positions
            if monitor is not None and monitor.may_wait(len(commands[0]), len(read[0])):
                self._samples[name] = commands, positions, drawn
                continue
            (asked, read, beside), later = zip(
                *(_in_order(each, known_s) for each in (commands, positions, drawn)), strict=True
            )
            ready[name] = asked, read, beside
            if any(times for times, _ in later):
                self._samples[name] = later[0], later[1], later[2]
        return ready

    def look_for_causes(self) -> None:
        """Say once what alarms that stand have in common, as soon as they have their names."""
        standing = [alarm for alarm in self.alarms.all if alarm.end_s is None]
        faults = {alarm.surface: alarm.fault for alarm in standing if alarm.fault is not None}
        is_early = any(alarm.fault is None and self.now_s - alarm.raised_s < _NAMED_S for alarm in standing)
        if len(faults) < 2 or is_early:
            return
        cause = cause_of_alarms(faults, len(self.monitors), self._watched_s, self._around.supply.fall)
        if cause is not None and not any(_are_one(known, cause) for known in self.causes):
            self.causes.append(cause)
            self.news.append(cause.text)

    def silence(self, arrival_now_s: float) -> list[Event]:
        """Tell that nothing comes from this vehicle any more; `arrival_now_s` is the receiver's clock [s]."""
        if self.is_lost or not arrival_now_s - self.received_s > _SILENCE_S or self.received_s == float("-inf"):
            return []
        self.is_lost = True
        quiet_s = arrival_now_s - self.received_s
        return [Event(self.now_s, "", "link_lost", text=f"nothing from vehicle {self.system} for {quiet_s:.1f} s")]

    def due(self) -> list[tuple[SurfaceMonitor, Look]]:
        """What the bank should look at now."""
        looks = ((monitor, monitor.due()) for monitor in self.every)
        return [(monitor, look) for monitor, look in looks if look is not None]

    def finish(self) -> list[Event]:
        """End of the stream."""
        self._disorder = Disorder()  # nothing more will come
        events = self.evaluate()
        for monitor in self.every:
            events += monitor.finish()
        return events

    def _sort(self, message: Received, time_s: float | None) -> None:
        if time_s is not None:
            for channel, value in self._table.of(message):
                self._add(channel, time_s, value)
            if self._table.news:
                self.news += self._table.news
                self._table.news.clear()

    def _add(self, channel: str, time_s: float, value: float) -> None:
        self._is_news |= self._around.add(channel, time_s, value)
        if channel in self._routes and not self._disorder.take(channel, time_s):
            return
        for name, role in self._routes.get(channel, ()):
            if time_s < self._held_s.get(name, time_s):
                continue
            self.has_positions |= role == 1
            columns = self._samples.setdefault(name, (([], []), ([], []), ([], [])))[role]
            columns[0].append(time_s)
            columns[1].append(value)


def _are_one(known: CommonCause, cause: CommonCause) -> bool:
    """Whether the same was said before of these surfaces, or of more."""
    is_same = known.kind == cause.kind and abs(known.since_s - cause.since_s) <= _SAME_S
    return is_same and set(cause.surfaces) <= set(known.surfaces)


def _in_order(samples: Samples, known_s: float) -> tuple[Rows, Samples]:
    """Samples of one channel by time, until then [s]; and what is left."""
    time_s, values = samples
    if not time_s:
        return (_NONE, _NONE), ([], [])
    times, taken = np.array(time_s), np.array(values)
    if any(later_s < earlier_s for earlier_s, later_s in pairwise(time_s)):
        order = np.argsort(times, kind="stable")
        times, taken = times[order], taken[order]
    if times[-1] <= known_s:
        return (times, taken), ([], [])
    count = int(np.searchsorted(times, known_s, side="right"))
    return (times[:count], taken[:count]), (times[count:].tolist(), taken[count:].tolist())
