"""A servo on its way: where it is, from one instant to the next, its state going along.

A whole log and a single live sample, a linear servo and one with effects, one servo and many side by side go through
the same compiled stepper (`servofd.servo.stepper`): a run in pieces is the run in one go.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Protocol

import numpy as np

from servofd.core.errors import DesignError
from servofd.core.types import BoolArray, FloatArray
from servofd.servo.context import NO_CONTEXT, Context
from servofd.servo.effect import Effect, Slot
from servofd.servo.effects.commands import Commands, in_frames
from servofd.servo.generate import INSIDE_LOOP, STEPPED, Stepper, stepper_of
from servofd.servo.loop import Loop, loop_of
from servofd.servo.physics import Physics
from servofd.servo.registry import everything
from servofd.servo.transfer import TransferFunction

_FASTEST_TIMES_STEP = 0.6
"""Of the loop's natural frequency: longest step while something acts on it (as exact as `Effect.longest_s`)."""
_SHORTEST_S = 5e-4
"""Shorter steps would take minutes for a log."""
_NOWHERE = np.zeros(0)
_NEVER = np.zeros(0, dtype=bool)
NOTHING_AROUND = np.zeros((0, 5))
"""Surroundings of a servo, in a simulation that does not depend on them."""
_FIRST_ORDER = {
    ("rate_up_deg_s", "speed_up_deg_s"),
    ("rate_down_deg_s", "speed_down_deg_s"),
    ("deg_s_per_v", "speed_deg_s_per_v"),
}
"""A servo of one pole has no speed of its own: its error is its speed, and what limits the one limits the other."""


