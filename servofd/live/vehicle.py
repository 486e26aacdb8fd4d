"""One vehicle of a link: its clock, its channels and the monitors of its surfaces."""

from __future__ import annotations

import math
from collections import defaultdict, deque
from collections.abc import Iterable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
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
from servofd.live.alarms import Alarms, travel_deg
from servofd.live.alerts import Alerts
from servofd.live.channels import ChannelTable, Surroundings
from servofd.live.clock import Least, VehicleClock
from servofd.live.requests import LOG_SILENCE_S, RemoteLog, Requests
from servofd.live.settings import Settings, rescaled
from servofd.live.witnesses import Rows, Witnesses

if TYPE_CHECKING:
    from servofd.live.axes import AxisWatch

Samples = tuple[list[float], list[float]]
"""Times and values of one channel."""

_SILENCE_S = 2.0
"""A vehicle without any message for longer is lost [s]."""
_CLOCK_S = 2.0
"""A clock that is not known by then will not be known any better [s]."""
_GAP_S = 1.0
"""Longer than any pause between two messages of a vehicle on the link."""
_JUMP_S = 1.0
"""Left out after a parameter has changed: pulses jump, at an instant that is not known exactly."""
_NAMED_S, _SAME_S = 2.0, 5.0
"""Alarms have their names so soon, and onsets of one cause are put so near to each other by later looks [s]."""
_READ_FIRST_S = 10.0
"""ArduPilot answers a name as it tells of a change: those that come so early answer whoever reads them at the start."""
_NONE = np.zeros(0)
_REORDERED, _LATEST_S = 160, 0.5
"""A sequence number so far ahead, of 256, is an old frame that came late (60 behind with a jitter of 50 ms), if one has
come so shortly before [s]."""
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


class Disorder:
    """How far behind each other messages of one vehicle come that overtake themselves on their way.

    In order, nothing waits; else samples wait for as long as any was behind its successor in the last half minute.
    """

    def __init__(self) -> None:
        self._recent: defaultdict[str, deque[float]] = defaultdict(lambda: deque(maxlen=_REMEMBERED))
        self._last_s: dict[str, float] = {}
        self._newest_s, self._order = -math.inf, Least(_DISORDER_S)
        """Of samples that came behind a newer one, how far [s], as negative numbers."""

    def take(self, channel: str, time_s: float) -> bool:
        """Take the time of a sample [s]; False if it is a copy of one that came before."""
        recent = self._recent[channel]
        newest_s = self._last_s.get(channel, -math.inf)
        if time_s > newest_s:
            recent.append(time_s)
            self._last_s[channel] = time_s
            self._newest_s = max(self._newest_s, time_s)
            return True
        if time_s in recent:
            return False
        recent.append(time_s)
        if newest_s - time_s <= _LONGEST_WAIT_S:
            self._order.take(time_s - newest_s, self._newest_s)
        return True

    def known_s(self) -> float:
        """Until when all samples are there [s]."""
        ahead_s = self._order.take(0.0, self._newest_s)
        return self._newest_s + ahead_s if ahead_s < 0.0 else math.inf


