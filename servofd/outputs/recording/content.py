"""What a recording holds, on its way into a file and back: verdicts and curves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from logparsers.records import FlightLog
from servofd.aircraft.pace import WARM_UP_STEPS, link_period_s
from servofd.aircraft.series import LeftOut, Series
from servofd.core.series import latest
from servofd.core.types import BoolArray, FloatArray
from servofd.onboard.seen import Seen, seen_of
from servofd.servo.context import NO_CONTEXT, Context

if TYPE_CHECKING:
    from servofd.detection.verdict import LogAudit, SurfaceAudit

_OF_LOG = ("format", "damage", "run", "vehicle", "firmware", "start_utc")
"""What a recording tells of its log, beside its name and its length."""


class Trace(NamedTuple):
    """Curves of one surface; all but the commands of shape (n,), one entry per measurement, NaN where unknown."""

    time_s: FloatArray
    command_deg: FloatArray
    simulated_deg: FloatArray
    """What a healthy servo does."""
    measured_deg: FloatArray
    residual_deg: FloatArray
    """NaN where it was not judged."""
    threshold_deg: FloatArray
    asked_s: FloatArray
    asked_deg: FloatArray
    """Each command on its own time stamp, shape (m,)."""
    left_out: tuple[LeftOut, ...] = ()
    context: Context = NO_CONTEXT

    @classmethod
    def of(cls, surface: SurfaceAudit) -> Self | None:
        """Curves that an audit judged; None if it had none."""
        segment, residuals = surface.segment, surface.residuals
        if segment is None or residuals is None:
            return None
        time_s = residuals.time_s
        asked_deg = held(segment.command_s, segment.command_deg, time_s)
        threshold_deg = np.full(time_s.size, np.nan) if surface.threshold is None else surface.threshold.level_deg
        residual_deg = np.where(residuals.settled, residuals.residual_deg, np.nan)
        curves = (time_s, asked_deg, residuals.simulated_deg, residuals.measured_deg, residual_deg, threshold_deg)
        return cls(*curves, segment.command_s, segment.command_deg, segment.left_out, segment.context)

    def segment(self, surface: str, command_period_s: float | None = None, *, is_streamed: bool = False) -> Series:
        """What an audit starts from, see `Series`: as of a log, without commands that are no numbers or come again."""
        given, seen = np.isfinite(self.asked_deg) & _rising(self.asked_s), _rising(self.time_s)
        asked, measured = (self.asked_s[given], self.asked_deg[given]), (self.time_s[seen], self.measured_deg[seen])
        link_s = link_period_s(asked[0][: WARM_UP_STEPS + 1]) if is_streamed else None
        return Series(surface, *asked, *measured, command_period_s, context=self.context, sent_period_s=link_s)


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """An audit, and the curves that it judged."""

    audit: LogAudit
    """Its log has no channels any more, its surfaces no segments."""
    traces: Mapping[str, Trace]
    """By name of the surface; those without a residual have none."""
    notes: tuple[str, ...] = ()
    """What a reader of the recording should know: that it was cut, or judged anew."""
    on_board: Mapping[str, Seen] = field(default_factory=dict)
    """What a script on the autopilot saw of each surface that it watched; a recording read back has none."""
    context: Context = NO_CONTEXT
    """Airspeed and supply of a recording read back."""

    @classmethod
    def of(cls, audit: LogAudit) -> Self:
        """Everything of an audit that a recording tells; nothing that tells where on a machine its log was."""
        log = audit.log
        kept: dict[str, Any] = {name: getattr(log, name) for name in _OF_LOG}
        bare = FlightLog(source=Path(log.source.name), channels={}, span_s=log.ends_s, **kept)
        surfaces = tuple(replace(s, segment=None, residuals=None, threshold=None) for s in audit.surfaces)
        traces = {s.surface: trace for s in audit.surfaces if (trace := Trace.of(s)) is not None}
        return cls(replace(audit, log=bare, surfaces=surfaces), traces, on_board=seen_of(log, audit.aircraft))

    @property
    def end_s(self) -> float:
        """Last time of all curves [s]."""
        return max((float(time_s[-1]) for time_s in self._times()), default=0.0)

    @property
    def start_s(self) -> float:
        """First time of all curves [s]."""
        return min((float(time_s[0]) for time_s in self._times()), default=0.0)

    def _times(self) -> list[FloatArray]:
        """Time stamps of all curves that hold any [s]."""
        found = [trace.time_s for trace in self.traces.values()]
        found += [s.current.time_s for s in self.audit.surfaces if s.current and s.current.time_s is not None]
        return [time_s for time_s in found if time_s.size]


def held(command_s: FloatArray, command_deg: FloatArray, time_s: FloatArray) -> FloatArray:
    """The last command before each time; NaN before the first."""
    if not command_s.size:
        return np.full(time_s.size, np.nan)
    return np.where(time_s >= command_s[0], latest(command_s, command_deg, time_s), np.nan)


def _rising(time_s: FloatArray) -> BoolArray:
    """Samples later than all before them: in a damaged recording some are not."""
    rising: BoolArray = time_s > np.concatenate([[-np.inf], np.maximum.accumulate(time_s)[:-1]])
    return rising
