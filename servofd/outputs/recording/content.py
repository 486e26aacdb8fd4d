"""What a recording holds, on its way into a file and back."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Self

import numpy as np

from logparsers.records import FlightLog, own
from servofd.servo.context import NO_CONTEXT, Context

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servofd.aircraft.segment import Segment
    from servofd.core.types import BoolArray, FloatArray
    from servofd.detection.residual import Residuals
    from servofd.detection.verdict import LogAudit, SurfaceAudit
    from servofd.onboard.seen import Seen

_CURVES = (
    "time_s",
    "command_deg",
    "simulated_deg",
    "measured_deg",
    "residual_deg",
    "threshold_deg",
    "asked_s",
    "asked_deg",
)


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """Curves of one surface; all but the commands of shape (n,), one entry per measurement.

    Parameters
    ----------
    time_s : ndarray
        When the deflection was measured [s].
    command_deg, simulated_deg, measured_deg : ndarray
        What was asked at that time, what a healthy servo does, what the surface did [deg]; NaN where unknown.
    residual_deg : ndarray
        Residual [deg]; NaN where it was not judged.
    threshold_deg : ndarray
        Level of the alarm [deg].
    asked_s, asked_deg : ndarray, shape (m,)
        When each command was logged [s], and what it asked for [deg].
    frozen_s, frozen_to_end, context : float, bool, Context
        As in `Segment`.
    """

    time_s: FloatArray
    command_deg: FloatArray
    simulated_deg: FloatArray
    measured_deg: FloatArray
    residual_deg: FloatArray
    threshold_deg: FloatArray
    asked_s: FloatArray
    asked_deg: FloatArray
    frozen_s: float = 0.0
    frozen_to_end: bool = False
    context: Context = NO_CONTEXT

    def __post_init__(self) -> None:
        for name in _CURVES:
            object.__setattr__(self, name, own(getattr(self, name)))

    @classmethod
    def of(cls, segment: Segment, residuals: Residuals, threshold_deg: FloatArray) -> Self:
        """Curves that an audit looked at."""
        return cls(
            residuals.time_s,
            command_at(segment, residuals.time_s),
            residuals.simulated_deg,
            residuals.measured_deg,
            np.where(residuals.settled, residuals.residual_deg, np.nan),
            threshold_deg,
            segment.command_s,
            segment.command_deg,
            segment.frozen_s,
            segment.frozen_to_end,
            segment.context,
        )

    def segment(self, surface: str, command_period_s: float | None = None, *, is_streamed: bool = False) -> Segment:
        """What an audit starts from, see `Segment`: as of a log, without commands that are no numbers or come again."""
        from servofd.aircraft.segment import WARM_UP_STEPS, Segment, sent_period_s

        given = np.isfinite(self.asked_deg) & _rising(self.asked_s)
        seen = _rising(self.time_s)
        return Segment(
            surface,
            self.asked_s[given],
            self.asked_deg[given],
            self.time_s[seen],
            self.measured_deg[seen],
            command_period_s,
            self.frozen_s,
            self.frozen_to_end,
            self.context,
            sent_period_s(self.asked_s[given][: WARM_UP_STEPS + 1]) if is_streamed else None,
        )

    def between(self, from_s: float, to_s: float) -> Self:
        """The same curves from one time to another [s]; of the commands, the one that held at the start as well."""
        first, last = np.searchsorted(self.time_s, (from_s, to_s + 1e-9)).tolist()
        asked = int(np.searchsorted(self.asked_s, from_s, side="right")) - 1
        until = int(np.searchsorted(self.asked_s, to_s, side="right"))
        rows = {name: getattr(self, name)[first:last] for name in _CURVES if not name.startswith("asked")}
        commands = slice(max(asked, 0), until)
        return replace(self, **rows, asked_s=self.asked_s[commands], asked_deg=self.asked_deg[commands])


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """An audit, and the curves it looked at.

    Parameters
    ----------
    audit : LogAudit
        The verdicts. Its log has no channels any more, its surfaces no segments.
    traces : Mapping[str, Trace]
        By name of the surface; those without a residual have none.
    attitude, position, geo : ndarray, shape (n, 4), or None
        Time [s], then roll, pitch and yaw [deg]; east, north and up from the first fix [m]; latitude, longitude
        [deg] and altitude [m].
    """

    audit: LogAudit
    traces: Mapping[str, Trace]
    attitude: FloatArray | None = None
    position: FloatArray | None = None
    geo: FloatArray | None = None
    notes: tuple[str, ...] = field(default=())
    """What a reader of the recording should know: that it was cut, or judged anew."""
    on_board: Mapping[str, Seen] = field(default_factory=dict)
    """What a script on the autopilot saw of each surface that it watched; a recording read back has none."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "traces", MappingProxyType(dict(self.traces)))

    @classmethod
    def of(cls, audit: LogAudit) -> Self:
        """Everything of an audit that a recording tells; nothing that tells where on a machine its log was."""
        log = audit.log
        bare = FlightLog(
            source=Path(log.source.name),
            format=log.format,
            channels={},
            damage=log.damage,
            run=log.run,
            vehicle=log.vehicle,
            firmware=log.firmware,
            start_utc=log.start_utc,
            span_s=_span_s(log),
        )
        surfaces = tuple(replace(s, segment=None, residuals=None, threshold=None) for s in audit.surfaces)
        return cls(
            replace(audit, log=bare, surfaces=surfaces),
            {s.surface: trace for s in audit.surfaces if (trace := _trace(s)) is not None},
        )

    @property
    def end_s(self) -> float:
        """Last time of all curves [s]."""
        return max((float(t.time_s[-1]) for t in self.traces.values() if t.time_s.size), default=0.0)

    @property
    def start_s(self) -> float:
        """First time of all curves [s]."""
        return min((float(t.time_s[0]) for t in self.traces.values() if t.time_s.size), default=0.0)


def command_at(segment: Segment, time_s: FloatArray) -> FloatArray:
    """Command that was held at given times [deg]; NaN before the first one.

    Examples
    --------
    >>> from servofd.aircraft.segment import Segment
    >>> command_at(Segment("x", np.array([1.0, 2.0]), np.array([5.0, 6.0]), np.ones(1), np.ones(1)), np.arange(3.0))
    array([nan,  5.,  6.])
    """
    latest = np.searchsorted(segment.command_s, time_s, side="right") - 1
    held: FloatArray = np.where(latest >= 0, segment.command_deg[np.maximum(latest, 0)], np.nan)
    return held


def _trace(surface: SurfaceAudit) -> Trace | None:
    if surface.segment is None or surface.residuals is None:
        return None
    size = surface.residuals.time_s.size
    level_deg = np.full(size, np.nan) if surface.threshold is None else surface.threshold.level_deg
    return Trace.of(surface.segment, surface.residuals, level_deg)


def _rising(time_s: FloatArray) -> BoolArray:
    """Samples later than all before them: in a damaged recording some are not."""
    rising: BoolArray = time_s > np.concatenate([[-np.inf], np.maximum.accumulate(time_s)[:-1]])
    return rising


def _span_s(log: FlightLog) -> tuple[float, float]:
    """First and last time of a log [s]; only its length if it has no channel."""
    if log.span_s is not None:
        return log.span_s
    spans = [(float(c.time_s[0]), float(c.time_s[-1])) for c in log.channels.values() if c.time_s.size]
    return (min(s[0] for s in spans), max(s[1] for s in spans)) if spans else (0.0, 0.0)
