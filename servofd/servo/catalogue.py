"""The effects that may be missing from a servo's model: adding one is adding a class and a line in `CATALOGUE`.

An effect says where it acts, which parameters it has, within which bounds they are physical, how large they may be on
a healthy servo, and what the log must hold to judge it. A parameter names the fields of
`servofd.servo.physics.Physics` that it sets; the kernel knows what they do.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from servofd.core.errors import ConfigError, UnknownName, suggest
from servofd.servo.effects import Extension, MissingEffect, Parameter, Place, Plan, neutral_of
from servofd.servo.physics import AFTER, BEFORE, INSIDE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.core.types import FloatArray
    from servofd.servo.physics import Physics


def installed(physics: Physics, effects: Sequence[type[MissingEffect]], values: Sequence[float]) -> Physics:
    """Servo with these effects, their parameters given in order."""
    changes: dict[str, float] = {}
    for effect in effects:
        changes |= effect.fixed
    parameters = [parameter for effect in effects for parameter in effect.parameters]
    for parameter, value in zip(parameters, values, strict=True):
        changes |= dict.fromkeys(parameter.fields, float(value))
    return physics._replace(**changes)


_SPLIT = Parameter("torque_share", ("torque_share",), 0.35, 0.97, 0.8, 0.2, (0.8,), aside=True)
"""Where in the motor a load acts is not in the servo's poles."""
_INFINITE = float("inf")
_UNFOLLOWED = {"follow_up_deg_s": _INFINITE, "follow_down_deg_s": _INFINITE}
_WIDTHS_DEG = (0.1, 0.2, 0.4, 0.8, 1.4, 2.2, 3.5, 6.0)
_RATES_DEG_S = (20.0, 30.0, 45.0, 60.0, 80.0, 105.0, 140.0, 180.0, 240.0, 320.0, 420.0, 600.0)
_RATES_DEG_S_PER_V = (1.4, 2.5, 4.0, 7.0, 11.0, 16.0, 22.0, 30.0, 45.0, 70.0)


_STEPS_DEG = (360.0 / 4096.0, *(round(0.1 + 0.05 * k, 2) for k in range(39)), 0.18, 360.0 / 1024.0, 2.5, 3.0)


class Bias(MissingEffect):
    """Trim that was lost, or a sensor's zero."""

    name, place = "bias", Place.SENSOR
    parameters = (Parameter("bias_deg", ("bias_deg",), -30.0, 30.0, 0.0, 0.3, (-1.0, 1.0)),)


class Gain(MissingEffect):
    """Horn or linkage of another ratio, or a sensor's scale."""

    name, place = "gain", Place.LINKAGE
    parameters = (Parameter("gain", ("gain",), 0.2, 2.0, 1.0, 0.03, (0.8, 0.95, 1.05, 1.2)),)


class Delay(MissingEffect):
    """Total transport delay of the command."""

    name, place = "delay", Place.LINK
    family = "lag"
    parameters = (
        Parameter("delay_s", ("delay_s",), 0.0, 0.5, 0.0, 0.003, (0.0, 0.01, 0.02, 0.035, 0.06, 0.1, 0.16, 0.25)),
    )


class ClockOffset(MissingEffect):
    """Positions stamped too late (positive) or too early."""

    name, place = "clock_offset", Place.SENSOR
    family = "lag"
    parameters = (
        Parameter(
            "offset_s", ("offset_s",), -0.5, 0.5, 0.0, 0.003, (-0.15, -0.08, -0.04, -0.02, 0.01, 0.03, 0.06, 0.12, 0.2)
        ),
    )


class SlowDynamics(MissingEffect):
    """All poles scaled: a weak battery, a heavy surface."""

    name, place = "slow_dynamics", Place.SERVO
    parameters = (
        Parameter("bandwidth_scale", ("bandwidth_scale",), 0.1, 4.0, 1.0, 0.1, (0.3, 0.45, 0.6, 0.75, 0.9, 1.15, 1.5)),
    )


class Damping(MissingEffect):
    """Damping of the fast pair of poles scaled."""

    name, place = "damping", Place.SERVO
    parameters = (Parameter("damping_scale", ("damping_scale",), 0.1, 6.0, 1.0, 0.1, (0.4, 0.7, 1.4, 2.2)),)


class RateLimit(MissingEffect):
    """Largest speed of the motor: the position error saturates, the loop waits."""

    name, place, form, fixed = "rate_limit", Place.SERVO, "motor", _UNFOLLOWED
    parameters = (
        Parameter("rate_limit_deg_s", ("rate_up_deg_s", "rate_down_deg_s"), 2.0, 3e3, 3e3, 60.0, _RATES_DEG_S),
    )


