"""When live messages were made: seconds since the vehicle's first boot, as in a telemetry log.

Stamps of the vehicle's own clock are kept exactly, with overflows added. What carries no stamp was made about when the
stamped messages around it were: arrival alone tells nothing, since a link may be ten seconds later than it was before.
What another clock stamped is shifted to that. A vehicle that restarts goes on where it was, by arrival time.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from logparsers.protocol import Component
from servofd.live.channels import stamp_of
from servofd.live.latency import Latency

if TYPE_CHECKING:
    from logparsers.codec import Heard

_RELAYED = ("NAMED_VALUE", "DEBUG", "SET_", "HIL_", "VISION", "TIMESYNC")
"""Often stamped by someone else."""
_BACKWARD_S = 1.0
_STRAYED_S = 10.0
_PERSISTS, _PERSISTS_S = 3, 0.3
"""Old stamps in a row, and for how long, that make a restart; a copy of the stream that comes late makes bursts."""
_PATIENCE_S = 2.0
_STAMPED_EVERY_S = 1.0
"""Autopilots send at least one stamped message a second; what is unstamped was made no later than the next of them."""
_FOREIGN_S = 60.0
"""How long the fastest message of another clock is believed: 20 ppm are a millisecond in that time."""
_WRAP_S = 2.0**32 * 1e-3
"""After 49.7 days ``time_boot_ms`` begins anew."""


class VehicleClock:
    """Puts the messages of one vehicle on one time base.

    Examples
    --------
    >>> from logparsers.codec import Heard
    >>> clock = VehicleClock()
    >>> clock.time_s(Heard("ATTITUDE", 1, 1, {"time_boot_ms": 4294950}), 100.0)
    4294.95
    >>> clock.time_s(Heard("SERVO_OUTPUT_RAW", 1, 1, {"time_usec": 32704}), 100.05)
    4295.0
    """

    def __init__(self) -> None:
        self.latency = Latency()
        self._shift_s = 0.0
        self._wraps = 0
        """How often the vehicle's milliseconds have overflown."""
        self._newest_s, self._arrived_s = -math.inf, -math.inf
        """Newest stamp of the vehicle's own clock, and when that message arrived."""
        self._begun_s: float | None = None
        self._back, self._back_s = 0, math.inf
        self._foreign: dict[tuple[int, str], _Shift] = {}
        self.restarts = 0
        """How often the vehicle has begun anew."""

    def is_reference(self, heard: Heard) -> bool:
        """Whether this message tells the vehicle's time since boot without overflowing."""
        stamp = stamp_of(heard.name)
        return (
            heard.component == Component.AUTOPILOT1
            and stamp is not None
            and stamp.field == "time_boot_ms"
            and not heard.name.startswith(_RELAYED)
            and heard.fields[stamp.field] > 0
        )

    def is_set(self, arrival_s: float) -> bool:
        """Whether the vehicle's time is known, or will not be known any better."""
        if self._begun_s is None:
            self._begun_s = arrival_s
        return math.isfinite(self._newest_s) or arrival_s - self._begun_s > _PATIENCE_S

    def time_s(self, heard: Heard, arrival_s: float) -> float | None:
        """When a message was made [s]; None while that cannot be told."""
        stamp = stamp_of(heard.name)
        raw = int(heard.fields[stamp.field]) if stamp else 0
        if stamp is None or raw == 0:
            return self.from_arrival(arrival_s)
        if self.is_reference(heard) or not math.isfinite(self._newest_s):
            return self._reference(raw * stamp.tick_s, arrival_s)
        expected_s = self._around(arrival_s)
        own_s = raw * stamp.tick_s
        if stamp.bits < 64:
            overflows = round((expected_s - self._shift_s - own_s) / (stamp.tick_s * 2.0**stamp.bits))
            own_s = (raw + overflows * (1 << stamp.bits)) * stamp.tick_s
        own_s += self._shift_s
        key = (heard.component, heard.name)
        latest_s = self._newest_s + max(arrival_s - self._arrived_s, 0.0) + _STRAYED_S
        if key not in self._foreign and self._newest_s - _STRAYED_S <= own_s <= latest_s:
            return own_s
        if stamp.bits < 64 and heard.component == Component.AUTOPILOT1:
            return None
        return own_s + self._foreign.setdefault(key, _Shift()).of(expected_s - own_s, arrival_s)

    def from_arrival(self, arrival_s: float) -> float | None:
        """About when a message was made that carries no stamp [s]."""
        return self._around(arrival_s) if math.isfinite(self._newest_s) else None

    def log_s(self, stamp_s: float) -> float:
        """Time of a row of the vehicle's own log, stamped with seconds since its latest boot."""
        return stamp_s + self._shift_s

    def answered(self, number: int, stamp_s: float, arrival_s: float) -> None:
        """Take an answer to TIMESYNC."""
        self.latency.answered(number, stamp_s + self._shift_s, arrival_s)

    def _around(self, arrival_s: float) -> float:
        return self._newest_s + min(max(arrival_s - self._arrived_s, 0.0), _STAMPED_EVERY_S)

    def _reference(self, stamp_s: float, arrival_s: float) -> float | None:
        if math.isfinite(self._newest_s):
            ahead_s = self._newest_s + arrival_s - self._arrived_s - self._shift_s - stamp_s
            wraps = round(ahead_s / _WRAP_S)
            if abs(ahead_s - wraps * _WRAP_S) <= _STRAYED_S:
                self._wraps = wraps
        time_s = stamp_s + self._wraps * _WRAP_S + self._shift_s
        if time_s < self._newest_s - _BACKWARD_S:
            self._back, self._back_s = self._back + 1, min(self._back_s, arrival_s)
            if self._back < _PERSISTS or arrival_s - self._back_s < _PERSISTS_S:
                return None
            time_s = self._newest_s + max(arrival_s - self._arrived_s, 0.0)
            self._shift_s, self._wraps, self._newest_s = time_s - stamp_s, 0, -math.inf
            self._foreign.clear()
            self.latency.begin_anew()
            self.restarts += 1
        self._back, self._back_s = 0, math.inf
        if time_s > self._newest_s:
            self._newest_s, self._arrived_s = time_s, arrival_s
        self.latency.take(arrival_s, time_s)
        return time_s


class _Shift:
    """From another clock to the vehicle's: that of its fastest message of the last minute or two."""

    def __init__(self) -> None:
        self._begun_s, self._now_s, self._before_s = -math.inf, math.inf, math.inf

    def of(self, shift_s: float, arrival_s: float) -> float:
        if arrival_s - self._begun_s >= _FOREIGN_S:
            self._begun_s, self._now_s, self._before_s = arrival_s, shift_s, self._now_s
        self._now_s = min(self._now_s, shift_s)
        return min(self._now_s, self._before_s)
