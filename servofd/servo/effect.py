"""What an effect is: one class that says where it acts, what it does, and which parameters it has.

A servo is a linear loop and the effects on it. An effect acts at one place, its `Slot`, on the value that passes there,
and every verb knows it by its class alone: `servofd.servo.generate` compiles it into the one stepper, the search of
``servofd explain`` starts from its grid, ``--effect`` and aircraft files install it by its name, and the documentation
lists it. To add one, write a class in a module of `servofd.servo.effects`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, ClassVar, Literal, NamedTuple

from servofd.core.errors import ConfigError
from servofd.servo.loop import BEFORE, INSIDE

Surroundings = Literal["airspeed_m_s", "servo_voltage_v", "servo_current_a", "servo_load"]


class Slot(Enum):
    """Where on the way from command to reading an effect acts, in the order of that way.

    What passes is an angle [deg] of the surface, but in `EVENTS`, where ``act(commands, *parameters)`` takes and
    returns times [s], values [deg] and slopes [deg/s], arrays, and sees no `Now`; in `LOAD`, the sum of the
    deflections that loads take away [deg], which begins at 0 and is positive where they push to smaller angles; in
    `GRIP`, the sum of frictions as the position error that overcomes them [deg], which begins at 0; and in `SPEED`,
    the speed of the shaft [deg/s], whose result is where the loop goes on: it may be limited, and not scaled, for a
    factor would act in each step anew. Effects of one slot act in the order of their modules' names, and within a
    module as they stand there. In `READING` nothing takes time: `Now.step_s` is 0.
    """

    EVENTS = "the commands, when they reach the servo"
    COMMAND = "the set point of the position loop"
    ERROR = "the position error that drives the motor"
    LOAD = "loads on the shaft"
    GRIP = "friction of the shaft"
    SPEED = "the speed of the shaft"
    STOP = "the position of the shaft"
    OUTPUT = "what hangs on the shaft"
    READING = "what the sensor says of it"
    OWN = "the servo's own linear loop"


_IN_LOOP = (Slot.ERROR, Slot.LOAD, Slot.GRIP, Slot.SPEED)
"""Slots whose effects differ with the place of the slow pole."""


class Now(NamedTuple):
    """What an effect may look at beside the value that passes: one step of the simulation."""

    step_s: float
    """Length of the step; 0 where it is asked only for what passes."""
    position_deg: float
    """Of the shaft, in the middle of the step; 0 in `Slot.READING`, which sees nothing of the motion."""
    speed_deg_s: float
    """Of the shaft, before the step; 0 there."""
    error_s: float
    """Position error that keeps up a steady motion, for each deg/s of its speed [deg/(deg/s)]."""
    effort_deg: float
    """Of the motor, as the position error that it balances; in `Slot.GRIP` alone."""
    load_deg: float
    """Deflection that all loads take away, in `Slot.OUTPUT` alone."""
    pressure_pa: float
    """Dynamic pressure; 0 if never logged."""
    supply_v: float
    """Of the servo; infinite if it was never logged, or not yet: ask `math.isfinite`."""
    power: float
    """Supply over the usual one; 1 if never logged, or where no calibration knows the usual one."""
    current_a: float
    """Drawn by the servo; 0 if never logged."""
    external: float
    """Load that was logged on the shaft, in its own unit; 0 if never logged."""
    travel_deg: float
    """Of the shaft in the step, in `Slot.OUTPUT` alone, as the next."""
    arrives_deg_s: float
    """Speed of the shaft at the end of the step."""


_AT_BOUND, _NEAR = 1e-3, 0.1
"""Share of the range, and of the lower bound, within which a value is at it."""


class Spread(NamedTuple):
    """How much sound servos differ in a parameter, in its unit: what a calibration must know to fit it."""

    between_servos: float
    between_flights: float
    """Of one servo."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number of an effect, in the unit that its name ends with.

    Raises
    ------
    ConfigError
        If a bound is missing or reversed, or the neutral value lies outside them.

    Examples
    --------
    >>> Parameter("width_deg", low=0.0, high=8.0, neutral=0.0, typical=0.1).off
    0.0
    """

    name: str
    fields: tuple[str, ...] = ()
    """Of `servofd.servo.physics.Physics`, all set to the value; if none is given, one of its own: effect_parameter."""
    low: float = math.nan
    high: float = math.nan
    neutral: float = math.nan
    """Value of a servo without the effect, or the bound that is nearest to it."""
    typical: float = math.nan
    """Deviation from neutral that is common on a healthy servo."""
    grid: tuple[float, ...] = ()
    """Values from which the search for the effect starts; if none is given, some on either side of neutral."""
    off: float = math.nan
    """Value at which it does nothing, if not `neutral`: an infinite limit."""
    loose: float = 0.0
    """Share of it that a surface may rest away from where it is asked to be, to either side."""
    kinked: bool = False
    """True if the error has many minima in it, and must be searched instead of descended."""
    aside: bool = False
    """True for a number of no interest that the effect needs to fit; it is neither reported nor judged."""
    smallest: float = 0.0
    """Least deviation from neutral that may be reported: what is smaller is the difference between two servos of a
    type, or no servo's at all."""
    width: float = 0.0
    """How far around the start the search goes; 0: to the neighbours on the grid."""
    calibrated: Spread | None = None
    """Standard deviations with which `servofd calibrate` fits it; None: it does not."""

    def __post_init__(self) -> None:
        for name in ("low", "high", "neutral", "typical"):
            if math.isnan(getattr(self, name)):
                raise ConfigError(f"parameter {self.name}: {name} is missing")
        if not self.low < self.high:
            raise ConfigError(
                f"parameter {self.name}: its lower bound {self.low:g} must be below its upper bound {self.high:g}"
            )
        if not (self.low <= self.neutral <= self.high or self.low > self.neutral == 0.0):
            raise ConfigError(
                f"parameter {self.name}: neutral {self.neutral:g} must lie between {self.low:g} and {self.high:g}"
            )
        if not self.typical > 0.0:
            raise ConfigError(f"parameter {self.name}: typical must be positive, not {self.typical:g}")
        if math.isnan(self.off):
            object.__setattr__(self, "off", self.neutral)
        if not self.grid and not self.kinked:
            object.__setattr__(self, "grid", self._usual_grid())

    def _usual_grid(self) -> tuple[float, ...]:
        """From a third to ten typical sizes on either side of neutral, within the bounds."""
        sizes = [self.neutral + sign * size * self.typical for size in (0.3, 1.0, 3.0, 10.0) for sign in (-1.0, 1.0)]
        return tuple(sorted(v for v in sizes if self.low < v < self.high)) or (0.5 * (self.low + self.high),)

    def away(self, value: float, known: Any) -> float:  # noqa: ANN401 - `Physics` stands on this
        """How far a value is from that of the servo as it is known."""
        neutral = getattr(known, self.fields[0])
        return abs(value - (neutral if math.isfinite(neutral) else self.neutral))

    def at_bound(self, value: float) -> bool:
        """Whether a value has run to the end of its range: a failure, not an answer."""
        if self.aside:
            return False
        margin = _AT_BOUND * (self.high - self.low)
        # Of a range over decades, that share would be many times its lower end.
        lower = min(margin, _NEAR * self.low) if self.low > 0.0 else margin
        at_neutral = abs(self.neutral - value) <= margin
        return (value - self.low <= lower or self.high - value <= margin) and not at_neutral


