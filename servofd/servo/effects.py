"""Effects: the small parts a servo model is made of, each at the place where it acts.

A model sorts its effects by place, because a rate limit before a stop and a stop before a rate limit are different
machines. Those that a user can add by name are in `servofd.servo.catalogue`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import ClassVar, Literal, Protocol

from servofd.core.errors import ConfigError
from servofd.servo.physics import Physics, scaled_transfer
from servofd.servo.transfer import TransferFunction


class Place(IntEnum):
    """Where along the way from autopilot to surface an effect acts."""

    LINK = 1
    SERVO = 2
    LINKAGE = 3
    SENSOR = 4
    WHOLE = 5
    """Effects of all places together."""


@dataclass(frozen=True, slots=True)
class Plan:
    """All effects of a model together, as the kernel needs them; the defaults are a perfect servo's."""

    delay_s: float = 0.0
    transfer: TransferFunction | None = None
    rate_down_deg_s: float = float("inf")
    rate_up_deg_s: float = float("inf")
    lower_deg: float = float("-inf")
    upper_deg: float = float("inf")
    physics: Physics | None = None
    """Effects beyond these, for the kernel of the position loop."""


class Effect(Protocol):
    """A piece of servo physics."""

    name: ClassVar[str]
    place: ClassVar[Place]

    def install(self, plan: Plan) -> Plan:
        """Add this effect to what the effects before it have planned."""


@dataclass(frozen=True, slots=True)
class Delay:
    """Transport delay between the logged command and the servo; several add up.

    Examples
    --------
    >>> Delay(0.004).install(Plan(delay_s=0.01)).delay_s
    0.014
    """

    name: ClassVar[str] = "delay"
    place: ClassVar[Place] = Place.LINK
    delay_s: float

    def __post_init__(self) -> None:
        if not 0.0 <= self.delay_s < float("inf"):
            raise ConfigError(f"delay: delay_s must be zero or more, not {self.delay_s}")

    def install(self, plan: Plan) -> Plan:
        """Lengthen the delay."""
        return replace(plan, delay_s=plan.delay_s + self.delay_s)


@dataclass(frozen=True, slots=True)
class LinearDynamics:
    """Linear response of the servo to its command (thesis Eq. 3.1)."""

    name: ClassVar[str] = "linear_dynamics"
    place: ClassVar[Place] = Place.SERVO
    transfer: TransferFunction

    def install(self, plan: Plan) -> Plan:
        """Set the dynamics; a servo has one response."""
        return replace(plan, transfer=self.transfer)


@dataclass(frozen=True, slots=True)
class RateLimit:
    """Largest speed of the output shaft, the same or different in the two directions."""

    name: ClassVar[str] = "rate_limit"
    place: ClassVar[Place] = Place.SERVO
    rate_limit_deg_s: float
    rate_down_deg_s: float | None = None

    def __post_init__(self) -> None:
        if not (self.rate_limit_deg_s > 0.0 and (self.rate_down_deg_s is None or self.rate_down_deg_s > 0.0)):
            raise ConfigError(f"rate_limit: rates must be positive [deg/s], not {self}")

    def install(self, plan: Plan) -> Plan:
        """Keep the tighter of the limits."""
        down = self.rate_limit_deg_s if self.rate_down_deg_s is None else self.rate_down_deg_s
        return replace(
            plan,
            rate_up_deg_s=min(plan.rate_up_deg_s, self.rate_limit_deg_s),
            rate_down_deg_s=min(plan.rate_down_deg_s, down),
        )


@dataclass(frozen=True, slots=True)
class PositionLimit:
    """Stops of the linkage.

    Examples
    --------
    >>> PositionLimit(-25.0, 25.0).install(Plan()).upper_deg
    25.0
    """

    name: ClassVar[str] = "position_limit"
    place: ClassVar[Place] = Place.LINKAGE
    lower_deg: float
    upper_deg: float

    def __post_init__(self) -> None:
        if not self.lower_deg < self.upper_deg:
            raise ConfigError(f"position_limit: lower_deg must be below upper_deg, not {self}")

    def install(self, plan: Plan) -> Plan:
        """Keep the tighter of the stops."""
        return replace(
            plan, lower_deg=max(plan.lower_deg, self.lower_deg), upper_deg=min(plan.upper_deg, self.upper_deg)
        )


@dataclass(frozen=True, slots=True)
class Extension:
    """All that a servo has beyond its linear model, as ``servofd explain`` finds it.

    Its delay and limits take the place of those that the servo had before; scaled poles become poles.

    Examples
    --------
    >>> Extension(Physics(delay_s=0.03, backlash_deg=0.5)).install(Plan(delay_s=0.004)).delay_s
    0.03
    """

    name: ClassVar[str] = "extension"
    place: ClassVar[Place] = Place.WHOLE
    physics: Physics

    def install(self, plan: Plan) -> Plan:
        """Replace what was planned before by what was found."""
        physics = self.physics
        transfer = scaled_transfer(plan.transfer, physics) if plan.transfer else None
        return replace(
            plan,
            delay_s=physics.delay_s,
            transfer=transfer,
            rate_up_deg_s=physics.follow_up_deg_s,
            rate_down_deg_s=physics.follow_down_deg_s,
            lower_deg=physics.lower_deg,
            upper_deg=physics.upper_deg,
            physics=physics._replace(bandwidth_scale=1.0, slow_scale=1.0, pair_scale=1.0, damping_scale=1.0),
        )


def neutral_of(plan: Plan) -> Physics:
    """Delay and limits of a servo, and its effects if it has any."""
    return plan.physics or Physics(
        delay_s=plan.delay_s,
        follow_up_deg_s=plan.rate_up_deg_s,
        follow_down_deg_s=plan.rate_down_deg_s,
        lower_deg=plan.lower_deg,
        upper_deg=plan.upper_deg,
    )


Context = Literal["airspeed_m_s", "servo_voltage_v", "servo_current_a", "servo_load"]

_AT_BOUND, _NEAR = 1e-3, 0.1
"""Share of the range, and of the lower bound, within which a value is at it."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number of an effect, in the unit that its name ends with."""

    name: str
    fields: tuple[str, ...]
    """Of `Physics`, all set to the value."""
    low: float
    high: float
    neutral: float
    typical: float
    """Deviation from neutral that is common on a healthy servo."""
    grid: tuple[float, ...]
    """Values to start from."""
    kinked: bool = False
    """True if the error has many minima in it, and must be searched instead of descended."""
    aside: bool = False
    """True for a number of no interest that the effect needs to fit; it is neither reported nor judged."""

    travel_power: int = 0
    """Power of the deflection that it is multiplied with: the same effect is smaller on a servo that turns further."""
    width: float = 0.0
    """How far around the start the search goes; 0: to the neighbours on the grid."""

    def away(self, value: float, known: Physics) -> float:
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


class MissingEffect:
    """Physics that the model does not have; subclasses fill in the rest."""

    name: ClassVar[str]
    place: ClassVar[Place]
    parameters: ClassVar[tuple[Parameter, ...]]
    needs: ClassVar[tuple[Context, ...]] = ()
    form: ClassVar[str] = ""
    """Which machine it is, where several go by one name."""
    family: ClassVar[str] = ""
    """Effects that are alike at low frequency, and hardly told apart where anything else is unexplained."""
    fixed: ClassVar[dict[str, float]] = {}
    """Fields of `Physics` that the effect replaces."""

    @classmethod
    def key(cls) -> str:
        """Name and form."""
        return f"{cls.name} ({cls.form})" if cls.form else cls.name