class FollowedRate(MissingEffect):
    """Largest speed of the output, which follows what a faster servo would do."""

    name, place, form = "rate_limit", Place.SERVO, "output"
    parameters = (
        Parameter("rate_limit_deg_s", ("follow_up_deg_s", "follow_down_deg_s"), 2.0, 3e3, 3e3, 60.0, _RATES_DEG_S),
    )


class ShaftSpeed(MissingEffect):
    """Largest speed of the shaft, whatever drives it: gear and bearings at their end, while the loop does not wait."""

    name, place, form, fixed = "rate_limit", Place.SERVO, "shaft", _UNFOLLOWED
    parameters = (
        Parameter("rate_limit_deg_s", ("speed_up_deg_s", "speed_down_deg_s"), 2.0, 3e3, 3e3, 60.0, _RATES_DEG_S),
    )


class AsymmetricRate(MissingEffect):
    """Largest speed of the motor, different in the two directions: a load that pulls one way."""

    name, place, form, fixed = "rate_limit", Place.SERVO, "motor, asymmetric", _UNFOLLOWED
    parameters = (
        Parameter("rate_up_deg_s", ("rate_up_deg_s",), 2.0, 3e3, 3e3, 60.0, (20.0, 40.0, 90.0, 180.0, 350.0)),
        Parameter("rate_down_deg_s", ("rate_down_deg_s",), 2.0, 3e3, 3e3, 60.0, (20.0, 40.0, 90.0, 180.0, 350.0)),
    )


class SetPointRate(MissingEffect):
    """Largest speed of the set point: firmware that lets no step through to the position loop."""

    name, place, form = "rate_limit", Place.LINK, "set point"
    parameters = (Parameter("rate_limit_deg_s", ("set_point_deg_s",), 2.0, 3e3, 3e3, 60.0, _RATES_DEG_S),)


class VoltageRate(MissingEffect):
    """Largest speed of the motor in proportion to its supply."""

    name, place, fixed, needs = "voltage_rate", Place.SERVO, _UNFOLLOWED, ("servo_voltage_v",)
    parameters = (Parameter("deg_s_per_v", ("deg_s_per_v",), 0.5, 600.0, 600.0, 12.0, _RATES_DEG_S_PER_V),)


class ShaftSpeedBySupply(MissingEffect):
    """Largest speed of the shaft in proportion to the supply."""

    name, place, form, fixed = "voltage_rate", Place.SERVO, "shaft", _UNFOLLOWED
    needs = ("servo_voltage_v",)
    parameters = (
        Parameter(
            "deg_s_per_v",
            ("speed_deg_s_per_v",),
            0.5,
            600.0,
            600.0,
            12.0,
            _RATES_DEG_S_PER_V,
        ),
    )


class CurrentLimit(MissingEffect):
    """Supply that cannot give more current: the torque grows with the root of large position errors.

    The duty cycle is proportional to the error, and what the bridge draws from a limited supply to its square
    (Rhoban's bam notes the same law for XL330 servos); linear well below the knee.
    """

    name, place = "current_limit", Place.SERVO
    parameters = (Parameter("knee_deg", ("knee_deg",), 0.3, 1e3, 1e3, 300.0, (1.0, 3.0, 8.0, 20.0, 50.0)),)


class DeadBand(MissingEffect):
    """Position error that the servo's controller ignores, counted from the edge."""

    name, place, form = "deadband", Place.SERVO, "error from the edge"
    family = "hysteresis"
    parameters = (Parameter("width_deg", ("deadband_deg",), 0.0, 20.0, 0.0, 0.3, _WIDTHS_DEG),)


class InsensitiveBand(MissingEffect):
    """Position error below which the motor is off, and above which it sees all of it."""

    name, place, form = "deadband", Place.SERVO, "whole error"
    family = "hysteresis"
    parameters = (Parameter("width_deg", ("insensitive_deg",), 0.0, 20.0, 0.0, 0.3, _WIDTHS_DEG),)


class Backlash(MissingEffect):
    """Free play of gear and linkage."""

    name, place = "backlash", Place.LINKAGE
    family = "hysteresis"
    parameters = (Parameter("width_deg", ("backlash_deg",), 0.0, 8.0, 0.0, 0.3, _WIDTHS_DEG),)


class Friction(MissingEffect):
    """Coulomb friction and stiction, as the position error that breaks it."""

    name, place = "friction", Place.SERVO
    family = "hysteresis"
    parameters = (
        Parameter("friction_deg", ("friction_deg",), 0.0, 10.0, 0.0, 0.15, (0.05, 0.1, 0.2, 0.4, 0.7, 1.2, 2.0)),
        _SPLIT,
    )


