"""One vehicle of a link: its clock, its channels and the monitors of its surfaces."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from servofd.detection.events import Event, Look
from servofd.detection.monitor import SurfaceMonitor
from servofd.detection.surroundings import Surroundings
from servofd.errors import ConfigError
from servofd.live.channels import ChannelTable
from servofd.live.clock import VehicleClock

if TYPE_CHECKING:
    from collections.abc import Iterable

    from logparsers.codec import Heard
    from servofd.aircraft import Aircraft

__all__ = ["Losses", "Vehicle"]

_SILENCE_S = 2.0
_NONE = np.zeros(0)
_REORDERED = 200
_COUNT_S = 5.0


@dataclass(slots=True)
class Losses:
    """Frames of one sender that never came, by its sequence numbers."""

    received: int = 0
    lost: int = 0
    repeated: int = 0
    _next: int | None = None

    def count(self, sequence: int) -> None:
        """Take the number of a frame.

        Examples
        --------
        >>> losses = Losses()
        >>> for number in (254, 255, 2, 1, 3):
        ...     losses.count(number)
        >>> losses.lost, losses.repeated
        (1, 1)
        """
        self.received += 1
        ahead = 0 if self._next is None else (sequence - self._next) % 256
        if ahead >= _REORDERED:
            # It came late, and was counted as lost; or twice.
            self.repeated += 1
            self.lost = max(self.lost - 1, 0)
            return
        self.lost += ahead
        self._next = (sequence + 1) % 256

    @property
    def share(self) -> float:
        """Of all frames that were sent."""
        return self.lost / max(self.received + self.lost, 1)


@dataclass(slots=True)
class Vehicle:
    """A vehicle, and what is known of it.

    Parameters
    ----------
    system : int
        Its MAVLink address.
    aircraft : Aircraft
        Its surfaces.

    Raises
    ------
    ConfigError
        If the aircraft file names no channel that a telemetry stream could have.
    """

    system: int
    aircraft: Aircraft
    clock: VehicleClock = field(default_factory=VehicleClock)
    losses: dict[int, Losses] = field(default_factory=dict)
    monitors: dict[str, SurfaceMonitor] = field(default_factory=dict)
    heard_s: float = float("-inf")
    """Arrival of the latest message [s]."""
    now_s: float = float("nan")
    """Its own time [s]."""
    is_lost: bool = False
    autopilot: int | None = None
    is_stream: bool = True
    """False where samples of any channel are given directly."""
    messages: set[str] = field(init=False)
    """Messages that carry its channels."""
    seldom: set[str] = field(init=False)
    """Messages that tell of airspeed and supply, if its servos depend on them."""
    _table: ChannelTable = field(init=False)
    _around: Surroundings = field(init=False)
    _is_news: bool = False
    _counted_s: float = float("-inf")
    _routes: dict[str, list[tuple[str, int]]] = field(default_factory=dict)
    _early: list[tuple[Heard, float]] = field(default_factory=list)
    _samples: dict[str, tuple[tuple[list[float], list[float]], tuple[list[float], list[float]]]] = field(
        default_factory=dict
    )

    def __post_init__(self) -> None:
        for name, surface in self.aircraft.surfaces.items():
            if surface.measured is None:
                continue
            self.monitors[name] = SurfaceMonitor(name, surface, self.aircraft.model(name))
            self._routes.setdefault(surface.command.channel, []).append((name, 0))
            self._routes.setdefault(surface.measured.channel, []).append((name, 1))
        if not self.monitors:
            raise ConfigError("the aircraft file names no measured channel: nothing can be watched")
        self.messages = ChannelTable(self._routes).messages
        self._around = Surroundings(sorted({need for m in self.monitors.values() for need in m.model.needs}))
        beside = ChannelTable(self._around.channels)
        self.seldom = beside.messages - self.messages
        self._table = ChannelTable([*self._routes, *(n for n in self._around.channels if n not in beside.unknown)])
        if self._table.unknown and self.is_stream:
            raise ConfigError(
                f"channel {self._table.unknown[0]!r} is none of a MAVLink stream; write for example "
                "SERVO_OUTPUT_RAW.servo2_raw or NAMED_VALUE_FLOAT[SRVP2].value"
            )

    @property
    def channels(self) -> list[str]:
        """Names of its channels: commands first, after what both depend on."""
        mine = sorted(self._routes, key=lambda channel: min(role for _, role in self._routes[channel]))
        return [*self._around.channels, *mine]

    def hear(self, heard: Heard, arrival_s: float) -> list[Event]:
        """Take a message of this vehicle; what is to be told comes with `evaluate`, except about the link."""
        events = self._back(arrival_s)
        self.losses.setdefault(heard.component, Losses()).count(heard.sequence)
        self.heard_s = arrival_s
        if heard.name == "HEARTBEAT" and heard.component == 1:
            self.autopilot = int(heard.fields["autopilot"])
        if not self.clock.is_set(arrival_s) and not self.clock.is_reference(heard):
            if heard.name in self._table.messages:
                self._early.append((heard, arrival_s))
            return events
        restarts = self.clock.restarts
        time_s = self.clock.time_s(heard, arrival_s)
        if self.clock.restarts != restarts:
            events += self._restart(time_s)
        early, self._early = self._early, []
        for before, at_s in early:
            self._sort(before, self.clock.time_s(before, at_s))
        if time_s is not None:
            self.now_s = time_s
            self._sort(heard, time_s)
        return events

    def rates_hz(self, arrival_now_s: float) -> dict[str, float]:
        """How often each message came, once every few seconds; empty in between, and while nothing comes at all."""
        span_s = arrival_now_s - self._counted_s
        if span_s < _COUNT_S:
            return {}
        counts, self._counted_s = self._table.counted(), arrival_now_s
        if self.is_lost or not span_s < 2.0 * _COUNT_S or arrival_now_s - self.heard_s > _SILENCE_S:
            return {}
        return {message: count / span_s for message, count in counts.items()}

    def give(self, channels: Iterable[tuple[str, float, float]]) -> None:
        """Take samples of channels directly: name, time [s] and value as logged."""
        for channel, time_s, value in channels:
            self.now_s = time_s
            self._add(channel, time_s, value)

    def evaluate(self) -> list[Event]:
        """Evaluate all that was heard since."""
        samples, self._samples = self._samples, {}
        events = []
        if self._is_news:
            context, self._is_news = self._around.context(), False
            for monitor in self.monitors.values():
                monitor.surroundings(context)
        for name, (commands, positions) in samples.items():
            asked = (np.array(commands[0]), np.array(commands[1])) if commands[0] else (_NONE, _NONE)
            seen = (np.array(positions[0]), np.array(positions[1])) if positions[0] else (_NONE, _NONE)
            events += self.monitors[name].feed(asked, seen)
        if np.isfinite(self.now_s):
            for monitor in self.monitors.values():
                events += monitor.silence(self.now_s)
        return events

    def silence(self, arrival_now_s: float) -> list[Event]:
        """Tell that nothing comes from this vehicle any more; `arrival_now_s` is the receiver's clock [s]."""
        if self.is_lost or not arrival_now_s - self.heard_s > _SILENCE_S or self.heard_s == float("-inf"):
            return []
        self.is_lost = True
        quiet_s = arrival_now_s - self.heard_s
        return [Event(self.now_s, "", "link_lost", text=f"nothing from vehicle {self.system} for {quiet_s:.1f} s")]

    def due(self) -> list[tuple[SurfaceMonitor, Look]]:
        """What the bank should look at now."""
        looks = ((monitor, monitor.due()) for monitor in self.monitors.values())
        return [(monitor, look) for monitor, look in looks if look is not None]

    def finish(self) -> list[Event]:
        """End of the stream."""
        events = self.evaluate()
        for monitor in self.monitors.values():
            events += monitor.finish()
        return events

    def _back(self, arrival_s: float) -> list[Event]:
        """The link is there again; how long it was away is known even if nobody asked meanwhile."""
        events = self.silence(arrival_s)
        if not self.is_lost:
            return events
        self.is_lost = False
        text = f"vehicle {self.system} is heard again after {arrival_s - self.heard_s:.1f} s"
        return [*events, Event(self.now_s, "", "link_restored", text=text)]

    def _restart(self, time_s: float | None) -> list[Event]:
        events = self.evaluate()
        for monitor in self.monitors.values():
            events += monitor.restart()
        now_s = self.now_s if time_s is None else time_s
        return [
            *events,
            Event(now_s, "", "no_data", text=f"vehicle {self.system} has restarted; the monitor begins anew"),
        ]

    def _sort(self, heard: Heard, time_s: float | None) -> None:
        if time_s is not None:
            for channel, value in self._table.of(heard):
                self._add(channel, time_s, value)

    def _add(self, channel: str, time_s: float, value: float) -> None:
        self._is_news |= self._around.add(channel, time_s, value)
        for name, role in self._routes.get(channel, ()):
            columns = self._samples.setdefault(name, (([], []), ([], [])))[role]
            columns[0].append(time_s)
            columns[1].append(value)
