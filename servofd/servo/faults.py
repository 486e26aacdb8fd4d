"""Faults that the simulator can put into a servo, each at a chosen time: the failure modes of thesis 2.2.

Adding one is adding a class here and its name in `_KINDS`. Sizes left out are those of a fault that a pilot would
notice on the ground; no source prescribes them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from itertools import pairwise
from typing import ClassVar

import numpy as np

from servofd.core.errors import ConfigError
from servofd.core.types import FloatArray
from servofd.servo.context import NO_CONTEXT, Context
from servofd.servo.loops import play
from servofd.servo.motion import Motion
from servofd.servo.servo_model import ServoModel

_LARGEST = 1e9
"""In degrees, Hz or seconds: beyond what any servo does, and far from where products of such numbers overflow."""


@dataclass(frozen=True, slots=True)
class Failure:
    """A way a servo can fail from `start_s` on, until `end_s` if it passes; itself, nothing fails."""

    kind: ClassVar[str]
    positive: ClassVar[tuple[str, ...]] = ()
    """Parameters that must be greater than zero."""
    pushes: ClassVar[bool] = True
    """Whether the motor still works against what keeps the surface from its command."""
    start_s: float
    """When it sets in [s]."""
    end_s: float = field(default=math.inf, kw_only=True)
    """When the servo is healthy again [s]; infinite: never."""

    def __post_init__(self) -> None:
        for name in [f.name for f in fields(self) if f.name != "end_s"]:
            value = getattr(self, name)
            if value is not None and not math.isfinite(value):
                raise ConfigError(f"{self.kind}: {name} must be finite, not {value}")
            if value is not None and abs(value) > _LARGEST and name != "seed":
                raise ConfigError(f"{self.kind}: {name} must be within {_LARGEST:g}, not {value:g}")
            if name in self.positive and not value > 0.0:
                raise ConfigError(f"{self.kind}: {name} must be positive, not {value}")
            if name == "seed" and (value < 0 or value != int(value)):
                raise ConfigError(f"{self.kind}: seed must be a whole number of zero or more, not {value}")
        if not self.end_s > self.start_s:
            raise ConfigError(
                f"{self.kind}: end_s must be later than its start at {self.start_s:g} s, not {self.end_s}"
            )

    def received(self, elapsed_s: FloatArray, command_deg: FloatArray, before_deg: float) -> FloatArray:
        """What the servo makes of the commands given `elapsed_s` [s] into the fault [deg], (k,), after `before_deg`."""
        return command_deg

    def become(self, servo: ServoModel) -> ServoModel:
        """The servo as it is during the fault."""
        return servo

    def moved(self, servo: ServoModel, elapsed_s: FloatArray, deflection_deg: FloatArray) -> FloatArray:
        """Where the surface is `elapsed_s` [s] into the fault, shape (k,), `deflection_deg` being the servo's way."""
        return deflection_deg

    def deflection(
        self, model: ServoModel, command_s: FloatArray, command_deg: FloatArray, at_s: FloatArray
    ) -> FloatArray:
        """Deflection of a servo with this fault alone [deg], shape (m,), at the rising times `at_s` [s], shape (m,)."""
        return failing_deflection(model, [self], command_s, command_deg, at_s)


def in_order(faults: Iterable[Failure]) -> tuple[Failure, ...]:
    """Faults of one surface by their start."""
    ordered = tuple(sorted(faults, key=lambda fault: fault.start_s))
    for one, two in pairwise(ordered):
        if two.start_s < one.end_s:
            raise ConfigError(
                f"{two.kind} at {two.start_s:g} s begins before {one.kind} at {one.start_s:g} s has ended: "
                f"one fault at a time on a surface, say when the first ends (end_s, at most {two.start_s:g})"
            )
    return ordered


