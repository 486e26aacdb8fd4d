"""What was found on an axis, in data types that outputs can show."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:
    from servofd.aircraft.axes import AxisModel
    from servofd.core.types import FloatArray
    from servofd.estimate.axis_windows import Inputs
    from servofd.estimate.statistics import Estimate

AxisStatus = Literal["healthy", "suspect", "fault", "unknown"]


@dataclass(frozen=True, slots=True)
class AxisEvent:
    """A time in which an axis did not answer as it should.

    Parameters
    ----------
    start_s, alarm_s : float
        Best estimate of the onset, and when it would have been told in flight [s].
    end_s : float or None
        When the axis answered again [s]; None if it never did.
    score : float
        Largest statistic, as a multiple of the calibration flights' largest.
    lost_share : Estimate
        lambda.
    offset_us : Estimate
        beta [us].
    cause : str
        Another axis whose event explains this one; empty if this is the cause.
    lag_s : Estimate or None
        tau [s], if the axis answers late rather than too little.
    from_start : bool
        Whether the flight differed from its first judged seconds on: another trim, payload or aircraft, or a failure
        before take-off. What comes later is judged beyond it.
    known_s : float
        From when on what the axis became is known, and what comes is judged beyond it; inf if it never was [s].
    """

    start_s: float
    alarm_s: float
    end_s: float | None
    score: float
    lost_share: Estimate
    offset_us: Estimate
    cause: str = ""
    lag_s: Estimate | None = None
    from_start: bool = False
    known_s: float = math.inf

    @property
    def is_own(self) -> bool:
        """Whether something happened to this axis in flight."""
        return not self.cause and not self.from_start


class Detectable(NamedTuple):
    """Smallest fault of an axis that most of a flight would have told; inf where none would."""

    loss: float
    """Share of its effect."""
    offset_us: float


@dataclass(frozen=True, slots=True, eq=False)
class AxisAudit:
    """Verdict on one axis.

    Parameters
    ----------
    axis : str
        ``"roll"``, ``"pitch"``, ``"side"`` or ``"thrust"``.
    status : {"healthy", "suspect", "fault", "unknown"}
        `fault` only beyond the multiple of the threshold that the calibrated hours support.
    reason : str
        One sentence.
    members : tuple of str
        Surfaces that serve it; which of them failed cannot be told.
    lost_share, offset_us : Estimate or None
        Of the worst event; of the whole flight without one; None if nothing could be estimated, or where the command
        never moved on its own, which tells nothing of its effect.
    events : tuple of AxisEvent
        In order of time.
    identifiable : float
        Share of the flight in which lambda was known to less than +-0.3.
    detectable : Detectable
        What would have been told.
    judged_share : float
        Share of the flight inside the calibrated regime.
    false_alarms_per_hour : float
        To expect of this axis at its threshold.
    time_s, score : ndarray, shape (n,)
        Statistic over its threshold.
    inputs : Inputs
        Residual, and what a loss and an offset would leave in it.
    model : AxisModel
        By which it was judged.
    """

    axis: str
    status: AxisStatus
    reason: str
    members: tuple[str, ...]
    lost_share: Estimate | None
    offset_us: Estimate | None
    events: tuple[AxisEvent, ...]
    identifiable: float
    detectable: Detectable
    judged_share: float
    false_alarms_per_hour: float
    time_s: FloatArray
    score: FloatArray
    inputs: Inputs
    model: AxisModel

    @property
    def is_expected(self) -> bool:
        """Whether a verdict can be expected: not of a command that copies another, nor of the engine."""
        return self.axis != "thrust" and self.model.own_command

    @property
    def is_weaker(self) -> bool:
        """Whether it surely lost some of its effect (95 %), though no more than healthy flights may."""
        return self.lost_share is not None and self.lost_share.low > 0.0

    @property
    def asked(self) -> FloatArray:
        """Effect of the command that the model expects, in the unit of its form."""
        return -self.inputs.loss

    @property
    def shown(self) -> FloatArray:
        """What the motion shows of it."""
        return self.inputs.residual - self.inputs.loss

    @property
    def since_s(self) -> float | None:
        """Onset of the first event that is the axis' own [s]."""
        return next((event.start_s for event in self.events if event.is_own), None)
