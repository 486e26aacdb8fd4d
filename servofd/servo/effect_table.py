"""Effects as an aircraft file writes them: a table from names to parameters, with the units in the keys."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from servofd.core.errors import ConfigError, UnknownName, suggest
from servofd.servo.catalogue import CATALOGUE, effects_named, installed
from servofd.servo.effects import Extension, Place, Plan, neutral_of
from servofd.servo.missing_effect import MissingEffect, Parameter

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.core.types import FloatArray
    from servofd.servo.physics import Physics

EffectTable = dict[str, dict[str, float | str]]
"""Effect name to its parameters, and its ``form`` where several machines go by one name."""

_OPTIONAL = ("phase",)
"""When pulse frames begin is another matter in each log."""


def effects_installed(physics: Physics, table: Mapping[str, Mapping[str, float | str]]) -> Physics:
    """Servo with the effects of a table.

    Examples
    --------
    >>> from servofd.servo.physics import Physics
    >>> effects_installed(Physics(), {"backlash": {"width_deg": 0.8}}).backlash_deg
    0.8
    >>> effects_installed(Physics(), {"backlash": {"width": 0.8}})
    Traceback (most recent call last):
        ...
    servofd.core.errors.UnknownName: effects.backlash: unknown parameter 'width'; did you mean width_deg? known: ...
    """
    for name, given in table.items():
        effect = _effect(name, given)
        values = [_value(name, parameter, given) for parameter in effect.parameters]
        physics = installed(physics, [effect], values)
    if not physics.lower_deg < physics.upper_deg or not physics.stop_lower_deg < physics.stop_upper_deg:
        raise ConfigError("effects.position_limit: lower_deg must be below upper_deg")
    return physics


@dataclass(frozen=True, slots=True)
class TabledEffect:
    """One effect of such a table, as a part of a servo model.

    Examples
    --------
    >>> TabledEffect("backlash", {"width_deg": 0.8}).install(Plan(delay_s=0.01)).physics.backlash_deg
    0.8
    """

    effect: str
    parameters: Mapping[str, float | str]
    name: ClassVar[str] = "tabled"
    place: ClassVar[Place] = Place.WHOLE

    def install(self, plan: Plan) -> Plan:
        """Add the effect to those that are there."""
        return Extension(effects_installed(neutral_of(plan), {self.effect: self.parameters})).install(plan)


def table_of(effects: Sequence[type[MissingEffect]], values: FloatArray) -> EffectTable:
    """Table of effects that were found, their parameters in order; the inverse of `effects_installed`.

    Examples
    --------
    >>> import numpy as np
    >>> from servofd.servo.catalogue import FollowedRate
    >>> table_of([FollowedRate], np.array([88.1234567]))
    {'rate_limit': {'form': 'output', 'rate_limit_deg_s': 88.12346}}
    """
    numbers = iter(values.tolist())
    table: EffectTable = {}
    for effect in effects:
        entry: dict[str, float | str] = {}
        if _default(effect.name, {p.name for p in effect.parameters}) is not effect:
            entry["form"] = effect.form
        digits = 10 if effect.name == "pwm_frame" else 7  # a period off by 1e-9 s is off by a frame after a day
        for parameter in effect.parameters:
            entry[parameter.name] = float(f"{next(numbers):.{digits}g}")
        table[effect.name] = entry
    return table


def _default(name: str, given: set[str]) -> type[MissingEffect] | None:
    """The first form that has the parameters that are given."""
    forms = [e for e in effects_named(name) if given <= {p.name for p in e.parameters}]
    return forms[0] if forms else None


def _effect(name: str, given: Mapping[str, float | str]) -> type[MissingEffect]:
    forms = effects_named(name)
    if not forms:
        raise UnknownName("effects: " + suggest("effect", name, dict.fromkeys(effect.name for effect in CATALOGUE)))
    wanted = set(given) - {"form"}
    for key in sorted(wanted):
        known = dict.fromkeys(parameter.name for effect in forms for parameter in effect.parameters)
        if key not in known:
            raise UnknownName(f"effects.{name}: " + suggest("parameter", key, known))
    if "form" in given:
        by_form = {effect.form: effect for effect in forms}
        if given["form"] not in by_form:
            raise UnknownName(f"effects.{name}: " + suggest("form", str(given["form"]), filter(None, by_form)))
        return by_form[str(given["form"])]
    chosen = _default(name, wanted)
    if chosen is None:
        raise ConfigError(f"effects.{name}: {' and '.join(sorted(wanted))} do not go together")
    return chosen


def _value(name: str, parameter: Parameter, given: Mapping[str, float | str]) -> float:
    where = f"effects.{name}.{parameter.name}"
    if parameter.name not in given:
        if parameter.aside or parameter.name in _OPTIONAL:
            return parameter.neutral
        raise ConfigError(f"{where}: this key is missing")
    value = given[parameter.name]
    # Just outside counts as on the bound: files hold rounded numbers.
    margin = 1e-6 * (parameter.high - parameter.low)
    if isinstance(value, str | bool) or not math.isfinite(value):
        raise ConfigError(f"{where}: must be a number from {parameter.low:g} to {parameter.high:g}, not {value!r}")
    if not parameter.low - margin <= value <= parameter.high + margin:
        raise ConfigError(f"{where}: must lie between {parameter.low:g} and {parameter.high:g}, not {value:g}")
    return float(value)
