"""A servo on its way: simulated piece by piece, its state going along."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from servofd.models.kernel import RESTART_ALL, observe
from servofd.models.state import FilterParameters, Memory, ServoParameters, new_memory

if TYPE_CHECKING:
    from servofd.models.extended import AnyServo
    from servofd.types import FloatArray


class Motion:
    """Where a servo is, from one piece of time to the next, under commands that are known beforehand.

    Parameters
    ----------
    servo : ServoParameters
        The servo.
    effective_s, command_deg : ndarray, shape (n,)
        When each command reaches the servo [s] and what it asks for [deg].

    Examples
    --------
    >>> from servofd.models.servo_model import ServoModel
    >>> from servofd.servos import servo_named
    >>> motion = ServoModel.of(servo_named("s9254")).motion(np.array([0.0, 0.1]), np.array([0.0, 5.0]))
    >>> motion.at(np.array([0.1, 0.5])).round(3)
    array([0., 5.])
    >>> motion.rest(0.6, -2.0)
    >>> motion.at(np.array([0.6, 1.0])).round(3)
    array([-2.,  5.])
    """

    def __init__(self, servo: ServoParameters, effective_s: FloatArray, command_deg: FloatArray) -> None:
        self.servo = servo
        self._effective_s = effective_s
        self._command_deg = command_deg
        self._memory = new_memory(servo, _no_filter(servo))

    def at(self, at_s: FloatArray) -> FloatArray:
        """Deflection at the next instants [deg], shape (m,); `at_s` [s], shape (m,), not before the last of them."""
        return self._observe(at_s, np.full(at_s.size, math.nan), np.zeros(at_s.size, dtype=np.int8))

    def rest(self, now_s: float, deflection_deg: float = math.nan) -> None:
        """Go on from rest at a deflection [deg]; from where the command in force wants it, if that is NaN."""
        self._observe(np.array([now_s]), np.array([deflection_deg]), np.full(1, RESTART_ALL, dtype=np.int8))

    def become(self, servo: AnyServo) -> None:
        """Go on as another servo with as many modes; each mode starts where it is, so the position does not jump."""
        if servo is self.servo:
            return
        if not isinstance(servo, ServoParameters):
            raise TypeError("a servo without effects becomes another one without")
        self.servo = servo
        self._memory.slot_step_s[:] = -1.0  # what is kept there are exponentials of the servo that was
        self._memory.motion[5] = math.inf  # it may be too fast for its limit already: have the kernel look

    def _observe(
        self, at_s: FloatArray, measured_deg: FloatArray, restart: np.ndarray[tuple[int], np.dtype[np.int8]]
    ) -> FloatArray:
        slope_deg_s = np.zeros(self._command_deg.size)
        commands = (self._effective_s, self._command_deg, slope_deg_s)
        return deflection(self.servo, commands, at_s, measured_deg, restart, self._memory)


def deflection(
    servo: ServoParameters,
    commands: tuple[FloatArray, FloatArray, FloatArray],
    at_s: FloatArray,
    measured_deg: FloatArray,
    restart: np.ndarray[tuple[int], np.dtype[np.int8]],
    memory: Memory | None = None,
) -> FloatArray:
    """Where a servo without effects is at some instants [deg], shape (m,).

    Parameters
    ----------
    servo : ServoParameters
        The servo.
    commands : tuple of ndarray, shape (n,)
        When each reaches the servo [s], what it asks for [deg] and its slope [deg/s].
    at_s, measured_deg : ndarray, shape (m,)
        The instants [s], and where the surface was measured [deg].
    restart : ndarray, shape (m,)
        2 where the servo starts anew, at what was measured; where that is NaN, at what the command in force asks for.
    memory : Memory, optional
        Of the servo on its way; it starts at rest if left out.
    """
    unused = _no_filter(servo)
    simulated_deg, residual_deg = np.empty(at_s.size), np.empty(at_s.size)
    if memory is None:
        memory = new_memory(servo, unused)
    observe(servo, unused, memory, *commands, at_s, measured_deg, restart, simulated_deg, residual_deg)
    return simulated_deg


def _no_filter(servo: ServoParameters) -> FilterParameters:
    """Of a kernel that is asked for the position alone."""
    return FilterParameters(1.0, servo.decay_rad_s, 1.0)
