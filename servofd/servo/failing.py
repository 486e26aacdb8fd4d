"""A servo in which things fail for a while: what a fault may change, and how the servo moves from fault to fault.

A fault acts on a servo in at most three places, and each has one small method: what the servo **receives** of its
command (dead band, offset), what the servo **has become** (slower), and how the surface **moves** in place of what
the servo does (jammed, blown by the wind). One simulation runs through the whole flight, so that position and
motion pass from interval to interval; where a surface was moved by something else than its servo, the servo goes on
from there, from rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from itertools import pairwise
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from servofd.core.errors import ConfigError
from servofd.servo.context import NO_CONTEXT, Context

if TYPE_CHECKING:
    from collections.abc import Iterable

    from servofd.core.types import FloatArray
    from servofd.servo.motion import AnyServo, ExtendedMotion, PlainMotion
    from servofd.servo.servo_model import ServoModel

_LARGEST = 1e9
"""In degrees, Hz or seconds: beyond what any servo does, and far from where products of such numbers overflow."""


@dataclass(frozen=True, slots=True)
class Fault:
    """A way a servo can fail from `start_s` on, until `end_s` if it passes; itself, nothing fails."""

    kind: ClassVar[str]
    positive: ClassVar[tuple[str, ...]] = ()
    """Parameters that must be greater than zero."""
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
        if not self.end_s > self.start_s:
            raise ConfigError(
                f"{self.kind}: end_s must be later than its start at {self.start_s:g} s, not {self.end_s}"
            )

    def received(self, command_deg: FloatArray, before_deg: float) -> FloatArray:  # noqa: ARG002 - other faults use it
        """What the servo makes of the commands given during the fault [deg], shape (k,), after `before_deg`."""
        return command_deg

    def become(self, servo: AnyServo) -> AnyServo:
        """The servo as it is during the fault."""
        return servo

    def moved(self, servo: AnyServo, elapsed_s: FloatArray, deflection_deg: FloatArray) -> FloatArray:  # noqa: ARG002
        """Where the surface is `elapsed_s` [s] into the fault, shape (k,), `deflection_deg` being the servo's way."""
        return deflection_deg

    def deflection(
        self, model: ServoModel, command_s: FloatArray, command_deg: FloatArray, at_s: FloatArray
    ) -> FloatArray:
        """Deflection of a servo with this fault alone [deg], shape (m,), at the rising times `at_s` [s], shape (m,)."""
        return failing_deflection(model, [self], command_s, command_deg, at_s)


def in_order(faults: Iterable[Fault]) -> tuple[Fault, ...]:
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
    faults: Iterable[Fault],
    command_s: FloatArray,
    command_deg: FloatArray,
    at_s: FloatArray,
    context: Context = NO_CONTEXT,
) -> FloatArray:
    """Deflection of a servo with faults, one after the other; `ServoModel.simulate` if there are none.

    Parameters
    ----------
    faults : iterable of Fault
        What fails, and when; the intervals [start_s, end_s) do not overlap.
    command_s, command_deg : ndarray, shape (n,)
        When each command was given [s] and what it asked for [deg]; it holds until the next.
    at_s : ndarray, shape (m,)
        Times [s], rising.

    Returns
    -------
    ndarray, shape (m,)
        Deflection [deg], starting from rest at the first command.

    Examples
    --------
    >>> from servofd.servo.faults import Slow, Stuck
    >>> from servofd.servo.servo_model import ServoModel
    >>> from servofd.servo.library import servo_named
    >>> t = np.arange(0.0, 3.0, 0.5)
    >>> model = ServoModel.of(servo_named("s9254"))
    >>> failing_deflection(model, [Slow(0.2), Stuck(1.0, end_s=2.0)], t, 10.0 * t, t).round(2)
    Traceback (most recent call last):
        ...
    servofd.core.errors.ConfigError: stuck at 1 s begins before slow at 0.2 s has ended: one fault at a time ...
    >>> failing_deflection(model, [Slow(0.2, end_s=1.0), Stuck(1.0, end_s=2.0)], t, 10.0 * t, t).round(2)
    array([ 0.,  0.,  5.,  5.,  5., 20.])
    """
    faults = in_order(faults)
    command_s, command_deg, at_s = (np.asarray(values, dtype=float) for values in (command_s, command_deg, at_s))
    for fault in faults:
        command_s, command_deg = _received(fault, command_s, command_deg)
    motion = model.motion(command_s, command_deg, context)
    deflection_deg = np.empty(at_s.size)
    done = 0
    for fault in faults:
        first, last = np.searchsorted(at_s, (fault.start_s, fault.end_s)).tolist()
        deflection_deg[done:first] = motion.at(at_s[done:first])
        if first < at_s.size:
            deflection_deg[first:last] = _during(fault, motion, at_s[first:last], passes=last < at_s.size)
        done = last
    deflection_deg[done:] = motion.at(at_s[done:])
    return deflection_deg


def _during(fault: Fault, motion: PlainMotion | ExtendedMotion, at_s: FloatArray, *, passes: bool) -> FloatArray:
    """Deflection while a fault lasts; afterwards the servo is as before, wherever the fault has left it."""
    healthy = motion.servo
    motion.at(np.array([fault.start_s]))
    motion.become(fault.become(healthy))
    instants_s = np.concatenate([[fault.start_s], at_s, [fault.end_s] if passes else []])
    simulated_deg = motion.at(instants_s)
    motion.become(healthy)
    moved_deg = fault.moved(healthy, instants_s - fault.start_s, simulated_deg)
    moved_deg = np.clip(moved_deg, healthy.lower_deg, healthy.upper_deg)
    if passes and moved_deg[-1] != simulated_deg[-1]:
        motion.rest(fault.end_s, float(moved_deg[-1]))
    return moved_deg[1 : at_s.size + 1]


def _received(fault: Fault, command_s: FloatArray, command_deg: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Commands as the servo receives them; the one in force when the fault comes or goes is received anew."""
    for cut_s in (fault.start_s, fault.end_s):
        k = int(np.searchsorted(command_s, cut_s))
        if k > 0 and math.isfinite(cut_s) and cut_s not in command_s[k : k + 1]:
            command_s = np.insert(command_s, k, cut_s)
            command_deg = np.insert(command_deg, k, command_deg[k - 1])
    first, last = np.searchsorted(command_s, (fault.start_s, fault.end_s))
    received_deg = command_deg.copy()
    received_deg[first:last] = fault.received(command_deg[first:last], float(command_deg[max(first - 1, 0)]))
    return command_s, received_deg
