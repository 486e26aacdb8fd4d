"""Names of axes and of the forms that their models may take."""

from __future__ import annotations

from collections.abc import Mapping

AXES = ("roll", "pitch", "side", "thrust")
"""In which order they are shown; ``thrust`` is the engine, whose loss must not be blamed on a surface."""

SURFACE_AXES = AXES[:3]
"""Those that surfaces turn."""

MOST_OF_THE_FLIGHT = 0.5
"""Share of the flight in which an axis must be judged, and its lost share known, for ``healthy``."""

FORM_NAMES: Mapping[str, int] = {
    "roll_rate": 4,
    "roll_acceleration": 4,
    "pitch_inverse": 6,
    "pitch_acceleration": 5,
    "side_force": 4,
    "yaw_rate": 5,
    "yaw_acceleration": 5,
    "specific_thrust": 3,
}
"""Each form and how much else than the command moves the aircraft in it."""
