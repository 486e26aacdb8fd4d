"""What goes wrong on the way from a vehicle to its ground station, and on board: as seen on a real ArduPilot.

Each trouble is a small class: its start [s of the flight] and what it takes. The air between both ends (`Air`) delays,
holds back and loses; what happens on board changes the flight (`troubled_flight`) or the vehicle.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from servofd.aircraft.schema import Aircraft
from servofd.core.errors import ConfigError
from servofd.core.types import BoolArray
from servofd.simulation.flight import SimulatedFlight

_LONGEST_S = 3600.0
"""Longest time that a trouble may be given [s]."""


@dataclass(frozen=True, slots=True)
class Trouble:
    """Something that goes wrong."""

    start_s: float
    """Counted from the beginning of the flight."""

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if isinstance(value, float) and name.endswith("_s") and not 0.0 <= value <= _LONGEST_S:
                raise ConfigError(f"{name} = {value:g}: give seconds from 0 to {_LONGEST_S:g}")


@dataclass(frozen=True, slots=True)
class Late(Trouble):
    """The link is so much later from then on [s]."""

    by_s: float = 4.0


@dataclass(frozen=True, slots=True)
class Pause(Trouble):
    """Nothing comes for so long [s], then all of it at once."""

    for_s: float = 6.0


@dataclass(frozen=True, slots=True)
class Silence(Trouble):
    """Nothing passes for so long [s], in either direction."""

    for_s: float = 20.0


@dataclass(frozen=True, slots=True)
class Jump(Trouble):
    """The numbers of frames jump by so many: frames of other components, routed elsewhere, count along."""

    by: float = 9.0


@dataclass(frozen=True, slots=True)
class Reboot(Trouble):
    """The autopilot begins anew, and is away for so long [s]."""

    away_s: float = 5.0


@dataclass(frozen=True, slots=True)
class Stall(Trouble):
    """The autopilot's log over MAVLink pauses for so long [s], as around arming and changes of mode."""

    for_s: float = 5.0


@dataclass(frozen=True, slots=True)
class Freeze(Trouble):
    """The servos' bus repeats the last positions of all of them, for so long [s]."""

    for_s: float = 0.2


@dataclass(frozen=True, slots=True)
class Edit(Trouble):
    """A parameter is set.

    SERVO_VOLZ_RANGE scales what a pulse asks of every servo; SERVOn_TRIM shifts and SERVOn_REVERSED mirrors the pulses
    of one output, which its servo obeys; others are just set. What follows from it is computed for servos
    that obey: one that is at fault by then moves along.
    """

    name: str = "SERVO_VOLZ_RANGE"
    value: float = 160.0


TROUBLES: dict[str, type[Trouble]] = {
    "late": Late,
    "pause": Pause,
    "silence": Silence,
    "sequence": Jump,
    "reboot": Reboot,
    "stall": Stall,
    "freeze": Freeze,
    "parameter": Edit,
}


