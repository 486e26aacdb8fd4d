"""How often each message is sent, as ArduPilot keeps count of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

OFF: Final = 0
"""Interval of a message that is not sent [ms]."""

_LONGEST_MS: Final = 60_000
_NOW: Final = -1


class TooFastError(Exception):
    """The main loop does not turn often enough."""


class Schedule:
    """Intervals of messages, and when each is due.

    A message leaves at a turn of the main loop, so that 40 Hz of a 50 Hz loop are gaps of 20 and 40 ms, as in real
    logs.

    Parameters
    ----------
    usual_ms : Mapping[str, int]
        Interval of each message before anybody asks for another [ms]; 0 for one that is not sent.
    loop_us : int
        Period of the main loop [us].
    any_rate : bool
        Grant whatever is asked for, up to the rate of the loop.

    Examples
    --------
    >>> schedule = Schedule({"SERVO_OUTPUT_RAW": 1000}, loop_us=20_000)
    >>> schedule.ask("SERVO_OUTPUT_RAW", 25_000)
    >>> [at_ms for at_ms in range(0, 200, 20) if schedule.due(1000 * at_ms)]
    [0, 40, 60, 80, 100, 140, 160, 180]
    """

    def __init__(self, usual_ms: Mapping[str, int], *, loop_us: int, any_rate: bool = False) -> None:
        self._usual_ms = dict(usual_ms)
        self._interval_ms = dict(usual_ms)
        self._next_us = dict.fromkeys(usual_ms, _NOW)
        self._loop_us = loop_us
        self._any_rate = any_rate

    def ask(self, name: str, interval_us: int) -> None:
        """Ask for another interval: in whole milliseconds up to a minute; 0 for the usual one, -1 for none."""
        if interval_us <= 0:
            self._interval_ms[name] = self._usual_ms[name] if interval_us == 0 else OFF
            return
        interval_ms = min(max(interval_us // 1000, 1), _LONGEST_MS)
        if not self._any_rate and interval_ms * 800 < self._loop_us:
            raise TooFastError
        self._interval_ms[name] = interval_ms
        self._next_us[name] = _NOW

    def ask_rate(self, name: str, rate_hz: int) -> None:
        """Ask for a rate, as REQUEST_DATA_STREAM does [Hz]: the fastest if it is too fast, 0 for none."""
        fastest_ms = -(-self._loop_us // 800)
        self.ask(name, 1000 * max(1000 // rate_hz, fastest_ms) if rate_hz else -1)

    def interval_us(self, name: str) -> int:
        """Interval as MESSAGE_INTERVAL tells it [us]: -1 for a message that is not sent, 0 for one that is unknown."""
        interval_ms = self._interval_ms.get(name)
        if interval_ms is None:
            return 0
        return -1 if interval_ms == OFF else 1000 * interval_ms

    def due(self, now_us: int) -> list[str]:
        """Messages that leave at this turn of the loop."""
        found = []
        for name, interval_ms in self._interval_ms.items():
            if interval_ms != OFF and now_us >= self._next_us[name]:
                found.append(name)
                behind = self._next_us[name] == _NOW or now_us - self._next_us[name] >= 1000 * interval_ms
                self._next_us[name] = 1000 * interval_ms + (now_us if behind else self._next_us[name])
        return found
