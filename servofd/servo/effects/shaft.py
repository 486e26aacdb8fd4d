"""Effects on the shaft: loads, friction, the largest speed, stops of the servo."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import ClassVar

from servofd.servo.effect import SELDOM, Effect, Now, Parameter, Slot
from servofd.servo.effects.commands import LARGEST_SPEED
from servofd.servo.effects.linkage import PositionLimit
from servofd.servo.effects.motor import UNFOLLOWED, VoltageRate
from servofd.servo.loop import AFTER, BEFORE, INSIDE

SPLIT = Parameter("torque_share", ("torque_share",), 0.35, 0.97, 0.8, 0.2, (0.8,), aside=True)
"""Where in the motor a load acts is not in the servo's poles; it changes no linear motion and no steady state."""
_FRICTION_DEG = (0.05, 0.1, 0.2, 0.4, 0.7, 1.2, 2.0)
"""Sizes of friction from which a search starts."""
_STRIBECK_DEG_S = 10.0
"""Speed at which most of what friction is larger at rest is gone: of grease and bushings."""
_RAD_PER_DEG = math.pi / 180.0
"""For the sine of an angle in degrees."""


class AirLoad(Effect):
    """Hinge moment of the air, which takes deflection away."""

    name, slot, rank = "airload", Slot.LOAD, 18
    spoken = "a surface that yields to the airload"
    needs = ("airspeed_m_s",)
    sees = ("airload_per_pa",)
    parameters = (
        Parameter(
            "deg_per_deg_pa", ("airload_per_pa",), -2e-3, 2e-2, 0.0, 2e-4, (-2e-4, 5e-5, 1.5e-4, 4e-4, 1e-3, 2.5e-3)
        ),
        SPLIT,
    )

    @staticmethod
    def act(x: float, now: Now, per_pa: float) -> float:
        return x + per_pa * now.pressure_pa * now.position_deg


class AirTrim(Effect):
    """Hinge moment of the air on a surface at 0 deg."""

    name, slot, searched = "air_trim", Slot.LOAD, False
    needs = ("airspeed_m_s",)
    parameters = (Parameter("deg_per_pa", ("air_trim_per_pa",), -0.02, 0.02, 0.0, 1e-3),)

    @staticmethod
    def act(x: float, now: Now, per_pa: float) -> float:
        return x + per_pa * now.pressure_pa


class GravityLoad(Effect):
    """Weight on the horn, straight below it at 0 deg."""

    name, slot, rank = "gravity_load", Slot.LOAD, 26
    spoken = "a load that hangs on it"
    varies = True
    sees = ("droop_deg", "hangs_deg")
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter(
            "droop_deg", ("droop_deg",), -180.0, 180.0, 0.0, 2.0, (-2.0, 1.0, 3.0, 8.0, 20.0, 45.0), smallest=0.1
        ),
        SPLIT,
    )

    @staticmethod
    def act(x: float, now: Now, droop_deg: float, hangs_deg: float) -> float:
        return x + droop_deg * math.sin((now.position_deg - hangs_deg) * _RAD_PER_DEG)


class TiltedLoad(GravityLoad):
    """Weight on the horn of a servo whose angles are counted from elsewhere: the joint of an arm."""

    form, rank, varies = "hanging elsewhere", 27, False
    parameters = (
        replace(GravityLoad.parameters[0], grid=(1.0, 3.0, 8.0, 20.0)),
        Parameter("hangs_deg", ("hangs_deg",), -360.0, 360.0, 0.0, 30.0, (-150.0, -90.0, -30.0, 30.0, 90.0, 150.0)),
        SPLIT,
    )


class ExternalLoad(Effect):
    """Force or torque that was logged, on the shaft: so many degrees for each of its units."""

    name, slot, rank = "external_load", Slot.LOAD, 28
    spoken = "the load that was logged"
    needs = ("servo_load",)
    sees = ("load_deg",)
    parameters = (
        Parameter("deg_per_unit", ("load_deg",), -1e5, 1e5, 0.0, 0.5, (-2.5, -0.85, -0.3, 0.3, 0.85, 2.5)),
        Parameter("late_s", ("load_late_s",), -0.1, 0.1, 0.0, 0.01, (0.0,), aside=True),
        SPLIT,
    )

    @staticmethod
    def act(x: float, now: Now, deg_per_unit: float) -> float:
        return x - deg_per_unit * now.external


