"""An effect of one's own: a worn gear whose error repeats with every few degrees.

servofd explain flight.csv -s elevator --effect own_effect.py
"""

import numpy as np

from servofd import OwnEffect, OwnParameter


def worn_gear(_time_s: np.ndarray, deflection_deg: np.ndarray, amplitude_deg: float, pitch_deg: float) -> np.ndarray:
    """Deflection [deg] behind a gear with an error of some amplitude that repeats with every pitch."""
    return deflection_deg + amplitude_deg * np.sin(2.0 * np.pi * deflection_deg / pitch_deg)


effect = OwnEffect(
    name="worn_gear",
    place="deflection",  # or "command": then the function gets commands, and changes what the servo hears
    parameters=(
        OwnParameter("amplitude_deg", low=-2.0, high=2.0, neutral=0.0, typical=0.3),
        OwnParameter("pitch_deg", low=1.0, high=8.0, neutral=4.5, typical=1.0),
    ),
    apply=worn_gear,
)