class Air:
    """What is between a vehicle and whoever hears it.

    `troubles`: those on board have no effect here.

    Examples
    --------
    >>> air = Air([Pause(1.0, for_s=2.0)])
    >>> [air.through(at_s, [b"%g" % at_s]) for at_s in (0.5, 1.5, 2.5, 3.5)]
    [[b'0.5'], [], [], [b'1.5', b'2.5', b'3.5']]
    """

    def __init__(self, troubles: Iterable[Trouble] = ()) -> None:
        self._troubles = tuple(troubles)
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._skipped: set[Trouble] = set()

    @property
    def empty(self) -> bool:
        """Whether nothing is on its way."""
        return not self._waiting

    def through(self, at_s: float, frames: Iterable[bytes]) -> list[bytes]:
        """Send frames at a time of the flight [s]; gives those that arrive by then, in order."""
        for frame in frames:
            due_s = self._due_s(at_s)
            if due_s is not None:
                self._waiting.append((max(due_s, self._waiting[-1][0] if self._waiting else due_s), frame))
        arrived = []
        while self._waiting and self._waiting[0][0] <= at_s:
            arrived.append(self._waiting.popleft()[1])
        return arrived

    def passes(self, at_s: float) -> bool:
        """Whether the vehicle hears what is said at that time [s]."""
        return not any(isinstance(t, Silence) and 0.0 <= at_s - t.start_s < t.for_s for t in self._troubles)

    def jump(self, at_s: float) -> int:
        """Frames that count along without ever being sent here, once at their time [s]."""
        found = {t for t in self._troubles if isinstance(t, Jump) and t.start_s <= at_s} - self._skipped
        self._skipped |= found
        return sum(round(t.by) for t in found if isinstance(t, Jump))

    def _due_s(self, at_s: float) -> float | None:
        if not self.passes(at_s):
            return None
        late_s = sum(t.by_s for t in self._troubles if isinstance(t, Late) and at_s >= t.start_s)
        held_s = [
            t.start_s + t.for_s for t in self._troubles if isinstance(t, Pause) and 0.0 <= at_s - t.start_s < t.for_s
        ]
        return max([at_s + late_s, *held_s])


def troubled_flight(flight: SimulatedFlight, aircraft: Aircraft, troubles: Sequence[Trouble]) -> SimulatedFlight:
    """The flight as the servos fly it (`Edit` changes pulses and motion) and the autopilot sees it (`Freeze`)."""
    begun_s, end_s = float(flight.time_s[0]), float(flight.time_s[-1])
    for trouble in troubles:
        if begun_s + trouble.start_s > end_s:
            raise ConfigError(f"{type(trouble).__name__.lower()} at {trouble.start_s:g} s: the flight is over by then")
    for edit in (t for t in troubles if isinstance(t, Edit)):
        flight = _edited(flight, aircraft, edit, flight.time_s >= begun_s + edit.start_s)
    measured_deg = flight.measured_deg.copy()
    for freeze in (t for t in troubles if isinstance(t, Freeze)):
        held = (flight.time_s >= begun_s + freeze.start_s) & (flight.time_s < begun_s + freeze.start_s + freeze.for_s)
        if held.any():
            measured_deg[held] = measured_deg[max(int(np.argmax(held)) - 1, 0)]
    return replace(flight, measured_deg=measured_deg)


def _edited(flight: SimulatedFlight, aircraft: Aircraft, edit: Edit, after: BoolArray) -> SimulatedFlight:
    """With the pulses and the motion that follow from a new value of a parameter."""
    command_deg, measured_deg = flight.command_deg.copy(), flight.measured_deg.copy()
    pulse_us, received_deg = flight.pulse_us.copy(), flight.received_deg.copy()
    for k, output in enumerate(flight.outputs):
        asked_deg, felt_deg = command_deg[:, k].copy(), command_deg[:, k].copy()
        if edit.name == "SERVO_VOLZ_RANGE":
            felt_deg[after] *= edit.value / (2.0 * max(o.travel_deg for o in flight.outputs))
        elif edit.name == f"SERVO{output.number}_TRIM":
            pulse_us[after, k] += round(edit.value) - output.trim_us
        elif edit.name == f"SERVO{output.number}_REVERSED" and bool(edit.value) != output.reversed:
            pulse_us[after, k] = 2 * output.trim_us - pulse_us[after, k]
        if edit.name != "SERVO_VOLZ_RANGE":
            felt_deg = command_deg[:, k] = output.deflection_deg(pulse_us[:, k])
        if np.array_equal(felt_deg, asked_deg):
            continue
        received_deg[:, k] += felt_deg - asked_deg
        model, time_s = aircraft.model(output.surface), flight.time_s
        measured_deg[:, k] += model.simulate(time_s, felt_deg, time_s) - model.simulate(time_s, asked_deg, time_s)
    return replace(
        flight, command_deg=command_deg, measured_deg=measured_deg, pulse_us=pulse_us, received_deg=received_deg
    )
