"""PX4 logs message by message: what is defined and said in them, and where the samples of each topic lie.

A message is its size (two bytes), its kind (a letter) and its content; the log describes its own samples
(https://docs.px4.io/main/en/dev_log/ulog_file_format.html).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from logparsers.compiled import compiled
from logparsers.errors import UnreadableLog
from logparsers.units import C_NUMBERS

Bytes = NDArray[np.uint8]
Numbers = NDArray[np.int64]

_MAGIC: Final = b"ULog\x01\x12\x35"
_HEADER, _HEAD, _FLAGS = 16, 3, 40
"""Bytes of the header of a log, of size and kind before each message, and of the flags that come first."""
_KNOWN: Final = np.zeros(256, dtype=np.bool_)
_KNOWN[list(b"ABCDFILMOPQRS")] = True
_DATA: Final = ord("D")
_TYPES: Final = {**C_NUMBERS, "bool": "i1", "char": "i1"}
_FIELD: Final = re.compile(r"([^ \[]+)(?:\[(\d+)\])? ([^ ]+).*")
_MOST_FORMATS, _MOST_FIELDS, _MOST_OF_TOPIC, _DEEPEST = 10_000, 200_000, 65_535, 16
"""Message formats, fields of all topics, fields of one, and messages within messages: forged logs have more."""


@compiled
def _goes_on(data: Bytes, at: int, end: int) -> bool:
    """Whether a message begins here, or the log ends."""
    return at == end or (at + _HEAD < end and (data[at] > 0 or data[at + 1] > 0) and _KNOWN[data[at + 2]])


@compiled
def _walk(data: Bytes, at: int, end: int, places: Numbers) -> tuple[int, int, int, int]:
    """Note where each message begins: their number, stretches without any, bytes of these, and of a cut last message.

    An empty `places` only counts.
    """
    count, stretches, lost = 0, 0, 0
    is_lost = False
    while at + _HEAD <= end:
        size = int(data[at]) | int(data[at + 1]) << 8
        known, after = size > 0 and _KNOWN[data[at + 2]], at + _HEAD + size
        if known and after > end and not is_lost:
            break
        is_next = after <= end and _goes_on(data, after, end)
        if known and after <= end and (is_next or not is_lost):
            if places.size:
                places[count] = at
            count += 1
        elif is_lost or size == 0 or data[at + 2] == 0 or not is_next:  # else of a kind that is not known yet
            stretches += not is_lost
            lost += 1
            is_lost = True
            at += 1
            continue
        is_lost = False
        at = after
    return count, stretches, lost, 0 if is_lost else end - at


@dataclass(eq=False)
class Samples:
    """All samples of a topic under one number.

    `types`: type of each field; arrays and nested messages are spread out. `places` (shape (n,)): where samples begin.
    """

    name: str
    instance: int
    types: dict[str, str]
    dtype: np.dtype[Any]
    data: Bytes
    places: Numbers

    @cached_property
    def rows(self) -> NDArray[Any]:
        """The samples themselves, shape (n,), with a field for each of theirs."""
        width = self.dtype.itemsize
        anywhere = np.ndarray((self.data.size - width + 1,), f"V{width}", self.data.data, 0, (1,))
        return anywhere[self.places].view(self.dtype)


def _parts(data: Bytes, name: str) -> Iterator[tuple[int, int]]:
    """Where the log begins and ends, and what was appended to it after a crash, by its flags."""
    if data[:7].tobytes() != _MAGIC or data.size < _HEADER:
        raise UnreadableLog(f"{name}: not a sound PX4 log: its header is none; copy the log again")
    begin, ends = _HEADER, [data.size]
    flags = data[_HEADER + _HEAD : _HEADER + _HEAD + _FLAGS].tobytes()
    if data.size >= _HEADER + _HEAD + _FLAGS and data[_HEADER + 2] == ord("B"):
        if flags[8] & ~1 or any(flags[9:16]):
            raise UnreadableLog(f"{name}: not a sound PX4 log: its flags say that only a newer reader can read it")
        ends = [at for at in struct.unpack("<3Q", flags[16:]) if flags[8] and begin < at < data.size] + ends
    for end in sorted(ends):
        yield begin, end
        begin = end


class Content:
    """A log: all but samples of topics that are not wanted. Times are those of the newest sample before [us].

    `data` (shape (n,)): the file. `name`: what to call it in messages. `wanted`: whether a topic is.
    """

    def __init__(self, data: Bytes, name: str, wanted: Callable[[str], bool]) -> None:
        self._data, self._name, self._wanted = data, name, wanted
        self.information: dict[str, Any] = {}
        self.initial: dict[str, Any] = {}
        """Parameters at the beginning."""
        self.changed: list[tuple[int, str, Any]] = []
        self.dropouts: list[tuple[int, int]] = []
        """With the milliseconds that each lasted."""
        self.said: list[tuple[int, bool, int, str]] = []
        """When, whether with a tag, how severe, and what."""
        self.announced: dict[str, None] = {}
        self.topics: list[Samples] = []
        self.stretches = self.lost_bytes = self.odd = self.cut_bytes = 0
        """Stretches without a message and their bytes, messages that contradict the log, bytes of one that is cut."""
        self._formats: dict[str, list[tuple[str, int, str]]] = {}
        self._left, self._has_begun = _MOST_FIELDS, False
        self._numbers: dict[int, list[tuple[int, Samples | None, int]]] = {}
        """Topics by number: where each was announced, what for (None: not wanted), and the most bytes of a sample."""
        self._events: list[tuple[int, str, Any]] = []
        """Where a parameter changed, its name and value; or a dropout, without a name, and how long it lasted [ms]."""
        places = np.concatenate([self._places(*ends) for ends in _parts(data, name)])
        self.start_us = int(data[8:_HEADER].view("<u8")[0])
        kinds = data[places + 2]
        for place in places[kinds != _DATA].tolist():
            try:
                self._take(place)
            except (ArithmeticError, LookupError, ValueError, struct.error):
                self.odd += 1
        self._sort(places[kinds == _DATA])

    def _places(self, begin: int, end: int) -> Numbers:
        """Where each message of a part begins, shape (n,)."""
        count, stretches, lost, self.cut_bytes = _walk(self._data, begin, end, np.zeros(0, np.int64))
        self.stretches += stretches
        self.lost_bytes += lost
        places = np.zeros(count, np.int64)
        if count:
            _walk(self._data, begin, end, places)
        return places

    def _take(self, at: int) -> None:
        """One message that is no sample."""
        size, kind = struct.unpack_from("<Hc", self._data.data, at)
        content = self._data[at + _HEAD : at + _HEAD + size].tobytes()
        self._has_begun |= kind in b"ACL"
        if kind == b"F":
            self._define(_text(content))
        elif kind == b"A":
            self._announce(at, content)
        elif kind == b"I":
            self.information.update([_value(content)])
        elif kind == b"P" and self._has_begun:
            self._events.append((at, *_value(content)))
        elif kind == b"P":
            self.initial.update([_value(content)])
        elif kind == b"O":
            self._events.append((at, "", *struct.unpack("<H", content)))
        elif kind == b"L":
            level, time_us = struct.unpack_from("<BQ", content)
            self.said.append((time_us, False, level, _text(content[9:])))
        elif kind == b"C":
            level, _, time_us = struct.unpack_from("<BHQ", content)
            self.said.append((time_us, True, level, _text(content[11:])))

    def _define(self, text: str) -> None:
        name, _, fields = text.partition(":")
        if len(self._formats) >= _MOST_FORMATS:
            raise UnreadableLog(f"{self._name}: more than {_MOST_FORMATS} message formats; PX4 has some hundred")
        found = [_FIELD.fullmatch(each) for each in fields.split(";") if each]
        self._formats[name] = [(each[1], int(each[2] or 0), each[3]) for each in found if each]
        if None in found:
            raise ValueError(f"{name}: no fields")

    def _announce(self, at: int, content: bytes) -> None:
        (instance, number), name = struct.unpack_from("<BH", content), _text(content[3:])
        self.announced[name] = None
        samples, most = None, 0
        if self._wanted(name):
            types = list(self._spread("", name, 0))
            most = sum(np.dtype(_TYPES[kind]).itemsize for _, kind in types)
            while types and types[-1][0].startswith("_padding"):
                types.pop()
            dtype = np.dtype([(each, _TYPES[kind]) for each, kind in types])
            samples = Samples(name, instance, dict(types), dtype, self._data, np.zeros(0, np.int64))
            self.topics.append(samples)
        self._numbers.setdefault(number, []).append((at, samples, most))

    def _spread(self, before: str, name: str, depth: int) -> Iterator[tuple[str, str]]:
        """Fields of a message and of those within it, with their types."""
        fields = self._formats[name]
        wanted = sum(max(count, 1) for _, count, _ in fields)
        self._left -= wanted
        if self._left < 0 or wanted > _MOST_OF_TOPIC or depth > _DEEPEST:
            raise ValueError(f"{name}: too many fields, or itself within it")
        for kind, count, label in fields:
            for each in [f"{before}{label}[{k}]" for k in range(count)] or [before + label]:
                if kind in _TYPES:
                    yield each, kind
                else:
                    yield from self._spread(f"{each}.", kind, depth + 1)

    def _sort(self, places: Numbers) -> None:
        """Give each topic its samples, and what has no time of its own that of the newest sample before it."""
        data = self._data
        numbers = data[places + _HEAD].astype(np.uint16) | data[places + _HEAD + 1].astype(np.uint16) << 8
        sizes = (data[places].astype(np.int64) | data[places + 1].astype(np.int64) << 8) - 2
        order = np.argsort(numbers, kind="stable")
        ends = np.searchsorted(numbers[order], np.arange((1 << 16) + 1))
        used = 0
        for number, announced in self._numbers.items():
            mine = order[ends[number] : ends[number + 1]]
            begins = np.searchsorted(places[mine], [at for at, _, _ in announced]).tolist()
            for (_, samples, most), first, last in zip(announced, begins, [*begins[1:], mine.size], strict=True):
                rows = mine[first:last]
                if samples is not None:
                    rows = rows[(sizes[rows] >= samples.dtype.itemsize) & (sizes[rows] <= most)]
                    samples.places = places[rows] + _HEAD + 2
                used += rows.size
        self.odd += places.size - used
        self.topics = sorted((one for one in self.topics if one.places.size), key=lambda t: (t.name, t.instance))
        timed = [one for one in self.topics if one.types.get("timestamp") == "uint64_t"] if self._events else []
        at = np.concatenate([[0], *(one.places for one in timed)])
        stamps = np.concatenate([np.array([self.start_us], np.uint64), *(one.rows["timestamp"] for one in timed)])
        order = np.argsort(at, kind="stable")
        newest_us = np.maximum.accumulate(stamps[order])
        for place, name, value in self._events:
            time_us = int(newest_us[np.searchsorted(at, place, sorter=order) - 1])
            if name:
                self.changed.append((time_us, name, value))
            else:
                self.dropouts.append((time_us, value))


def _text(raw: bytes) -> str:
    return raw.decode("utf-8", "ignore")


def _value(content: bytes) -> tuple[str, Any]:
    """Name and value of an information or a parameter: a number, a text, or bytes of anything else."""
    length = content[0]
    kind, name = _text(content[1 : 1 + length]).split(" ")[:2]
    raw = content[1 + length :]
    if kind.startswith("char["):
        return name, _text(raw)
    return name, np.frombuffer(raw, _TYPES[kind])[0].item() if kind in _TYPES else raw
