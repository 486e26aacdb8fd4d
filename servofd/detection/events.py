"""What a monitor tells, and what it has the bank look at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

from servofd.detection.calibrated import judge_stretch
from servofd.detection.contradiction import contradictions
from servofd.detection.judge import judge_evaluated
from servofd.detection.plausible import wiring_problem

if TYPE_CHECKING:
    from servofd.aircraft.schema import Surface
    from servofd.core.types import BoolArray, FloatArray
    from servofd.detection.bank.flight import Fault
    from servofd.detection.residual import Commands, ResidualGenerator, Residuals
    from servofd.detection.threshold import Threshold
    from servofd.servo.context import Context

EventKind = Literal["alarm", "clear", "named", "no_data", "link_lost", "link_restored"]


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened, on the clock of the vehicle."""

    time_s: float
    surface: str
    event: EventKind
    kind: str = ""
    """Of the fault; `unknown` until the bank has told it, `healthy` for an alarm that a working servo explains."""
    residual_deg: float = float("nan")
    threshold_deg: float = float("nan")
    text: str = ""
    """More, in words."""
    fault: Fault | None = None


class Reading(NamedTuple):
    """Where a surface stands."""

    time_s: float
    command_deg: float
    measured_deg: float
    residual_deg: float
    threshold_deg: float
    settled: bool


class Inputs(NamedTuple):
    """What samples were evaluated with."""

    asked_deg: FloatArray
    """Command at each of them, shape (n,) [deg]."""
    command_s: FloatArray
    """Commands that have come since the samples before, shape (m,) [s],"""
    command_deg: FloatArray
    """and what they asked for [deg]."""
    context: Context


class Look(NamedTuple):
    """A copy of what is known of a surface."""

    at_s: float
    generator: ResidualGenerator
    surface: Surface
    residuals: Residuals
    threshold: Threshold
    suspicious: BoolArray
    commands: Commands
    sent_period_s: float | None = None
    """Between commands as they were sent [s], where most of them get lost."""
    earlier_deg: FloatArray | None = None
    """Positions before, of a model that was fitted, of which only faults are wanted: suspicions wait for the end."""
    is_last: bool = False
    """Whether it is for the report, with all that a report holds."""
    quiet_s: float = float("inf")
    """Since when a surface in alarm is quiet [s]; infinite if it is not."""

    def judge(self) -> tuple[tuple[Fault, ...], tuple[Fault, ...], str]:
        """Faults and suspicions, and why nothing should be concluded from them; depends on nothing else."""
        _, _, _, residuals, threshold, suspicious, commands, sent_period_s, _, is_last, quiet_s = self
        if self.surface.calibrated is not None and self.surface.is_calibrated:
            calibrated = judge_stretch(self.surface.calibrated, residuals, commands, sent_period_s)
            return calibrated.faults, calibrated.suspicions, ""
        if self.earlier_deg is not None:
            faults = contradictions(self.generator, residuals, self.earlier_deg)
            problem = wiring_problem(residuals) if faults else ""
            return (() if problem else faults), (), problem
        found = judge_evaluated(
            self.generator,
            self.surface,
            residuals,
            threshold,
            suspicious,
            commands,
            is_report=is_last,
            quiet_s=quiet_s,
        )
        problem = wiring_problem(residuals) if found.faults or found.suspicions else ""
        return (() if problem else found.faults), (() if problem else found.suspicions), problem


@dataclass(slots=True)
class Alarm:
    """An alarm that was raised."""

    kind: str = "unknown"
    stands: bool = True
    dismissed: bool = False
    belongs: bool = False
    """To the alarm before it, which only seemed to be over."""
    fault: Fault | None = None
