"""The monitor at work: frames in, events out; where they come from and where they go is decided elsewhere."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from logparsers.codec import Codec, Received, is_signed
from logparsers.protocol import Autopilot, Component
from logparsers.units import S_PER_NS, US_PER_S
from servofd.aircraft.outputs import of_other_messages
from servofd.aircraft.schema import Aircraft, plain_aircraft
from servofd.detection.event import Event, Inputs
from servofd.detection.monitor import SurfaceMonitor
from servofd.detection.stream import Piece
from servofd.live.channels import ChannelTable, stamp_of
from servofd.live.requests import RemoteLog
from servofd.live.vehicle import Vehicle

_GROUND_SYSTEM = 255
"""System id of ground stations, which are no vehicles."""
_SYNC_S = 5.0
"""How often the delay of a link is asked for; ground stations ask every 10 s."""
_SETTLED_S = 1.0
"""When a vehicle has sent no new channel for so long, it is known what it sends: positions come five times a second."""
_RENUMBERED_S = 1.0
"""A vehicle that was silent for so long while another number's stamps go on where its own ended, to within as long [s],
has been given that number: autopilots take a new system id at once, and no two boot within a second."""
_LATEST_US = 2**64 - 1
"""That a telemetry log can hold; read from a damaged one, seconds in a float come to one more."""


def _positions(craft: Aircraft) -> set[str]:
    """Channels of the positions by which a file's surfaces are watched, and of currents where there are none."""
    return {surface.watched_channel for surface in craft.surfaces.values() if surface.can_be_watched} - {""}


def stamped(arrival_s: float, frame: bytes) -> bytes:
    """A frame as a telemetry log holds it: after its arrival time in microseconds."""
    return struct.pack(">Q", min(round(arrival_s * US_PER_S), _LATEST_US)) + frame


def _load_bank() -> None:
    """Have the bank look at a made-up jam: whatever it loads and compiles is there before the first alarm."""
    aircraft = plain_aircraft(["any"], "s9254")
    model = aircraft.model("any")
    surface = aircraft.surfaces["any"].model_copy(update={"threshold": "interval"})
    time_s = np.arange(0.0, 16.0, 0.02)
    asked_deg = 10.0 * np.sin(2.0 * time_s)
    moved_deg = np.where(time_s < 12.0, model.simulate(time_s, asked_deg, time_s), 5.0)
    monitor = SurfaceMonitor("any", surface, model)
    for piece in np.array_split(np.arange(time_s.size), 80):
        monitor.feed((time_s[piece], asked_deg[piece]), (time_s[piece], moved_deg[piece]))
        look = monitor.due()
        if look is not None:
            monitor.events_of(look, look.find())


