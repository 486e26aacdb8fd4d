"""Effects whose size goes, from run to run, with something that was logged beside them: a speed that falls with a load.

Such an effect is another form of the effect that it varies, with one number more, and competes with all others.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.servo import catalogue
from servofd.servo.missing_effect import MissingEffect, Parameter

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servofd.core.types import FloatArray
    from servofd.servo.physics import Physics

VARIED: tuple[type[MissingEffect], ...] = (
    catalogue.RateLimit,
    catalogue.ShaftSpeed,
    catalogue.FollowedRate,
    catalogue.SetPointRate,
    catalogue.GravityLoad,
    catalogue.Friction,
    catalogue.StribeckFriction,
    catalogue.DeadBand,
    catalogue.Backlash,
    catalogue.CurrentLimit,
    catalogue.Gain,
    catalogue.Bias,
    catalogue.Delay,
)
"""Effects whose first number may go with a condition."""
FEWEST_RUNS = 5
ALIKE = 0.98
"""Correlation beyond which two conditions cannot be told apart."""
_SHARES = (-0.3, -0.1, 0.1, 0.3)


def told_apart(conditions: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Conditions from -1 to 1, one of those that vary together; none of too few runs."""
    found: dict[str, FloatArray] = {}
    for name, of in conditions.items():
        if of.size < FEWEST_RUNS or not np.all(np.isfinite(of)) or np.ptp(of) == 0.0:
            continue
        if all(abs(float(np.corrcoef(of, other)[0, 1])) <= ALIKE for other in found.values()):
            found[name] = 2.0 * (of - of.min()) / np.ptp(of) - 1.0
    return found


_LAWS: dict[tuple[str, int, str], type[MissingEffect]] = {}


def by_condition(effect: type[MissingEffect], number: int, condition: str) -> type[MissingEffect]:
    """The effect, its first number a line over a condition of the runs."""
    key = effect.__name__, number, condition
    if key in _LAWS:
        return _LAWS[key]
    first = effect.parameters[0]
    most = first.high - first.low
    grid = tuple(share * (first.typical if first.low < 0.0 else 1.0) for share in _SHARES)
    slope = Parameter(f"{first.name}_by_run", ("run_slope",), -most, most, 0.0, first.typical, grid, aside=True)
    members = {
        "parameters": (*effect.parameters, slope),
        "fixed": {**effect.fixed, "run_field": float(VARIED.index(effect)), "run_condition": float(number)},
        "form": ", ".join(filter(None, (effect.form, f"by {condition}"))),
    }
    return _LAWS.setdefault(key, type(f"{effect.__name__}By{number}", (effect,), members))


def is_law(effect: type[MissingEffect]) -> bool:
    """Whether its size goes with a condition."""
    return any(p.fields == ("run_slope",) for p in effect.parameters)


def plain(effect: type[MissingEffect]) -> type[MissingEffect]:
    """The effect as it is with one size for all runs."""
    return VARIED[int(effect.fixed["run_field"])] if is_law(effect) else effect


def at_run(physics: Physics, conditions: Sequence[float]) -> Physics:
    """The servo as it is in a run."""
    if physics.run_slope == 0.0 or not conditions:
        return physics
    parameter = VARIED[int(physics.run_field)].parameters[0]
    value = getattr(physics, parameter.fields[0]) + physics.run_slope * conditions[int(physics.run_condition)]
    return physics._replace(**dict.fromkeys(parameter.fields, min(max(value, parameter.low), parameter.high)))
