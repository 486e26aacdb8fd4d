"""The vehicle on its link: the only place here that knows of sockets and of the time of day."""

from __future__ import annotations

import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from typing import Final, NamedTuple

from logparsers.codec import Codec
from logparsers.link import Link
from logparsers.units import S_PER_US, US_PER_S
from servofd.aircraft.schema import Aircraft
from servofd.simulation.flight import SimulatedFlight
from servofd.simulation.vehicle.remote_log import Send
from servofd.simulation.vehicle.troubles import Air, Edit, Reboot, Stall, troubled_flight
from servofd.simulation.vehicle.vehicle import Settings, Vehicle

_BEAT_S: Final = 0.5
_TICK_S: Final = 0.02
"""Pause of the loop that flies the vehicle [s]."""
_MOST_AT_ONCE: Final = 256
"""Pieces of data that are read in one turn of it."""


class Leg(NamedTuple):
    """A vehicle from one start of its autopilot to the next."""

    begun_s: float
    """Since the beginning of the flight [s]."""
    vehicle: Vehicle


def legs(flight: SimulatedFlight, aircraft: Aircraft, settings: Settings) -> tuple[Leg, ...]:
    """A flight between the restarts of its autopilot; troubles are counted from the beginning of the flight."""
    flight = troubled_flight(flight, aircraft, settings.troubles)
    first_s = float(flight.time_s[0])
    reboots = sorted((t for t in settings.troubles if isinstance(t, Reboot)), key=lambda t: t.start_s)
    begins_s = [0.0, *(t.start_s + t.away_s for t in reboots)]
    ends_s = [*(t.start_s for t in reboots), float("inf")]
    found = []
    for begun_s, end_s in zip(begins_s, ends_s, strict=True):
        rows = (flight.time_s - first_s >= begun_s - 1e-9) & (flight.time_s - first_s < end_s - 1e-9)
        if rows.sum() < 2:
            continue
        part = replace(
            flight,
            time_s=flight.time_s[rows] - begun_s,
            command_deg=flight.command_deg[rows],
            measured_deg=flight.measured_deg[rows],
            received_deg=flight.received_deg[rows],
            pulse_us=flight.pulse_us[rows],
        )
        mine = tuple(
            replace(t, start_s=t.start_s - begun_s)
            for t in settings.troubles
            if isinstance(t, Edit | Stall) and begun_s <= t.start_s < end_s
        )
        found.append(Leg(begun_s, Vehicle(part, aircraft, replace(settings, troubles=mine))))
    return tuple(found)


def fly(flown: tuple[Leg, ...], link: Link, codec: Codec, *, wait: bool, air: Air) -> Flown:
    """Fly until the flight ends, or Ctrl-C ends it, over a link, which is left open, and the air before it."""
    flight = Flown(flown, link, codec, air)
    with suppress(KeyboardInterrupt):
        if wait:
            flight.wait()
        flight.fly()
    return flight


class Flown:
    """A flight, and how it went."""

    def __init__(self, flown: tuple[Leg, ...], link: Link, codec: Codec, air: Air) -> None:
        self.turns = 0
        """Of the main loop."""
        self.sent = self.received = 0
        """Messages."""
        self._legs, self._link, self._codec, self._air = flown, link, codec, air
        self._vehicle, self._speed = flown[0].vehicle, flown[0].vehicle.speed
        self._at_s = 0.0

    def wait(self) -> None:
        """Say that it is there, and stand still."""
        now_us = int(self._vehicle.time_us[0])
        while not self.received:
            self._send([self._vehicle.heartbeat()])
            self._listen(_BEAT_S, now_us)

    def fly(self) -> None:
        """Fly to its end."""
        takeoff_s = time.monotonic()
        for leg in self._legs:
            self._vehicle = leg.vehicle
            at_us = leg.vehicle.time_us
            for index in range(at_us.size):
                self._at_s = leg.begun_s + S_PER_US * float(at_us[index] - at_us[0])
                due_s = takeoff_s + self._at_s / self._speed
                for _ in range(_MOST_AT_ONCE):
                    left_s = due_s - time.monotonic()
                    now_us = int(at_us[index] - US_PER_S * max(left_s, 0.0) * self._speed)
                    if not self._listen(left_s, now_us) and time.monotonic() >= due_s:
                        break
                self._send(leg.vehicle.turn(index))
                self.turns += 1
        while not self._air.empty:
            time.sleep(_TICK_S / self._speed)
            self._at_s += _TICK_S
            self._send([])

    def _listen(self, timeout_s: float, now_us: int) -> bool:
        """Hear what arrives within a time, and answer; False if nothing did."""
        data = self._link.receive(timeout_s)
        if not self._air.passes(self._at_s):
            return bool(data)
        for message in self._codec.decode(data):
            self.received += 1
            self._send(self._vehicle.receive(message, now_us))
        return bool(data)

    def _send(self, messages: Iterable[Send]) -> None:
        self._codec.skip(self._air.jump(self._at_s))
        frames = [self._codec.encode(name, fields) for name, fields in messages]
        for frame in self._air.through(self._at_s, frames):
            self._link.send(frame)
            self.sent += 1
