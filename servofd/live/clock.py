"""When live messages were made: seconds since the vehicle's first boot, as in a telemetry log.

Stamps of the vehicle's own clock are kept exactly, with overflows added; what is stamped by another clock is shifted
by the fastest of its messages so far. A vehicle that restarts goes on where it was, by arrival time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from servofd.live.channels import stamp_of

if TYPE_CHECKING:
    from logparsers.codec import Heard

__all__ = ["VehicleClock"]

_AUTOPILOT = 1
_RELAYED = ("NAMED_VALUE", "DEBUG", "SET_", "HIL_", "VISION", "TIMESYNC")
"""Often stamped by someone else."""
_BACKWARD_S = 1.0
_STRAYED_S = 10.0
_PERSISTS = 3
_PATIENCE_S = 2.0
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
        self._late_s = float("inf")
        """Arrival minus stamp of the fastest message."""
        self._shift_s = 0.0
        self._wraps = 0
        """How often the vehicle's milliseconds have overflown."""
        self._newest_s = float("-inf")
        self._begun_s: float | None = None
        self._back = 0
        self._foreign: dict[tuple[int, str], float] = {}
        self.restarts = 0
        """How often the vehicle has begun anew."""

    def is_reference(self, heard: Heard) -> bool:
        """Whether this message tells the vehicle's time since boot without overflowing."""
        stamp = stamp_of(heard.name)
        return (
            heard.component == _AUTOPILOT
            and stamp is not None
            and stamp.field == "time_boot_ms"
            and not heard.name.startswith(_RELAYED)
            and heard.fields[stamp.field] > 0
        )

    def is_set(self, arrival_s: float) -> bool:
        """Whether the vehicle's time is known, or will not be known any better."""
        if self._begun_s is None:
            self._begun_s = arrival_s
        return self._late_s < float("inf") or arrival_s - self._begun_s > _PATIENCE_S

    def time_s(self, heard: Heard, arrival_s: float) -> float | None:
        """When a message was made [s]; None while that cannot be told."""
        stamp = stamp_of(heard.name)
        raw = int(heard.fields[stamp.field]) if stamp else 0
        if stamp is None or raw == 0:
            return self.from_arrival(arrival_s)
        if self.is_reference(heard) or self._late_s == float("inf"):
            return self._reference(raw * stamp.tick_s, arrival_s)
        expected_s = arrival_s - self._late_s
        own_s = raw * stamp.tick_s
        if stamp.bits < 64:
            overflows = round((expected_s - self._shift_s - own_s) / (stamp.tick_s * 2.0**stamp.bits))
            own_s = (raw + overflows * (1 << stamp.bits)) * stamp.tick_s
        own_s += self._shift_s
        key = (heard.component, heard.name)
        if key not in self._foreign and abs(own_s - expected_s) <= _STRAYED_S:
            return own_s
        if stamp.bits < 64 and heard.component == _AUTOPILOT:
            return None
        self._foreign[key] = min(self._foreign.get(key, float("inf")), expected_s - own_s)
        return own_s + self._foreign[key]

    def from_arrival(self, arrival_s: float) -> float | None:
        """Arrival time on the vehicle's clock [s], late by what the message waited."""
        return arrival_s - self._late_s if self._late_s < float("inf") else None

    def _reference(self, stamp_s: float, arrival_s: float) -> float | None:
        if self._late_s < float("inf"):
            ahead_s = arrival_s - self._late_s - self._shift_s - stamp_s
            wraps = round(ahead_s / _WRAP_S)
            if abs(ahead_s - wraps * _WRAP_S) <= _STRAYED_S:
                self._wraps = wraps
        time_s = stamp_s + self._wraps * _WRAP_S + self._shift_s
        if time_s < self._newest_s - _BACKWARD_S:
            self._back += 1
            if self._back < _PERSISTS:
                return None
            expected_s = max(arrival_s - self._late_s, self._newest_s)
            self._shift_s, self._wraps, self._newest_s = expected_s - stamp_s, 0, float("-inf")
            self._foreign.clear()
            self.restarts += 1
            time_s = expected_s
        self._back = 0
        self._newest_s = max(self._newest_s, time_s)
        self._late_s = min(self._late_s, arrival_s - time_s)
        return time_s
