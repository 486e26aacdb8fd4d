"""From messages to the channels that an aircraft file names: the same names as in a telemetry log."""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Iterable
from functools import cache
from typing import NamedTuple

import numpy as np

from logparsers.codec import Received
from logparsers.mavlink import dialect
from logparsers.protocol import Component
from servofd.aircraft.series import SURROUNDINGS
from servofd.detection.causes import AROUND_S, FALLEN, before_it_fell, fell_from
from servofd.detection.stream import MEMORY_S
from servofd.servo.context import NO_CONTEXT, Context

_LARGEST = 1e6
"""Degrees, microseconds and counts of no servo and no supply are as large."""
_MOST_OTHERS = 64
"""Other senders of a wanted message that are remembered, so that each is reported once."""
_NAME = re.compile(r"(?:(\d+)/(\d+):)?([A-Z0-9_]+)(?:\[([^\]]*)\])?\.(\w+)(?:\[(\d+)\])?")


class _Wanted(NamedTuple):
    channel: str
    source: tuple[int, int] | None
    field: str
    element: int | None


class Stamp(NamedTuple):
    """Where a message says when it was made."""

    field: str
    tick_s: float
    bits: int
    is_relayed: bool
    """Whether others than the vehicle often make it."""


class ChannelTable:
    """Finds the wanted channels in messages.

    A channel without a source is the autopilot's, or that of the script on it; whoever else sends it is named in `news`
    once, and not obeyed. What is no number of a servo is dropped, and named once.
    """

    def __init__(self, channels: Iterable[str], news: list[str] | None = None) -> None:
        self._wanted: dict[tuple[str, str], list[_Wanted]] = {}
        self._others: set[tuple[str, tuple[int, int]]] = set()
        self.news = [] if news is None else news
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
        self._named = {wanted.source for each in self._wanted.values() for wanted in each if wanted.source}
        self._instances = {name: layouts[name].instance for name in self.messages}

    def of(self, message: Received) -> list[tuple[str, float]]:
        """Wanted channels of a message, and their values as logged."""
        found = []
        for wanted in self._asked(message):
            sender = (message.system, message.component)
            if sender != wanted.source and (wanted.source is not None or message.component != Component.AUTOPILOT1):
                continue
            field = message.fields[wanted.field]
            value = float(field if wanted.element is None else field[wanted.element])
            if not abs(value) <= _LARGEST:
                self._tell(wanted.channel, sender, f"{value:.3g} is no measurement: such values are left out")
                continue
            self._counts[wanted.channel] = (message.name, self._counts[wanted.channel][1] + 1)
            found.append((wanted.channel, value))
        return found

    def obeys(self, message: Received) -> bool:
        """Whether a message is the autopilot's, or of a sender that a channel names; tells of others once."""
        if message.component == Component.AUTOPILOT1:
            return True
        sender = (message.system, message.component)
        if sender in self._named:
            return True
        if any(wanted.source is None for wanted in self._asked(message)):
            self._tell(message.name, sender, f"not that of component {message.component}")
        return False

    def _asked(self, message: Received) -> list[_Wanted]:
        field = self._instances.get(message.name, "")
        return self._wanted.get((message.name, str(message.fields[field]) if field else ""), [])

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


_RELAYED = ("NAMED_VALUE", "DEBUG", "SET_", "HIL_", "VISION", "TIMESYNC")
"""Beginnings of the names of messages that are often stamped by someone else."""


@cache
def stamp_of(message: str) -> Stamp | None:
    """Time stamp of a message; None if it carries none."""
    clock = dialect().layouts[message].clock if message in dialect().layouts else None
    if clock is None:
        return None
    field, tick_s = clock
    return Stamp(field.name, tick_s, 8 * field.dtype.itemsize, message.startswith(_RELAYED))


_PERIOD_S = 0.1
"""Airspeed and supply change slowly; more than that is not kept."""
_BEFORE = 10
"""So many samples before a supply fell say what it was."""


class Supply:
    """Volts of the servos as they come; those of a supply that gave way count as before, until they are back."""

    def __init__(self) -> None:
        self._held_v = self._was_v = self._latest_v = 0.0
        self._fell_s, self._looked_s = math.nan, -math.inf

    def take(self, volts_v: float) -> float:
        """The next reading [V], or what counts in its place."""
        self._held_v, self._latest_v = (self._held_v if volts_v < FALLEN * self._held_v else 0.0), volts_v
        return self._held_v or volts_v

    def held(self, known: Context) -> Context:
        """The same as if it had not given way."""
        held = before_it_fell(known, since_s=self._looked_s)
        if known.voltage_s.size:
            self._looked_s = math.floor(float(known.voltage_s[-1]) - AROUND_S)
            if known.voltage_v[-1] < FALLEN * held.voltage_v[-1]:
                if not self._held_v:
                    first = int(np.argmax(held.voltage_v > known.voltage_v))
                    self._fell_s = float(known.voltage_s[first])
                    self._was_v = float(np.median(known.voltage_v[max(first - _BEFORE, 0) : first + 1]))
                self._held_v = float(held.voltage_v[-1])
        return held

    @property
    def is_held(self) -> bool:
        """Whether it gave way, and is not back."""
        return self._held_v > 0.0

    @property
    def fall(self) -> tuple[float, str]:
        """When it gave way [s], and by how much in words; NaN and nothing if it has not, or is back."""
        return (self._fell_s, fell_from(self._was_v, self._latest_v)) if self.is_held else (math.nan, "")


class Surroundings:
    """What was received of them lately; of several channels with the same news, the one that audits would take.

    `needs` are those of the models, of ``airspeed_m_s`` and ``servo_voltage_v``.
    """

    def __init__(self, needs: Iterable[str]) -> None:
        self._sources: dict[str, tuple[str, int, float]] = {}
        for need in needs:
            for rank, (channel, scale) in enumerate(SURROUNDINGS[need].items()):
                self._sources[channel] = need, rank, scale
        self._received: dict[str, tuple[int, deque[tuple[float, float]]]] = {}
        self.supply = Supply()

    @property
    def channels(self) -> list[str]:
        """Names of channels that tell about them."""
        return list(self._sources)

    def add(self, channel: str, time_s: float, value: float) -> bool:
        """Take a sample, as logged; whether it is news."""
        if channel not in self._sources or not np.isfinite(value):
            return False
        need, rank, scale = self._sources[channel]
        known_rank, samples = self._received.get(need, (rank + 1, deque()))
        if rank < known_rank:
            samples = deque(maxlen=int(MEMORY_S / _PERIOD_S))
            self._received[need] = rank, samples
        if rank > known_rank or (samples and not time_s - samples[-1][0] >= _PERIOD_S):
            return False
        known = scale * value
        samples.append((time_s, self.supply.take(known) if need == "servo_voltage_v" else known))
        return True

    def context(self) -> Context:
        """All that is known, as if no supply had given way; what came last holds until something else comes."""
        columns = {need: np.array(samples).T for need, (_, samples) in self._received.items()}
        nothing = (NO_CONTEXT.airspeed_s, NO_CONTEXT.airspeed_m_s)
        known = Context(*columns.get("airspeed_m_s", nothing), *columns.get("servo_voltage_v", nothing))
        held = self.supply.held(known)
        if self.supply.is_held and held.voltage_v[-1] > known.voltage_v[-1]:
            samples = self._received["servo_voltage_v"][1]
            samples.clear()
            samples.extend(zip(held.voltage_s.tolist(), held.voltage_v.tolist(), strict=True))
        return held
