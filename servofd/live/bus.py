"""Readings of a servo bus that froze, told from servos that stand still."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servofd.aircraft.calibration import Calibration

_FEWEST_SURFACES: Final = 3
_FEWEST_ASKED: Final = 2
_ASKED_DEG: Final = 0.5
"""Readings of a servo that is asked to move so far change: none is coarser."""
_REPEATS: Final = 2
_STILL_S: Final = 0.1
"""On an ArduPlane with six servos on one bus each position is refreshed every 45 ms, at times only after 80 ms."""
_SILENT_S: Final = 1.0
_TOLD_S: Final = 0.3


@dataclass(slots=True)
class _Servo:
    """What came of one servo."""

    command: Calibration
    asked: float = float("nan")
    asked_then: float = float("nan")
    """When its reading changed last."""
    reading: float = float("nan")
    changed_s: float = float("nan")
    newest_s: float = float("-inf")
    repeats: int = 0

    @property
    def is_asked(self) -> bool:
        """Whether its command has moved since its reading changed last."""
        now_deg, then_deg = self.command.to_deg(np.array([self.asked, self.asked_then]))
        return bool(abs(now_deg - then_deg) > _ASKED_DEG)


@dataclass(slots=True)
class ServoBus:
    """Says of each reading whether it is only an old one again, because the whole bus is frozen.

    It is where the readings of all servos stay the same to the last bit while some of them are asked to move. One that
    jams stands still alone; and what stands still unasked is as good as new.

    Examples
    --------
    >>> from servofd.aircraft.schema import load_aircraft
    >>> commands = {name: s.command for name, s in load_aircraft("simulated").surfaces.items()}
    >>> bus = ServoBus.of(commands)
    >>> seen = []
    >>> for k in range(10):
    ...     for name in commands:
    ...         bus.ask(name, 1500.0 + 20.0 * k)
    ...         seen.append(bus.is_old(name, 0.05 * k, 1.8 * min(k, 5)))
    >>> [any(seen[3 * k : 3 * k + 3]) for k in range(10)]
    [False, False, False, False, False, False, False, True, True, True]
    """

    news: str = ""
    """What is to be told, once in each outage."""
    _servos: dict[str, _Servo] = field(default_factory=dict)
    _told: bool = False

    @classmethod
    def of(cls, commands: Mapping[str, Calibration]) -> ServoBus:
        """For surfaces with these commands."""
        return cls(_servos={name: _Servo(command) for name, command in commands.items()})

    def ask(self, name: str, command: float) -> None:
        """Take a command, in the unit of its channel."""
        self._servos[name].asked = command

    def is_old(self, name: str, time_s: float, reading: float) -> bool:
        """Take a reading, and say whether it says nothing."""
        servo = self._servos[name]
        servo.newest_s = max(servo.newest_s, time_s)
        if reading != servo.reading:
            servo.reading, servo.changed_s, servo.asked_then, servo.repeats = reading, time_s, servo.asked, 0
            self._told = False
            return False
        servo.repeats += 1
        if servo.repeats < _REPEATS:
            return False
        alive = [each for each in self._servos.values() if time_s - each.newest_s < _SILENT_S]
        still_s = time_s - max(each.changed_s for each in alive)
        if (
            len(alive) < _FEWEST_SURFACES
            or still_s < _STILL_S
            or any(each.repeats < _REPEATS for each in alive)
            or sum(each.is_asked for each in alive) < _FEWEST_ASKED
        ):
            return False
        if still_s >= _TOLD_S and not self._told:
            self.news, self._told = (
                f"positions of all servos stand still since {time_s - still_s:.1f} s: servo bus?",
                True,
            )
        return True
