"""Verdicts on the surfaces and axes of a log, in data types that outputs can show."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from servofd.core.evidence import NAMED, NOTHING_DETECTABLE, Detectable, ModelOrigin

if TYPE_CHECKING:
    from logparsers.records import FlightLog
    from servofd.aircraft.axes import AxisModel
    from servofd.aircraft.schema import Aircraft
    from servofd.aircraft.segment import Segment
    from servofd.core.types import FloatArray
    from servofd.detection.bank.window import Fault
    from servofd.detection.residual import Residuals
    from servofd.detection.threshold import Threshold, ThresholdKind
    from servofd.estimate.axis_windows import Inputs
    from servofd.estimate.statistics import Estimate

_OUTLINE_PARTS = 60


@dataclass(frozen=True, slots=True)
class Statistics:
    """Size of the residual while it was judged [deg]."""

    mean_deg: float
    std_deg: float
    max_abs_deg: float
    simulation_error_rms_deg: float

    @classmethod
    def of(cls, residual_deg: FloatArray, error_deg: FloatArray) -> Statistics:
        """Of the residual and of the error of the simulation at the samples that were judged, shape (n,) each.

        Infinite where squares are no numbers any more: such positions are wrong, and their verdict needs no more.

        Examples
        --------
        >>> Statistics.of(np.array([1.0, -3.0]), np.array([0.5, 0.5]))
        Statistics(mean_deg=-1.0, std_deg=2.0, max_abs_deg=3.0, simulation_error_rms_deg=0.5)
        """
        with np.errstate(over="ignore", invalid="ignore"):
            return cls(
                mean_deg=float(np.mean(residual_deg)),
                std_deg=float(np.std(residual_deg)),
                max_abs_deg=float(np.max(np.abs(residual_deg))),
                simulation_error_rms_deg=float(np.sqrt(np.mean(error_deg**2))),
            )


def outline(time_s: FloatArray, residual_deg: FloatArray, level_deg: FloatArray) -> tuple[float | None, ...]:
    """Largest residual over its threshold in each of equal parts of the flight; None where nothing was judged.

    Of shape (n,) each; the residual is NaN where it was not judged.

    Examples
    --------
    >>> time_s = np.arange(600.0)
    >>> outline(time_s, np.where(time_s < 10.0, np.nan, time_s), np.full(600, 100.0))[:3]
    (None, 0.19, 0.29)
    """
    if time_s.size < 2:
        return ()
    share = np.abs(residual_deg) / level_deg
    edges_s = np.linspace(time_s[0], time_s[-1], _OUTLINE_PARTS + 1)[:-1]
    parts = np.split(share, np.searchsorted(time_s, edges_s)[1:])
    return tuple(round(float(np.nanmax(part)), 3) if np.isfinite(part).any() else None for part in parts)


AxisStatus = Literal["healthy", "suspect", "fault", "unknown"]


@dataclass(frozen=True, slots=True)
class AxisEvent:
    """A time in which an axis did not answer as it should."""

    start_s: float
    alarm_s: float
    """Best estimate of the onset, and when it would have been told in flight [s]."""
    end_s: float | None
    """When the axis answered again [s]; None if it never did."""
    score: float
    """Largest statistic, as a multiple of the calibration flights' largest."""
    lost_share: Estimate
    """lambda."""
    offset_us: Estimate
    """beta [us]."""
    cause: str = ""
    """Another axis whose event explains this one; empty if this is the cause."""
    lag_s: Estimate | None = None
    """tau [s], if the axis answers late rather than too little."""
    from_start: bool = False
    """Whether the flight differed from its first judged seconds on: another trim, payload or aircraft, or a failure
    before take-off. What comes later is judged beyond it."""
    known_s: float = math.inf
    """From when on what the axis became is known, and what comes is judged beyond it; inf if it never was [s]."""

    @property
    def is_own(self) -> bool:
        """Whether something happened to this axis in flight."""
        return not self.cause and not self.from_start


class AxisDetectable(NamedTuple):
    """Smallest fault of an axis that most of a flight would have told; inf where none would."""

    loss: float
    """Share of its effect."""
    offset_us: float


