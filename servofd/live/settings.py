"""Parameters of the autopilot that change in flight, and what they mean for the calibration of a surface.

A servo obeys pulses. SERVO_VOLZ_RANGE says what angle a pulse asks for: the calibration follows it, to the digit, from
that moment on. TRIM, MIN, MAX and REVERSED of an output say which pulse the autopilot sends: the calibration stays, but
the pulse jumps. FUNCTION says what the output is for: nothing is known of the surface until it is what it was.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple

from servofd.aircraft.calibration import PulseCalibration

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from servofd.aircraft.calibration import Calibration
    from servofd.aircraft.schema import Surface

_RANGE: Final = "SERVO_VOLZ_RANGE"
_CENTRE_US: Final = 1500.0
"""Where a Volz servo stands at zero, whatever SERVOn_TRIM is (AP_Volz_Protocol)."""
_OF_AN_OUTPUT: Final = re.compile(r"SERVO(\d+)_(TRIM|MIN|MAX|REVERSED|FUNCTION)")
_OUTPUT: Final = re.compile(r"servo(\d+)_raw|RCOU\.C(\d+)|CSRV\[(\d+)\]")


class Change(NamedTuple):
    """What a new value of a parameter means for some surfaces."""

    surfaces: tuple[str, ...]
    scale: float
    """Of what a pulse asks for; 1 if that stays."""
    suspends: bool
    """Whether nothing is known of them any more."""
    text: str


def output_of(channel: str) -> int | None:
    """Number of the autopilot's output that a channel belongs to; None if its name does not tell."""
    found = _OUTPUT.search(channel)
    if found is None:
        return None
    return int(found[3]) + 1 if found[3] else int(found[1] or found[2])


def rescaled(command: Calibration, scale: float) -> Calibration | None:
    """Calibration of a command whose pulses ask for so many times as much; None if that cannot be told."""
    if not isinstance(command, PulseCalibration):
        return command  # degrees, as the driver computes them with that parameter
    if command.slope_deg_per_us is None:
        return None
    trim_us = _CENTRE_US - (_CENTRE_US - command.trim_us) / scale
    return command.model_copy(update={"slope_deg_per_us": scale * command.slope_deg_per_us, "trim_us": trim_us})


@dataclass(slots=True)
class Settings:
    """The parameters of one vehicle, as far as they were heard.

    Parameters
    ----------
    outputs : Mapping of str to int or None
        By surface, the output that it hangs on.
    """

    outputs: Mapping[str, int | None]
    _known: dict[str, float] = field(default_factory=dict)
    _first: dict[str, float] = field(default_factory=dict)

    def hear(self, name: str, value: float, *, is_news: bool = False) -> Change | None:
        """Take a parameter; None if it says nothing new, or nothing of these surfaces.

        `is_news` for one that came without its place in the list, as it does when somebody has set it.
        """
        found = _OF_AN_OUTPUT.fullmatch(name)
        if found is None and name != _RANGE:
            return None
        before = self._known.get(name)
        self._known[name] = value
        if before == value or (before is None and not is_news):
            return None
        text = f"{name} {before:g} -> {value:g}" if before is not None else f"{name} is {value:g}"
        return self._of_all(before, value, text) if found is None else self._of_one(found, before, value, text)

    def _of_all(self, before: float | None, value: float, text: str) -> Change:
        """The range of every servo."""
        everything = tuple(self.outputs)
        if before is None:
            return Change(everything, 1.0, True, f"{text}, was not heard before")
        if not (value > 0.0 and before > 0.0):
            return Change(everything, 1.0, True, text)
        return Change(everything, value / before, False, f"{text}: calibration follows")

    def _of_one(self, found: re.Match[str], before: float | None, value: float, text: str) -> Change | None:
        """What an output is for, or which pulses it sends."""
        surfaces = tuple(surface for surface, output in self.outputs.items() if output == int(found[1]))
        if not surfaces:
            return None
        if found[2] == "FUNCTION":
            first = self._first.setdefault(found[0], value if before is None else before)
            return Change(surfaces, 1.0, value != first, text)
        return Change(surfaces, 1.0, False, f"{text}: servo gets pulses as before")

    def missing(self) -> tuple[str, ...]:
        """What has to be known before it changes, and is not."""
        return () if _RANGE in self._known else (_RANGE,)

    @staticmethod
    def of(surfaces: Mapping[str, Surface], watched: Iterable[str]) -> Settings:
        """Of the surfaces of an aircraft that are watched."""
        return Settings({name: output_of(surfaces[name].command.channel) for name in watched})
