"""What an autopilot's parameters say about its servo outputs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

SURFACE_FUNCTIONS = {
    2: "flap",
    3: "flap",
    4: "aileron",
    16: "spoiler_left",
    17: "spoiler_right",
    19: "elevator",
    21: "rudder",
    24: "flaperon_left",
    25: "flaperon_right",
    26: "ground_steering",
    41: "tilt",
    45: "tilt_rear_left",
    46: "tilt_rear_right",
    47: "tilt_rear",
    75: "tilt_left",
    76: "tilt_right",
    77: "elevon_left",
    78: "elevon_right",
    79: "vtail_left",
    80: "vtail_right",
    86: "spoiler_left_2",
    87: "spoiler_right_2",
    110: "airbrake",
}
"""ArduPilot's SERVOn_FUNCTION numbers of outputs that turn something."""

_FULL_TRAVEL_DEG = 45.0
"""ArduPilot scales angle outputs to +-4500 centidegrees at full travel."""


@dataclass(frozen=True, slots=True)
class LoggedOutput:
    """One servo output.

    Parameters
    ----------
    number : int
        From 1, as printed on the autopilot.
    function : int or None
        SERVOn_FUNCTION; None if the log does not tell.
    trim_us, min_us, max_us : float
        Pulse widths at neutral and at the ends [us].
    reversed : bool
        SERVOn_REVERSED.
    """

    number: int
    function: int | None = None
    trim_us: float = 1500.0
    min_us: float = 1000.0
    max_us: float = 2000.0
    reversed: bool = False

    @property
    def slope_deg_per_us(self) -> float:
        """Angle per pulse width by the firmware's own formula, mean of both sides [deg/us].

        Examples
        --------
        >>> LoggedOutput(1, 4, trim_us=1500.0, min_us=1100.0, max_us=1900.0).slope_deg_per_us
        0.1125
        """
        span_us = max(self.max_us - self.min_us, 1.0)
        return 2.0 * _FULL_TRAVEL_DEG / span_us

    @property
    def sign(self) -> int:
        """-1 for a reversed output."""
        return -1 if self.reversed else 1

    @property
    def turns_something(self) -> bool:
        """False for motors, relays and outputs without a function."""
        return self.function is None or self.function in SURFACE_FUNCTIONS


def outputs_of(parameters: Mapping[str, float]) -> dict[int, LoggedOutput]:
    """Servo outputs that a log's parameters describe, by number.

    Examples
    --------
    >>> outputs_of({"SERVO2_FUNCTION": 19.0, "SERVO2_TRIM": 1480.0})[2].trim_us
    1480.0
    """
    outputs = {}
    for number in range(1, 33):
        function = parameters.get(f"SERVO{number}_FUNCTION")
        if function is not None and function != 0.0 and math.isfinite(function):
            outputs[number] = LoggedOutput(
                number,
                int(function),
                trim_us=parameters.get(f"SERVO{number}_TRIM", 1500.0),
                min_us=parameters.get(f"SERVO{number}_MIN", 1000.0),
                max_us=parameters.get(f"SERVO{number}_MAX", 2000.0),
                reversed=bool(parameters.get(f"SERVO{number}_REVERSED", 0.0)),
            )
    return outputs


def named_outputs(outputs: Mapping[int, LoggedOutput], numbers: list[int]) -> dict[int, str]:
    """Name a surface for each output; functions that several outputs share get the output's number.

    Examples
    --------
    >>> named_outputs({1: LoggedOutput(1, 4), 2: LoggedOutput(2, 19), 9: LoggedOutput(9, 4)}, [1, 2, 9])
    {1: 'aileron_1', 2: 'elevator', 9: 'aileron_9'}
    """
    plain = {}
    for number in numbers:
        function = outputs[number].function if number in outputs else None
        plain[number] = SURFACE_FUNCTIONS.get(function or 0, "servo")
    shared = {name for name in plain.values() if name == "servo" or list(plain.values()).count(name) > 1}
    return {number: f"{name}_{number}" if name in shared else name for number, name in plain.items()}