@dataclass(frozen=True, slots=True, eq=False)
class AxisAudit:
    """Verdict on one axis."""

    axis: str
    """``"roll"``, ``"pitch"``, ``"side"`` or ``"thrust"``."""
    status: AxisStatus
    """`fault` only beyond the multiple of the threshold that the calibrated hours support."""
    reason: str
    """One sentence."""
    members: tuple[str, ...]
    """Surfaces that serve it; which of them failed cannot be told."""
    lost_share: Estimate | None
    offset_us: Estimate | None
    """Of the worst event; of the whole flight without one; None if nothing could be estimated, or where the command
    never moved on its own, which tells nothing of its effect."""
    events: tuple[AxisEvent, ...]
    """In order of time."""
    identifiable: float
    """Share of the flight in which lambda was known to less than +-0.3."""
    detectable: AxisDetectable
    """What would have been told."""
    judged_share: float
    """Share of the flight inside the calibrated regime."""
    false_alarms_per_hour: float
    """To expect of this axis at its threshold."""
    time_s: FloatArray
    score: FloatArray
    """Statistic over its threshold."""
    inputs: Inputs
    """Residual, and what a loss and an offset would leave in it."""
    model: AxisModel
    """By which it was judged."""

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
    def outline(self) -> tuple[float | None, ...]:
        """Largest distance from healthy over its threshold in each of equal parts of the flight."""
        distance = np.where(self.inputs.usable, np.sqrt(np.maximum(self.score, 0.0)), np.nan)
        return outline(self.time_s, distance, np.ones(distance.size))

    @property
    def since_s(self) -> float | None:
        """Onset of the first event that is the axis' own [s]."""
        return next((event.start_s for event in self.events if event.is_own), None)


Status = Literal["healthy", "suspect", "fault", "no_data", "unknown"]


@dataclass(frozen=True, slots=True)
class SurfaceAudit:
    """Verdict on one surface."""

    surface: str
    status: Status
    reason: str
    servo: str
    threshold_kind: ThresholdKind
    threshold_deg: float
    """Of an interval threshold the median level."""
    expected: bool
    """False if the aircraft file names no measured channel, or the log knows nothing of this surface."""
    faults: tuple[Fault, ...] = ()
    suspicions: tuple[Fault, ...] = ()
    """What only a cumulative sum noticed, or the tolerances of a working servo explain."""
    statistics: Statistics | None = None
    false_alarms_per_hour: float | None = None
    segment: Segment | None = None
    residuals: Residuals | None = None
    threshold: Threshold | None = None
    model: ModelOrigin = NAMED
    """Where the healthy model comes from, and how well it predicts."""
    detectable: Detectable = NOTHING_DETECTABLE
    """The smallest faults that this log would have shown."""
    judged_share: float = 0.0
    """Share of the log for which this surface was judged."""
    outline: tuple[float | None, ...] = ()
    """Largest residual over its threshold in each of equal parts of the flight; None where nothing was judged."""

    @property
    def is_judged(self) -> bool:
        """True if the data told whether this surface is well."""
        return self.status not in ("no_data", "unknown")


@dataclass(frozen=True, slots=True)
class LogAudit:
    """Verdict on all surfaces of one log."""

    log: FlightLog
    aircraft: Aircraft
    surfaces: tuple[SurfaceAudit, ...]
    axes: tuple[AxisAudit, ...] = ()
    """What the aircraft's motion tells, if it was calibrated."""

    @property
    def has_fault(self) -> bool:
        """True if any surface or axis is at fault."""
        return "fault" in {*(s.status for s in self.surfaces), *(a.status for a in self.axes)}

    @property
    def unjudged(self) -> tuple[SurfaceAudit, ...]:
        """Surfaces that were expected to be judged and could not be."""
        return tuple(s for s in self.surfaces if s.expected and not s.is_judged)

    @property
    def not_judged(self) -> str:
        """Why there is no verdict on the log as a whole, in one line; empty if there is one.

        Axes that could not be judged matter where no surface was: feedback tells more than motion.
        """
        if self.has_fault:
            return ""
        suspects = [(s.surface, s.reason) for s in self.surfaces if s.status == "suspect"]
        suspects += [(a.axis, a.reason) for a in self.axes if a.status == "suspect"]
        if suspects:
            return "not cleared: " + "; ".join(f"{name}: {reason}" for name, reason in suspects)
        if any(s.is_judged for s in self.surfaces):
            missing = self.unjudged
            return "could not judge " + "; ".join(f"{s.surface}: {s.reason}" for s in missing) if missing else ""
        if self.axes:
            dark = [axis for axis in self.axes if axis.is_expected and axis.status != "healthy"]
            known = any(axis.is_expected for axis in self.axes)
            text = "; ".join(f"{axis.axis}: {axis.reason}" for axis in (dark if known else self.axes))
            return f"could not judge {text}" if text else ""
        silent = self.unjudged or self.surfaces
        if silent and all(s.status == "no_data" for s in silent):
            return f"no measured deflection to judge: {silent[0].surface}: {silent[0].reason}"
        return "could not judge " + "; ".join(f"{s.surface}: {s.reason}" for s in silent)