class StribeckFriction(MissingEffect):
    """Friction that is larger at rest than at speed (Stribeck): usual of grease and bushings."""

    name, place, form, family = "friction", Place.SERVO, "Stribeck", "hysteresis"
    parameters = (
        Parameter("friction_deg", ("friction_deg",), 0.0, 10.0, 0.0, 0.15, (0.05, 0.1, 0.2, 0.4, 0.7, 1.2, 2.0)),
        Parameter("stribeck", ("stribeck",), 0.0, 1.0, 0.0, 0.3, (0.3,), aside=True),
    )


class LoadFriction(MissingEffect):
    """Friction that grows with the motor's effort."""

    name, place = "load_friction", Place.SERVO
    parameters = (Parameter("share", ("load_friction",), 0.0, 0.95, 0.0, 0.1, (0.05, 0.15, 0.3, 0.6)), _SPLIT)


class AirLoad(MissingEffect):
    """Hinge moment of the air, which takes deflection away."""

    name, place, needs = "airload", Place.SERVO, ("airspeed_m_s",)
    parameters = (
        Parameter(
            "deg_per_deg_pa", ("airload_per_pa",), -2e-3, 2e-2, 0.0, 2e-4, (-2e-4, 5e-5, 1.5e-4, 4e-4, 1e-3, 2.5e-3)
        ),
        _SPLIT,
    )


class GravityLoad(MissingEffect):
    """Weight on the horn, hanging at 0 deg."""

    name, place = "gravity_load", Place.SERVO
    parameters = (
        Parameter("droop_deg", ("droop_deg",), -180.0, 180.0, 0.0, 2.0, (-2.0, 1.0, 3.0, 8.0, 20.0, 45.0)),
        _SPLIT,
    )


class TiltedLoad(MissingEffect):
    """Weight on the horn of a servo whose angles are counted from elsewhere: the joint of an arm."""

    name, place, form = "gravity_load", Place.SERVO, "hanging elsewhere"
    parameters = (
        Parameter("droop_deg", ("droop_deg",), -180.0, 180.0, 0.0, 2.0, (1.0, 3.0, 8.0, 20.0)),
        Parameter("hangs_deg", ("hangs_deg",), -360.0, 360.0, 0.0, 30.0, (-150.0, -90.0, -30.0, 30.0, 90.0, 150.0)),
        _SPLIT,
    )


class ExternalLoad(MissingEffect):
    """Force or torque that was logged, on the shaft: so many degrees for each of its units."""

    name, place, needs = "external_load", Place.SERVO, ("servo_load",)
    parameters = (
        Parameter("deg_per_unit", ("load_deg",), -1e5, 1e5, 0.0, 0.5, (-2.5, -0.85, -0.3, 0.3, 0.85, 2.5)),
        Parameter("late_s", ("load_late_s",), -0.1, 0.1, 0.0, 0.01, (0.0,), aside=True),
        _SPLIT,
    )


class PositionLimit(MissingEffect):
    """Stops of the linkage: the surface waits there while the servo goes on."""

    name, place, form = "position_limit", Place.LINKAGE, "linkage"
    parameters = (
        Parameter("lower_deg", ("lower_deg",), -90.0, 0.0, -90.0, 2.0, (-15.0, -10.0, -6.0, -4.0, -2.0)),
        Parameter("upper_deg", ("upper_deg",), 0.0, 90.0, 90.0, 2.0, (2.0, 4.0, 6.0, 10.0, 15.0)),
    )


class ServoStop(MissingEffect):
    """Stops that block the servo itself."""

    name, place, form = "position_limit", Place.LINKAGE, "servo"
    parameters = (
        Parameter("lower_deg", ("stop_lower_deg",), -90.0, 0.0, -90.0, 2.0, (-15.0, -10.0, -6.0, -4.0, -2.0)),
        Parameter("upper_deg", ("stop_upper_deg",), 0.0, 90.0, 90.0, 2.0, (2.0, 4.0, 6.0, 10.0, 15.0)),
    )


class PwmFrame(MissingEffect):
    """Commands wait for the next pulse frame."""

    name, place = "pwm_frame", Place.LINK
    parameters = (
        Parameter("period_s", ("frame_s",), 2e-3, 0.2, 0.0, 0.02, (), True, width=2e-6),
        Parameter("phase", ("frame_phase",), -1.0, 2.0, 0.0, 0.5, (), True, width=0.06),
    )


class SensorLag(MissingEffect):
    """First-order filter of the position sensor."""

    name, place = "sensor_lag", Place.SENSOR
    parameters = (
        Parameter("time_constant_s", ("lag_s",), 0.0, 1.0, 0.0, 0.01, (0.003, 0.008, 0.016, 0.03, 0.06, 0.12, 0.25)),
    )