SELDOM, RARELY, HARDLY_EVER = 8.0, 12.0, 24.0
"""Surprises of effects that are 55, 400 and 160 000 times as rare as the others."""


class Effect:
    """Physics beyond a linear servo; subclasses say which.

    An instance is the effect with values, in the order of its parameters; parameters left out are as without it.

    Examples
    --------
    >>> class Creep(Effect):
    ...     '''Reading that a warm sensor moves.'''
    ...     name, slot = "creep", Slot.READING
    ...     parameters = (Parameter("shift_deg", low=-2.0, high=2.0, neutral=0.0, typical=0.1),)
    ...     @staticmethod
    ...     def act(x, now, shift_deg):
    ...         return x + shift_deg
    >>> Creep(0.5).sizes, Creep.key()
    ({'creep_shift_deg': 0.5}, 'creep')
    """

    name: ClassVar[str]
    slot: ClassVar[Slot]
    parameters: ClassVar[tuple[Parameter, ...]]
    form: ClassVar[str] = ""
    """Which machine it is, where several go by one name."""
    spoken: ClassVar[str] = ""
    """How people call it, in "a servo with ..."; its name, if left out."""
    sound: ClassVar[float | None] = None
    """Most that a sound hobby servo has of its first number, an angle [deg]; more is a fault, or never if None."""
    advice: ClassVar[str] = ""
    """What to do on the ground beyond that."""
    family: ClassVar[str] = ""
    """Effects that are alike at low frequency, and hardly separated where anything else is unexplained."""
    needs: ClassVar[tuple[Surroundings, ...]] = ()
    """What the log must hold beside commands and positions."""
    fixed: ClassVar[Mapping[str, float]] = {}
    """Fields of `Physics` that the effect replaces."""
    instead: ClassVar[tuple[str, ...]] = ()
    """Names of effects on top of which it does not come, nor they on top of it: forms of one thing, or one that bends
    the position much as the other does."""
    places: ClassVar[tuple[float, ...] | None] = None
    """Where the slow pole of a servo of three may lie with it (`servofd.servo.loop`), the likeliest first; empty if
    that does not matter. What acts within the loop, or before what may follow it, differs with the place."""
    varies: ClassVar[bool] = False
    """Whether its first number may go with a condition of the runs."""
    at_rest: ClassVar[int] = 0
    """Rank where only rests can be judged; 0: what it does to a surface at rest is not seen there."""
    surprise: ClassVar[float] = 0.0
    """Minus twice the logarithm of how much rarer than the others it is, or how much more it can pass for."""
    rank: ClassVar[int] = 100
    """Simple before flexible: where data cannot tell two effects apart, the one of lower rank is named."""
    searched: ClassVar[bool] = True
    """False for a number of the servo's own, which is part of a model and not named as an effect."""
    memory: ClassVar[int] = 0
    """How many numbers it remembers from step to step. Where a run begins, and after each pause, the first is the
    command or the deflection that passes (elsewhere than in these slots 0), and the others are 0."""
    longest_s: ClassVar[float] = 2.5e-3
    """Longest step in which it is held: half of it changes a flight with much manoeuvring by less than 0.002 deg rms
    (tests/laws/test_stepper.py)."""
    apart_s: ClassVar[float] = math.inf
    """The same behind something else that hangs on the shaft, so that it does not move with the shaft."""
    sees: ClassVar[tuple[str, ...]] = ()
    """Fields of `Physics` that `act` is given; if none is given, those of its parameters."""
    switches: ClassVar[tuple[str, ...]]
    """Fields of which one at least is not off where it acts."""

    act: ClassVar[Callable[..., Any] | None] = None
    """``act(x, now, *fields, *memory)``: what becomes of the value that passes, and then of each number of its memory.

    A static method of floats, with nothing but `math` and what its module holds of numbers and of functions of floats.
    """

    def __init_subclass__(cls) -> None:
        for needed in ("name", "slot", "parameters"):
            if not hasattr(cls, needed):
                raise ConfigError(f"effect {cls.__name__}: {needed} is missing")
        if not cls.parameters or not cls.__doc__:
            raise ConfigError(f"effect {cls.name}: it needs a parameter and a sentence that says what it is")
        cls.parameters = tuple(p if p.fields else replace(p, fields=(f"{cls.name}_{p.name}",)) for p in cls.parameters)
        if cls.places is None:
            cls.places = (BEFORE, INSIDE) if cls.slot in _IN_LOOP else ()
        cls.spoken = cls.spoken or cls.name.replace("_", " ")
        cls.switches = tuple(dict.fromkeys(f for p in cls.parameters if not p.aside for f in p.fields))
        if not cls.sees:
            cls.sees = tuple(dict.fromkeys(field for p in cls.parameters for field in p.fields))

    def __init__(self, *values: float) -> None:
        if len(values) > len(self.parameters):
            raise ConfigError(f"{self.name}: its parameters are {', '.join(p.name for p in self.parameters)}")
        for p, value in zip(self.parameters, values, strict=False):
            if math.isnan(value) or (p.low >= 0.0 and value < 0.0) or (p.low > 0.0 and value == 0.0):
                bound = "positive" if p.low > 0.0 else "zero or more" if p.low == 0.0 else "a number"
                raise ConfigError(f"{self.name}: {p.name} must be {bound}, not {value:g}")
        left_out = (p.off for p in self.parameters[len(values) :])
        self.values: tuple[float, ...] = (*map(float, values), *left_out)

    @property
    def sizes(self) -> dict[str, float]:
        """Fields of `Physics` that it sets, and to what."""
        changes = dict(self.fixed)
        for p, value in zip(self.parameters, self.values, strict=True):
            changes |= dict.fromkeys(p.fields, value)
        return changes

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Effect) and type(self) is type(other) and self.values == other.values

    def __hash__(self) -> int:
        return hash((type(self), self.values))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{value:g}' for value in self.values)})"

    @classmethod
    def key(cls) -> str:
        """Name and form."""
        return f"{cls.name} ({cls.form})" if cls.form else cls.name
