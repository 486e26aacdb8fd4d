"""An effect of one's own: a worn gear whose error repeats with every few degrees.

servofd explain flight.csv -s elevator --effect own_effect.py
"""

import math

from servofd import Effect, Parameter, Slot
from servofd.servo.effect import Now


class WornGear(Effect):
    """Gear with an error of some amplitude that repeats with every pitch."""

    name, slot = "worn_gear", Slot.OUTPUT
    parameters = (
        Parameter("amplitude_deg", low=-2.0, high=2.0, neutral=0.0, typical=0.3),
        Parameter("pitch_deg", low=1.0, high=8.0, neutral=4.5, typical=1.0),
    )

    @staticmethod
    def act(x: float, now: Now, amplitude_deg: float, pitch_deg: float) -> float:  # noqa: ARG004 - the step is not needed
        """Deflection behind the gear."""
        return x + amplitude_deg * math.sin(2.0 * math.pi * x / pitch_deg)