class Vehicle:
    """A vehicle, and what is known of it.

    `is_stream` is false where samples of any channel are given directly.
    """

    def __init__(self, system: int, aircraft: Aircraft, *, is_stream: bool = True) -> None:
        self.system, self.aircraft, self.is_stream = system, aircraft, is_stream
        self.clock = VehicleClock()
        self.log: RemoteLog | None = None
        """Its own log, where its channels are in that."""
        self.axes: AxisWatch | None = None
        """Its axes, if the aircraft file knows its motion."""
        self.losses: defaultdict[int, Losses] = defaultdict(Losses)
        """By component."""
        self.past: list[SurfaceMonitor] = []
        """Those of the boots before."""
        self.began_s = [0.0]
        """When each of its boots began, on a time line that they have in common [s]."""
        self.received_s = self.synced_s = self._counted_s = -math.inf
        """Arrival of the latest message, and when it was last asked for the time and its messages were counted [s]."""
        self._met_s = math.inf
        """Arrival of the first message [s]."""
        self.is_lost = self._is_news = False
        self.has_positions = False
        """Whether it has sent any measured position."""
        self.news: list[str] = []
        """What is to be reported of it, and then forgotten."""
        self.looks: list[tuple[SurfaceMonitor, Look, Future[Any]]] = []
        """What the bank looks at in a thread of its own."""
        self._read: set[str] = set()
        """Parameters that were asked for,"""
        self._reads = 0
        """and how often: an autopilot without such servos does not answer."""
        self._routes: dict[str, list[tuple[str, int]]] = {}
        self._early: list[tuple[Received, float]] = []
        known = {name: surface for name, surface in aircraft.surfaces.items() if surface.watched_channel}
        known = {n: s for n, s in known.items() if s.measured is not None or n not in aircraft.sharing_current}
        self._begin({name: surface for name, surface in known.items() if surface.can_be_watched}, math.nan)
        for name, surface in known.items():
            for role, channel in enumerate(self._channels_of(name, surface)):
                self._routes.setdefault(channel, []).append((name, role))
        streamed: set[str] = set()
        if aircraft.motion is not None:
            from servofd.live.axes import STREAMED, AxisWatch

            self.axes, streamed = AxisWatch(aircraft.motion), set(STREAMED)
        if not self.monitors and self.axes is None:
            raise ConfigError(
                "the aircraft file names no measured channel, and no calibrated current of one servo alone: nothing "
                "can be watched; one current of several servos is judged after the flight, by 'servofd audit'"
            )
        self.settings = Settings({name: output_of(aircraft.surfaces[name]) for name in self.monitors})
        mine, beside = ChannelTable(self._routes).messages, ChannelTable(self._around.channels)
        self.messages = mine | (streamed - {"VFR_HUD"})
        """Messages that carry its channels."""
        around = (name for name in self._around.channels if name not in beside.unknown)
        self._table = ChannelTable([*self._routes, *around], self.news)
        self.requests = Requests(system, self.messages, (beside.messages - mine) | (streamed & {"VFR_HUD"}))
        self.alerts = Alerts([*self.monitors, *(self.axes.model.axes if self.axes is not None else ())])
        self.alarms = Alarms(system, {name: travel_deg(aircraft.surfaces[name]) for name in self.monitors})
        if self._table.unknown and is_stream:
            raise ConfigError(
                f"channel {self._table.unknown[0]!r} is none of a MAVLink stream; write for example "
                "SERVO_OUTPUT_RAW.servo2_raw or NAMED_VALUE_FLOAT[SRVP2].value"
            )

    def _begin(self, surfaces: Mapping[str, Surface], time_s: float) -> None:
        """Begin a boot, of which nothing is known but its time [s]."""
        self.watchers = {name: self._watcher(name, surface) for name, surface in surfaces.items()}
        self.monitors = {name: each.of_both for name, each in self.watchers.items()}
        """Of each watcher the monitor that knows more."""
        self._around = Surroundings(sorted({need for m in self.monitors.values() for need in m.needs}))
        # Of the positions, watched or not: currents may well stand still together.
        self._bus = Bus([name for name, surface in self.aircraft.surfaces.items() if surface.measured is not None])
        self.now_s, self._watched_s, self._checked_s = time_s, math.nan, -math.inf
        """Its own time, as its newest message tells it, and when its first surface was watched [s]."""
        self.causes: list[CommonCause] = []
        """What its alarms have in common."""
        self._held_s: dict[str, float] = {}
        """Until when samples of a surface are left out [s]."""
        self._samples: dict[str, tuple[Samples, Samples, Samples]] = {}
        """What waits of each surface: commands, what it is watched by, and the current beside its position."""
        self._disorder = Disorder()

    def _channels_of(self, name: str, surface: Surface) -> list[str]:
        """Those of its command, of what it is watched by, and of the current beside its position, where it has one."""
        channels = [surface.command.channel, surface.watched_channel]
        if name in self.watchers:
            return channels + [surface.beside_channel] * (self.watchers[name].made is not None)
        return [] if self.is_stream and ChannelTable(channels).unknown else channels

    def _watcher(self, name: str, surface: Surface) -> Witnesses:
        monitor = self._monitor(name, surface)

        def of_current() -> SurfaceMonitor:  # whose calibration follows the settings meanwhile
            return self._monitor(name, monitor.surface.model_copy(update={"measured": None}))

        return Witnesses(monitor, of_current if isinstance(monitor.beside, OfBoth) else None)

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

    @property
    def every(self) -> list[SurfaceMonitor]:
        """All monitors of its latest boot: of two witnesses those that do not watch now as well."""
        return [one for each in self.watchers.values() for one in each.both]

    @property
    def judges(self) -> list[SurfaceMonitor]:
        """Those that have found something, or may."""
        return [*(one for each in self.watchers.values() for one in each.past), *self.every]

    @property
    def channels(self) -> list[str]:
        """Names of its channels: commands first, after what both depend on."""
        mine = sorted(self._routes, key=lambda channel: min(role for _, role in self._routes[channel]))
        return [*self._around.channels, *mine, *(self.axes.channels if self.axes is not None else ())]

    def receive(self, message: Received, arrival_s: float) -> list[Event]:
        """Events of the link that a message of this vehicle causes; all others come with `evaluate`."""
        if not self._table.obeys(message):
            return []
        events = self.silence(arrival_s)  # so that an outage counts even between two calls
        if self.is_lost:
            self.is_lost = False
            text = f"vehicle {self.system} sends again after {arrival_s - self.received_s:.1f} s"
            events.append(Event(self.now_s, "", "link_restored", text=text))
        self.losses[message.component].count(message.sequence, arrival_s)
        self.received_s = arrival_s
        self._met_s = min(self._met_s, arrival_s)
        if message.name == "PARAM_VALUE" and message.component == Component.AUTOPILOT1:
            events += self._set(message.fields)
        is_early = not self.clock.is_set and arrival_s - self._met_s <= _CLOCK_S
        if is_early and not self.clock.is_reference(message):
            if message.name in self._table.messages:
                self._early.append((message, arrival_s))
            return self.alarms.publish(events)
        restarts = self.clock.restarts
        time_s = self.clock.time_s(message, arrival_s)
        reports: list[Event] = []
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

    def _begin_anew(self, events: list[Event], time_s: float) -> list[Event]:
        """Events of the boot that has ended, and that another begins, whose time it is."""
        events = [*events, *self.finish()]
        self.past += self.judges
        self.began_s.append(self.began_s[-1] + max(self.now_s, 0.0))
        self._begin({name: each.of_both.surface for name, each in self.watchers.items()}, time_s)
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
        waiting = ((self._samples.get(name), 2 if m.stands_in else 1) for name, m in self.monitors.items())
        has_all = all(each and each[0][0] and each[read][0] for each, read in waiting)
        return has_all and all(monitor.rests(for_s) for monitor in self.monitors.values())

    def evaluate(self, *, final: bool = True) -> list[Event]:
        """Evaluate what was received since; all of it, or what cannot wait for the next position."""
        ready, events = self._ready(final=final), []
        if self._is_news:
            context, self._is_news = self._around.context(), False
            for monitor in self.monitors.values():
                monitor.surroundings(context)
        surfaces = self.aircraft.surfaces | {name: monitor.surface for name, monitor in self.monitors.items()}
        positions = {name: now[:2] for name, now in ready.items() if surfaces[name].measured is not None}
        stands = self._bus.take({name: New.of(surfaces[name], *now) for name, now in positions.items()})
        if ready and not math.isfinite(self._watched_s):
            self._watched_s = self.now_s
        for name, (asked, read, drawn) in ready.items():
            if name in self.watchers:
                watcher = self.watchers[name]
                events += watcher.feed(asked, read, drawn, stands.get(name), self._bus.stood_s)
                self.monitors[name] = watcher.watching
        if self.now_s - self._checked_s >= _CHECK_S:
            self._checked_s = self.now_s
            for watcher in self.watchers.values():
                events += watcher.silence(self.now_s)
        if self.axes is not None and math.isfinite(self.now_s):
            events += self.axes.due(self.now_s)
        return events

    def _ready(self, *, final: bool) -> dict[str, tuple[Rows, Rows, Rows]]:
        """Commands, positions and currents of each surface that are evaluated now; all others wait."""
        samples, self._samples = self._samples, {}
        known_s, ready = self._disorder.known_s(), {}
        for name, (commands, positions, drawn) in samples.items():
            monitor = None if final else self.monitors.get(name)
            judged = drawn if monitor is not None and monitor.stands_in else positions
            if monitor is not None and monitor.may_wait(len(commands[0]), len(judged[0])):
                self._samples[name] = commands, positions, drawn
                continue
            (asked, later), (read, more) = _in_order(commands, known_s), _in_order(positions, known_s)
            beside, rest = _in_order(drawn, known_s)
            ready[name] = asked, read, beside
            if later[0] or more[0] or rest[0]:
                self._samples[name] = later, more, rest
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
