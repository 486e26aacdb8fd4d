"""Asking an autopilot for the rates that a model needs, and taking no for an answer."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from logparsers.mavlink import dialect

if TYPE_CHECKING:
    from logparsers.codec import Heard

__all__ = ["Requests"]

_SET_MESSAGE_INTERVAL: Final = 511  # MAV_CMD
_ACCEPTED, _IN_PROGRESS, _UNSUPPORTED = 0, 5, 3  # MAV_RESULT
_RATES_HZ: Final = (50.0, 40.0, 25.0, 10.0)
"""ArduPlane grants 0.8 of its loop rate: 40 Hz with the usual 50 Hz loop."""
_SELDOM_HZ: Final = (5.0, 2.0, 1.0)
"""Of airspeed and supply."""
_PATIENCE_S, _TRIES = 1.0, 3
_AGAIN_S = 30.0
_TOO_SLOW = 0.6


@dataclass(slots=True)
class _Wish:
    message: str
    rates_hz: tuple[float, ...] = _RATES_HZ
    step: int = 0
    tries: int = 0
    granted_hz: float = 0.0
    done: bool = False


@dataclass(slots=True)
class Requests:
    """One vehicle's message intervals, asked for one after the other.

    Parameters
    ----------
    system : int
        The vehicle.
    messages : set of str
        What its surfaces need.
    seldom : set of str
        What tells of airspeed and supply.

    Examples
    --------
    >>> from logparsers.codec import Heard
    >>> requests = Requests(1, {"SERVO_OUTPUT_RAW"})
    >>> [fields["param2"] for _, fields in requests.due(0.0)]
    [20000.0]
    >>> requests.hear(Heard("COMMAND_ACK", 1, 1, {"command": 511, "result": 2}))
    'SERVO_OUTPUT_RAW at 50 Hz denied'
    >>> [fields["param2"] for _, fields in requests.due(0.1)]
    [25000.0]
    >>> requests.hear(Heard("COMMAND_ACK", 1, 1, {"command": 511, "result": 0}))
    'SERVO_OUTPUT_RAW at 40 Hz granted'
    """

    system: int
    messages: set[str]
    seldom: set[str] = field(default_factory=set)
    _wishes: list[_Wish] = field(init=False)
    _asked_s: float = float("-inf")
    _open: _Wish | None = None
    _finished_s: float = float("-inf")

    def __post_init__(self) -> None:
        self.again()

    def due(self, now_s: float) -> list[tuple[str, dict[str, Any]]]:
        """What to ask now [s, the receiver's clock]."""
        if self._open is not None and now_s - self._asked_s < _PATIENCE_S:
            return []
        wish = self._open or next((wish for wish in self._wishes if not wish.done), None)
        if wish is None:
            return []
        wish.tries += 1
        if wish.tries > _TRIES:
            wish.done, self._open, self._finished_s = True, None, now_s
            return []
        self._open, self._asked_s = wish, now_s
        period_us = 1e6 / wish.rates_hz[wish.step]
        number = dialect().layouts[wish.message].id
        fields = {"target_system": self.system, "target_component": 1, "command": _SET_MESSAGE_INTERVAL}
        return [("COMMAND_LONG", fields | {"param1": float(number), "param2": period_us})]

    def hear(self, heard: Heard) -> str:
        """Take an answer, and say what it means; empty if it is none."""
        wish = self._open
        if wish is None or heard.name != "COMMAND_ACK" or heard.fields["command"] != _SET_MESSAGE_INTERVAL:
            return ""
        result = int(heard.fields["result"])
        if result == _IN_PROGRESS:
            return ""
        asked_hz = wish.rates_hz[wish.step]
        self._open, self._finished_s = None, self._asked_s
        if result == _ACCEPTED:
            wish.done, wish.granted_hz = True, asked_hz
            return f"{wish.message} at {asked_hz:g} Hz granted"
        wish.step, wish.tries = wish.step + 1, 0
        wish.done = result == _UNSUPPORTED or wish.step == len(wish.rates_hz)
        return f"{wish.message} at {asked_hz:g} Hz denied" if not wish.done else f"{wish.message}: no rate is granted"

    def measured(self, message: str, rate_hz: float, now_s: float) -> str:
        """Ask again if a message comes much more slowly than was granted, and say so: another station changed it."""
        wish = next((wish for wish in self._wishes if wish.message == message), None)
        if wish is None or self._open is not None or now_s - self._finished_s <= _AGAIN_S:
            return ""
        if not rate_hz < _TOO_SLOW * wish.granted_hz:
            return ""
        granted_hz = wish.granted_hz
        self.again()
        return f"{message} comes at {rate_hz:.2g} Hz, not at {granted_hz:g} Hz as granted: asks again"

    def again(self) -> None:
        """Ask for everything once more, as after a restart."""
        self._wishes = [_Wish(message) for message in sorted(self.messages)]
        self._wishes += [_Wish(message, _SELDOM_HZ) for message in sorted(self.seldom)]
        self._open = None
