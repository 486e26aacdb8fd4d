"""All effects together: which there are, how a table of a file names them, and how they are put on a servo."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from servofd.core.errors import ConfigError, UnknownName, suggest
from servofd.core.types import FloatArray
from servofd.servo.effect import Effect, Parameter
from servofd.servo.physics import Physics
from servofd.servo.registry import catalogue, everything


def installed(physics: Physics, effects: Sequence[type[Effect]], values: Sequence[float]) -> Physics:
    """Servo with these effects, their parameters given in order."""
    changes: dict[str, float] = {}
    for effect in effects:
        changes |= effect.fixed
    parameters = [parameter for effect in effects for parameter in effect.parameters]
    for parameter, value in zip(parameters, values, strict=True):
        changes |= dict.fromkeys(parameter.fields, float(value))
    return physics._replace(**changes)


def effects_named(name: str) -> tuple[type[Effect], ...]:
    """All forms of an effect, or of a number of the servo's own, simple before flexible."""
    return tuple(sorted((e for e in everything() if e.name == name), key=lambda effect: effect.rank))


_FEWEST_RUNS = 5
"""Fewer runs show no line over a condition."""
ALIKE = 0.98
"""Correlation above which two conditions cannot be separated."""
_SHARES = (-0.3, -0.1, 0.1, 0.3)
"""Slopes of a line over a condition from which a search starts, as shares of the typical size."""


def told_apart(conditions: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Conditions from -1 to 1, one of those that vary together; none of too few runs."""
    found: dict[str, FloatArray] = {}
    for name, of in conditions.items():
        if of.size < _FEWEST_RUNS or not np.all(np.isfinite(of)) or np.ptp(of) == 0.0:
            continue
        if all(abs(float(np.corrcoef(of, other)[0, 1])) <= ALIKE for other in found.values()):
            found[name] = 2.0 * (of - of.min()) / np.ptp(of) - 1.0
    return found


_LAWS: dict[tuple[type[Effect], int, str], type[Effect]] = {}


def by_condition(effect: type[Effect], number: int, condition: str) -> type[Effect]:
    """The effect, its first number a line over a condition of the runs."""
    key = effect, number, condition
    if key in _LAWS:
        return _LAWS[key]
    first = effect.parameters[0]
    most = first.high - first.low
    grid = tuple(share * (first.typical if first.low < 0.0 else 1.0) for share in _SHARES)
    slope = Parameter(f"{first.name}_by_run", ("run_slope",), -most, most, 0.0, first.typical, grid, aside=True)
    which = {"run_field": float(everything().index(effect)), "run_condition": float(number)}
    members = {
        "__doc__": effect.__doc__,
        "parameters": (*effect.parameters, slope),
        "fixed": {**effect.fixed, **which},
        "form": ", ".join(filter(None, (effect.form, f"by {condition}"))),
    }
    return _LAWS.setdefault(key, type(f"{effect.__name__}By{number}", (effect,), members))


def is_law(effect: type[Effect]) -> bool:
    """Whether its size goes with a condition."""
    return any(p.fields == ("run_slope",) for p in effect.parameters)


def plain(effect: type[Effect]) -> type[Effect]:
    """The effect as it is with one size for all runs."""
    return everything()[int(effect.fixed["run_field"])] if is_law(effect) else effect


def at_run(physics: Physics, conditions: Sequence[float]) -> Physics:
    """The servo as it is in a run."""
    if physics.run_slope == 0.0 or not conditions:
        return physics
    parameter = everything()[int(physics.run_field)].parameters[0]
    value = getattr(physics, parameter.fields[0]) + physics.run_slope * conditions[int(physics.run_condition)]
    return physics._replace(**dict.fromkeys(parameter.fields, min(max(value, parameter.low), parameter.high)))


EffectTable = dict[str, dict[str, float | str]]
"""Effect name to its parameters, and its ``form`` where several machines go by one name."""

_OPTIONAL = ("phase",)
"""When pulse frames begin is another matter in each log."""


def effects_installed(physics: Physics, table: Mapping[str, Mapping[str, float | str]]) -> Physics:
    """Servo with the effects of a table."""
    for name, given in table.items():
        effect = _effect(name, given)
        values = [_value(name, parameter, given) for parameter in effect.parameters]
        physics = installed(physics, [effect], values)
    if not physics.lower_deg < physics.upper_deg or not physics.stop_lower_deg < physics.stop_upper_deg:
        raise ConfigError("effects.position_limit: lower_deg must be below upper_deg")
    return physics


def effect_of(name: str, given: Mapping[str, float | str]) -> Effect:
    """One effect of an effects table, with its values.

    Examples
    --------
    >>> effect_of("backlash", {"width_deg": 0.8})
    Backlash(0.8)
    """
    effect = _effect(name, given)
    return effect(*(_value(name, parameter, given) for parameter in effect.parameters))


def table_of(effects: Sequence[type[Effect]], values: FloatArray) -> EffectTable:
    """Table of effects that were found, their parameters in order; the inverse of `effects_installed`.

    Examples
    --------
    >>> from servofd.servo.effects.linkage import RateLimit
    >>> table_of([RateLimit], np.array([88.1234567]))
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


def _default(name: str, given: set[str]) -> type[Effect] | None:
    """The first form that has the parameters that are given."""
    forms = [e for e in effects_named(name) if given <= {p.name for p in e.parameters}]
    return forms[0] if forms else None


def _effect(name: str, given: Mapping[str, float | str]) -> type[Effect]:
    forms = effects_named(name)
    if not forms:
        raise UnknownName("effects: " + suggest("effect", name, dict.fromkeys(effect.name for effect in catalogue())))
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
        raise ConfigError(f"{where}: give it too, a number from {parameter.low:g} to {parameter.high:g}")
    value = given[parameter.name]
    # Just outside counts as on the bound: files hold rounded numbers.
    margin = 1e-6 * (parameter.high - parameter.low)
    if isinstance(value, str | bool) or not math.isfinite(value):
        raise ConfigError(f"{where}: must be a number from {parameter.low:g} to {parameter.high:g}, not {value!r}")
    if not parameter.low - margin <= value <= parameter.high + margin:
        raise ConfigError(f"{where}: must lie between {parameter.low:g} and {parameter.high:g}, not {value:g}")
    return float(value)
