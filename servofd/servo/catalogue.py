"""The effects that may be missing from a servo's model: adding one is adding a class and a line in `CATALOGUE`.

An effect says where it acts, which parameters it has, within which bounds they are physical, how large they may be on
a healthy servo, and what the log must hold to judge it. A parameter names the fields of
`servofd.servo.physics.Physics` that it sets; the kernel knows what they do.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from servofd.servo.effects import Place
from servofd.servo.missing_effect import MissingEffect, Parameter
from servofd.servo.physics import AFTER, BEFORE, INSIDE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.servo.physics import Physics


def installed(physics: Physics, effects: Sequence[type[MissingEffect]], values: Sequence[float]) -> Physics:
    """Servo with these effects, their parameters given in order.

    Examples
    --------
    >>> from servofd.servo.physics import Physics
    >>> installed(Physics(), [Backlash, Gain], [0.5, 0.9]).backlash_deg
    0.5
    """
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
    """All forms of an effect.

    Examples
    --------
    >>> [effect.form for effect in effects_named("rate_limit")]
    ['motor', 'output', 'set point', 'shaft', 'motor, asymmetric']
    """
    return tuple(effect for effect in (*CATALOGUE, *OWN) if effect.name == name)
