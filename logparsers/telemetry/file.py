"""MAVLink telemetry logs (.tlog): opened in one pass over the file, decoded one column at a time.

Opening finds and checks every frame (MAVLink 1 and 2, signed or not) and decodes none. A column is copied out
of the mapped file when it is asked for, bit for bit as pymavlink decodes it. Damage costs the frames it hit.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from logparsers.channels import MOST_CHANNELS, Series, as_float
from logparsers.errors import UnreadableLog
from logparsers.mavlink import Dialect, dialect, enum_name, rival_names, version_text
from logparsers.protocol import LONGEST_TEXT, Autopilot, Capability, Kind, ParameterType, kind_of
from logparsers.records import Damage, FloatArray, Setting, Text, settings_changed
from logparsers.source import LogBytes, mapped
from logparsers.telemetry import frames
from logparsers.telemetry.clock import TelemetryClock
from logparsers.telemetry.messages import MessageTable
from logparsers.texts import split_rows

if TYPE_CHECKING:
    from logparsers.telemetry.messages import Sender

_SAMPLE_BYTES = 1 << 17
"""Bytes that are read again in other dialects, where something cannot be read in the default one."""
_INTEGERS = {
    ParameterType.UINT8: "u1", ParameterType.INT8: "i1", ParameterType.UINT16: "<u2", ParameterType.INT16: "<i2",
    ParameterType.UINT32: "<u4", ParameterType.INT32: "<i4",
}  # fmt: skip
_NO_VEHICLES = [
    getattr(Kind, name)
    for name in (
        *("GCS", "ONBOARD_CONTROLLER", "GIMBAL", "ADSB", "CAMERA", "CHARGING_STATION", "FLARM", "SERVO", "ODID"),
        *("BATTERY", "PARACHUTE", "LOG", "OSD", "IMU", "GPS", "WINCH", "ILLUMINATOR", "GRIPPER"),
    )
]
"""What sends heartbeats beside a vehicle."""
_AUTOPILOTS = {"ardupilotmega": "ArduPilot", "px4": "PX4"}
_BANNER = re.compile(r"(Ardu\w+|APM:\w+|PX4|Rover|Blimp|AntennaTracker)[ -]?V?\d")
_NO_SERIES = ("PARAM_", "MISSION_", "STATUSTEXT", "FILE_TRANSFER", "LOG_", "REMOTE_LOG", "TERRAIN_DATA")
"""Messages that carry lists, files or words: their numbers are no signal over time."""
_OFTEN_TWICE = 0.25
"""Share of a message's rows from which on those that repeat the one before, stamp and all, are a link's doing."""


_KINDS = {
    frames.BAD_CHECKSUM: ("bad_checksum", "a message with a wrong check-sum"),
    frames.LOST_SYNC: ("corrupt", "no message can be read"),
    frames.TRUNCATED: ("truncated", "the file ends inside a message"),
}


@dataclass(frozen=True, slots=True)
class Vehicle:
    """The aircraft, as its autopilot introduces itself.

    `type`: for example ``"fixed wing"``. `autopilot`: for example ``"ardupilotmega"`` or ``"px4"``. `firmware`:
    version, for example ``"4.7.0-dev"`` or a line of text; empty if it never said. `system`, `component`: its MAVLink
    address; 0 where the log has none.
    """

    type: str
    autopilot: str
    firmware: str = ""
    system: int = 0
    component: int = 0

    def kind(self, parameters: Mapping[str, float]) -> str:
        """What it is by its own word and its parameters."""
        return kind_of(self.type, parameters)


class Stream(NamedTuple):
    """Messages that share a clock: one type, from one sender, of one instance."""

    message: str
    source: Sender | None
    instance: object


class TelemetryFile(MessageTable):
    """One telemetry log.

    A name is ``MESSAGE.field``; the elements of an array ``MESSAGE.field[0]`` and on. A message that comes in
    several instances has its value in brackets, ``NAMED_VALUE_FLOAT[SRVP1].value``; the number 0 is left out
    (``SERVO_OUTPUT_RAW.servo3_raw`` is port 0, ``SERVO_OUTPUT_RAW[1].servo3_raw`` port 1). ``1/1:`` stands
    before it, system and component, where several sources send that message (named values: that name). Where
    instances are numbered and named (``DEBUG_FLOAT_ARRAY``), the name stands in the channel's origin. Lists, files and
    words (parameters, missions, texts) are no channels.

    `data` (shape (n,)): the file; kept, not copied. `name`: what to call it in messages. `dialect`: the one that knows
    all messages, unless another reads more of the file. `lost_bytes`: how many belong to no good message. `unknown`:
    frames of messages the dialect does not know: kept in step, never decoded.
    """

    def __init__(self, data: NDArray[np.uint8], name: str) -> None:
        known, (markers, kinds, unstamped, spans, hurt, lost) = _read(data)
        if markers.size == 0:
            raise UnreadableLog(f"{name}: no MAVLink message with a correct check-sum in {data.size} bytes")
        rows = split_rows([*known.layouts, ""], kinds)
        self.unknown = int(rows.pop("").size)
        positions = {message: markers[mine] for message, mine in rows.items() if mine.size}
        super().__init__(name, data, positions, known.layouts, unstamped)
        self.dialect, self.lost_bytes = known.name, lost
        self.damaged_bytes: NDArray[Any] = spans
        """Stretches without good messages: ``offset``, ``length`` [bytes] and ``kind``; the first 1000."""
        self._hurt: int = hurt
        self._bare = bool(unstamped.size > markers.size // 2)
        self.clock = TelemetryClock(self, bare=self._bare)

    @classmethod
    def open(cls, source: LogBytes) -> TelemetryFile:
        """Map a file, or take bytes, and find its messages."""
        return cls(*mapped(source))

    def time_s(self, message: str, *, source: Sender | None = None, instance: object = None) -> FloatArray:
        """When each message was made, on the time base of the file.

        `source`, `instance`: as for `column`. Result (shape (n,)): seconds since the vehicle's first boot [s], in the
        order of the file (not always rising: messages overtake each other). From the message's own clock, overflows
        added; from its arrival time, mapped onto the vehicle's clock, if it has none. Without a vehicle clock: since
        the first message.
        """
        chosen: FloatArray = self.clock.time_s(message, source)[self.pick(message, source, instance)]
        return chosen

    def series(self) -> dict[str, Series]:
        """Every series by the name of its channel."""
        found: dict[str, Series] = {}
        for message in self.messages:
            if message.startswith(_NO_SERIES):
                continue
            senders: tuple[Sender | None, ...] = self.sources(message)
            alone = self._of_one_sender(message)
            for sender in senders if len(senders) > 1 else (None,):
                if len(found) > MOST_CHANNELS:
                    return found
                prefix = f"{sender.system}/{sender.component}:" if sender else ""
                found.update(self._of(message, sender, prefix, alone))
        return found

    def stamps(self, group: Stream) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        """Time of each message [s], and which did not come a second time, where many do, as over two links.

        Those that could not be placed have their arrival time. A receiver that is asked twice between two fixes says
        the same twice as well.
        """
        time_s = self.time_s(group.message, source=group.source, instance=group.instance)
        again = np.diff(time_s, prepend=np.nan) == 0.0
        if self.layout(group.message).clock is None or np.count_nonzero(again) < _OFTEN_TWICE * again.size:
            return time_s, None
        markers = self.stream(group.message, group.source)[self.pick(group.message, group.source, group.instance)]
        width = max(field.offset + field.width for field in self.layout(group.message).fields.values())
        places = np.flatnonzero(again)
        now, before = (frames.gather(self._data, markers[each], 0, width) for each in (places, places - 1))
        again[places] = (now == before).all(axis=1)
        return time_s, ~again if np.count_nonzero(again) >= _OFTEN_TWICE * again.size else None

    def values(self, series: Series) -> NDArray[Any]:
        """Numbers of a series in the order of the file."""
        of: Stream = series.group  # type: ignore[assignment]
        return self.column(of.message, series.field, source=of.source, instance=of.instance, element=series.element)

    def _of_one_sender(self, message: str) -> set[object]:
        """Names that a single sender gives to values, such as those of a monitor beside those of the autopilot."""
        layout = self.layout(message)
        if not layout.instance or not layout.fields[layout.instance].is_text:
            return set()
        given = Counter(name for sender in self.sources(message) for name in self.instances(message, sender))
        return {name for name, count in given.items() if count == 1}

    def _of(self, message: str, source: Sender | None, prefix: str, alone: Collection[object]) -> dict[str, Series]:
        """Series of one sender's messages of one type; no prefix for names that no other sender gives."""
        layout = self.layout(message)
        clock = layout.clock[0].name if layout.clock else ""
        fields = [f for f in layout.fields.values() if not f.is_text and f.name not in (clock, layout.instance)]
        named = layout.instance != "name" and "name" in layout.fields and layout.fields["name"].is_text
        found: dict[str, Series] = {}
        for instance in self.instances(message, source) or (None,):
            if len(found) > MOST_CHANNELS:
                break
            bracket = "" if instance is None or instance == 0 else f"[{instance}]"
            stream = Stream(message, source, instance)
            titles = set(self.column(message, "name", source=source, instance=instance)) if named else ()
            title = f"[{next(iter(titles))}]" if len(titles) == 1 and "" not in titles else ""
            for field in fields:
                sender = "" if instance in alone else prefix
                stem, origin = f"{sender}{message}{bracket}.{field.name}", f"{message}{title}.{field.name}"
                if not field.length:
                    found[stem] = Series(stream, field.name, None, field.unit, origin)
                for k in range(field.length):
                    found[f"{stem}[{k}]"] = Series(stream, field.name, k, field.unit, f"{origin}[{k}]")
        return found

    @property
    def damage(self) -> tuple[Damage, ...]:
        """What is wrong with bytes and clocks."""
        return (*self._byte_damage, *self.clock.damage)

    @property
    def start_utc(self) -> datetime | None:
        """Date and time at 0 s: by the vehicle's clock (SYSTEM_TIME) if it was set, else by the receiver's."""
        return self.clock.start_utc

    @cached_property
    def parameters(self) -> Mapping[str, float]:
        """Last value of each parameter of the vehicle."""
        return MappingProxyType({name: value for _, name, value in self._settings})

    @cached_property
    def _settings(self) -> list[tuple[float, str, float]]:
        """When the vehicle reported a parameter [s], which, and its value."""
        source = self._vehicle_source("PARAM_VALUE")
        if source is None:
            return []
        values = self.column("PARAM_VALUE", "param_value", source=source)
        numbers = as_float(values)
        if self._sends_bytes(source):
            kinds = self.column("PARAM_VALUE", "param_type", source=source)
            for kind, dtype in _INTEGERS.items():
                rows = kinds == kind
                raw = np.ascontiguousarray(values[rows]).view(np.uint8).reshape(-1, 4)
                width = np.dtype(dtype).itemsize
                numbers[rows] = np.ascontiguousarray(raw[:, :width]).view(dtype).reshape(-1)
        names = self.column("PARAM_VALUE", "param_id", source=source)
        times_s = self.time_s("PARAM_VALUE", source=source)
        return list(zip(times_s.tolist(), names.tolist(), numbers.tolist(), strict=True))

    def _sends_bytes(self, source: Sender) -> bool:
        """Whether integers are sent as their bytes."""
        if source in self.sources("AUTOPILOT_VERSION"):
            flags = int(self.column("AUTOPILOT_VERSION", "capabilities", source=source)[-1])
            return bool(flags & Capability.PARAM_ENCODE_BYTEWISE)
        if source in self.sources("HEARTBEAT"):
            return bool((self.column("HEARTBEAT", "autopilot", source=source) == Autopilot.PX4).any())
        return False

    def _vehicle_source(self, message: str) -> Sender | None:
        """Pick the vehicle among the senders of a message, or the busiest if it is not among them."""
        senders = self.sources(message)
        if not senders:
            return None
        craft = self.craft
        for sender in senders:
            if craft and sender == (craft.system, craft.component):
                return sender
        return max(senders, key=lambda sender: self.stream(message, sender).size)

    @property
    def changed(self) -> tuple[Setting, ...]:
        """Parameters that became other ones while the log ran."""
        return settings_changed(self._settings)

    @cached_property
    def texts(self) -> tuple[Text, ...]:
        """What the vehicle and others said in words, in the order of the file; long texts are put together again."""
        found: list[tuple[int, Text]] = []
        senders = self.sources("STATUSTEXT")
        for sender in senders:
            name = f"{sender.system}/{sender.component}" if len(senders) > 1 else ""
            columns = ("severity", "text", "id", "chunk_seq")
            rows = [self.column("STATUSTEXT", field, source=sender).tolist() for field in columns]
            begun: tuple[int, int] | None = None  # text and next chunk that may continue the last entry
            times = self.time_s("STATUSTEXT", source=sender).tolist()
            places = self.stream("STATUSTEXT", sender).tolist()
            for place, time_s, severity, text, number, chunk in zip(places, times, *rows, strict=True):
                if begun and begun == (number, chunk) and number:
                    where, before = found[-1]
                    found[-1] = where, Text(before.time_s, before.text + text, severity, name)
                else:
                    found.append((place, Text(time_s, text, severity, name)))
                begun = (number, chunk + 1) if len(text) == LONGEST_TEXT else None
        return tuple(text for _, text in sorted(found, key=lambda entry: entry[0]))

    @cached_property
    def craft(self) -> Vehicle | None:
        """The sender of the most heartbeats of a vehicle that name an autopilot; None if there is none.

        Ground stations that call themselves a generic autopilot, and trackers that follow the aircraft, come after it.
        """
        found: list[tuple[tuple[bool, bool, int], Vehicle]] = []
        for source in self.sources("HEARTBEAT"):
            autopilots = self.column("HEARTBEAT", "autopilot", source=source)
            kinds = self.column("HEARTBEAT", "type", source=source)
            named = (autopilots != Autopilot.INVALID) & ~np.isin(kinds, _NO_VEHICLES)
            if not named.any():
                continue
            kind, autopilot = (int(np.bincount(each[named]).argmax()) for each in (kinds, autopilots))
            rank = kind != Kind.ANTENNA_TRACKER, autopilot != Autopilot.GENERIC, int(np.count_nonzero(named))
            names = enum_name("MAV_TYPE", kind), enum_name("MAV_AUTOPILOT", autopilot)
            found.append((rank, Vehicle(*names, self._version(source), *source)))
        return max(found, key=lambda each: each[0])[1] if found else None

    def _version(self, source: Sender) -> str:
        """Version from AUTOPILOT_VERSION, else from the banner that ArduPilot prints when parameters are read."""
        if source in self.sources("AUTOPILOT_VERSION"):
            number = int(self.column("AUTOPILOT_VERSION", "flight_sw_version", source=source)[-1])
            if number:
                return version_text(number)
        return next((said.text for said in self.texts if _BANNER.match(said.text)), "")

    @property
    def vehicle(self) -> str:
        """Kind of aircraft, for example ``"fixed wing"``; empty if the log does not say."""
        return self.craft.kind(self.parameters) if self.craft else ""

    @property
    def firmware(self) -> str:
        """Name and version; a version alone gets the name of the autopilot. Empty if the log does not say."""
        if self.craft is None:
            return ""
        name, said = _AUTOPILOTS.get(self.craft.autopilot, self.craft.autopilot), self.craft.firmware
        return f"{name} {said}" if said[:1].isdigit() else said or name

    @cached_property
    def _byte_damage(self) -> tuple[Damage, ...]:
        found = [self._describe(span) for span in self.damaged_bytes]
        more = self._hurt - self.damaged_bytes.size
        if more:
            rest = self.lost_bytes - int(self.damaged_bytes["length"].sum())
            found.append(Damage("corrupt", f"{more} more damaged stretches, {rest} bytes in all", rest))
        if self.unknown:
            note = f"{self.unknown} messages that dialect {self.dialect!r} does not know, or with a damaged id"
            found.append(Damage("unknown_message", note, self.unknown))
        if self._bare:
            found.append(Damage("no_arrival_time", "frames were stored without arrival times", self._unstamped.size))
        elif self._unstamped.size:
            note = "good messages whose arrival time was damaged; a neighbour's is used"
            found.append(Damage("no_arrival_time", note, self._unstamped.size))
        return tuple(found)

    def _describe(self, span: Any) -> Damage:  # noqa: ANN401 - a row of SPAN
        """Place a damaged stretch in time by the first good frame after it."""
        offset, length = int(span["offset"]), int(span["length"])
        kind, words = _KINDS[int(span["kind"])]
        time_s = None
        follower = np.array([offset + length + frames.STAMP_BYTES], dtype=np.int64)
        if follower[0] < self._data.size and not self._bare and follower[0] not in self._unstamped:
            time_s = float(self.clock.timeline.from_arrival(self.clock.arrival_s(follower), follower)[0])
        return Damage(kind, f"{words}: {length} bytes at offset {offset}", length, time_s, time_s)


def _read(data: NDArray[np.uint8]) -> tuple[Dialect, tuple[Any, ...]]:
    """Find the frames, in the dialect that finds most."""
    known = dialect()
    found = frames.scan(data, known.slots, known.seeds)
    _, kinds, _, spans, _, _ = found
    if not ((spans["kind"] != frames.TRUNCATED).any() or (kinds == known.seeds.size).any()):
        return known, found
    pieces = [data[span["offset"] : span["offset"] + span["length"]][:_SAMPLE_BYTES] for span in spans[:200]]
    sample = np.concatenate([data[:_SAMPLE_BYTES], *pieces])[: 2 * _SAMPLE_BYTES]
    best, most = known, _decodable(sample, known)
    for rival in (dialect(name) for name in rival_names()):
        if (read := _decodable(sample, rival)) > most:
            best, most = rival, read
    return (best, frames.scan(data, best.slots, best.seeds)) if best is not known else (known, found)


def _decodable(sample: NDArray[np.uint8], known: Dialect) -> int:
    """Messages that a dialect can check and decode."""
    return int(np.count_nonzero(frames.scan(sample, known.slots, known.seeds)[1] < known.seeds.size))
