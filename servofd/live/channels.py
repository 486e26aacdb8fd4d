"""From messages to the channels that an aircraft file names: the same names as in a telemetry log."""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from logparsers.mavlink import dialect
from logparsers.protocol import Component
from servofd.aircraft.series import SURROUNDINGS
from servofd.detection.stream import MEMORY_S
from servofd.servo.context import NO_CONTEXT, Context

if TYPE_CHECKING:
    from collections.abc import Iterable

    from logparsers.codec import Heard

_GONE_S = 5.0
"""A sender that is no autopilot and silent for so long makes room for another."""
_MOST_OTHERS = 64
_NAME = re.compile(r"(?:(\d+)/(\d+):)?([A-Z0-9_]+)(?:\[([^\]]*)\])?\.(\w+)(?:\[(\d+)\])?")


class _Wanted(NamedTuple):
    channel: str
    source: tuple[int, int] | None
    field: str
    element: int | None


@dataclass(slots=True)
class _Sender:
    """Whom a channel is taken from."""

    who: tuple[int, int]
    latest_s: float


class Stamp(NamedTuple):
    """Where a message says when it was made."""

    field: str
    tick_s: float
    bits: int


class ChannelTable:
    """Finds the wanted channels in messages.

    A channel without a source takes the autopilot, if that sends it, or else the first that does, for as long as that
    goes on; whoever else sends it is named in `news`, and not obeyed.

    Examples
    --------
    >>> from logparsers.codec import Heard
    >>> table = ChannelTable(["NAMED_VALUE_FLOAT[SRVP2].value", "SERVO_OUTPUT_RAW.servo2_raw"])
    >>> table.of(Heard("NAMED_VALUE_FLOAT", 1, 1, {"name": "SRVP2", "value": 3.5}))
    [('NAMED_VALUE_FLOAT[SRVP2].value', 3.5)]
    """

    def __init__(self, channels: Iterable[str]) -> None:
        self._wanted: dict[tuple[str, str], list[_Wanted]] = {}
        self._senders: dict[str, _Sender] = {}
        self._others: set[tuple[str, tuple[int, int]]] = set()
        self.news: list[str] = []
        """What is to be told of senders, and forgotten."""
        self._counts: dict[str, tuple[str, int]] = {}
        self.unknown: list[str] = []
        """Names that are no channels of a telemetry stream."""
        layouts = dialect().layouts
        for channel in dict.fromkeys(channels):
            match = _NAME.fullmatch(channel)
            if match is None or match[3] not in layouts or match[5] not in layouts[match[3]].fields:
                self.unknown.append(channel)
                continue
            source = (int(match[1]), int(match[2])) if match[1] else None
            element = int(match[6]) if match[6] else None
            instance = match[4] if match[4] is not None else ("0" if layouts[match[3]].instance else "")
            self._wanted.setdefault((match[3], instance), []).append(_Wanted(channel, source, match[5], element))
            self._counts[channel] = (match[3], 0)
        self.messages = {message for message, _ in self._wanted}
        self._instances = {name: layouts[name].instance for name in self.messages}

    def of(self, heard: Heard, arrival_s: float = 0.0) -> list[tuple[str, float]]:
        """Wanted channels of a message that arrived then [s, receiver's clock], and their values as logged."""
        if heard.name not in self.messages:
            return []
        field = self._instances[heard.name]
        instance = str(heard.fields[field]) if field else ""
        found = []
        for wanted in self._wanted.get((heard.name, instance), ()):
            sender = (heard.system, heard.component)
            if wanted.source is None:
                if not self._obeyed(wanted.channel, sender, arrival_s):
                    continue
            elif wanted.source != sender:
                continue
            value = heard.fields[wanted.field]
            self._counts[wanted.channel] = (heard.name, self._counts[wanted.channel][1] + 1)
            found.append((wanted.channel, float(value if wanted.element is None else value[wanted.element])))
        return found

    def _obeyed(self, channel: str, sender: tuple[int, int], arrival_s: float) -> bool:
        bound, message = self._senders.get(channel), self._counts[channel][0]
        if bound is None:
            self._senders[channel] = _Sender(sender, arrival_s)
            return True
        if bound.who == sender:
            bound.latest_s = arrival_s
            return True
        is_better = sender[1] == Component.AUTOPILOT1 and bound.who[1] != Component.AUTOPILOT1
        if is_better or (bound.who[1] != Component.AUTOPILOT1 and arrival_s - bound.latest_s > _GONE_S):
            self._tell(message, sender, f"component {sender[1]}, not {bound.who[1]}")
            self._senders[channel] = _Sender(sender, arrival_s)
            return True
        self._tell(message, sender, f"not that of component {sender[1]}")
        return False

    def _tell(self, message: str, sender: tuple[int, int], what: str) -> None:
        if (message, sender) not in self._others and len(self._others) < _MOST_OTHERS:
            self._others.add((message, sender))
            self.news.append(f"{message}: {what}")

    def counted(self) -> dict[str, int]:
        """By message, samples of its rarest channel since this was last asked."""
        counts: dict[str, int] = {}
        for channel, (message, count) in self._counts.items():
            counts[message] = min(counts.get(message, count), count)
            self._counts[channel] = (message, 0)
        return counts


_STAMPS: dict[str, Stamp | None] = {}


def stamp_of(message: str) -> Stamp | None:
    """Time stamp of a message; None if it carries none."""
    if message not in _STAMPS:
        clock = dialect().layouts[message].clock if message in dialect().layouts else None
        _STAMPS[message] = Stamp(clock[0].name, clock[1], 8 * clock[0].dtype.itemsize) if clock else None
    return _STAMPS[message]


_PERIOD_S = 0.1
"""Airspeed and supply change slowly; more than that is not kept."""


class Surroundings:
    """What was heard of them lately; of several channels with the same news, the one that audits would take.

    `needs` are those of the models, of ``airspeed_m_s`` and ``servo_voltage_v``.
    """

    def __init__(self, needs: Iterable[str]) -> None:
        self._sources = {
            channel: (need, rank, scale)
            for need in needs
            for rank, (channel, scale) in enumerate(SURROUNDINGS[need].items())
        }
        self._heard: dict[str, tuple[int, deque[tuple[float, float]]]] = {}

    @property
    def channels(self) -> list[str]:
        """Names of channels that tell about them."""
        return list(self._sources)

    def add(self, channel: str, time_s: float, value: float) -> bool:
        """Take a sample, as logged; whether it is news."""
        if channel not in self._sources or not np.isfinite(value):
            return False
        need, rank, scale = self._sources[channel]
        known_rank, samples = self._heard.get(need, (rank + 1, deque()))
        if rank < known_rank:
            samples = deque(maxlen=int(MEMORY_S / _PERIOD_S))
            self._heard[need] = rank, samples
        if rank > known_rank or (samples and not time_s - samples[-1][0] >= _PERIOD_S):
            return False
        samples.append((time_s, scale * value))
        return True

    def context(self) -> Context:
        """All that is known; what came last holds until something else comes."""
        columns = {need: np.array(samples).T for need, (_, samples) in self._heard.items()}
        nothing = (NO_CONTEXT.airspeed_s, NO_CONTEXT.airspeed_m_s)
        return Context(*columns.get("airspeed_m_s", nothing), *columns.get("servo_voltage_v", nothing))
