"""When the messages of a telemetry log were made: chooses the vehicle's clock and puts all others on it."""

from __future__ import annotations

from datetime import datetime
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from logparsers.clock import utc_date
from logparsers.protocol import Component
from logparsers.records import Damage, FloatArray
from logparsers.telemetry.timeline import Break, Timeline, build_timeline, despike, place, unwrap
from logparsers.units import S_PER_US

if TYPE_CHECKING:
    from logparsers.mavlink import Field
    from logparsers.telemetry.messages import MessageTable, Sender

_BREAKS = {
    "reboot": "the vehicle's clock starts again; times run on by arrival time",
    "clock_jump": "the vehicle's clock was set forward; times run on by arrival time",
    "arrival_jump": "the receiver's clock was set; the vehicle's own time stamps are not affected",
}
_MOST_BREAKS = 100
"""Breaks of the clock that are listed one by one."""
_RELAYED = ("NAMED_VALUE", "DEBUG", "SET_", "HIL_", "VISION", "TIMESYNC")  # often stamped by someone else


class TelemetryClock:
    """Time of every message on one base: seconds since the vehicle's first boot.

    `table`: the messages. `bare`: True for a stream of frames that was stored without arrival times.
    """

    def __init__(self, table: MessageTable, *, bare: bool) -> None:
        self._table, self._bare = table, bare
        self._times: dict[tuple[str, Sender | None], FloatArray] = {}

    def time_s(self, message: str, source: Sender | None) -> FloatArray:
        """Time of each message of a stream, shape (n,) [s]; kept, so that its columns can share it."""
        key = (message, source)
        if key not in self._times:
            senders = self._table.sources(message) if source is None else ()
            if len(senders) > 1:
                markers = self._table.stream(message)
                time = np.empty(markers.size)
                for sender in senders:
                    rows = np.searchsorted(markers, self._table.stream(message, sender))
                    time[rows] = self.time_s(message, sender)
            else:
                time = self._place(message, source)
            time.setflags(write=False)
            self._times[key] = time
        return self._times[key]

    @cached_property
    def timeline(self) -> Timeline:
        """The vehicle's clock against arrival time."""
        return self._built[0]

    @cached_property
    def damage(self) -> tuple[Damage, ...]:
        """Restarts and jumps of either clock."""
        found = []
        timeline, breaks, times = self._built
        for number, point in enumerate(breaks[:_MOST_BREAKS], start=1):
            step = float(timeline.shift_s[number] - timeline.shift_s[number - 1])
            before, after = float(times[point.index - 1]), float(times[point.index])
            note = f"{_BREAKS[point.kind]} ({step:+.1f} s)" if step else _BREAKS[point.kind]
            found.append(Damage(point.kind, note, 1, before, after))
        rest = len(breaks) - len(found)
        if rest:
            found.append(Damage("clock_jump", f"{rest} more restarts and jumps of the clocks", rest))
        return tuple(found)

    @cached_property
    def start_utc(self) -> datetime | None:
        """Date and time at 0 s; None if it was not known."""
        if "SYSTEM_TIME" in self._table.messages:
            since_1970 = self._table.column("SYSTEM_TIME", "time_unix_usec") * S_PER_US
            starts = since_1970 - self.time_s("SYSTEM_TIME", None)
            known = sorted(start for start in starts.tolist() if utc_date(start))
            if known:
                return utc_date(known[len(known) // 2])
        return None if self._bare else utc_date(self._epoch_us * S_PER_US + float(self.timeline.offset_s[0]))

    def arrival_s(self, markers: NDArray[Any]) -> FloatArray:
        """Arrival of frames [s], counted from the first message of the file; nothing wild among them."""
        if self._bare:
            known, stamps = self._substitute
            return np.interp(markers, known, stamps) if known.size else np.zeros(markers.size)
        arrivals = self._table.arrivals_us(markers)
        seconds = (arrivals.astype(np.float64) - self._epoch_us) * S_PER_US
        return np.nan_to_num(despike(np.where(arrivals == 0, np.nan, seconds)))

    @cached_property
    def _epoch_us(self) -> float:
        firsts = sorted(int(self._table.stream(message)[0]) for message in self._table.messages)
        arrivals = self._table.arrivals_us(np.array(firsts[:9], dtype=np.int64))
        known = arrivals[arrivals > 0]
        return float(np.median(known[:3])) if known.size else 0.0

    @cached_property
    def _reference(self) -> tuple[str, Sender, Field, float] | None:
        """The vehicle's busiest stream with a clock: message, source, clock, and its tick [s]."""
        table = self._table

        def rank(stream: tuple[str, Sender, Field, float]) -> tuple[bool, bool, bool, int]:
            message, sender, _, tick_s = stream
            own = not message.startswith(_RELAYED)
            return sender.component == Component.AUTOPILOT1, own, tick_s == 1e-3, table.stream(message, sender).size

        clocks = [(message, clock) for message in table.messages if (clock := table.layout(message).clock)]
        streams = [(message, sender, *clock) for message, clock in clocks for sender in table.sources(message)]
        return max(streams, key=rank, default=None)

    def _reference_stamps(self) -> tuple[NDArray[Any], NDArray[Any], float, int]:
        """Positions and raw stamps of the reference stream, tick [s], bits; a stamp of 0 was not filled in."""
        if self._reference is None:
            nothing = np.zeros(0, dtype=np.int64)
            return nothing, nothing, 1.0, 64
        message, sender, field, tick_s = self._reference
        raw = self._table.column(message, field.name, source=sender)
        filled = raw > 0
        return self._table.stream(message, sender)[filled], raw[filled], tick_s, 8 * field.dtype.itemsize

    @cached_property
    def _substitute(self) -> tuple[NDArray[Any], FloatArray]:
        """For a stream without arrival times: positions and times of the reference messages."""
        markers, raw, tick_s, bits = self._reference_stamps()
        stamps = unwrap(raw, bits=bits).astype(np.float64) * tick_s
        return markers, np.maximum.accumulate(stamps) if stamps.size else stamps

    @cached_property
    def _built(self) -> tuple[Timeline, list[Break], FloatArray]:
        markers, raw, tick_s, bits = self._reference_stamps()
        arrival = self.arrival_s(markers)
        stamps = unwrap(raw, bits=bits, elapsed=arrival / tick_s).astype(np.float64) * tick_s
        timeline, breaks = build_timeline(stamps, arrival, markers)
        return timeline, breaks, stamps + timeline.shift_s[timeline.part(markers)]

    def _place(self, message: str, source: Sender | None) -> FloatArray:
        markers = self._table.stream(message, source)
        arrival = self.arrival_s(markers)
        clock = self._table.layout(message).clock
        if clock is None:
            return self.timeline.from_arrival(arrival, markers)
        field, tick_s = clock
        raw, bits = self._table.column(message, field.name, source=source), 8 * field.dtype.itemsize
        return place(raw, tick_s, bits=bits, arrival_s=arrival, positions=markers, timeline=self.timeline)
