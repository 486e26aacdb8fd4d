"""What a missing effect is: a place, parameters with their bounds, and what a log must hold to judge it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

from servofd.servo.effects import Place

if TYPE_CHECKING:
    from servofd.servo.physics import Physics

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
