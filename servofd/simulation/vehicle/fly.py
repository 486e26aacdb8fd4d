"""The vehicle on its link: the only place here that knows of sockets and of the time of day."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterable

    from logparsers.codec import Codec
    from logparsers.link import Link
    from servofd.simulation.vehicle.messages import Send
    from servofd.simulation.vehicle.vehicle import Vehicle

__all__ = ["Flown", "fly"]

_BEAT_S: Final = 0.5
_MOST_AT_ONCE: Final = 256


@dataclass(slots=True)
class Flown:
    """How a flight went."""

    turns: int = 0
    """Turns of the main loop."""
    sent: int = 0
    """Messages."""
    heard: int = 0
    """Messages."""


def fly(vehicle: Vehicle, link: Link, codec: Codec, *, wait: bool = False) -> Flown:
    """Fly until the flight ends, or Ctrl-C ends it.

    Parameters
    ----------
    vehicle : Vehicle
        What flies.
    link : Link
        Where it is heard; left open.
    codec : Codec
        Its end of the link.
    wait : bool
        Begin when somebody has said something.

    Returns
    -------
    Flown
        Counts, also of a flight that was ended.
    """
    session = _Session(vehicle, link, codec)
    try:
        if wait:
            session.wait()
        session.fly()
    except KeyboardInterrupt:
        pass
    return session.flown


class _Session:
    def __init__(self, vehicle: Vehicle, link: Link, codec: Codec) -> None:
        self.flown = Flown()
        self._vehicle, self._link, self._codec, self._speed = vehicle, link, codec, vehicle.speed

    def wait(self) -> None:
        """Say that it is there, and stand still."""
        now_us = int(self._vehicle.time_us[0])
        while not self.flown.heard:
            self._send([self._vehicle.heartbeat()])
            self._listen(_BEAT_S, now_us)

    def fly(self) -> None:
        at_us = self._vehicle.time_us
        begin_s = time.monotonic()
        for index in range(at_us.size):
            due_s = begin_s + 1e-6 * float(at_us[index] - at_us[0]) / self._speed
            for _ in range(_MOST_AT_ONCE):
                left_s = due_s - time.monotonic()
                now_us = int(at_us[index] - 1e6 * max(left_s, 0.0) * self._speed)
                if not self._listen(left_s, now_us) and time.monotonic() >= due_s:
                    break
            self._send(self._vehicle.turn(index))
            self.flown.turns += 1

    def _listen(self, timeout_s: float, now_us: int) -> bool:
        """Hear what arrives within a time, and answer; False if nothing did."""
        data = self._link.receive(timeout_s)
        for heard in self._codec.decode(data):
            self.flown.heard += 1
            self._send(self._vehicle.hear(heard, now_us))
        return bool(data)

    def _send(self, messages: Iterable[Send]) -> None:
        for name, fields in messages:
            self._link.send(self._codec.encode(name, fields))
            self.flown.sent += 1