@dataclass(frozen=True, slots=True, eq=False)
class Machine:
    """Servos side by side as the stepper takes them: V variants of one, under the same commands."""

    stepper: Stepper
    loops: tuple[Loop, ...]
    sizes: FloatArray
    """Of shape (V, fields)."""
    acts: BoolArray
    longest_s: float
    _arrays: tuple[FloatArray, ...]

    def new_state(self) -> State:
        """Before the first instant."""
        count, states = len(self.loops), self.loops[0].rest.size
        return State(
            np.array([math.nan, 0.0, 0.0, 0.0]), np.zeros((count, 3 * states)), np.zeros((count, self.stepper.memory))
        )

    def run(
        self,
        state: State,
        commands: Commands,
        at_s: FloatArray,
        *,
        anew: BoolArray = _NEVER,
        measured_deg: FloatArray = _NOWHERE,
        around: FloatArray = NOTHING_AROUND,
        speed_deg_s: FloatArray = _NOWHERE,
    ) -> tuple[FloatArray, int]:
        """Readings at the next instants [deg], shape (n, V), and how many of the commands have reached the servo.

        The state is moved on. See `servofd.servo.stepper.run` for what the arrays hold.
        """
        read_deg = np.empty((at_s.size, len(self.loops)))
        facts, a, b, steps, rest = self._arrays
        used = self.stepper.run(
            self.sizes, self.acts, facts, a, b, steps, rest, self.loops[0].grid_s, self.longest_s,
            _plain(commands[0]), _plain(commands[1]), _plain(commands[2]), _plain(at_s),
            anew if anew.flags.carray else np.array(anew), _plain(measured_deg), around,
            state.clock, state.states, state.memory, read_deg, speed_deg_s,
        )  # fmt: skip
        return read_deg, int(used)


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Everything that changes from instant to instant; arrays, updated in place."""

    clock: FloatArray
    """Time [s], NaN at first; command in force [deg] and its slope; whether any came. Shape (4,)."""
    states: FloatArray
    memory: FloatArray

    def copy(self) -> State:
        """The same, to be moved on apart."""
        return State(self.clock.copy(), self.states.copy(), self.memory.copy())


def _plain(values: FloatArray) -> FloatArray:
    """Values as all others lie in memory: what a log lends is read-only, for which everything is compiled once more."""
    return values if values.flags.carray else np.array(values, dtype=float)


def machine_of(
    transfer: TransferFunction,
    variants: Sequence[Physics],
    finer: float = 1.0,
    effects: tuple[type[Effect], ...] | None = None,
) -> Machine:
    """Variants of one servo, to be moved on side by side; `finer` divides the steps where something acts.

    `effects` are those that may act, if not all of the catalogue: fewer are compiled apart, and move faster.

    Raises `DesignError` if something acts inside a servo with zeros or more than three poles.
    """
    return _machine(transfer, tuple(variants), finer, everything() if effects is None else effects)


@lru_cache(maxsize=256)
def _machine(
    transfer: TransferFunction, variants: tuple[Physics, ...], finer: float, effects: tuple[type[Effect], ...]
) -> Machine:
    order = len(transfer.denominator) - 1
    if order == 1:
        variants = tuple(_of_first_order(each, transfer.dc_gain) for each in variants)
    acting = {name for each in variants for name, _ in each}
    loops = [loop_of(transfer, each.scales) for each in variants]
    stepper = stepper_of(effects, any_order=loops[0].rest.size != 3)
    grid_s = min(loop.grid_s for loop in loops)
    loops = [
        loop if loop.grid_s == grid_s else loop_of(transfer, v.scales, grid_s)
        for loop, v in zip(loops, variants, strict=True)
    ]
    sizes = np.array([[known.get(name, off) for name, off in stepper.off.items()] for known in map(dict, variants)])
    acts, longest_s = np.zeros(len(STEPPED) + 1, dtype=bool), math.inf
    active = [act for act in stepper.acts if not acting.isdisjoint(act.switches)]
    for act in active:
        if act.effect.slot in INSIDE_LOOP and not loops[0].is_physical:
            raise DesignError(
                f"a servo of order {order} with {len(transfer.numerator) - 1} zeros has no {act.effect.name}: "
                "servos of one to three poles and no zeros can"
            )
        acts[STEPPED.index(act.effect.slot)] = True
        if act.effect.slot in INSIDE_LOOP or act.effect.memory:
            acts[-1], longest_s = True, min(longest_s, act.effect.longest_s)
    on_shaft = [act.effect for act in active if act.effect.slot is Slot.OUTPUT]
    if len(on_shaft) > 1:
        longest_s = min(longest_s, *(effect.apart_s for effect in on_shaft))
    if acts[-1]:
        fastest = max(loop.natural_rad_s for loop in loops)
        longest_s = min(longest_s, max(_FASTEST_TIMES_STEP / fastest, _SHORTEST_S))
    facts = np.array([[o.gain, o.error_s, o.per_error, float(o.leaves), float(o.filters)] for o in loops])
    each_of = ([getattr(o, name) for o in loops] for name in ("a", "b", "steps", "rest"))
    stacked = (np.array(one) if len(one) > 1 else one[0][None] for one in each_of)  # of one servo they are not copied
    return Machine(stepper, tuple(loops), sizes, acts, min(longest_s, 1.0) / finer, (facts, *stacked))


def _of_first_order(physics: Physics, dc_gain: float) -> Physics:
    """What of a servo of one pole acts on its error: friction is a dead band, and the shaft's speed the motor's."""
    changes = {drive: min(getattr(physics, drive), getattr(physics, shaft)) for drive, shaft in _FIRST_ORDER}
    return physics._replace(
        **changes, **{shaft: math.inf for _, shaft in _FIRST_ORDER},
        deadband_deg=physics.deadband_deg + 2.0 * physics.friction_deg / dc_gain, friction_deg=0.0,
        load_friction=0.0,
    )  # fmt: skip


def received(physics: Physics, commands: Commands) -> Commands:
    """Commands as they reach a servo: delayed, in steps, in pulse frames; by every effect on them, in their order."""
    acting = {name for name, _ in physics}
    for effect in everything():
        if effect.slot is Slot.EVENTS and effect.act is not None and not acting.isdisjoint(effect.switches):
            commands = Commands(*effect.act(commands, *(getattr(physics, name) for name in effect.sees)))
    return commands


class Simulated(Protocol):
    """A servo that is simulated, as `ServoModel` is."""

    @property
    def transfer(self) -> TransferFunction:
        """The linear servo."""

    @property
    def physics(self) -> Physics:
        """Sizes of its effects."""

    @property
    def context(self) -> Context:
        """What is around it."""


def started_anew(
    servo: Simulated, commands: Commands, at_s: FloatArray, measured_deg: FloatArray, anew: BoolArray
) -> FloatArray:
    """Deflection at some instants [deg], shape (n,), from rest where it was measured at those that are marked.

    `servo`: as in `Motion`.
    """
    if not at_s.size:
        return np.zeros(0)
    machine = machine_of(servo.transfer, (servo.physics,))
    commands = received(servo.physics, commands) if commands[0].size else commands
    beside = _around(servo.context, servo.physics, machine, at_s)
    read_deg, _ = machine.run(machine.new_state(), commands, at_s, anew=anew, measured_deg=measured_deg, around=beside)
    return read_deg[:, 0]


def _around(context: Context, physics: Physics, machine: Machine, at_s: FloatArray) -> FloatArray:
    """What acts on a servo until each of some instants; nothing where nothing was logged, or it depends on nothing."""
    if context is NO_CONTEXT or not machine.acts.any():
        return NOTHING_AROUND
    return around_servo(
        at_s.size,
        pressure_pa=context.pressure_pa(at_s),
        supply_v=context.supply_v(at_s),
        current_a=context.drawn_a(at_s),
        load=context.pushed(at_s, physics.load_late_s),
    )


def around_servo(
    count: int,
    *,
    pressure_pa: FloatArray | float = 0.0,
    supply_v: FloatArray | float = math.inf,
    power: FloatArray | float = 1.0,
    current_a: FloatArray | float = 0.0,
    load: FloatArray | float = 0.0,
) -> FloatArray:
    """What acts on a servo until each of so many instants, as the stepper takes it, shape (count, 5)."""
    columns = (pressure_pa, supply_v, power, current_a, load)
    return np.column_stack([np.broadcast_to(each, count) for each in columns])


@dataclass(slots=True, eq=False)
class Motion:
    """Where a servo is, from one instant to the next, under commands that come in as time goes on.

    `servo`: its delay left to whoever delays the commands (`ServoModel.servo`); with what is around it, which a monitor
    in flight replaces as it learns more. `start_deg`: where the surface was measured at the first instant [deg]; NaN:
    where its first command wants it.
    """

    servo: Simulated
    start_deg: float = math.nan
    context: Context = field(init=False)
    _machine: Machine = field(init=False)
    _state: State = field(init=False)
    _waiting: Commands = field(init=False, default=Commands(_NOWHERE, _NOWHERE, _NOWHERE))
    _next_frame: int | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self.context = self.servo.context
        self._machine = machine_of(self.servo.transfer, (self.servo.physics,))
        self._state = self._machine.new_state()

    def receive(self, effective_s: FloatArray, command_deg: FloatArray, slope_deg_s: FloatArray) -> None:
        """Commands to come, shape (n,): when they reach the servo [s], what they ask for, and their slope; copied."""
        if not effective_s.size:
            return
        unframed = self.servo.physics._replace(frame_s=0.0, frame_phase=0.0)
        new = received(unframed, Commands(effective_s, command_deg, slope_deg_s))
        self._waiting = Commands(*map(np.concatenate, zip(self._waiting, new, strict=True)))

    def at(self, at_s: FloatArray) -> FloatArray:
        """Measured position at the next instants [deg], shape (m,); rising, and not before the last of them."""
        if at_s.size == 0:
            return np.zeros(0)
        if math.isnan(self._state.clock[0]):
            nothing = math.isnan(self.start_deg) and not self._waiting[0].size
            self.rest(float(at_s[0]), 0.0 if nothing else self.start_deg)
        return self._moved(at_s, _NEVER, _NOWHERE)

    def rest(self, now_s: float, deflection_deg: float = math.nan) -> None:
        """Go on from rest at a deflection [deg]; from where the command in force wants it, if that is NaN."""
        self._moved(np.array([now_s]), np.ones(1, dtype=bool), np.array([deflection_deg]))

    def _moved(self, at_s: FloatArray, anew: BoolArray, measured_deg: FloatArray) -> FloatArray:
        physics = self.servo.physics
        framed = physics.frame_s > 0.0
        commands = self._framed(float(at_s[-1])) if framed else self._waiting
        beside = _around(self.context, physics, self._machine, at_s)
        read_deg, used = self._machine.run(
            self._state, commands, at_s, anew=anew, measured_deg=measured_deg, around=beside
        )
        if not framed:
            self._waiting = Commands(*(each[used:] for each in self._waiting))
        return read_deg[:, 0]

    def become(self, servo: Simulated) -> None:
        """Go on as another servo, from where it is; a slower one, as if time had been stretched."""
        if servo is self.servo:
            return
        machine = machine_of(servo.transfer, (servo.physics,))
        if machine.loops[0].rest.size != self._machine.loops[0].rest.size:
            raise TypeError("a servo becomes another one with as many poles")
        loop = machine.loops[0]
        scale = servo.physics.bandwidth_scale / self.servo.physics.bandwidth_scale
        self._state.states[:, : loop.rest.size] *= scale**loop.stretch
        self.servo, self._machine = servo, machine

    def _framed(self, until_s: float) -> Commands:
        """Commands as the pulse frames until an instant carry them: the one in force when a frame begins."""
        period_s, phase = self.servo.physics.frame_s, self.servo.physics.frame_phase
        if not self._waiting[0].size:
            return self._waiting
        if self._next_frame is None:
            self._next_frame = math.ceil(self._waiting[0][0] / period_s - phase)
        after = math.floor(until_s / period_s - phase) + 1
        carried = in_frames(self._waiting, np.arange(float(self._next_frame), after), period_s, phase)
        self._next_frame = max(self._next_frame, after)
        # The last command before now may be carried by frames to come.
        done = max(int(np.searchsorted(self._waiting[0], until_s, side="right")) - 1, 0)
        self._waiting = Commands(*(each[done:] for each in self._waiting))
        return carried
