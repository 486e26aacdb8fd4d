"""Faults that the simulator can put into a servo, each at a chosen time.

Adding one is adding a class here and a line in `FAULTS`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Protocol

import numpy as np

from servofd.errors import ConfigError
from servofd.models.play import play

if TYPE_CHECKING:
    from collections.abc import Callable

    from servofd.models.servo_model import ServoModel
    from servofd.types import FloatArray

__all__ = ["FAULTS", "DeadBand", "Fault", "Stuck"]


class Fault(Protocol):
    """A way a servo can fail from some instant on."""

    kind: ClassVar[str]

    @property
    def start_s(self) -> float:
        """When it sets in [s]."""

    def deflection(
        self, model: ServoModel, command_s: FloatArray, command_deg: FloatArray, at_s: FloatArray
    ) -> FloatArray:
        """Deflection of the failing servo [deg], shape (m,), at the times `at_s` [s], shape (m,)."""


@dataclass(frozen=True, slots=True)
class Stuck:
    """The shaft jams (thesis 4.2.2): where it happens to be, or at `position_deg` once it is there.

    Examples
    --------
    >>> from servofd.models.servo_model import ServoModel
    >>> from servofd.servos import servo_named
    >>> t = np.arange(0.0, 2.0, 0.5)
    >>> Stuck(1.0).deflection(ServoModel.of(servo_named("s9254")), t, 10.0 * t, t).round(2)
    array([0., 0., 5., 5.])
    """

    kind: ClassVar[str] = "stuck"
    start_s: float
    position_deg: float | None = None

    def deflection(
        self, model: ServoModel, command_s: FloatArray, command_deg: FloatArray, at_s: FloatArray
    ) -> FloatArray:
        """Deflection up to the jam, then the same for ever."""
        if self.position_deg is not None:
            before = command_s < self.start_s
            command_s = np.append(command_s[before], self.start_s)
            command_deg = np.append(command_deg[before], self.position_deg)
            return model.simulate(command_s, command_deg, at_s)
        deflection = model.simulate(command_s, command_deg, np.sort(np.append(at_s, self.start_s)))
        jam = int(np.searchsorted(at_s, self.start_s))
        return np.concatenate([deflection[:jam], np.full(at_s.size - jam, deflection[jam])])


@dataclass(frozen=True, slots=True)
class DeadBand:
    """Increased dead band or stiction (thesis 4.2.1): the servo rests until it is `width_deg` / 2 off its command."""

    kind: ClassVar[str] = "deadband"
    start_s: float
    width_deg: float = 3.0

    def __post_init__(self) -> None:
        if not self.width_deg > 0.0:
            raise ConfigError(f"deadband: width_deg must be positive, not {self.width_deg}")

    def deflection(
        self, model: ServoModel, command_s: FloatArray, command_deg: FloatArray, at_s: FloatArray
    ) -> FloatArray:
        """Deflection of a servo that sees its command through a dead zone."""
        later = int(np.searchsorted(command_s, self.start_s))
        start = command_deg[max(later - 1, 0)]
        seen = np.concatenate([command_deg[:later], play(command_deg[later:], self.width_deg, start)])
        return model.simulate(command_s, seen, at_s)


FAULTS: dict[str, Callable[..., Fault]] = {fault.kind: fault for fault in (Stuck, DeadBand)}
"""Faults that a user can ask for by name."""