class Friction(Effect):
    """Coulomb friction and stiction, as the position error that breaks it."""

    name, slot, family, rank = "friction", Slot.GRIP, "hysteresis", 15
    spoken = "friction"
    sound, advice = 0.3, "check for binding, and the gear"
    longest_s, places, varies, at_rest = 2e-3, (BEFORE, INSIDE, AFTER), True, 6
    sees = ("friction_deg", "stribeck")
    parameters = (
        Parameter("friction_deg", ("friction_deg",), 0.0, 10.0, 0.0, 0.15, _FRICTION_DEG, loose=1.0, smallest=0.08),
        SPLIT,
    )

    @staticmethod
    def act(x: float, now: Now, friction_deg: float, stribeck: float) -> float:
        slip = now.speed_deg_s / _STRIBECK_DEG_S
        return x + friction_deg * (1.0 + stribeck * math.exp(-slip * slip) if stribeck > 0.0 else 1.0)


class StribeckFriction(Friction):
    """Friction that is larger at rest than at speed (Stribeck): usual of grease and bushings."""

    form, rank, at_rest = "Stribeck", 16, 0
    parameters = (Friction.parameters[0], Parameter("stribeck", ("stribeck",), 0.0, 1.0, 0.0, 0.3, (0.3,), aside=True))


class LoadFriction(Effect):
    """Friction that grows with the motor's effort."""

    name, slot, rank = "load_friction", Slot.GRIP, 29
    spoken = "friction under load"
    longest_s, surprise, instead = Friction.longest_s, SELDOM, ("friction",)
    sees = ("load_friction",)
    parameters = (
        Parameter("share", ("load_friction",), 0.0, 0.95, 0.0, 0.1, (0.05, 0.15, 0.3, 0.6), smallest=0.03),
        SPLIT,
    )

    @staticmethod
    def act(x: float, now: Now, share: float) -> float:
        return x + share * now.effort_deg


class ShaftSpeed(Effect):
    """Largest speed of the shaft, whatever drives it: gear and bearings at their end, while the loop does not wait."""

    name, slot, form, fixed, rank = "rate_limit", Slot.SPEED, "shaft", UNFOLLOWED, 9
    spoken = "a rate limit"
    longest_s, places, varies = 1.25e-3, (BEFORE, AFTER, INSIDE), True
    parameters = (LARGEST_SPEED(fields=("speed_up_deg_s", "speed_down_deg_s")),)

    @staticmethod
    def act(x: float, now: Now, up_deg_s: float, down_deg_s: float) -> float:
        return min(max(x, -down_deg_s), up_deg_s)


class ShaftSpeedBySupply(VoltageRate):
    """Largest speed of the shaft in proportion to the supply."""

    slot, form, rank, longest_s = Slot.SPEED, "shaft", 20, ShaftSpeed.longest_s
    places, sees = (BEFORE, AFTER, INSIDE), ("speed_deg_s_per_v",)
    parameters = (replace(VoltageRate.parameters[0], fields=("speed_deg_s_per_v",)),)

    @staticmethod
    def act(x: float, now: Now, deg_s_per_v: float) -> float:
        most = deg_s_per_v * now.supply_v
        return min(max(x, -most), most)


class ServoStop(Effect):
    """Stops that block the servo itself."""

    name, slot, form, rank = "position_limit", Slot.STOP, "servo", 11
    spoken = "a stop"
    parameters = tuple(replace(each, fields=(f"stop_{each.name}",)) for each in PositionLimit.parameters)

    @staticmethod
    def act(x: float, now: Now, lower_deg: float, upper_deg: float) -> float:
        return min(max(x, lower_deg), upper_deg)
