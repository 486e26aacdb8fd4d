"""When live messages were made: seconds since the vehicle's latest boot.

Stamps of the vehicle's own clock are kept exactly, with overflows added. What carries no stamp was made about when the
stamped messages around it were: arrival alone tells nothing, since a link may be ten seconds later than it was before.
What another clock stamped is shifted to that. With a boot time begins at zero again; what the boot before it sent, and
the link still brings, is not taken for the new one's.
"""

from __future__ import annotations

import math

from logparsers.codec import Received
from logparsers.protocol import Component
from servofd.live.channels import stamp_of

_DRIFT = 1e-4
"""Most by which two clocks drift apart [s/s]; crystals have some 20 ppm, and 50 in the cold."""
_BLOCK_S = 0.5
"""The delay of a link is that of the fastest message of one or two blocks."""
_LATE_S = 0.75
"""From here on a link is late, and in time again below half of it; radios take 0.05 to 0.3 s, LTE 0.1 to 0.6 s."""
_HELD_S = 1.0
"""For so long it must be late to be reported,"""
_CALM_S = 5.0
"""and so long in time; what comes and goes more quickly is one sentence."""


class Least:
    """The least value of the last one or two spans of time."""

    def __init__(self, span_s: float) -> None:
        self._span_s, self._begun_s = span_s, -math.inf
        self._now, self._before = math.inf, math.inf

    def take(self, value: float, now_s: float) -> float:
        """Take a value [same unit] at a time [s], and give the least one."""
        if now_s - self._begun_s >= self._span_s:
            self._begun_s, self._now, self._before = now_s, math.inf, self._now
        self._now = min(self._now, value)
        return min(self._now, self._before)


class Latency:
    """Follows the delay of one vehicle's messages."""

    def __init__(self) -> None:
        self._lag_s, self._lags = math.inf, Least(_BLOCK_S)
        """Least of arrival minus stamp [s]."""
        self._fastest_s, self._slowest_s, self._bound_s = math.inf, -math.inf, -math.inf
        self._told_s, self._since_s, self._calm_s = 0.0, math.inf, math.inf
        self._sent: dict[int, float] = {}

    @property
    def late_s(self) -> float:
        """By how much messages are later than the fastest ones would be [s]."""
        lag_s = self._lag_s
        return max(lag_s - max(self._fastest_s, self._slowest_s), 0.0) if math.isfinite(lag_s) else 0.0

    def take(self, arrival_s: float, made_s: float) -> None:
        """Take the arrival [s, receiver's clock] and the stamp [s, vehicle's clock] of a message."""
        lag_s = arrival_s - made_s
        if math.isfinite(self._bound_s):
            drifted_s = _DRIFT * max(arrival_s - self._bound_s, 0.0)
            self._fastest_s += drifted_s
            self._slowest_s -= drifted_s
        self._bound_s = max(arrival_s, self._bound_s)
        self._lag_s, self._fastest_s = self._lags.take(lag_s, arrival_s), min(self._fastest_s, lag_s)

    def ask(self, now_s: float) -> int:
        """Number that a TIMESYNC sent now [s] carries, and its answer repeats."""
        number = round(now_s * 1e9)
        self._sent = dict([*self._sent.items(), (number, now_s)][-8:])
        return number

    def answered(self, number: int, made_s: float, arrival_s: float) -> None:
        """Take an answer to TIMESYNC: its number, when it was made [s, vehicle's clock], and its arrival [s].

        It was made after the question was sent, so that no message is later than the way there and back.
        """
        sent_s = self._sent.pop(number, None)
        if sent_s is not None:
            self.take(arrival_s, made_s)
            self._slowest_s = max(self._slowest_s, sent_s - made_s)

    def begin_anew(self) -> None:
        """The vehicle's clock began anew, or was set."""
        told_s = self._told_s
        self.__init__()  # type: ignore[misc]
        self._told_s = told_s

    def news(self, now_s: float) -> str:
        """A sentence when the link has become late, much later, or is in time again; else empty."""
        late_s = self.late_s
        level_s = max(_LATE_S, 2.0 * self._told_s)
        self._since_s = min(self._since_s, now_s) if late_s >= level_s else math.inf
        self._calm_s = min(self._calm_s, now_s) if late_s < _LATE_S / 2.0 else math.inf
        if now_s - self._since_s >= _HELD_S:
            self._told_s, self._since_s = late_s, math.inf
            return f"link {late_s:.0f} s late"
        if self._told_s and now_s - self._calm_s >= _CALM_S:
            self._told_s = 0.0
            return "link in time again"
        return ""


_BACKWARD_S = 1.0
_STRAYED_S = 10.0
"""A stamp further than this from the clock's newest one is of another boot or another clock [s]."""
_PERSISTS, _PERSISTS_S = 3, 0.3
"""Old stamps in a row, and for how long, that make a restart; a copy of the stream that comes late makes bursts."""
_GONE_BACK_S = 5.0
"""Old stamps for so long, and no other, are a clock that went back by whatever: a log that is replayed once more."""
_STAMPED_EVERY_S = 1.0
"""Autopilots send at least one stamped message a second; what is unstamped was made no later than the next of them."""
_FOREIGN_S = 60.0
"""How long the fastest message of another clock is believed: 20 ppm are a millisecond in that time."""
_WRAP_S = 2.0**32 * 1e-3
"""After 49.7 days ``time_boot_ms`` begins anew."""


