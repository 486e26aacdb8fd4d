"""What a monitor tells and remembers of a surface: events, looks of the bank, how long it was judged or quiet."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from servofd.aircraft.segment import OUTAGE_S
from servofd.detection.calibrated import judge_stretch
from servofd.detection.contradiction import contradictions
from servofd.detection.judge import judge_evaluated
from servofd.detection.plausible import wiring_problem

if TYPE_CHECKING:
    from servofd.aircraft.schema import Surface
    from servofd.core.types import BoolArray, FloatArray
    from servofd.detection.bank.window import Fault
    from servofd.detection.residual import Commands, ResidualGenerator, Residuals
    from servofd.detection.stream import Piece
    from servofd.detection.threshold import Threshold
    from servofd.servo.context import Context


@dataclass(slots=True)
class JudgedTime:
    """Time between positions that had a value, where they were judged."""

    seconds: float = 0.0
    _latest_s: float = float("nan")

    def take(self, time_s: FloatArray, measured_deg: FloatArray, settled: BoolArray) -> None:
        """Count the next samples, arrays of shape (n,)."""
        valued = np.isfinite(measured_deg)
        if not valued.any():
            return
        valued_s = time_s[valued]
        begin_s = self._latest_s if np.isfinite(self._latest_s) else valued_s[0]
        steps_s = np.minimum(np.diff(valued_s, prepend=begin_s), OUTAGE_S)
        self.seconds += float(steps_s[settled[valued]].sum())
        self._latest_s = float(valued_s[-1])


QUIET_SHARE = 0.5
"""Of its threshold, below which the residual of a surface in alarm is quiet."""
QUIET_S = 0.75
"""After so long in quiet the bank looks whether an alarm is over,"""
_OVER_S, _AS_FAST = 1.25, 0.7
"""In flights of an ArduPlane alarms of faults that had ended were taken back after 0.8 to 1.5 s, but for two of eleven,
in which the bank saw no end."""
_PAUSE_S, _LONGEST_PAUSE_S = 0.4, 1.5
"""and again after pauses that grow with each look in vain."""


@dataclass(slots=True)
class Quiet:
    """How long the residual of a surface in alarm has been quiet."""

    quiet_s: float = float("inf")
    """Since when it is quiet [s]; infinite if it is not."""
    away_s: float = float("inf")
    """Since when it is, elsewhere than where it was stuck [s]."""
    _loudest_deg_s: float = 0.0
    """How fast the servo was asked to move where the residual passed its threshold."""
    _quiet_deg_s: float = 0.0
    """The same since it is quiet."""
    _asked_s: float = float("-inf")
    _asked: int = 0

    def follow(self, piece: Piece, stuck_deg: float) -> None:
        """Take the next samples, and where the surface is said to be stuck [deg]; NaN if nowhere."""
        residuals, level_deg = piece.residuals, piece.threshold.level_deg
        judged = residuals.settled
        loud = judged & ~(np.abs(residuals.residual_deg) < QUIET_SHARE * level_deg)
        there = loud | (judged & ~(np.abs(residuals.measured_deg - stuck_deg) > level_deg))
        passed = judged & (np.abs(residuals.residual_deg) >= level_deg)
        speed_deg_s = np.abs(np.diff(residuals.simulated_deg, append=np.nan)) / np.diff(residuals.time_s, append=np.nan)
        speed_deg_s = np.nan_to_num(speed_deg_s)
        self._loudest_deg_s = max(self._loudest_deg_s, float(speed_deg_s[passed].max(initial=0.0)))
        self.quiet_s = self._since_s(self.quiet_s, residuals.time_s, judged, loud)
        earlier_deg_s = 0.0 if loud.any() else self._quiet_deg_s
        calm = judged & (residuals.time_s >= self.quiet_s)
        self._quiet_deg_s = max(earlier_deg_s, float(speed_deg_s[calm].max(initial=0.0)))
        self.away_s = self._since_s(self.away_s, residuals.time_s, judged, there)

    def is_over(self, now_s: float) -> bool:
        """Whether motion as fast as that which passed the threshold has left the residual quiet for long enough."""
        return now_s - self.quiet_s >= _OVER_S and self._quiet_deg_s >= _AS_FAST * self._loudest_deg_s > 0.0

    def is_due(self, now_s: float) -> bool:
        """Whether the bank should look now [s]."""
        pause_s = min(_PAUSE_S * (1 + self._asked), _LONGEST_PAUSE_S)
        if now_s - self._asked_s < pause_s or now_s - self.quiet_s < QUIET_S:
            return False
        self._asked_s, self._asked = now_s, self._asked + 1
        return True

    @staticmethod
    def _since_s(since_s: float, time_s: FloatArray, judged: BoolArray, ends: BoolArray) -> float:
        last = np.flatnonzero(ends)
        if last.size:
            since_s, time_s, judged = np.inf, time_s[last[-1] + 1 :], judged[last[-1] + 1 :]
        begun = np.flatnonzero(judged)
        return min(since_s, float(time_s[begun[0]])) if begun.size else since_s


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
