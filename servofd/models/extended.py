"""A servo with everything that its linear model lacks, on its way: the position loop's kernel with its state carried.

`servofd.discrepancy` fits with the same kernel, so that what was found is what an audit simulates. A whole log and a
single live sample go through the same `ExtendedMotion.at`: a run in pieces is the run in one go.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from servofd.models.context import NO_CONTEXT, Context
from servofd.models.physics import LOOSE_FIELDS, RATE_FIELDS, Physics, Plant, longest_step_s
from servofd.models.state import ServoParameters

if TYPE_CHECKING:
    from servofd.types import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ExtendedServo:
    """A servo with effects.

    Parameters
    ----------
    plant : Plant
        Its linear part.
    physics : Physics
        Size of every effect; its delay is left to whoever delays the commands.
    context : Context
        Airspeed and supply.
    """

    plant: Plant
    physics: Physics
    context: Context = NO_CONTEXT

    def slower(self, bandwidth_scale: float) -> ExtendedServo:
        """The servo with every pole scaled."""
        scale = bandwidth_scale * self.physics.bandwidth_scale
        return replace(self, physics=self.physics._replace(bandwidth_scale=scale))

    def limited(self, rate_deg_s: float) -> ExtendedServo:
        """The servo with a lower rate limit [deg/s], of the kind that it has."""
        kind = ("follow_up_deg_s", "follow_down_deg_s") if self.physics.follow_up_deg_s < math.inf else RATE_FIELDS[:2]
        lower = {name: min(rate_deg_s, getattr(self.physics, name)) for name in kind}
        return replace(self, physics=self.physics._replace(**lower))

    def weaker(self, share: float) -> ExtendedServo:
        """The servo with every rate limit lower by a share."""
        lower = {name: (1.0 - share) * getattr(self.physics, name) for name in RATE_FIELDS}
        return replace(self, physics=self.physics._replace(**lower))

    @property
    def rate_up_deg_s(self) -> float:
        """Fastest motion upwards [deg/s]; infinite if nothing limits it."""
        return min(self.physics.rate_up_deg_s, self.physics.follow_up_deg_s, self.physics.set_point_deg_s)

    @property
    def rate_down_deg_s(self) -> float:
        """Fastest motion downwards [deg/s]."""
        return min(self.physics.rate_down_deg_s, self.physics.follow_down_deg_s, self.physics.set_point_deg_s)

    @property
    def lower_deg(self) -> float:
        """Lowest position of the surface: a stop of the linkage or of the servo [deg]."""
        return max(self.physics.lower_deg, self.physics.gain * self.physics.stop_lower_deg)

    @property
    def upper_deg(self) -> float:
        """Highest position [deg]."""
        return min(self.physics.upper_deg, self.physics.gain * self.physics.stop_upper_deg)

    @property
    def play_deg(self) -> float:
        """How far it may be from where its model believes it to be, after a start at an unknown point of its play."""
        return float(sum(abs(getattr(self.physics, name)) * half for name, half in LOOSE_FIELDS.items()))


AnyServo = ServoParameters | ExtendedServo
"""A servo without effects, or with."""


class ExtendedMotion:
    """Where such a servo is, from one instant to the next, under commands that come in as time goes on.

    Parameters
    ----------
    servo : ExtendedServo
        The servo.
    start_deg : float
        Where the surface was measured at the first instant [deg]; NaN: where its first command wants it.

    Examples
    --------
    A sample at a time, or all at once:

    >>> from servofd.models.servo_model import ServoModel, plant_of
    >>> from servofd.servos import servo_named
    >>> plant = plant_of(ServoModel.of(servo_named("hs225bb-eq31")))
    >>> servo = ExtendedServo(plant, Physics(backlash_deg=1.0))
    >>> t = np.arange(0.0, 1.0, 0.01)
    >>> whole, pieces = ExtendedMotion(servo, 0.0), ExtendedMotion(servo, 0.0)
    >>> whole.receive(t, 5.0 * t, 0.0 * t)
    >>> at_once = whole.at(t)
    >>> by_sample = []
    >>> for k in range(t.size):
    ...     pieces.receive(t[k : k + 1], 5.0 * t[k : k + 1], np.zeros(1))
    ...     by_sample += pieces.at(t[k : k + 1]).tolist()
    >>> bool(np.abs(at_once - by_sample).max() < 1e-12)
    True
    """

    def __init__(self, servo: ExtendedServo, start_deg: float = math.nan) -> None:
        self.servo = servo
        self.context = servo.context
        """A monitor in flight replaces it as it learns more."""
        self._start_deg = start_deg
        self._memory: FloatArray | None = None
        self._waiting = np.zeros((3, 0))
        self._in_force = np.zeros((3, 0))
        self._next_frame: int | None = None

    def receive(self, effective_s: FloatArray, command_deg: FloatArray, slope_deg_s: FloatArray) -> None:
        """Commands to come, shape (n,): when they reach the servo [s], what they ask for, and their slope."""
        step_deg = self.servo.physics.command_step_deg
        if step_deg > 0.0:
            command_deg = step_deg * np.round(command_deg / step_deg)
        self._waiting = np.hstack([self._waiting, np.vstack([effective_s, command_deg, slope_deg_s])])

    def at(self, at_s: FloatArray) -> FloatArray:
        """Measured position at the next instants [deg], shape (m,); rising, and not before the last of them."""
        from servofd.models.position_loop import new_memory, received, run

        servo, physics = self.servo, self.servo.physics
        if at_s.size == 0:
            return np.zeros(0)
        # Positions that are stamped too late show where the servo was before.
        instants_s = at_s - physics.offset_s
        if self._memory is None:
            self._memory = new_memory(self._first_deg(float(instants_s[0])))
        commands = self._framed(float(instants_s[-1])) if physics.frame_s > 0.0 else self._waiting
        machine, loop = servo.plant.machine(physics)
        position_deg: FloatArray = run(
            machine,
            loop,
            servo.plant.dc_gain,
            longest_step_s(machine),
            commands[0],
            commands[1],
            commands[2],
            instants_s,
            self.context.pressure_pa(at_s),
            self.context.supply_v(at_s),
            self._memory,
        )
        if physics.deg_per_a != 0.0:
            position_deg = position_deg + physics.deg_per_a * self.context.drawn_a(at_s)
        if physics.frame_s <= 0.0:
            done = received(self._memory)
            self._in_force = self._waiting[:, :done][:, -1:] if done else self._in_force
            self._waiting = self._waiting[:, done:]
        return position_deg

    def rest(self, now_s: float, deflection_deg: float = math.nan) -> None:
        """Go on from rest at a deflection [deg]; from where the command in force wants it, if that is NaN."""
        self._memory, self._start_deg = None, deflection_deg
        self._waiting = np.hstack([self._in_force, self._waiting])
        self._next_frame = None
        self.at(np.array([now_s]))

    def become(self, servo: AnyServo) -> None:
        """Go on as another servo with effects, from where it is."""
        if not isinstance(servo, ExtendedServo):
            raise TypeError("a servo with effects becomes another one with effects")
        self.servo = servo

    def _first_deg(self, now_s: float) -> float:
        """Where the surface is at first [deg]."""
        if math.isfinite(self._start_deg):
            return self._start_deg
        if self._waiting.shape[1] == 0:
            return 0.0
        received = int(np.searchsorted(self._waiting[0], now_s, side="right"))
        wanted_deg = float(self._waiting[1, max(received - 1, 0)])
        physics = self.servo.physics
        return physics.gain * self.servo.plant.dc_gain * wanted_deg + physics.bias_deg

    def _framed(self, until_s: float) -> FloatArray:
        """Commands as the pulse frames until an instant carry them: the one in force when a frame begins."""
        period_s, phase = self.servo.physics.frame_s, self.servo.physics.frame_phase
        if self._waiting.shape[1] == 0:
            return self._waiting
        if self._next_frame is None:
            self._next_frame = math.ceil(self._waiting[0, 0] / period_s - phase)
        last = math.floor(until_s / period_s - phase)
        begin_s = (np.arange(self._next_frame, last + 1) + phase) * period_s
        self._next_frame = max(self._next_frame, last + 1)
        held = np.maximum(np.searchsorted(self._waiting[0], begin_s, side="right") - 1, 0)
        since_s = np.maximum(begin_s - self._waiting[0, held], 0.0)
        deg = self._waiting[1, held] + self._waiting[2, held] * since_s
        # The last command before now may be carried by frames to come.
        done = int(np.searchsorted(self._waiting[0], until_s, side="right")) - 1
        self._waiting = self._waiting[:, max(done, 0) :]
        return np.vstack([begin_s, deg, np.zeros(begin_s.size)])
