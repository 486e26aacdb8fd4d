"""How late the messages of a vehicle are, told by what they carry: nobody's clock has to be right.

A stamped message says how much later it arrived than it was made, but for an unknown difference between two clocks. The
fastest messages bound that difference from above, the answers to TIMESYNC from both sides. Both bounds forget: crystals
drift apart, and a difference that was true an hour ago is not any more.
"""

from __future__ import annotations

import math

_DRIFT = 1e-4
"""Most by which two clocks drift apart [s/s]; crystals have some 20 ppm, and 50 in the cold."""
_BLOCK_S = 0.5
"""The delay of a link is that of the fastest message of one or two blocks."""
_LATE_S = 0.75
"""From here on a link is late, and in time again below half of it; radios take 0.05 to 0.3 s, LTE 0.1 to 0.6 s."""
_HELD_S = 1.0
"""For so long it must be late to be told,"""
_CALM_S = 5.0
"""and so long in time; what comes and goes more quickly is one sentence."""


class Latency:
    """Follows the delay of one vehicle's messages.

    Examples
    --------
    A link that is 4 s later from 10 s on:

    >>> latency, said = Latency(), []
    >>> for k in range(300):
    ...     made_s = 0.1 * k
    ...     arrival_s = 1000.0 + made_s + (4.1 if made_s > 10.0 else 0.1)
    ...     latency.take(arrival_s, made_s)
    ...     said.append(latency.news(arrival_s))
    >>> [text for text in said if text], round(latency.late_s, 1)
    (['link 4 s late'], 4.0)
    """

    def __init__(self) -> None:
        self._lags_s = [math.inf, math.inf]
        """Least of arrival minus stamp in this block and in the one before."""
        self._block_s = -math.inf
        self._fastest_s, self._slowest_s, self._bound_s = math.inf, -math.inf, -math.inf
        self._told_s, self._since_s, self._calm_s = 0.0, math.inf, math.inf
        self._sent: dict[int, float] = {}

    @property
    def late_s(self) -> float:
        """By how much messages are later than the fastest ones would be [s]."""
        lag_s = min(self._lags_s)
        return max(lag_s - max(self._fastest_s, self._slowest_s), 0.0) if math.isfinite(lag_s) else 0.0

    def take(self, arrival_s: float, made_s: float) -> None:
        """Take the arrival [s, receiver's clock] and the stamp [s, vehicle's clock] of a message."""
        lag_s = arrival_s - made_s
        self._forget(arrival_s)
        if arrival_s - self._block_s >= _BLOCK_S:
            self._block_s, self._lags_s = arrival_s, [lag_s, self._lags_s[0]]
        self._lags_s[0] = min(self._lags_s[0], lag_s)
        self._fastest_s = min(self._fastest_s, lag_s)

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

    def _forget(self, arrival_s: float) -> None:
        if math.isfinite(self._bound_s):
            drifted_s = _DRIFT * max(arrival_s - self._bound_s, 0.0)
            self._fastest_s += drifted_s
            self._slowest_s -= drifted_s
        self._bound_s = max(arrival_s, self._bound_s)
