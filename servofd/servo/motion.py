"""A servo on its way: where it is, from one instant to the next, its state going along.

A whole log and a single live sample go through the same `Motion.at`: a run in pieces is the run in one go. A servo
without effects is moved by `servofd.servo.kernel`, one with effects by `servofd.servo.position_loop`, with which
`servofd.discrepancy` fits as well, so that what was found is what an audit simulates.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np

from servofd.core.types import BoolArray, FloatArray
from servofd.servo.context import NO_CONTEXT, Context
from servofd.servo.kernel import ServoParameters, fixed, new_memory
from servofd.servo.physics import LOOSE_FIELDS, RATE_FIELDS, Physics, Plant, longest_step_s

if TYPE_CHECKING:
    from servofd.servo.kernel import Memory


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
_Commands = tuple[FloatArray, FloatArray, FloatArray]
"""When each reaches the servo [s], what it asks for [deg], and its slope [deg/s]; of shape (n,)."""
_NOTHING: _Commands = (fixed(np.zeros(0)), fixed(np.zeros(0)), fixed(np.zeros(0)))
_ANEW, _GOING_ON = fixed(np.ones(1, dtype=bool)), (fixed(np.zeros(0, dtype=bool)), fixed(np.zeros(0)))
"""At which instants a servo is at rest, and where it was measured there: at the only one, or at none."""


def _joined(some: _Commands, more: _Commands) -> _Commands:
    """Commands after commands; not copied where there were none."""
    if not some[0].size:
        return more
    return np.append(some[0], more[0]), np.append(some[1], more[1]), np.append(some[2], more[2])


def _cut(commands: _Commands, first: int, last: int | None = None) -> _Commands:
    """A copy of some of them: whoever lent the others may use their memory again."""
    effective_s, command_deg, slope_deg_s = (each[first:last].copy() for each in commands)
    return effective_s, command_deg, slope_deg_s


Kind = TypeVar("Kind", bound=AnyServo)


class Motion(ABC, Generic[Kind]):
    """Where a servo is, from one instant to the next, under commands that come in as time goes on.

    Parameters
    ----------
    servo : ServoParameters or ExtendedServo
        The servo.
    start_deg : float
        Where the surface was measured at the first instant [deg]; NaN: where its first command wants it.
    """

    def __init__(self, servo: Kind, start_deg: float = math.nan) -> None:
        self.servo = servo
        self.context = NO_CONTEXT
        """Airspeed and supply; a monitor in flight replaces it as it learns more."""
        self._start_deg = start_deg
        self._waiting = _NOTHING

    def receive(self, effective_s: FloatArray, command_deg: FloatArray, slope_deg_s: FloatArray) -> None:
        """Commands to come, shape (n,): when they reach the servo [s], what they ask for, and their slope."""
        self._waiting = _joined(self._waiting, (effective_s, command_deg, slope_deg_s))

    @abstractmethod
    def at(self, at_s: FloatArray) -> FloatArray:
        """Measured position at the next instants [deg], shape (m,); rising, and not before the last of them."""

    @abstractmethod
    def rest(self, now_s: float, deflection_deg: float = math.nan) -> None:
        """Go on from rest at a deflection [deg]; from where the command in force wants it, if that is NaN."""

    def become(self, servo: AnyServo) -> None:
        """Go on as another servo of the same kind, from where it is."""
        if not isinstance(servo, type(self.servo)):
            raise TypeError("a servo without effects becomes another one without, and one with effects one with")
        self.servo = servo


def swung(servo: AnyServo, commands: _Commands, at_s: FloatArray) -> FloatArray:
    """Deflection at some instants after the first command [deg], from rest at that.

    Examples
    --------
    >>> from servofd.servo.servo_model import ServoModel
    >>> from servofd.servo.library import servo_named
    >>> servo = ServoModel.of(servo_named("s9254")).parameters()
    >>> swung(servo, (np.array([0.0, 0.1]), np.array([0.0, 5.0]), np.zeros(2)), np.array([0.1, 0.5])).round(3)
    array([0., 5.])
    """
    if isinstance(servo, ExtendedServo):
        motion = on_its_way(servo)
        motion.receive(*commands)
        return motion.at(np.concatenate([commands[0][:1], at_s]))[1:]
    from_first_s = np.concatenate([commands[0][:1], at_s])
    begins = np.zeros(from_first_s.size, dtype=bool)
    return started_anew(servo, commands, from_first_s, np.full(from_first_s.size, math.nan), begins)[1:]


def started_anew(
    servo: ServoParameters, commands: _Commands, at_s: FloatArray, measured_deg: FloatArray, anew: BoolArray
) -> FloatArray:
    """Deflection at some instants [deg], shape (n,), from rest where it was measured at those that are marked.

    Examples
    --------
    >>> from servofd.servo.servo_model import ServoModel
    >>> from servofd.servo.library import servo_named
    >>> servo = ServoModel.of(servo_named("s9254")).parameters()
    >>> commands = np.array([0.0, 0.1]), np.array([0.0, 5.0]), np.zeros(2)
    >>> at_s, measured_deg = np.array([0.1, 0.5, 0.6]), np.array([0.0, 4.0, 2.0])
    >>> started_anew(servo, commands, at_s, measured_deg, np.array([True, False, True])).round(3)
    array([0., 5., 2.])
    """
    from servofd.servo.kernel import run

    position_deg = np.empty(at_s.size)
    if not at_s.size:
        return position_deg
    if not anew[0]:
        anew, measured_deg = anew.copy(), measured_deg.copy()
        anew[0], measured_deg[0] = True, math.nan
    heard = int(np.searchsorted(commands[0], at_s[-1], side="right"))
    run(
        servo,
        new_memory(servo),
        *(fixed(each[:heard]) for each in commands),
        fixed(at_s),
        fixed(anew),
        fixed(measured_deg),
        position_deg,
    )
    return position_deg


class PlainMotion(Motion[ServoParameters]):
    """Of a servo without effects."""

    _memory: Memory | None = None

    def receive(self, effective_s: FloatArray, command_deg: FloatArray, slope_deg_s: FloatArray) -> None:
        """Commands to come, shape (n,), copied once for all the pieces in which they are used."""
        effective_s, command_deg, slope_deg_s = (np.array(each) for each in (effective_s, command_deg, slope_deg_s))
        super().receive(effective_s, command_deg, slope_deg_s)
        for each in self._waiting:
            each.setflags(write=False)  # as `fixed` makes it

    def at(self, at_s: FloatArray) -> FloatArray:
        """Measured position at the next instants [deg], shape (m,)."""
        if at_s.size == 0:
            return np.zeros(0)
        if self._memory is None:
            self.rest(float(at_s[0]), self._start_deg)
        return self._moved(at_s, *_GOING_ON)

    def rest(self, now_s: float, deflection_deg: float = math.nan) -> None:
        """Go on from rest; before its first command, what holds the surface can only have been an earlier one."""
        if self._memory is None:
            self._memory = new_memory(self.servo)
        self._moved(np.array([now_s]), _ANEW, fixed(np.array([deflection_deg])))

    def _moved(self, at_s: FloatArray, anew: BoolArray, measured_deg: FloatArray) -> FloatArray:
        from servofd.servo.kernel import run

        position_deg = np.empty(at_s.size)
        effective_s, command_deg, slope_deg_s = self._waiting
        done = run(self.servo, self._memory, *self._waiting, fixed(at_s), anew, measured_deg, position_deg)
        self._waiting = effective_s[done:], command_deg[done:], slope_deg_s[done:]
        return position_deg

    def become(self, servo: AnyServo) -> None:
        """Go on as another servo with as many modes; each mode starts where it is, so the position does not jump."""
        if servo is not self.servo and self._memory is not None:
            self._memory.slot_step_s[:] = -1.0  # what is kept there are exponentials of the servo that was
            self._memory.motion[5] = math.nan
        super().become(servo)


class ExtendedMotion(Motion[ExtendedServo]):
    """Of a servo with effects.

    Examples
    --------
    A sample at a time, or all at once:

    >>> from servofd.servo.servo_model import ServoModel, plant_of
    >>> from servofd.servo.library import servo_named
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
        super().__init__(servo, start_deg)
        self.context = servo.context
        self._memory: FloatArray | None = None
        self._in_force = _NOTHING
        self._next_frame: int | None = None

    def receive(self, effective_s: FloatArray, command_deg: FloatArray, slope_deg_s: FloatArray) -> None:
        """Commands to come, shape (n,), in the steps in which the servo takes them."""
        step_deg = self.servo.physics.command_step_deg
        if step_deg > 0.0:
            command_deg = step_deg * np.round(command_deg / step_deg)
        super().receive(effective_s, command_deg, slope_deg_s)

    def at(self, at_s: FloatArray) -> FloatArray:
        """Measured position at the next instants [deg], shape (m,); rising, and not before the last of them."""
        from servofd.servo.position_loop import new_memory, received, run

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
            self.context.pushed(at_s, physics.load_late_s),
        )
        if physics.deg_per_a != 0.0:
            position_deg = position_deg + physics.deg_per_a * self.context.drawn_a(at_s)
        if physics.frame_s <= 0.0:
            done = received(self._memory)
            self._in_force = _cut(self._waiting, done - 1, done) if done else self._in_force
            self._waiting = _cut(self._waiting, done)
        return position_deg

    def rest(self, now_s: float, deflection_deg: float = math.nan) -> None:
        """Go on from rest at a deflection [deg]; from where the command in force wants it, if that is NaN."""
        self._memory, self._start_deg = None, deflection_deg
        self._waiting = _joined(self._in_force, self._waiting)
        self._next_frame = None
        self.at(np.array([now_s]))

    def become(self, servo: AnyServo) -> None:
        """Go on as another servo with effects; a slower one, as if time had been stretched."""
        from servofd.servo.position_loop import stretch

        before = self.servo.physics.bandwidth_scale
        super().become(servo)
        physics = self.servo.physics
        if self._memory is not None and physics.bandwidth_scale != before:
            stretch(self._memory, self.servo.plant.loop(physics), physics.bandwidth_scale / before)

    def _first_deg(self, now_s: float) -> float:
        """Where the surface is at first [deg]."""
        if math.isfinite(self._start_deg):
            return self._start_deg
        if not self._waiting[0].size:
            return 0.0
        received = int(np.searchsorted(self._waiting[0], now_s, side="right"))
        wanted_deg = float(self._waiting[1][max(received - 1, 0)])
        physics = self.servo.physics
        return physics.gain * self.servo.plant.dc_gain * wanted_deg + physics.bias_deg

    def _framed(self, until_s: float) -> _Commands:
        """Commands as the pulse frames until an instant carry them: the one in force when a frame begins."""
        period_s, phase = self.servo.physics.frame_s, self.servo.physics.frame_phase
        if not self._waiting[0].size:
            return self._waiting
        if self._next_frame is None:
            self._next_frame = math.ceil(self._waiting[0][0] / period_s - phase)
        last = math.floor(until_s / period_s - phase)
        begin_s = (np.arange(self._next_frame, last + 1) + phase) * period_s
        self._next_frame = max(self._next_frame, last + 1)
        held = np.maximum(np.searchsorted(self._waiting[0], begin_s, side="right") - 1, 0)
        since_s = np.maximum(begin_s - self._waiting[0][held], 0.0)
        deg = self._waiting[1][held] + self._waiting[2][held] * since_s
        # The last command before now may be carried by frames to come.
        done = int(np.searchsorted(self._waiting[0], until_s, side="right")) - 1
        self._waiting = _cut(self._waiting, max(done, 0))
        return begin_s, deg, np.zeros(begin_s.size)


def on_its_way(servo: AnyServo) -> PlainMotion | ExtendedMotion:
    """The motion of a servo, from rest where its first command wants it."""
    return PlainMotion(servo) if isinstance(servo, ServoParameters) else ExtendedMotion(servo)
