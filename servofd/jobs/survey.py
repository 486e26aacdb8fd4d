"""What a log holds, and what can be done with it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.aircraft.current_source import current_sources, read_current
from servofd.aircraft.outputs import output_of
from servofd.aircraft.schema import Aircraft
from servofd.aircraft.series import SLOWEST_RATE_HZ, cut
from servofd.core.errors import NoMeasurement
from servofd.feedback.draft import what_to_log
from servofd.feedback.flown import known_aircraft, logs_of, surfaces_of
from servofd.onboard.seen import seen_on_board

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from logparsers import Channel, FlightLog

_GAP_PERIODS = 5.0
"""Longer than so many sample periods is a gap."""
_RATE_PER_BANDWIDTH = 10.0
"""Samples that a period of the fastest motion needs, so that a residual filter can follow it."""


@dataclass(frozen=True, slots=True)
class ChannelSurvey:
    """One channel."""

    name: str
    unit: str
    samples: int
    rate_hz: float | None
    gaps: int
    """Intervals of more than five median ones."""
    longest_gap_s: float


@dataclass(frozen=True, slots=True)
class SurfaceSurvey:
    """One surface."""

    name: str
    command: str
    position: str
    command_hz: float | None
    position_hz: float | None
    verdict: str
    """"yes", with what the rate allows; or why not."""
    current: str = ""
    """Channel of its current; empty if the log holds none."""
    current_hz: float | None = None


@dataclass(frozen=True, slots=True)
class OnBoard:
    """What a script on board saw of one surface."""

    name: str
    """Of the surface; of the output, if the aircraft does not know it."""
    output: int
    samples: int
    peak_share: float | None
    """Largest residual as a share of its threshold; None if none was judged."""
    alarms_s: tuple[float, ...]
    """When it went over that [s]."""


@dataclass(frozen=True, slots=True)
class Survey:
    """One log."""

    log: FlightLog
    surfaces: tuple[SurfaceSurvey, ...]
    channels: tuple[ChannelSurvey, ...]
    on_board: tuple[OnBoard, ...]
    """What a script on board saw."""
    advice: str
    """What would have to be logged; empty if every surface can be audited."""

    def as_dict(self) -> dict[str, Any]:
        """Everything, as plain dictionaries and lists."""
        log = self.log
        return {
            "path": str(log.source),
            "run": log.run or None,
            "format": log.format,
            "duration_s": log.duration_s,
            "vehicle": log.vehicle or None,
            "firmware": log.firmware or None,
            "start_utc": log.start_utc.isoformat() if log.start_utc else None,
            "channels": len(log.channels),
            "damage": [asdict(damage) for damage in log.damage_summary],
            "surfaces": [asdict(surface) for surface in self.surfaces],
            "on_board": [asdict(seen) for seen in self.on_board],
            "channel_details": [asdict(channel) for channel in self.channels],
            "advice": self.advice or None,
        }


def survey(path: str | Path, aircraft: str | Path | None = None, *, every_channel: bool = False) -> tuple[Survey, ...]:
    """Look into a log, one result for each run it holds.

    Parameters
    ----------
    aircraft : str or Path, optional
        Aircraft file; left out, the log's own description is used as far as there is one.
    every_channel : bool
        Survey all channels, not only those of surfaces.

    Examples
    --------
    >>> (found,) = survey("sample_logs/faser_stuck_flight.mat")
    >>> round(found.surfaces[0].position_hz)
    100
    """
    known = known_aircraft(aircraft)
    return tuple(_survey(log, known, every_channel) for log in logs_of(path, known))


def _survey(log: FlightLog, known: Aircraft | None, every_channel: bool) -> Survey:
    try:
        aircraft: Aircraft | None = surfaces_of(log, known)
    except NoMeasurement:
        aircraft = None
    surfaces = tuple(_with_currents(log, aircraft)) if aircraft else ()
    unfit = not surfaces or any(not s.verdict.startswith("yes") for s in surfaces)
    channels = tuple(_channel(log[name]) for name in log.channels) if every_channel else ()
    return Survey(
        log, surfaces, channels, _on_board(log, aircraft), what_to_log(log) if unfit and log.is_of_autopilot else ""
    )


def _with_currents(log: FlightLog, aircraft: Aircraft) -> Iterator[SurfaceSurvey]:
    """Each surface, with what its current allows beside its position, or instead of it."""
    try:
        sources = current_sources(log, aircraft)
    except NoMeasurement:
        sources = {}
    for name in aircraft.surfaces:
        found, source = _surface(log, aircraft, name), sources.get(name)
        if source is None:
            yield found
            continue
        try:
            rate_hz = _rate(read_current(log, source).time_s)
        except NoMeasurement as reason:
            yield replace(found, verdict=f"{found.verdict}; {reason}", current=source.channel)
            continue
        by_current = (
            "by its current whether it is blocked or has no power, and once calibrated whether it binds or wears"
        )
        verdict = f"{found.verdict}; and {by_current}" if found.verdict.startswith("yes") else f"yes, {by_current}"
        yield replace(found, verdict=verdict, current=source.channel, current_hz=rate_hz)


def _surface(log: FlightLog, aircraft: Aircraft, name: str) -> SurfaceSurvey:
    surface = aircraft.surfaces[name]
    position = surface.measured.channel if surface.measured else "-"
    try:
        segment = cut(log, name, aircraft)
    except NoMeasurement as reason:
        return SurfaceSurvey(name, surface.command.channel, position, None, None, f"no: {reason}")
    command_hz, position_hz = (
        _rate(segment.command_s),
        round(1.0 / segment.period_s, 3) if segment.period_s > 0.0 else None,
    )
    return SurfaceSurvey(name, surface.command.channel, position, command_hz, position_hz, _judged_by_rate(position_hz))


def _on_board(log: FlightLog, aircraft: Aircraft | None) -> tuple[OnBoard, ...]:
    names = {output_of(surface): name for name, surface in aircraft.surfaces.items()} if aircraft else {}
    return tuple(
        OnBoard(
            names.get(seen.output, f"output {seen.output}"),
            seen.output,
            seen.time_s.size,
            None if np.isnan(seen.peak_share) else round(seen.peak_share, 3),
            tuple(np.round(seen.crossed_s, 3).tolist()),
        )
        for seen in seen_on_board(log)
    )


def _judged_by_rate(position_hz: float | None) -> str:
    if position_hz is None:
        return "no: fewer than two positions"
    if position_hz < SLOWEST_RATE_HZ:
        return f"no: {position_hz:.1f} Hz is too slow, {SLOWEST_RATE_HZ:g} Hz are needed"
    return f"yes, servos of up to {position_hz / _RATE_PER_BANDWIDTH:.1f} Hz bandwidth"


def _channel(channel: Channel) -> ChannelSurvey:
    steps_s = np.diff(channel.time_s)
    period_s = float(np.median(steps_s)) if steps_s.size else 0.0
    gaps = int(np.count_nonzero(steps_s > _GAP_PERIODS * period_s)) if period_s > 0.0 else 0
    longest_s = float(steps_s.max()) if steps_s.size else 0.0
    return ChannelSurvey(channel.name, channel.unit, channel.time_s.size, _rate(channel.time_s), gaps, longest_s)


def _rate(time_s: np.ndarray[Any, Any]) -> float | None:
    """Median rate [Hz]; None for fewer than two samples."""
    if time_s.size < 2:
        return None
    return round(1.0 / float(np.median(np.diff(time_s))), 3)
