"""What an autopilot makes of commands: outputs, and the pulses that it sends through them."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from typing import Final

import numpy as np

from servofd.aircraft.calibration import Calibration, PulseCalibration
from servofd.aircraft.outputs import FULL_TRAVEL_DEG, HALF_TRAVEL_US, SURFACE_FUNCTIONS
from servofd.aircraft.schema import Aircraft
from servofd.core.errors import ConfigError
from servofd.core.types import FloatArray, IntArray

MOST_OUTPUTS: Final = 14
"""Outputs of one RCOU message."""
THROTTLE: Final = 3
"""Output of the throttle, which turns no surface."""
THROTTLE_FUNCTION: Final = 70
"""Function of an output that is the throttle (ArduPilot, SERVOn_FUNCTION)."""
THROTTLE_US: Final = 1620
"""What it is sent, all the time [us]."""

_HALF_RANGE_US: Final = round(HALF_TRAVEL_US)
"""Pulse width from trim to either end [us]."""
_FUNCTION_OF: Final = {name: function for function, name in reversed(SURFACE_FUNCTIONS.items())}
"""SERVOn_FUNCTION by what it turns; of two the smaller."""
_FLAP: Final = _FUNCTION_OF["flap"]
_ANYTHING: Final = 94
"""Function of an output that only its script knows (ArduPilot, SERVOn_FUNCTION: Script1)."""
_USUAL: Final = {_FUNCTION_OF[name]: number for name, number in (("aileron", 1), ("elevator", 2), ("rudder", 4))}
"""Outputs of these as they come with ArduPlane."""
_FUNCTIONS: Final = {
    word: tuple(_FUNCTION_OF.get(f"{word}_{side}") or _FUNCTION_OF[word] for side in ("left", "right"))
    for word in ("elevon", "vtail", "flaperon", "flap", "spoiler", "airbrake", "aileron", "elevator", "rudder")
}
"""Words in the names of surfaces, and their SERVOn_FUNCTION on the left and on the right."""
_NUMBERED: Final = re.compile(r"(?:RCOU\.C|\.servo)(\d+)(?:_raw)?$")


@dataclass(frozen=True, slots=True)
class Output:
    """One output of an autopilot, as the parameters SERVOn_* describe it.

    `surface`: what its servo turns. `number`: counted from 1: the n of SERVOn. `function`: SERVOn_FUNCTION. `min_us`,
    `trim_us`, `max_us`: SERVOn_MIN, _TRIM and _MAX [us]. `travel_deg`: deflection at MAX, and with the other sign at
    MIN [deg]. `reversed`: SERVOn_REVERSED: a positive deflection takes a shorter pulse, and the servo's arm turns the
    other way.
    """

    surface: str
    number: int
    function: int
    min_us: int = 1000
    trim_us: int = 1500
    max_us: int = 2000
    travel_deg: float = FULL_TRAVEL_DEG
    reversed: bool = False

    @property
    def is_range(self) -> bool:
        """True if the firmware counts this function from MIN to MAX, not from TRIM both ways."""
        return self.function == _FLAP

    def pulse_us(self, deflection_deg: FloatArray) -> IntArray:
        """Pulse that the firmware sends for a deflection [us], of the same shape.

        It computes in single precision and cuts fractions of a microsecond off, towards TRIM (angles) or MIN
        (ranges): ``SRV_Channel::pwm_from_angle`` and ``pwm_from_range``.
        """
        x = np.clip(np.asarray(deflection_deg, dtype=np.float32) / np.float32(self.travel_deg), -1.0, 1.0)
        if self.reversed:
            x = -x
        if self.is_range:
            zero_us, away_us = self.min_us, (x + 1.0) * np.float32(0.5 * (self.max_us - self.min_us))
        else:
            half_us = np.where(x > 0.0, self.max_us - self.trim_us, self.trim_us - self.min_us)
            zero_us, away_us = self.trim_us, x * half_us.astype(np.float32)
        pulse_us: IntArray = zero_us + np.trunc(away_us).astype(np.int64)
        return pulse_us

    def nearest_us(self, deflection_deg: FloatArray) -> IntArray:
        """Pulse that asks for a deflection most closely, outside MIN and MAX as well [us], of the same shape."""
        x = np.asarray(self.arm_deg(deflection_deg)) / self.travel_deg
        middle_us = 0.5 * (self.min_us + self.max_us) if self.is_range else float(self.trim_us)
        half_us = np.where(x > 0.0, self.max_us - middle_us, middle_us - self.min_us)
        return np.rint(middle_us + x * half_us).astype(np.int64)

    def deflection_deg(self, pulse_us: IntArray) -> FloatArray:
        """Deflection that a pulse asks for [deg], of the same shape: the inverse, without cutting."""
        middle_us = 0.5 * (self.min_us + self.max_us) if self.is_range else float(self.trim_us)
        away_us = np.asarray(pulse_us, dtype=np.float64) - middle_us
        half_us = np.where(away_us > 0.0, self.max_us - middle_us, middle_us - self.min_us)
        return self.arm_deg(self.travel_deg * away_us / half_us)

    def arm_deg(self, deflection_deg: FloatArray) -> FloatArray:
        """Angle of the servo's arm, which is what it reports [deg]; also turns arm angles into deflections."""
        return -deflection_deg if self.reversed else deflection_deg