class VehicleClock:
    """Puts the messages of one vehicle on one time base."""

    def __init__(self) -> None:
        self.latency = Latency()
        self._wraps = 0
        """How often the vehicle's milliseconds have overflown."""
        self._newest_s, self._arrived_s = -math.inf, -math.inf
        """Newest stamp of the vehicle's own clock, and when that message arrived."""
        self._back, self._back_s = 0, math.inf
        self._before: tuple[float, float] | None = None
        """Newest stamp of the boot before this one, and when that message arrived [s]."""
        self._foreign: dict[tuple[int, str], Least] = {}
        """From another clock to the vehicle's: shifts of its messages."""
        self.restarts = 0
        """How often the vehicle has begun anew."""

    def is_reference(self, message: Received) -> bool:
        """Whether this message tells the vehicle's time since boot without overflowing."""
        stamp = stamp_of(message.name)
        return (
            message.component == Component.AUTOPILOT1
            and stamp is not None
            and stamp.field == "time_boot_ms"
            and not stamp.is_relayed
            and message.fields[stamp.field] > 0
        )

    @property
    def is_set(self) -> bool:
        """Whether the vehicle's time is known."""
        return math.isfinite(self._newest_s)

    def time_s(self, message: Received, arrival_s: float) -> float | None:
        """When a message was made [s]; None while that is not known."""
        stamp = stamp_of(message.name)
        raw = int(message.fields[stamp.field]) if stamp else 0
        if stamp is None or raw == 0:
            return self._around(arrival_s) if self.is_set else None
        if self.is_reference(message) or not self.is_set:
            return self._reference(raw * stamp.tick_s, arrival_s)
        expected_s = self._around(arrival_s)
        own_s = raw * stamp.tick_s
        if stamp.bits < 64:
            overflows = round((expected_s - own_s) / (stamp.tick_s * 2.0**stamp.bits))
            own_s = (raw + overflows * (1 << stamp.bits)) * stamp.tick_s
        key = (message.component, message.name)
        latest_s = self._newest_s + max(arrival_s - self._arrived_s, 0.0) + _STRAYED_S
        if key not in self._foreign and self._newest_s - _STRAYED_S <= own_s <= latest_s:
            is_autopilot = message.component == Component.AUTOPILOT1
            if is_autopilot and own_s > self._newest_s and arrival_s - self._arrived_s > _STAMPED_EVERY_S:
                self._newest_s, self._arrived_s = own_s, arrival_s  # of a link with no other stamps
            return own_s
        if stamp.bits < 64 and message.component == Component.AUTOPILOT1:
            return None
        return own_s + self._foreign.setdefault(key, Least(_FOREIGN_S)).take(expected_s - own_s, arrival_s)

    def _around(self, arrival_s: float) -> float:
        return self._newest_s + min(max(arrival_s - self._arrived_s, 0.0), _STAMPED_EVERY_S)

    def _reference(self, stamp_s: float, arrival_s: float) -> float | None:
        if self.is_set:
            ahead_s = self._newest_s + arrival_s - self._arrived_s - stamp_s
            wraps = round(ahead_s / _WRAP_S)
            if abs(ahead_s - wraps * _WRAP_S) <= _STRAYED_S:
                self._wraps = wraps
        time_s = stamp_s + self._wraps * _WRAP_S
        if self._is_of_the_boot_before(time_s, arrival_s):
            return None
        if time_s < self._newest_s - _BACKWARD_S:
            self._back, self._back_s = self._back + 1, min(self._back_s, arrival_s)
            if not self._is_restart(stamp_s, arrival_s):
                return None
            self._before = self._newest_s, self._arrived_s
            time_s, self._wraps, self._newest_s = stamp_s, 0, -math.inf
            self._foreign.clear()
            self.latency.begin_anew()
            self.restarts += 1
        self._back, self._back_s = 0, math.inf
        if time_s > self._newest_s:
            self._newest_s, self._arrived_s = time_s, arrival_s
        self.latency.take(arrival_s, time_s)
        return time_s

    def _is_restart(self, stamp_s: float, arrival_s: float) -> bool:
        """Whether old stamps in a row are those of a vehicle that began anew, not of messages that come late.

        Who has booted since the newest message counts no more seconds than have passed since then.
        """
        lasts_s = arrival_s - self._back_s
        is_young = stamp_s <= arrival_s - self._arrived_s + _STRAYED_S
        return self._back >= _PERSISTS and lasts_s >= (_PERSISTS_S if is_young else _GONE_BACK_S)

    def _is_of_the_boot_before(self, time_s: float, arrival_s: float) -> bool:
        """Whether a stamp fits where the boot before was when its last message came, and not where this one is."""
        if self._before is None:
            return False
        newest_s, arrived_s = self._before
        is_ahead = time_s > self._newest_s + max(arrival_s - self._arrived_s, 0.0) + _STRAYED_S
        return is_ahead and newest_s - _STRAYED_S <= time_s <= newest_s + (arrival_s - arrived_s) + _STRAYED_S
