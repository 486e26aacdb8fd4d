"""PX4 logs (``.ulg``): of their samples only those of the topics that are asked for reach memory."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from datetime import datetime
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from logparsers.channels import Series
from logparsers.clock import utc_date
from logparsers.errors import EmptyLog, MissingChannel
from logparsers.mavlink import enum_name, version_text
from logparsers.only import Only
from logparsers.records import Damage, Setting, Text, settings_changed
from logparsers.source import LogBytes, mapped
from logparsers.texts import distinct_texts, split_rows
from logparsers.ulog.messages import Content, Samples
from logparsers.units import S_PER_MS, S_PER_US

FloatArray = NDArray[np.float64]

_CLOCK_TOPICS = ("vehicle_gps_position", "sensor_gps", "vehicle_global_position")
"""Small topics that know the date; always read, shown only if they are asked for."""

_NAME_FIELDS = {"debug_key_value": "key", "debug_vect": "name", "debug_array": "name"}
"""Topics that several senders share, and the text that tells them apart."""

_UNITS = {
    "_m_s2": "m/s/s", "_m_s": "m/s", "_rad_s": "rad/s", "_celsius": "degC", "_celcius": "degC", "_rad": "rad",
    "_deg": "deg", "_rpm": "rpm", "_pa": "Pa", "_hz": "Hz", "_us": "us", "_ms": "ms", "_v": "V", "_a": "A",
}  # fmt: skip
"""Endings by which PX4 names units, longer ones first; the log itself has none."""


class Topic(NamedTuple):
    """Rows that share a clock: one topic, one instance, and one sender where the topic names them."""

    name: str
    instance: int
    label: str


_UNIT = re.compile(f"(?:{'|'.join(_UNITS)})$")


def unit_of(field: str) -> str:
    """Read the unit off the end of a field's name; empty if there is none.

    Examples
    --------
    >>> unit_of("true_airspeed_m_s"), unit_of("voltage5v_v"), unit_of("control[3]"), unit_of("rate_rad[0]")
    ('m/s', 'V', '', 'rad')
    """
    found = _UNIT.search(field.partition("[")[0])
    return _UNITS[found[0]] if found else ""


class UlogFile:
    """One PX4 log.

    Names of its channels are ``topic[instance].field``, as in ``actuator_servos[0].control[3]``. Where a topic carries
    named values of several senders, the name follows: ``debug_array[0][SRVP].data[2]``.

    `data` (shape (n,)): the file. `name`: what to call it in messages. `only`: topics to read.
    """

    def __init__(self, data: NDArray[np.uint8], name: str, only: Only) -> None:
        self.name, self._log = name, Content(data, name, lambda topic: topic in only or topic in _CLOCK_TOPICS)
        if not self._log.topics and not self._log.announced:
            raise EmptyLog(f"{name}: the log has no topics")
        self._topics: dict[tuple[str, int], list[Samples]] = {}
        self._named: dict[tuple[str, int], dict[str, NDArray[np.intp]]] = {}
        for found in self._log.topics:
            if "timestamp" in found.types and found.name in only:
                self._topics.setdefault((found.name, found.instance), []).append(found)

    @classmethod
    def open(cls, source: LogBytes, *, only: Sequence[str] | None = None) -> UlogFile:
        """Read the chosen topics of a file, or of bytes.

        `source`: a path, the content itself, or an open binary file. `only`: topics to read, with ``*`` and ``?`` as
        in file names; all if None.
        """
        return cls(*mapped(source), Only.of(only))

    def __repr__(self) -> str:
        return f"<UlogFile {self.name}: {len(self._topics)} topics, {len(self.damage)} defects>"

    @property
    def begin_s(self) -> float:
        """When logging began, by the head of the file [s since boot]."""
        return self._log.start_us * S_PER_US

    @property
    def announced(self) -> tuple[str, ...]:
        """Names of the topics that the log has, whether they were read or not."""
        return tuple(self._log.announced)

    @property
    def topics(self) -> tuple[tuple[str, int], ...]:
        """Name and instance of each topic that was read, sorted."""
        return tuple(self._topics)

    def count(self, topic: str, instance: int = 0) -> int:
        """Count the samples of a topic; 0 if it was not read."""
        return sum(part.places.size for part in self._topics.get((topic, instance), ()))

    def fields(self, topic: str, instance: int = 0) -> Mapping[str, str]:
        """Type of each field of a topic; arrays and nested messages are spread out."""
        return self._topics[topic, instance][0].types

    def column(self, topic: str, field: str, *, instance: int = 0) -> NDArray[Any]:
        """Values of one field in the order of the file, shape (n,), in the type of the log."""
        parts = self._topics[topic, instance]
        columns = [part.rows[field] for part in parts if field in part.types]
        if len(columns) < len(parts):
            raise MissingChannel(f"{topic} has no field {field!r}; it has {', '.join(parts[0].types)}")
        return columns[0] if len(columns) == 1 else np.concatenate(columns)

    def time_s(self, topic: str, *, instance: int = 0) -> FloatArray:
        """Time stamps of a topic [s since boot], shape (n,), in the order of the file."""
        time: FloatArray = self.column(topic, "timestamp", instance=instance) * S_PER_US
        return time

    def series(self) -> dict[str, Series]:
        """Every series by the name of its channel."""
        found: dict[str, Series] = {}
        for topic, instance in self.topics:
            numbers = {f: unit_of(f) for f, kind in self.fields(topic, instance).items() if kind != "char"}
            numbers.pop("timestamp", None)
            for label in self._labels(topic, instance):
                group, stem = Topic(topic, instance, label), f"{topic}[{instance}]{f'[{label}]' if label else ''}"
                for field, unit in numbers.items():
                    found[f"{stem}.{field}"] = Series(group, field, None, unit, f"{topic}.{field}")
        return found

    def stamps(self, group: Topic) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        """Time of each row [s since boot]; 0 was not filled in, unless the log begins at 0."""
        time_s = self._of(group, self.time_s(group.name, instance=group.instance))
        return time_s, time_s > 0.0 if self.begin_s > 0.0 else None

    def values(self, series: Series) -> NDArray[Any]:
        """Numbers of a series in the order of the file."""
        group: Topic = series.group  # type: ignore[assignment]
        return self._of(group, self.column(group.name, series.field, instance=group.instance))

    def _of(self, group: Topic, values: NDArray[Any]) -> NDArray[Any]:
        if group.label:
            return values[self._labels(group.name, group.instance)[group.label]]
        # PX4 logs each topic once at the beginning, with a stamp of 0 if not published yet: no row, no damage.
        first = self._topics[group.name, group.instance][0].rows["timestamp"][:1]
        return values[1:] if self.begin_s > 0.0 and not first.all() else values

    def _labels(self, topic: str, instance: int) -> dict[str, NDArray[np.intp]]:
        """Names that share a topic, and whose each row is."""
        key = (topic, instance)
        if key not in self._named:
            stem = _NAME_FIELDS.get(topic)
            fields = [f for f in self.fields(topic, instance) if stem and f.startswith(f"{stem}[")]
            if fields and self.count(topic, instance):
                raw = np.stack([self.column(topic, f, instance=instance) for f in fields], axis=1)
                self._named[key] = split_rows(*distinct_texts(raw.astype(np.uint8)))
            else:
                self._named[key] = {"": np.zeros(0, dtype=np.intp)}
        return self._named[key]

    @cached_property
    def parameters(self) -> Mapping[str, float]:
        """Parameters, as changed in flight: the last value counts."""
        known = self._log.initial | {name: value for _, name, value in self._log.changed}
        return MappingProxyType({k: float(v) for k, v in known.items() if isinstance(v, int | float)})

    @property
    def changed(self) -> tuple[Setting, ...]:
        """Parameters that became other ones while the log ran."""
        first = [(-np.inf, *each) for each in self._log.initial.items()]
        later = [(time_us * S_PER_US, name, value) for time_us, name, value in self._log.changed]
        return settings_changed((t, name, float(v)) for t, name, v in (*first, *later) if isinstance(v, int | float))

    @cached_property
    def texts(self) -> tuple[Text, ...]:
        """What the autopilot logged in words, in the order of time."""
        said = sorted(self._log.said, key=lambda entry: entry[:2])
        return tuple(Text(t * S_PER_US, text.rstrip("\t\0"), level - ord("0")) for t, _, level, text in said)

    @cached_property
    def vehicle(self) -> str:
        """Kind of aircraft (from ``MAV_TYPE``), for example ``"fixed wing"``; empty if the log does not say."""
        kind = self.parameters.get("MAV_TYPE", math.nan)
        return enum_name("MAV_TYPE", int(kind)) if math.isfinite(kind) else ""

    @cached_property
    def firmware(self) -> str:
        """For example ``"PX4 1.15.0"``; without a number if the log does not say."""
        release = self._log.information.get("ver_sw_release")
        return f"PX4 {version_text(release)}" if isinstance(release, int) else "PX4"

    @cached_property
    def start_utc(self) -> datetime | None:
        """Date and time at 0 s, when the autopilot was booted, by the first GPS fix; None without one."""
        for field in ("time_utc_usec", "gps_time_utc_usec"):
            for part in self._log.topics:
                if part.name not in _CLOCK_TOPICS or not {"timestamp", field} <= part.types.keys():
                    continue
                stamps, utc = part.rows["timestamp"], part.rows[field]
                fixed = np.flatnonzero(utc)
                if fixed.size:
                    return utc_date((float(utc[fixed[0]]) - float(stamps[fixed[0]])) * S_PER_US)
        return None

    @property
    def damage(self) -> tuple[Damage, ...]:
        """Everything found to be wrong so far."""
        found = []
        for time_us, lasted_ms in self._log.dropouts:
            start_s, note = time_us * S_PER_US, f"the logger was too slow for {lasted_ms} ms"
            found.append(Damage("gap", note, 1, start_s, start_s + lasted_ms * S_PER_MS))
        log = self._log
        if log.stretches or log.odd:
            lost = f"{log.lost_bytes} bytes in {log.stretches} places are no message" if log.stretches else ""
            odd = f"{log.odd} messages contradict what it says of itself" if log.odd else ""
            found.append(
                Damage(
                    "corrupt",
                    f"the file is corrupt: {' and '.join(filter(None, (lost, odd)))}",
                    log.stretches + log.odd,
                )
            )
        if log.cut_bytes:
            found.append(Damage("truncated", f"the file ends inside a message: {log.cut_bytes} bytes"))
        return tuple(found)