def outputs_of(aircraft: Aircraft) -> tuple[Output, ...]:
    """Connect the surfaces of an aircraft to the outputs of an autopilot.

    `aircraft`: a command in microseconds gives its output's trim, scale and direction, and its number if the channel
    has one (``RCOU.C2``, ``SERVO_OUTPUT_RAW.servo2_raw``); any other only its direction. Result: in the order of the
    surfaces. The function follows from the surface's name (``aileron``, ``elevator``, ``rudder``, ``flap``, ``elevon``,
    ``vtail``, ...); a name that says nothing gets one of the scripts'.

    Examples
    --------
    >>> from servofd.aircraft.schema import plain_aircraft
    >>> [(o.number, o.function) for o in outputs_of(plain_aircraft(["elevator", "vtail_right", "gimbal"]))]
    [(2, 19), (5, 80), (6, 94)]
    """
    if len(aircraft.surfaces) >= MOST_OUTPUTS:
        raise ConfigError(f"{len(aircraft.surfaces)} surfaces: an autopilot's log has room for {MOST_OUTPUTS - 1}")
    named = {name: _NUMBERED.search(surface.command.channel) for name, surface in aircraft.surfaces.items()}
    claimed = {name: int(found[1]) if found else None for name, found in named.items()}
    taken = {number for number in claimed.values() if number}
    if len(taken) < sum(number is not None for number in claimed.values()) or max(taken, default=0) > MOST_OUTPUTS:
        raise ConfigError(f"each command needs an output of its own from 1 to {MOST_OUTPUTS}, not {claimed}")
    functions = functions_of(aircraft.surfaces)
    found = []
    for name, surface in aircraft.surfaces.items():
        # The usual output of its function, or the first that is free behind those of ArduPlane.
        usual = [_USUAL.get(functions[name], 5), *range(5, MOST_OUTPUTS + 1), *_USUAL.values()]
        number = claimed[name] or next(each for each in usual if each not in taken)
        taken.add(number)
        found.append(_output(name, number, functions[name], surface.command))
    return tuple(found)


def _output(name: str, number: int, function: int, command: Calibration) -> Output:
    trim_us, slope = 1500, FULL_TRAVEL_DEG / _HALF_RANGE_US
    if isinstance(command, PulseCalibration) and command.slope_deg_per_us is not None:
        trim_us, slope = round(command.trim_us), command.slope_deg_per_us
    min_us, max_us = trim_us - _HALF_RANGE_US, trim_us + _HALF_RANGE_US
    travel_deg, is_reversed = abs(slope) * _HALF_RANGE_US, slope * command.sign < 0.0
    return Output(name, number, function, min_us, trim_us, max_us, travel_deg, is_reversed)


def functions_of(surfaces: Collection[str]) -> dict[str, int]:
    """SERVOn_FUNCTION by the names of surfaces; of two without a side the first is the left one."""
    functions: dict[str, int] = {}
    unknown = 0
    for name in surfaces:
        plain = name.lower().replace("-", "").replace("_tail", "tail")
        pair = next((both for word, both in _FUNCTIONS.items() if word in plain), None)
        if pair is None:
            functions[name] = _ANYTHING + unknown
            unknown += 1
            continue
        is_right = "right" in plain or plain.endswith("_r")
        is_left = "left" in plain or plain.endswith("_l")
        functions[name] = pair[1] if is_right or (not is_left and pair[0] in functions.values()) else pair[0]
    return functions
