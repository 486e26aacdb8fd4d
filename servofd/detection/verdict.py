"""Verdicts on the surfaces of a log, in data types that outputs can show."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from servofd.core.evidence import NAMED, NOTHING_DETECTABLE, Detectable, ModelOrigin

if TYPE_CHECKING:
    from logparsers.records import FlightLog
    from servofd.aircraft.schema import Aircraft
    from servofd.aircraft.segment import Segment
    from servofd.detection.axis_verdict import AxisAudit
    from servofd.detection.bank.flight import Fault
    from servofd.detection.residual import Residuals
    from servofd.detection.statistics import Statistics
    from servofd.detection.threshold import Threshold, ThresholdKind

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
