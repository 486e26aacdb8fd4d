"""Parameters of the autopilot that change in flight, and what they mean for the calibration of a surface.

A servo obeys pulses. SERVO_VOLZ_RANGE says what angle a pulse asks for: the calibration follows it, to the digit, from
that moment on. TRIM, MIN, MAX and REVERSED of an output say which pulse the autopilot sends: the calibration stays, but
the pulse jumps. FUNCTION says what the output is for: nothing is known of the surface until it is what it was.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from servofd.aircraft.calibration import Calibration, PulseCalibration

_RANGE: Final = "SERVO_VOLZ_RANGE"
_CENTRE_US: Final = 1500.0
"""Where a Volz servo stands at zero, whatever SERVOn_TRIM is (AP_Volz_Protocol)."""
_OF_AN_OUTPUT: Final = re.compile(r"SERVO(\d+)_(TRIM|MIN|MAX|REVERSED|FUNCTION)")


class Change(NamedTuple):
    """What a new value of a parameter means for some surfaces."""

    surfaces: tuple[str, ...]
    scale: float
    """Of what a pulse asks for; 1 if that stays."""
    suspends: bool
    """Whether nothing is known of them any more."""
    text: str


def rescaled(command: Calibration, scale: float) -> Calibration | None:
    """Calibration of a command whose pulses ask for so many times as much; None if that is not known."""
    if not isinstance(command, PulseCalibration):
        return command  # degrees, as the driver computes them with that parameter
    if command.slope_deg_per_us is None:
        return None
    trim_us = _CENTRE_US - (_CENTRE_US - command.trim_us) / scale
    return command.model_copy(update={"slope_deg_per_us": scale * command.slope_deg_per_us, "trim_us": trim_us})


@dataclass(slots=True)
class Settings:
    """The parameters of one vehicle, as far as they were received."""

    outputs: Mapping[str, int | None]
    """By surface, the output that it hangs on."""
    _known: dict[str, float] = field(default_factory=dict)
    _first: dict[str, float] = field(default_factory=dict)

    def receive(self, name: str, value: float, *, is_news: bool = False) -> Change | None:
        """Take a parameter; None if it says nothing new, or nothing of these surfaces.

        `is_news` for one that came without its place in the list, as it does when it has been set.
        """
        found = _OF_AN_OUTPUT.fullmatch(name)
        before = self._known.get(name)
        self._known[name] = value
        if (found is None and name != _RANGE) or before == value or (before is None and not is_news):
            return None
        text = f"{name} {before:g} -> {value:g}" if before is not None else f"{name} is {value:g}"
        everything = tuple(self.outputs)
        if found is None:
            if before is None:
                return Change(everything, 1.0, True, f"{text}, was not received before")
            follows = value > 0.0 and before > 0.0
            text += ": calibration follows" if follows else ""
            return Change(everything, value / before if follows else 1.0, not follows, text)
        surfaces = tuple(surface for surface in everything if self.outputs[surface] == int(found[1]))
        if not surfaces:
            return None
        if found[2] == "FUNCTION":
            first = self._first.setdefault(found[0], value if before is None else before)
            return Change(surfaces, 1.0, value != first, text)
        return Change(surfaces, 1.0, False, f"{text}: servo gets pulses as before")

    def missing(self) -> tuple[str, ...]:
        """What has to be known before it changes, and is not; a log that holds it also tells what each output turns."""
        functions = (f"SERVO{output}_FUNCTION" for output in self.outputs.values() if output is not None)
        return tuple(name for name in (_RANGE, *functions) if name not in self._known)