def failing_deflection(
    model: ServoModel,
    faults: Iterable[Failure],
    command_s: FloatArray,
    command_deg: FloatArray,
    at_s: FloatArray,
    context: Context = NO_CONTEXT,
) -> FloatArray:
    """Deflection of a servo with faults, one after the other; `ServoModel.simulate` if there are none.

    `faults`: what fails, and when; the intervals [start_s, end_s) do not overlap. `command_s`, `command_deg` (shape
    (n,)): when each command was given [s] and what it asked for [deg]; it holds until the next. `at_s` (shape (m,)):
    times [s], rising. Result (shape (m,)): deflection [deg], starting from rest at the first command.
    """
    faults = in_order(faults)
    command_s, command_deg, at_s = (np.asarray(values, dtype=float) for values in (command_s, command_deg, at_s))
    motion = model.motion(*as_received(faults, command_s, command_deg), context)
    healthy, deflection_deg = model.servo(context), np.empty(at_s.size)
    done = 0
    for fault in faults:
        first, last = np.searchsorted(at_s, (fault.start_s, fault.end_s)).tolist()
        deflection_deg[done:first] = motion.at(at_s[done:first])
        if first < at_s.size:
            deflection_deg[first:last] = _during(fault, healthy, motion, at_s[first:last], passes=last < at_s.size)
        done = last
    deflection_deg[done:] = motion.at(at_s[done:])
    return deflection_deg


def _during(fault: Failure, healthy: ServoModel, motion: Motion, at_s: FloatArray, *, passes: bool) -> FloatArray:
    """Deflection while a fault lasts; afterwards the servo is as before, wherever the fault has left it."""
    motion.at(np.array([fault.start_s]))
    motion.become(fault.become(healthy))
    instants_s = np.concatenate([[fault.start_s], at_s, [fault.end_s] if passes else []])
    simulated_deg = motion.at(instants_s)
    motion.become(healthy)
    moved_deg = fault.moved(healthy, instants_s - fault.start_s, simulated_deg)
    moved_deg = np.clip(moved_deg, *healthy.stops_deg)
    if passes and moved_deg[-1] != simulated_deg[-1]:
        motion.rest(fault.end_s, float(moved_deg[-1]))
    return moved_deg[1 : at_s.size + 1]