class Quantization(MissingEffect):
    """Steps of the position sensor."""

    name, place, form = "quantization", Place.SENSOR, "position"
    parameters = (Parameter("step_deg", ("output_step_deg",), 0.02, 10.0, 0.0, 0.1, _STEPS_DEG, True),)


class SupplyCoupling(MissingEffect):
    """Reading that moves with the servo's current, because both hang on one supply: nothing has moved."""

    name, place, needs = "supply_coupling", Place.SENSOR, ("servo_current_a",)
    parameters = (Parameter("deg_per_a", ("deg_per_a",), -20.0, 20.0, 0.0, 0.3, (-1.0, 1.0)),)


class CommandSteps(MissingEffect):
    """Steps of the command."""

    name, place, form = "quantization", Place.LINK, "command"
    parameters = (Parameter("step_deg", ("command_step_deg",), 0.02, 10.0, 0.0, 0.1, _STEPS_DEG, True),)


class LinkageNonlinearity(MissingEffect):
    """Geometry of horn and rod: the ratio changes with the deflection."""

    name, place = "linkage_nonlinearity", Place.LINKAGE
    parameters = (
        Parameter("quadratic_per_deg", ("quadratic_per_deg",), -0.05, 0.05, 0.0, 2e-3, (-4e-3, 4e-3), travel_power=1),
        Parameter("cubic_per_deg2", ("cubic_per_deg2",), -5e-3, 5e-3, 0.0, 2e-4, (-4e-4, 4e-4), travel_power=2),
    )


class Resonance(MissingEffect):
    """Flexible linkage between servo and surface."""

    name, place = "resonance", Place.LINKAGE
    parameters = (
        Parameter(
            "frequency_hz",
            ("resonance_hz",),
            1.0,
            80.0,
            80.0,
            30.0,
            (3.0, 4.0, 5.0, 6.5, 8.0, 10.0, 12.5, 16.0, 20.0, 26.0, 34.0),
        ),
        Parameter("damping_ratio", ("resonance_damping",), 5e-3, 0.5, 0.05, 0.05, (0.03, 0.15)),
    )


CATALOGUE: tuple[type[MissingEffect], ...] = (
    Bias,
    Gain,
    Delay,
    ClockOffset,
    SlowDynamics,
    RateLimit,
    FollowedRate,
    SetPointRate,
    ShaftSpeed,
    PositionLimit,
    ServoStop,
    DeadBand,
    InsensitiveBand,
    Backlash,
    Friction,
    StribeckFriction,
    SensorLag,
    AirLoad,
    VoltageRate,
    ShaftSpeedBySupply,
    PwmFrame,
    Quantization,
    CommandSteps,
    SupplyCoupling,
    Damping,
    GravityLoad,
    TiltedLoad,
    ExternalLoad,
    LoadFriction,
    CurrentLimit,
    AsymmetricRate,
    LinkageNonlinearity,
    Resonance,
)
"""Simple before flexible: where data cannot tell two effects apart, the earlier one is named."""


class Poles(MissingEffect):
    """How a servo's poles differ from those of its type, and where the slow one acts: part of a model, no effect."""

    name, place, form, fixed = "poles", Place.SERVO, "inside", {"slow_place": INSIDE}
    parameters = (
        Parameter("slow_scale", ("slow_scale",), 0.02, 50.0, 1.0, 0.03, ()),
        Parameter("pair_scale", ("pair_scale",), 0.02, 50.0, 1.0, 0.03, ()),
        Parameter("damping_scale", ("damping_scale",), 0.02, 50.0, 1.0, 0.06, ()),
    )


class PolesBefore(Poles):
    """The same of a servo whose slow pole filters the command."""

    form, fixed = "before", {"slow_place": BEFORE}


class PolesAfter(Poles):
    """The same of a servo whose slow pole filters what the loop moves."""

    form, fixed = "after", {"slow_place": AFTER}


OWN: tuple[type[MissingEffect], ...] = (Poles, PolesBefore, PolesAfter)


def effects_named(name: str) -> tuple[type[MissingEffect], ...]:
    """All forms of an effect."""
    return tuple(effect for effect in (*CATALOGUE, *OWN) if effect.name == name)


VARIED: tuple[type[MissingEffect], ...] = (
    RateLimit,
    ShaftSpeed,
    FollowedRate,
    SetPointRate,
    GravityLoad,
    Friction,
    StribeckFriction,
    DeadBand,
    Backlash,
    CurrentLimit,
    Gain,
    Bias,
    Delay,
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
