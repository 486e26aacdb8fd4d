"""Changes of the servo's own linear loop: they have no step of their own, for the loop's matrices hold them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from servofd.servo.effect import SELDOM, Effect, Parameter, Slot
from servofd.servo.loop import AFTER, BEFORE, INSIDE

_SCALES = (0.3, 0.45, 0.6, 0.75, 0.9, 1.15, 1.5)
"""Of all poles, from which a search starts."""


class SlowDynamics(Effect):
    """All poles scaled: a weak battery, a heavy surface."""

    name, slot, rank = "slow_dynamics", Slot.OWN, 5
    spoken = "slower dynamics"
    parameters = (Parameter("bandwidth_scale", ("bandwidth_scale",), 0.1, 4.0, 1.0, 0.1, _SCALES, smallest=0.08),)


class Damping(Effect):
    """Damping of the fast pair of poles scaled."""

    name, slot, rank = "damping", Slot.OWN, 25
    spoken = "another damping"
    surprise = SELDOM
    parameters = (
        Parameter("damping_scale", ("damping_scale",), 0.1, 6.0, 1.0, 0.1, (0.4, 0.7, 1.4, 2.2), smallest=0.2),
    )


class Poles(Effect):
    """How a servo's poles differ from those of its type, the slow one in the loop: part of a model, no effect."""

    name, slot, searched, form = "poles", Slot.OWN, False, "inside"
    fixed: ClassVar[Mapping[str, float]] = {"slow_place": INSIDE}
    parameters = tuple(
        Parameter(name, (name,), 0.02, 50.0, 1.0, typical, (1.0,))
        for name, typical in (("slow_scale", 0.03), ("pair_scale", 0.03), ("damping_scale", 0.06))
    )


class PolesBefore(Poles):
    """The same of a servo whose slow pole filters the command."""

    form, fixed = "before", {"slow_place": BEFORE}


class PolesAfter(Poles):
    """The same of a servo whose slow pole filters what the loop moves."""

    form, fixed = "after", {"slow_place": AFTER}
