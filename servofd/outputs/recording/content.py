"""What a recording holds, on its way into a file and back: verdicts, curves, and how the aircraft itself moved."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Self

import numpy as np

from logparsers.records import FlightLog, own
from servofd.core.series import latest, tenths
from servofd.servo.context import NO_CONTEXT, Context

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servofd.aircraft.series import LeftOut, Series
    from servofd.core.types import BoolArray, FloatArray
    from servofd.detection.verdict import LogAudit, SurfaceAudit
    from servofd.onboard.seen import Seen

_ASKED = ("asked_s", "asked_deg")
_CURVES = ("time_s", "command_deg", "simulated_deg", "measured_deg", "residual_deg", "threshold_deg")


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
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

    def __post_init__(self) -> None:
        for name in (*_CURVES, *_ASKED):
            object.__setattr__(self, name, own(getattr(self, name)))

    @classmethod
    def of(cls, surface: SurfaceAudit) -> Self | None:
        """Curves that an audit judged; None if it had none."""
        segment, residuals = surface.segment, surface.residuals
        if segment is None or residuals is None:
            return None
        time_s, size = residuals.time_s, residuals.time_s.size
        asked_deg = np.full(size, np.nan)
        if segment.command_s.size:
            held_deg = latest(segment.command_s, segment.command_deg, time_s)
            asked_deg = np.where(time_s >= segment.command_s[0], held_deg, np.nan)
        threshold_deg = np.full(size, np.nan) if surface.threshold is None else surface.threshold.level_deg
        return cls(
            time_s,
            asked_deg,
            residuals.simulated_deg,
            residuals.measured_deg,
            np.where(residuals.settled, residuals.residual_deg, np.nan),
            threshold_deg,
            segment.command_s,
            segment.command_deg,
            segment.left_out,
            segment.context,
        )

    def segment(self, surface: str, command_period_s: float | None = None, *, is_streamed: bool = False) -> Series:
        """What an audit starts from, see `Series`: as of a log, without commands that are no numbers or come again."""
        from servofd.aircraft.series import WARM_UP_STEPS, Series, link_period_s, marks_of

        given = np.isfinite(self.asked_deg) & _rising(self.asked_s)
        seen = _rising(self.time_s)
        return Series(
            surface,
            self.asked_s[given],
            self.asked_deg[given],
            self.time_s[seen],
            self.measured_deg[seen],
            command_period_s,
            marks_of(self.left_out, self.time_s[seen]),
            self.context,
            link_period_s(self.asked_s[given][: WARM_UP_STEPS + 1]) if is_streamed else None,
        )

    def between(self, from_s: float, to_s: float) -> Self:
        """The same curves from one time to another [s]; of the commands, the one that held at the start as well."""
        first, last = np.searchsorted(self.time_s, (from_s, to_s + 1e-9)).tolist()
        asked = int(np.searchsorted(self.asked_s, from_s, side="right")) - 1
        until = int(np.searchsorted(self.asked_s, to_s, side="right"))
        rows = {name: getattr(self, name)[first:last] for name in _CURVES}
        commands = slice(max(asked, 0), until)
        return replace(self, **rows, asked_s=self.asked_s[commands], asked_deg=self.asked_deg[commands])


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """An audit, and the curves that it judged."""

    audit: LogAudit
    """Its log has no channels any more, its surfaces no segments."""
    traces: Mapping[str, Trace]
    """By name of the surface; those without a residual have none."""
    attitude: FloatArray | None = None
    """Time [s], roll, pitch and yaw [deg], shape (n, 4)."""
    position: FloatArray | None = None
    """Time [s], east, north and up from the first fix [m]."""
    geo: FloatArray | None = None
    """Time [s], latitude, longitude [deg] and altitude [m]."""
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
            span_s=log.ends_s,
        )
        surfaces = tuple(replace(s, segment=None, residuals=None, threshold=None) for s in audit.surfaces)
        return cls(
            replace(audit, log=bare, surfaces=surfaces),
            {s.surface: trace for s in audit.surfaces if (trace := Trace.of(s)) is not None},
        )

    @property
    def end_s(self) -> float:
        """Last time of all curves [s]."""
        return max((float(t.time_s[-1]) for t in self.traces.values() if t.time_s.size), default=0.0)

    @property
    def start_s(self) -> float:
        """First time of all curves [s]."""
        return min((float(t.time_s[0]) for t in self.traces.values() if t.time_s.size), default=0.0)


def _rising(time_s: FloatArray) -> BoolArray:
    """Samples later than all before them: in a damaged recording some are not."""
    rising: BoolArray = time_s > np.concatenate([[-np.inf], np.maximum.accumulate(time_s)[:-1]])
    return rising


_ATTITUDES = (
    ("ATT.Roll", "ATT.Pitch", "ATT.Yaw"),
    ("ATTITUDE.roll", "ATTITUDE.pitch", "ATTITUDE.yaw"),
)
_QUATERNIONS = tuple(
    tuple(f"{topic}.q[{i}]" for i in range(4)) for topic in ("vehicle_attitude[0]", "vehicle_attitude")
)
_POSITIONS = (
    ("POS.Lat", "POS.Lng", "POS.Alt"),
    ("GPS[0].Lat", "GPS[0].Lng", "GPS[0].Alt"),
    ("GPS.Lat", "GPS.Lng", "GPS.Alt"),
    ("GLOBAL_POSITION_INT.lat", "GLOBAL_POSITION_INT.lon", "GLOBAL_POSITION_INT.alt"),
    ("vehicle_gps_position[0].lat", "vehicle_gps_position[0].lon", "vehicle_gps_position[0].alt"),
    ("vehicle_gps_position[0].latitude_deg", "vehicle_gps_position[0].longitude_deg", "vehicle_gps_position[0].alt"),
)
_EARTH_RADIUS_M = 6_371_008.8
"""Mean radius, IUGG."""
_WHOLE_DEGREES = 1e-7
"""Messages hold latitude and longitude in 1e-7 deg, altitude in mm."""


def attitude_of(log: FlightLog) -> FloatArray | None:
    """Time [s], roll, pitch and yaw [deg], of shape (n, 4), at most ten a second; None if the log has none."""
    found = _together(log, _ATTITUDES)
    if found is not None:
        names, rows = found
        if log[names[0]].unit == "rad":
            rows[:, 1:] = np.degrees(rows[:, 1:])
        return rows
    found = _together(log, _QUATERNIONS)
    if found is None:
        return None
    time_s, w, x, y, z = found[1].T
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return np.column_stack([time_s, np.degrees([roll, pitch, yaw]).T])


def geo_of(log: FlightLog) -> FloatArray | None:
    """Time [s], latitude, longitude [deg] and altitude [m], of shape (n, 4); None if the log has none."""
    found = _together(log, _POSITIONS) or _together(log, tuple(names[:2] for names in _POSITIONS))
    if found is None:
        return None
    names, rows = found
    scale = _WHOLE_DEGREES if np.max(np.abs(rows[:, 1:3])) > 360.0 else 1.0
    height_m = rows[:, 3] if rows.shape[1] > 3 else np.zeros(len(rows))
    if rows.shape[1] > 3 and scale != 1.0 and log[names[2]].unit != "m":
        height_m = height_m * 1e-3
    placed = np.column_stack([rows[:, 0], rows[:, 1:3] * scale, height_m])
    # Receivers report 0, 0 until they have a fix.
    placed = placed[np.any(placed[:, 1:3] != 0.0, axis=1)]
    return placed if len(placed) > 1 else None


def local_of(geo: FloatArray) -> FloatArray:
    """Time [s], east, north and up from the first fix [m], of shape (n, 4): the flight without the place.

    Examples
    --------
    >>> local_of(np.array([[0.0, 60.0, 10.0, 5.0], [1.0, 60.001, 10.001, 7.0]])).round(1)[1].tolist()
    [1.0, 55.6, 111.2, 2.0]
    """
    moved = np.radians(geo[:, 1:3] - geo[0, 1:3])
    east_m = _EARTH_RADIUS_M * moved[:, 1] * np.cos(np.radians(geo[0, 1]))
    return np.column_stack([geo[:, 0], east_m, _EARTH_RADIUS_M * moved[:, 0], geo[:, 3] - geo[0, 3]])


def _together(log: FlightLog, choices: tuple[tuple[str, ...], ...]) -> tuple[tuple[str, ...], FloatArray] | None:
    """First set of channels that the log has, thinned: their names, and time and values of shape (n, 1 + k)."""
    for names in choices:
        if not all(name in log.channels for name in names):
            continue
        channels = [log[name] for name in names]
        if any(c.time_s.shape != channels[0].time_s.shape for c in channels):
            continue
        rows = np.column_stack([channels[0].time_s, *(c.values for c in channels)])
        rows = rows[np.all(np.isfinite(rows), axis=1)]
        rows = rows[tenths(rows[:, 0])]
        if len(rows) > 1:
            return names, rows
    return None
