"""From logs to estimates: one task per log, done side by side, and the order in which the logs were flown."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from logparsers import LogError
from servofd.aircraft.axis_names import SURFACE_AXES
from servofd.aircraft.segment import cut
from servofd.batch.fetch import fetched
from servofd.core.errors import ConfigError, NoMeasurement, ServofdError
from servofd.estimate.statistics import Estimate
from servofd.feedback.flown import logs_of, surfaces_of
from servofd.wear.estimate import estimate_flight
from servofd.wear.records import FlightEstimate

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from datetime import datetime

    from logparsers import FlightLog
    from servofd.aircraft.axes import MotionModel
    from servofd.aircraft.schema import Aircraft
    from servofd.aircraft.segment import Segment
    from servofd.batch.find import LogSource

_SYSTEM_IDS = ("MAV_SYSID", "SYSID_THISMAV")


@dataclass(frozen=True, slots=True)
class FlownLog:
    """One run of one log: what it tells of each surface."""

    path: str
    run: str
    start_utc: datetime | None
    identity: str
    """What the log says of the vehicle it comes from; empty if nothing."""
    flights: tuple[FlightEstimate, ...]
    problems: tuple[str, ...]
    """Why it tells nothing of some surfaces, a line each."""


class Order(NamedTuple):
    """Logs in the order in which they were flown, and how that is known."""

    logs: tuple[FlownLog, ...]
    by: str
    """``time`` or ``name``."""
    reason: str


def estimate_log(source: LogSource, aircraft: Aircraft, surfaces: tuple[str, ...] = ()) -> tuple[FlownLog, ...]:
    """Estimate every surface of a log; one result for each run; what cannot be read becomes a problem.

    Examples
    --------
    >>> from servofd.aircraft.schema import load_aircraft
    >>> from servofd.batch.find import LogSource
    >>> (log,) = estimate_log(LogSource("sample_logs/faser_healthy_flight.mat", 0), load_aircraft("faser"))
    >>> log.flights[0].surface, log.flights[0].values["dead_band_deg"].value < 0.2
    ('elevator', True)
    """
    try:
        with fetched(source.path) as local:
            return tuple(_of_run(log, source.path, aircraft, surfaces) for log in logs_of(local, aircraft))
    except (LogError, ServofdError, OSError) as error:
        return (FlownLog(source.path, "", None, "", (), (str(error).removeprefix(f"{source.path}: "),)),)


def _of_run(log: FlightLog, path: str, aircraft: Aircraft, surfaces: tuple[str, ...]) -> FlownLog:
    flights, problems = [], []
    if aircraft.surfaces:
        aircraft = surfaces_of(log, aircraft)
    for name in surfaces or aircraft.surfaces:
        entry = aircraft.surfaces[name]
        if entry.measured is None:
            continue
        try:
            segment = cut(log, name, entry)
            estimated = estimate_flight(segment, aircraft, _voltage_v(segment))
        except ServofdError as error:
            problems.append(f"{name}: {error}")
            continue
        flights.append(FlightEstimate(path, log.run, name, log.start_utc, log.duration_s, *estimated))
    if aircraft.motion is not None and not surfaces:
        try:
            flights += _axes(log, path, aircraft.motion)
        except NoMeasurement as error:
            problems.append(f"axes: {error}")
    return FlownLog(path, log.run, log.start_utc, _identity(log), tuple(flights), tuple(problems))


def _axes(log: FlightLog, path: str, motion: MotionModel) -> list[FlightEstimate]:
    """What the motion of a flight tells of each axis: the effect that was left, and where it stood."""
    from servofd.axes.judge import judge_motion
    from servofd.axes.read import motion_of

    found = []
    for audit in judge_motion(motion, motion_of(log, motion.rate_hz, motion.parameters)):
        if audit.axis not in SURFACE_AXES:
            continue
        values, missing = {}, {}
        for name, between in (("effect", audit.lost_share), ("offset_us", audit.offset_us)):
            if between is None or not audit.is_expected:
                missing[name] = audit.reason
                continue
            sigma = between.deviation
            values[name] = Estimate.of(1.0 - between.value if name == "effect" else between.value, sigma)
        alarm = audit.reason if audit.status in ("suspect", "fault") else ""
        found.append(
            FlightEstimate(path, log.run, audit.axis, log.start_utc, log.duration_s, values, missing, alarm=alarm)
        )
    return found


def _voltage_v(segment: Segment) -> float | None:
    """Mean supply voltage during the flight [V]; None if it was not logged."""
    time_s, volts = segment.context.voltage_s, segment.context.voltage_v
    volts = volts[(time_s >= segment.measured_s[0]) & (time_s <= segment.measured_s[-1])]
    return float(np.mean(volts)) if volts.size and float(np.mean(volts)) > 0.0 else None


def _identity(log: FlightLog) -> str:
    number = next((f"{log.parameters[name]:.0f}" for name in _SYSTEM_IDS if name in log.parameters), "")
    return ", ".join(filter(None, (log.vehicle, f"system {number}" if number else "")))


def check_one_aircraft(logs: Iterable[FlownLog]) -> None:
    """Refuse logs that say they come from different vehicles."""
    first: dict[str, str] = {}
    for log in logs:
        if log.identity:
            first.setdefault(log.identity, log.path)
    if len(first) > 1:
        vehicles = "; ".join(f"{path}: {identity}" for identity, path in list(first.items())[:3])
        raise ConfigError(f"these logs come from {len(first)} vehicles, a trend follows one: {vehicles}")


def in_order(logs: Sequence[FlownLog]) -> Order:
    """By when they were flown, if all of them tell; else by name, numbers in it by their size.

    Examples
    --------
    >>> some = [FlownLog(f"f{k}.csv", "", None, "", (), ()) for k in (10, 9)]
    >>> [log.path for log in in_order(some).logs], in_order(some).by
    (['f9.csv', 'f10.csv'], 'name')
    """
    silent = [log for log in logs if log.start_utc is None]
    if not silent:
        ordered = sorted(logs, key=lambda log: (log.start_utc.timestamp() if log.start_utc else 0.0, log.path))
        return Order(tuple(ordered), "time", "by the UTC time at which each log begins")
    why = "none tells" if len(silent) == len(logs) else f"{len(silent)} of {len(logs)} do not tell"
    return Order(tuple(sorted(logs, key=_natural)), "name", f"by name of the logs, as {why} when it was flown")


def _natural(log: FlownLog) -> tuple[list[tuple[int, str]], str]:
    parts = re.split(r"(\d+)", log.path)
    return [(int(part) if part.isdecimal() else -1, part) for part in parts], log.run