@dataclass(slots=True)
class Session:
    """All vehicles of one link."""

    codec: Codec
    """Takes frames apart; its own messages are made elsewhere."""
    aircraft: Mapping[int, Aircraft]
    """By system id; with the key 0, of whichever vehicle speaks first, and with -1, -2, ... beside it of those whose
    positions they name."""
    store: Callable[[bytes], None] | None = None
    """Takes every frame with its arrival time, as a telemetry log has it."""
    send: Callable[[int, str, dict[str, Any]], None] | None = None
    """Sends requests to a vehicle: its number, message name and fields. None: nothing is asked for."""
    alert: Callable[[int, str, dict[str, Any]], None] | None = None
    """Sends alerts about a vehicle, with the same arguments. None: nothing is said."""
    is_stream: bool = True
    """False for a log of another kind, whose samples are given directly."""
    aside: bool = False
    """Whether the bank works in a thread of its own; otherwise the session waits for it."""
    remote_log: bool = False
    """Whether channels are those of the autopilot's own log, which is asked for if there is a `send`."""
    component: int = 191
    """As which it asks: answers to others are none of its own."""
    listener: Callable[[str, Piece, Inputs], None] | None = None
    """Called with every piece that was evaluated."""
    vehicles: dict[int, Vehicle] = field(default_factory=dict)
    strangers: set[int] = field(default_factory=set)
    """Systems on the link that no aircraft file is for."""
    names: set[str] = field(default_factory=set)
    """Messages that were received from vehicles."""
    notes: list[str] = field(default_factory=list)
    """News of the link, to be shown and forgotten."""
    frames: int = 0
    damaged_bytes: int = 0
    signed: tuple[int, int] = (0, 0)
    """Whole frames that carry a signature: taken, and refused because it is another key's."""
    _pool: ThreadPoolExecutor | None = None
    _compared: set[str] = field(default_factory=set)
    _left: set[int] = field(default_factory=set)
    """Systems that were watched until another one sent the positions."""
    _wanted: set[str] = field(default_factory=set)
    """Messages that a vehicle sends which has such a file,"""
    _table: ChannelTable = field(init=False)
    """and the positions in them."""
    _met_s: dict[int, float] = field(default_factory=dict)
    """When a vehicle without a file first spoke [s],"""
    _renumbered: dict[int, int] = field(default_factory=dict)
    """and of whom it turned out to be the watched one, by the number that this has now."""
    _first: int = 0
    """The vehicle that has the one file without a system id."""
    _open: dict[int, Aircraft] = field(default_factory=dict)
    """Of several files without a system id, those that no vehicle has yet,"""
    _sent: dict[int, dict[str, float]] = field(default_factory=dict)
    """and when a vehicle without a file has first sent a position [s], by its channel."""

    def __post_init__(self) -> None:
        for system in self.aircraft:
            vehicle = self._adopt(system, system)
            if system <= 0:
                self._wanted |= vehicle.messages
                del self.vehicles[system]
        if -1 in self.aircraft:
            self._open = {number: craft for number, craft in self.aircraft.items() if number <= 0}
        self._table = ChannelTable(channel for craft in self.aircraft.values() for channel in _positions(craft))
        if self.aside:
            self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="servofd bank")
            self._pool.submit(_load_bank)

    def take(self, arrival_s: float, data: bytes) -> list[Event]:
        """Take bytes that arrived [s, the receiver's clock]."""
        events: list[Event] = []
        for frame, message in self.codec.frames(data):
            if self.store is not None:
                self.store(stamped(arrival_s, frame))
            if message is None:
                self.damaged_bytes += len(frame)
            if is_signed(frame):
                taken, refused = self.signed
                if message is not None and not taken:  # say once whether they are checked
                    fits = "signatures are those of the key: what carries no such one is not believed"
                    open_ = "frames are signed, and taken unchecked: --signing-key FILE would check them"
                    self.notes.append(fits if self.codec.has_key else open_)
                self.signed = (taken + (message is not None), refused + (message is None))
            if message is None:
                continue
            self.frames += 1
            if message.system in self._renumbered:
                message = replace(message, system=self._renumbered[message.system])  # noqa: PLW2901 - the same vehicle's
            vehicle = self.vehicles.get(message.system) or self._found(message, arrival_s)
            if vehicle is not None:
                self.names.add(message.name)
                reports = vehicle.receive(message, arrival_s)
                if any(event.event == "link_restored" or "restarted" in event.text for event in reports):
                    vehicle.requests.again()  # it may have started anew, with its usual rates
                events += reports
                is_answer = message.name == "TIMESYNC" and message.component == Component.AUTOPILOT1
                if is_answer and message.fields["tc1"] > 0:
                    vehicle.clock.latency.answered(message.fields["ts1"], message.fields["tc1"] * S_PER_NS, arrival_s)
                self._note(vehicle.requests.receive(message))
        return events

    def _note(self, said: str) -> None:
        if said:
            self.notes.append(said)

    def step(self, arrival_now_s: float, *, final: bool = False) -> list[Event]:
        """Evaluate what was taken, or of it what cannot wait for the next step, and do what is due."""
        events: list[Event] = []
        self._match(arrival_now_s)
        for vehicle in tuple(self.vehicles.values()):
            for monitor in vehicle.every:
                monitor.listener = self.listener
            seen = [*vehicle.evaluate(final=final), *vehicle.silence(arrival_now_s), *self._look(vehicle)]
            events += self._speak(vehicle, seen, arrival_now_s)
            self._inquire(vehicle, arrival_now_s)
            self._compare(vehicle)
        return events

    @property
    def at_ease(self) -> bool:
        """Whether no surface of any vehicle is anywhere near an alarm."""
        return all(monitor.at_ease for vehicle in self.vehicles.values() for monitor in vehicle.monitors.values())

    def rests(self, for_s: float) -> bool:
        """Whether nothing is looked into for so long [s], and of every surface something has come to be evaluated."""
        return all(vehicle.rests(for_s) for vehicle in self.vehicles.values())

    def finish(self, arrival_now_s: float) -> list[Event]:
        """End of the stream."""
        if self._pool is not None:
            self._pool.shutdown(wait=True)
        events: list[Event] = []
        for vehicle in self.vehicles.values():
            events += self._speak(vehicle, self._finished_looks(vehicle) + vehicle.finish(), arrival_now_s)
        return events

    @property
    def watched(self) -> list[tuple[Vehicle, SurfaceMonitor]]:
        """Every surface of every vehicle, in its latest boot."""
        return [(vehicle, monitor) for vehicle in self.vehicles.values() for monitor in vehicle.monitors.values()]

    @property
    def judges(self) -> list[SurfaceMonitor]:
        """Those of every surface and every boot."""
        return [one for vehicle in self.vehicles.values() for one in (*vehicle.past, *vehicle.judges)]

    def _found(self, message: Received, arrival_s: float) -> Vehicle | None:
        """The first vehicle that speaks, if the aircraft file says of none which it is.

        Whoever speaks first is asked for positions; the first that sends any is the one. Of several such files each
        waits for a vehicle that sends what it names.
        """
        autopilot = message.name == "HEARTBEAT" and message.component == Component.AUTOPILOT1
        autopilot = autopilot and message.fields["autopilot"] != Autopilot.INVALID
        if 0 not in self.aircraft or message.system == _GROUND_SYSTEM:
            self._stranger(message.system, autopilot)
            return None
        self._met_s.setdefault(message.system, arrival_s)
        sent = self._table.of(message)
        if -1 in self.aircraft:
            since_s = self._sent.setdefault(message.system, {})
            for channel, _ in sent:
                since_s.setdefault(channel, arrival_s)
            if not self._open:
                self._stranger(message.system, autopilot)
            return None
        bound = self.vehicles.get(self._first)
        if bound is not None:
            if bound.has_positions and self._is_bound(bound, message, arrival_s):
                self.notes.append(f"vehicle {bound.system} speaks as vehicle {message.system} now: it is watched on")
                self._renumbered[message.system] = bound.system
                return bound
            if bound.has_positions or message.system in self._left or not sent:
                met_s = self._met_s[message.system]
                if bound.received_s > met_s or arrival_s - met_s > 2.0 * _RENUMBERED_S:  # else it may be the bound one
                    self._stranger(message.system, autopilot)
                return None
            left = bound.system
            self.notes.append(f"vehicle {message.system} sends the positions: it is watched, not vehicle {left}")
            del self.vehicles[left]
            self._left.add(left)
            self.strangers.add(left)
        elif not autopilot and message.name not in self._wanted:
            return None
        self._first = message.system
        return self._adopt(message.system, 0)

    def _is_bound(self, bound: Vehicle, message: Received, arrival_s: float) -> bool:
        """Whether a message of another number is that of the watched vehicle, whose number was changed in flight.

        That fell silent when the other began, and its clock goes on in the other's stamps.
        """
        stamp, silent_s = stamp_of(message.name), arrival_s - bound.received_s
        if stamp is None or silent_s < _RENUMBERED_S or bound.received_s > self._met_s[message.system]:
            return False
        return abs(stamp.tick_s * float(message.fields[stamp.field]) - bound.now_s - silent_s) <= _RENUMBERED_S

    def _match(self, arrival_now_s: float) -> None:
        """Give each of several files to the vehicle that sends the positions it names.

        A vehicle has the file of which it sends the most. Where it may be one of two, the files belong to the vehicles
        in the order of their numbers, once there are as many.
        """
        named = {number: _positions(craft) for number, craft in self._open.items()}
        fits: dict[int, list[int]] = {}
        for system, since_s in sorted(self._sent.items()):
            if since_s and arrival_now_s - max(since_s.values()) >= _SETTLED_S:
                most = max((len(names) for names in named.values() if names <= since_s.keys()), default=0)
                fits[system] = [n for n, names in named.items() if len(names) == most and names <= since_s.keys()]
        are_all_here = sum(map(bool, fits.values())) >= len(self._open)
        for system, numbers in fits.items():
            if numbers and (are_all_here or len(numbers) == 1):
                surfaces = ", ".join(self._open.pop(numbers[0]).surfaces)
                self.notes.append(f"vehicle {system} is watched with file {1 - numbers[0]}: it sends {surfaces}")
                self._adopt(system, numbers[0])
                del self._sent[system]
                return

    def _stranger(self, system: int, is_vehicle: bool) -> None:
        if is_vehicle and system not in self.strangers:
            self.strangers.add(system)
            if self.vehicles:
                self.notes.append(f"vehicle {system} is not watched: -c {system}=FILE would")

    def _adopt(self, system: int, file: int) -> Vehicle:
        vehicle = Vehicle(system, self.aircraft[file], is_stream=self.is_stream and not self.remote_log)
        self.vehicles[system] = vehicle
        vehicle.requests.component = self.component
        if self.remote_log:
            vehicle.log = RemoteLog(system)
        return vehicle

    def _look(self, vehicle: Vehicle) -> list[Event]:
        events = self._finished_looks(vehicle)
        if self._pool is not None:
            vehicle.looks += [(monitor, look, self._pool.submit(look.find)) for monitor, look in vehicle.due()]
            return events
        while looks := vehicle.due():
            for monitor, look in looks:
                events += monitor.events_of(look, look.find())
        return events

    @staticmethod
    def _finished_looks(vehicle: Vehicle) -> list[Event]:
        looks, vehicle.looks, events = vehicle.looks, [], list[Event]()
        for monitor, look, verdict in looks:
            if verdict.done():
                events += monitor.events_of(look, verdict.result())
            else:
                vehicle.looks.append((monitor, look, verdict))
        return events

    def _speak(self, vehicle: Vehicle, seen: list[Event], now_s: float) -> list[Event]:
        """Publish what was seen of a vehicle, and say what there is to say about it."""
        events = vehicle.alarms.publish(seen)
        vehicle.look_for_causes()
        alerts, late = vehicle.alerts, vehicle.clock.latency.news(now_s)
        for news in filter(None, (*vehicle.news, late)):
            self.notes.append(news)
            alerts.note(f"servofd: {news}", now_s)
        vehicle.news.clear()
        if vehicle.log is not None:
            self._note(vehicle.log.news(now_s))
        for event in events:
            monitor = vehicle.monitors.get(event.surface) if event.event == "no_data" else None
            if monitor is not None and monitor.is_watched:  # on a link that is too poor it still is
                alerts.note(f"{event.surface}: {event.text}", now_s)
            else:
                alerts.take(event, now_s)
        for name, monitor in vehicle.monitors.items():
            if monitor.is_watched:
                alerts.watched(name)
        messages = alerts.due(now_s) + alerts.periodic(vehicle.monitors, vehicle.alarms.gravest, vehicle.now_s, now_s)
        if self.alert is not None:
            for name, fields in messages:
                self.alert(self._number_of(vehicle), name, fields)
        return events

    def _inquire(self, vehicle: Vehicle, now_s: float) -> None:
        """Ask a vehicle for what is needed, and for the time."""
        if self.send is None or vehicle.received_s == float("-inf"):
            return
        requests = vehicle.requests
        for message, rate_hz in vehicle.rates_hz(now_s).items():
            self._note(requests.measured(message, rate_hz, now_s))
        due = requests.due(now_s)
        if vehicle.log is not None:
            due += vehicle.log.due(now_s)
        if now_s - vehicle.synced_s >= _SYNC_S:
            vehicle.synced_s = now_s
            due.append(("TIMESYNC", {"tc1": 0, "ts1": vehicle.clock.latency.ask(now_s)}))
            target = {"target_system": vehicle.system, "target_component": Component.AUTOPILOT1, "param_index": -1}
            due += [("PARAM_REQUEST_READ", target | {"param_id": name}) for name in vehicle.unread()]
        number = self._number_of(vehicle)
        for name, fields in due:
            self.send(number, name, fields | ({"target_system": number} if "target_system" in fields else {}))

    def _number_of(self, vehicle: Vehicle) -> int:
        """The system id by which a vehicle goes now."""
        return next((new for new, old in reversed(self._renumbered.items()) if old == vehicle.system), vehicle.system)

    def _compare(self, vehicle: Vehicle) -> None:
        """Say once, of each surface, that less comes than its servo needs, or other messages than it is known by."""
        said_of = [f"{monitor.name}: {monitor.too_slow}" for monitor in vehicle.monitors.values() if monitor.too_slow]
        others = [monitor.name for monitor in vehicle.monitors.values() if monitor.surface.by_other_messages]
        for said in (of_other_messages(others), *said_of):
            if said not in self._compared:
                self._note(said)
                self._compared.add(said)

    def unjudged(self) -> str:
        """Which surfaces were not judged to the end, or not for most of the flight, and why; empty if all were."""
        if not self.watched or self._open:
            return self.waiting() or "no vehicle"
        reasons: dict[str, list[str]] = {}
        for vehicle, monitor in self.watched:
            before = [past for past in vehicle.past if past.name == monitor.name]
            # What has booted just before the end had its flight before.
            why = (before[-1] if before and not (monitor.was_judged or monitor.silenced) else monitor).unjudged
            if vehicle.is_lost:
                why = f"nothing from vehicle {vehicle.system} since {vehicle.now_s:.1f} s"
            if why:
                reasons.setdefault(why, []).append(monitor.name)
        return "; ".join(f"{', '.join(who)}: {why}" for why, who in reasons.items())

    def waiting(self) -> str:
        """What is still missing, in words; empty if every surface is watched."""
        if not self.vehicles:
            return self._nobody()
        missing = {f"file {1 - k} waits for its vehicle (-c ID=FILE)": list(c.surfaces) for k, c in self._open.items()}
        for vehicle in self.vehicles.values():
            if vehicle.axes is not None and vehicle.axes.problem:
                missing.setdefault(vehicle.axes.problem, []).append("axes")
        for vehicle, monitor in self.watched:
            if not monitor.is_watched:
                channel = monitor.surface.watched_channel
                pace = f"learning how often {monitor.quantity}s come"
                why = monitor.silenced or (pace if math.isfinite(monitor.rate_hz) else f"waiting for {channel}")
                who = monitor.name if len(self.vehicles) == 1 else f"{vehicle.system}/{monitor.name}"
                missing.setdefault(why, []).append(who)
        return "; ".join(f"{', '.join(who)}: {why}" for why, who in missing.items())

    def _nobody(self) -> str:
        if self.strangers:
            systems = ", ".join(map(str, sorted(self.strangers)))
            return f"hears vehicle {systems}, for which there is no aircraft file (-c ID=FILE)"
        if self.frames:
            return "hears MAVLink, but no vehicle"
        if self.signed[1] and self.codec.has_key:
            return "no frame is signed with this key: they carry another's signature"
        if self.damaged_bytes:
            if self.codec.has_key:
                return "nothing that it hears is signed: leave --signing-key out, or have the vehicle sign"
            return "hears bytes that are no MAVLink: another baud rate?"
        return "waiting for the first byte"