def as_received(
    faults: Iterable[Failure], command_s: FloatArray, command_deg: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """What a servo makes of its commands while faults last: times [s] and values [deg], in order.

    The command in force when a fault comes or goes is received anew.

    Examples
    --------
    >>> as_received([Bias(1.0, bias_deg=-2.0)], np.array([0.0, 1.0]), np.array([0.0, 5.0]))
    (array([0., 1.]), array([0., 3.]))
    """
    for fault in faults:
        for cut_s in (fault.start_s, fault.end_s):
            k = int(np.searchsorted(command_s, cut_s))
            if k > 0 and math.isfinite(cut_s) and cut_s not in command_s[k : k + 1]:
                command_s = np.insert(command_s, k, cut_s)
                command_deg = np.insert(command_deg, k, command_deg[k - 1])
        first, last = np.searchsorted(command_s, (fault.start_s, fault.end_s))
        elapsed_s, before_deg = command_s[first:last] - fault.start_s, float(command_deg[max(first - 1, 0)])
        received_deg = fault.received(elapsed_s, command_deg[first:last], before_deg)
        command_deg = np.concatenate([command_deg[:first], received_deg, command_deg[last:]])
    return command_s, command_deg


_STOP_DEG = 25.0
"""Where a servo that runs away comes to rest if nothing says where its stop is: the FASER surfaces' full travel."""
_UNLOADED_RATE_DEG_S = 400.0
"""Speed of a servo that runs away if its rate limit is not known: thesis Appendix A gives 332 deg/s at 4.8 V and
417 deg/s at 6 V for the HS-225BB."""
_TONES = 32
"""Sines that make up a surface's motion in the wind: enough for deflections to be spread like Gaussian ones."""


@dataclass(frozen=True, slots=True)
class Stuck(Failure):
    """The shaft jams (thesis 4.2.2): where it happens to be, or at `position_deg` once it is there.

    Examples
    --------
    >>> from servofd.servo.servo_model import ServoModel
    >>> from servofd.servo.library import servo_named
    >>> t = np.arange(0.0, 2.0, 0.5)
    >>> Stuck(1.0).deflection(ServoModel.of(servo_named("s9254")), t, 10.0 * t, t).round(2)
    array([0., 0., 5., 5.])
    """

    kind: ClassVar[str] = "stuck"
    position_deg: float | None = None

    def received(self, elapsed_s: FloatArray, command_deg: FloatArray, before_deg: float) -> FloatArray:
        return command_deg if self.position_deg is None else np.full(command_deg.size, self.position_deg)

    def moved(self, servo: ServoModel, elapsed_s: FloatArray, deflection_deg: FloatArray) -> FloatArray:
        return np.full(elapsed_s.size, deflection_deg[0]) if self.position_deg is None else deflection_deg


@dataclass(frozen=True, slots=True)
class Bias(Failure):
    """Constant offset (a linkage that slipped, a trim that was lost): the servo moves to it as to any command.

    Examples
    --------
    >>> Bias(1.0, bias_deg=-2.0).received(np.array([0.0, 0.1]), np.array([0.0, 5.0]), 0.0)
    array([-2.,  3.])
    """

    kind: ClassVar[str] = "bias"
    bias_deg: float = 2.0

    def received(self, elapsed_s: FloatArray, command_deg: FloatArray, before_deg: float) -> FloatArray:
        return command_deg + self.bias_deg


@dataclass(frozen=True, slots=True)
class HardOver(Failure):
    """The servo runs away: at its rate limit to `position_deg`, but no further than to its stop, and stays there.

    Without `position_deg` it goes to the upper stop; the sign of `position_deg` gives the direction.
    """

    kind: ClassVar[str] = "hardover"
    position_deg: float | None = None

    def moved(self, servo: ServoModel, elapsed_s: FloatArray, deflection_deg: FloatArray) -> FloatArray:
        lower_deg, upper_deg = servo.stops_deg
        stop_deg = upper_deg if math.isfinite(upper_deg) else _STOP_DEG
        goal_deg = stop_deg if self.position_deg is None else self.position_deg
        way_deg = np.clip(goal_deg, lower_deg, upper_deg) - deflection_deg[0]
        rate_deg_s = servo.rates_deg_s[0 if way_deg > 0.0 else 1]
        rate_deg_s = rate_deg_s if math.isfinite(rate_deg_s) else _UNLOADED_RATE_DEG_S
        moved_deg: FloatArray = deflection_deg[0] + np.sign(way_deg) * np.minimum(rate_deg_s * elapsed_s, abs(way_deg))
        return moved_deg


@dataclass(frozen=True, slots=True)
class Floating(Failure):
    """The linkage is off: the wind moves the surface about `mean_deg`, smoothly, whatever the command.

    Tones of random phase between nothing and `bandwidth_hz`; `amplitude_deg` is that of a sine of the same power, so
    that the standard deviation is `amplitude_deg` / sqrt(2). The surface leaves the position at which the linkage
    broke within about 1 / (2 pi bandwidth).
    """

    kind: ClassVar[str] = "floating"
    pushes: ClassVar[bool] = False
    positive: ClassVar[tuple[str, ...]] = ("amplitude_deg", "bandwidth_hz")
    amplitude_deg: float = 4.0
    bandwidth_hz: float = 1.0
    mean_deg: float = 0.0
    seed: float = 0

    def moved(self, servo: ServoModel, elapsed_s: FloatArray, deflection_deg: FloatArray) -> FloatArray:
        rng = np.random.default_rng(int(self.seed))
        tones_hz = self.bandwidth_hz * (np.arange(_TONES) + rng.random(_TONES)) / _TONES
        phases = rng.uniform(0.0, 2.0 * np.pi, _TONES)
        wind_deg = np.full(elapsed_s.size, self.mean_deg)
        for tone_hz, phase in zip(tones_hz, phases, strict=True):
            wind_deg += self.amplitude_deg / np.sqrt(_TONES) * np.sin(2.0 * np.pi * tone_hz * elapsed_s + phase)
        forgotten = np.exp(-2.0 * np.pi * self.bandwidth_hz * elapsed_s)
        moved_deg: FloatArray = wind_deg + forgotten * (deflection_deg[0] - wind_deg[0])
        return moved_deg


@dataclass(frozen=True, slots=True)
class Oscillation(Failure):
    """The servo swings: on top of its motion ("liquid"), or in place of it about where it was ("solid")."""

    kind: ClassVar[str] = "oscillation"
    positive: ClassVar[tuple[str, ...]] = ("amplitude_deg", "frequency_hz")
    amplitude_deg: float = 1.5
    frequency_hz: float = 3.0
    replaces: bool = False

    def __post_init__(self) -> None:
        Failure.__post_init__(self)
        if self.replaces not in (0, 1):
            raise ConfigError(f"oscillation: replaces must be 0 (on top of the motion) or 1, not {self.replaces}")

    def moved(self, servo: ServoModel, elapsed_s: FloatArray, deflection_deg: FloatArray) -> FloatArray:
        about_deg = deflection_deg[0] if self.replaces else deflection_deg
        return about_deg + self.amplitude_deg * np.sin(2.0 * np.pi * self.frequency_hz * elapsed_s)


@dataclass(frozen=True, slots=True)
class DeadBand(Failure):
    """Increased dead band or stiction (thesis 4.2.1): the servo rests until it is `width_deg` / 2 off its command."""

    kind: ClassVar[str] = "deadband"
    positive: ClassVar[tuple[str, ...]] = ("width_deg",)
    width_deg: float = 3.0

    def received(self, elapsed_s: FloatArray, command_deg: FloatArray, before_deg: float) -> FloatArray:
        return play(command_deg, self.width_deg, before_deg)


@dataclass(frozen=True, slots=True)
class Slow(Failure):
    """The servo has become slower: every pole times `bandwidth_scale`, its rate limit (if any) times `rate_scale`.

    Left out, `bandwidth_scale` is 0.5; or 1 if a `rate_scale` below 1 says that the rate limit is what has changed.
    Poles scaled are time stretched: each mode goes on from where it is, only slower, so that the position does not
    jump when the fault comes or goes.
    """

    kind: ClassVar[str] = "slow"
    positive: ClassVar[tuple[str, ...]] = ("bandwidth_scale", "rate_scale")
    bandwidth_scale: float | None = None
    rate_scale: float = 1.0

    def __post_init__(self) -> None:
        if self.bandwidth_scale is None:
            object.__setattr__(self, "bandwidth_scale", 1.0 if self.rate_scale < 1.0 else 0.5)
        Failure.__post_init__(self)
        for name in self.positive:
            if getattr(self, name) > 1.0:
                raise ConfigError(f"slow: {name} must be at most 1, not {getattr(self, name)}")

    def become(self, servo: ServoModel) -> ServoModel:
        return servo.slower(self.bandwidth_scale or 1.0).weaker(1.0 - self.rate_scale)


@dataclass(frozen=True, slots=True)
class LossOfEffectiveness(Failure):
    """The surface moves only `gain` times what is asked, about its neutral position."""

    kind: ClassVar[str] = "loss_of_effectiveness"
    gain: float = 0.6

    def __post_init__(self) -> None:
        Failure.__post_init__(self)
        if not 0.0 <= self.gain < 1.0:
            raise ConfigError(f"loss_of_effectiveness: gain must be at least 0 and below 1, not {self.gain}")

    def received(self, elapsed_s: FloatArray, command_deg: FloatArray, before_deg: float) -> FloatArray:
        return self.gain * command_deg


@dataclass(frozen=True, slots=True)
class Intermittent(Failure):
    """A contact that comes and goes: for about `outage_s` no command arrives, and then they do for `apart_s`.

    The servo holds the last command that arrived. Lengths are drawn at random, outages within 40 % of `outage_s`.
    """

    kind: ClassVar[str] = "intermittent"
    positive: ClassVar[tuple[str, ...]] = ("outage_s", "apart_s")
    outage_s: float = 0.8
    apart_s: float = 4.0
    seed: float = 0

    def received(self, elapsed_s: FloatArray, command_deg: FloatArray, before_deg: float) -> FloatArray:
        rng = np.random.default_rng(int(self.seed))
        edges_s, last_s = [0.0], float(elapsed_s[-1]) if elapsed_s.size else 0.0
        while edges_s[-1] < last_s:
            edges_s += [edges_s[-1] + self.outage_s * rng.uniform(0.6, 1.4)]
            edges_s += [edges_s[-1] + self.apart_s * rng.uniform(0.4, 1.6)]
        arrives = np.searchsorted(edges_s, elapsed_s, side="right") % 2 == 0
        held = np.maximum.accumulate(np.where(arrives, np.arange(elapsed_s.size), -1))
        return np.where(held >= 0, command_deg[held], before_deg)


_KINDS = (Stuck, Bias, HardOver, Floating, Oscillation, DeadBand, Slow, LossOfEffectiveness, Intermittent)
FAULTS: dict[str, type[Failure]] = {fault.kind: fault for fault in _KINDS}
"""Faults that a user can ask for by name."""
