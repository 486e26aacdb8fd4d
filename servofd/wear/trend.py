"""One aircraft over many flights."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from logparsers import FlightLog, LogError
from servofd.aircraft.axes import SURFACE_AXES, MotionModel
from servofd.aircraft.current_source import current_sources
from servofd.aircraft.schema import Aircraft, load_aircraft
from servofd.aircraft.series import bus_of, cut
from servofd.batch.find import LogSource, Skipped, fetched, find_logs
from servofd.batch.local import run_local
from servofd.core.errors import ConfigError, NoMeasurement, ServofdError
from servofd.core.statistics import Estimate
from servofd.core.types import Marks
from servofd.current.audit import current_series
from servofd.current.judge import judged
from servofd.current.model import see
from servofd.current.wear import followed_limits, quantities_of
from servofd.detection.audit import audit_segment
from servofd.detection.kinds import STANDS_STILL
from servofd.feedback.flown import layout_of, logs_of, surfaces_of
from servofd.wear.estimate import QUANTITIES, ServoEstimate, estimate_flight
from servofd.wear.series import FEWEST_FOR_LINE, Piece, QuantityTrend, SurfaceTrend, Wear, follow

_SYSTEM_IDS = ("MAV_SYSID", "SYSID_THISMAV")


@dataclass(frozen=True, slots=True)
class FlownLog:
    """One run of one log: what it tells of each surface."""

    path: str
    run: str
    start_utc: datetime | None
    identity: str
    """What the log says of the vehicle it comes from; empty if nothing."""
    flights: Mapping[str, ServoEstimate]
    """By surface, or axis."""
    problems: tuple[str, ...]
    """Why it tells nothing of some surfaces, a line each."""


class Order(NamedTuple):
    """Logs in the order in which they were flown, and how that is known."""

    logs: tuple[FlownLog, ...]
    by: str
    """``time`` or ``name``."""
    reason: str


def estimate_log(source: LogSource, aircraft: Aircraft, surfaces: tuple[str, ...] = ()) -> tuple[FlownLog, ...]:
    """Estimate every surface of a log; one result for each run; what cannot be read becomes a problem."""
    try:
        with fetched(source.path) as local:
            return tuple(_of_run(log, source.path, aircraft, surfaces) for log in logs_of(local, aircraft))
    except (LogError, ServofdError, OSError) as error:
        return (FlownLog(source.path, "", None, "", {}, (str(error).removeprefix(f"{source.path}: "),)),)


def _of_run(log: FlightLog, path: str, aircraft: Aircraft, surfaces: tuple[str, ...]) -> FlownLog:
    flights, problems = {}, []
    if aircraft.surfaces:
        aircraft = surfaces_of(log, aircraft)
    bus = bus_of(log, aircraft)
    for name in surfaces or aircraft.surfaces:
        values: dict[str, Estimate] = {}
        missing: dict[str, str] = {}
        alarms: list[str] = []
        reasons: list[str] = []
        for witness in (partial(_by_position, bus=bus), _by_current):
            try:
                found = witness(log, name, aircraft)
            except ServofdError as error:
                reasons.append(f"{name}: {error}")
                continue
            if found is not None:
                values |= found.values
                missing |= found.missing
                alarms += [found.alarm] * bool(found.alarm)
        if values or missing:
            flights[name] = ServoEstimate(values, missing, "; ".join(alarms))
        problems += reasons if not values else []
    if aircraft.motion is not None and not surfaces:
        try:
            flights |= _axes(log, aircraft.motion)
        except NoMeasurement as error:
            problems.append(f"axes: {error}")
    return FlownLog(path, log.run, log.start_utc, _identity(log), flights, tuple(problems))


def _by_position(log: FlightLog, name: str, aircraft: Aircraft, bus: Mapping[str, Marks]) -> ServoEstimate | None:
    if aircraft.surfaces[name].measured is None:
        return None
    segment = cut(log, name, aircraft, bus)
    verdict = audit_segment(segment, aircraft, duration_s=log.duration_s)
    stood = any(fault.kind in STANDS_STILL for fault in verdict.faults)
    estimated = estimate_flight(segment, aircraft, unfit="stood still for a part of the flight" if stood else "")
    return estimated._replace(alarm=verdict.reason if verdict.status == "fault" else "")


def _by_current(log: FlightLog, name: str, aircraft: Aircraft) -> ServoEstimate | None:
    sources, unfit = current_sources(log, aircraft)
    if name in unfit:
        raise NoMeasurement(unfit[name])
    known, source = aircraft.surfaces[name].healthy_current, sources.get(name)
    if known is None or source is None or [one.channel for one in sources.values()].count(source.channel) > 1:
        return None  # a wire that several servos share wears for none of them
    seen = see(current_series(log, name, aircraft, source), known)
    verdict = judged(seen)
    return ServoEstimate(quantities_of(seen), {}, verdict.reason if verdict.faults else "")


def _axes(log: FlightLog, motion: MotionModel) -> dict[str, ServoEstimate]:
    """What the motion of a flight tells of each axis: the effect that was left, and where it stood."""
    from servofd.axes.judge import judge_motion
    from servofd.axes.read import motion_of

    found = {}
    for audit in judge_motion(motion, motion_of(log, motion.rate_hz, motion.parameters)):
        if audit.axis not in SURFACE_AXES:
            continue
        values, missing = {}, {}
        for name, between in (("effect", audit.lost_share), ("offset_us", audit.offset_us)):
            if between is None or not audit.is_expected:
                missing[name] = audit.reason
                continue
            value = 1.0 - between.value if name == "effect" else between.value
            values[name] = Estimate.of(value, between.deviation)
        alarm = audit.reason if audit.status in ("suspect", "fault") else ""
        found[audit.axis] = ServoEstimate(values, missing, alarm)
    return found


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
    """By when they were flown, if all of them tell; else by name, numbers in it by their size."""
    silent = [log for log in logs if log.start_utc is None]
    if not silent:
        ordered = sorted(logs, key=lambda log: (log.start_utc.timestamp() if log.start_utc else 0.0, log.path))
        return Order(tuple(ordered), "time", "by the UTC time at which each log begins")
    why = "none tells" if len(silent) == len(logs) else f"{len(silent)} of {len(logs)} do not tell"
    return Order(tuple(sorted(logs, key=_natural)), "name", f"by name of the logs, as {why} when it was flown")


def _natural(log: FlownLog) -> list[list[tuple[int, str]]]:
    """Name and run, numbers in them by their size.

    Examples
    --------
    >>> cycles = [FlownLog("a.csv", run, None, "", {}, ()) for run in ("10", "2", "1")]
    >>> [log.run for log in sorted(cycles, key=_natural)]
    ['1', '2', '10']
    """
    names = (re.split(r"(\d+)", name) for name in (log.path, log.run))
    return [[(int(part) if part.isdecimal() else -1, part) for part in parts] for parts in names]


@dataclass(frozen=True, slots=True, eq=False)
class AircraftTrend:
    """All surfaces of one aircraft over its flights."""

    aircraft: str
    order: Order
    surfaces: tuple[SurfaceTrend, ...]
    problems: tuple[str, ...]
    """What could not be used, and why, a line each."""
    not_judged: tuple[str, ...]
    """Logs that tell nothing at all."""
    skipped: tuple[Skipped, ...] = ()
    """Files that are no logs."""

    @property
    def has_alarm(self) -> bool:
        """Whether anything is beyond its limit, or will be."""
        return any(surface.alarms for surface in self.surfaces)


def trend_logs(
    logs: str | Path | Sequence[str | Path],
    aircraft: Aircraft | str | Path,
    *,
    surfaces: tuple[str, ...] = (),
    workers: int | None = None,
    progress: Callable[[int], AbstractContextManager[Callable[[], None]]] = lambda _count: nullcontext(lambda: None),
) -> AircraftTrend:
    """Follow the servos of one aircraft over many flights.

    Parameters
    ----------
    logs : str, Path or sequence of them
        Logs, folders, patterns or addresses.
    aircraft : Aircraft, str or Path
        The aircraft or its file, with serial numbers, swaps and limits where there are any.
    surfaces : tuple of str
        Which to follow; all if empty.
    workers : int, optional
        Number of processes; one per core if None, 0: this one.
    progress : callable
        Called with the number of logs; gives a context with the function to call after each of them.

    Examples
    --------
    >>> seen = trend_logs(["sample_logs/faser_healthy_flight.mat"], "faser", surfaces=("rudder",), workers=0)
    >>> seen.has_alarm
    False
    """
    known = aircraft if isinstance(aircraft, Aircraft) else load_aircraft(aircraft)
    known.check_names(surfaces)
    paths = [logs] if isinstance(logs, str | Path) else logs
    there = find_logs([str(path) for path in paths], layout_of(known))
    task = partial(estimate_log, aircraft=known, surfaces=surfaces)
    flown: list[FlownLog] = []
    problems = list(there.problems)
    with progress(len(there.logs)) as step:
        for source, outcome in run_local(task, there.logs, workers):
            if isinstance(outcome, Exception):
                problems.append(f"{source.path}: {outcome}")
            else:
                flown += outcome
            step()
    return trend_of(flown, known, problems=problems, skipped=there.skipped)


def trend_of(
    logs: Sequence[FlownLog], aircraft: Aircraft, *, problems: Sequence[str] = (), skipped: tuple[Skipped, ...] = ()
) -> AircraftTrend:
    """Follow the servos of one aircraft over flights that are estimated already."""
    check_one_aircraft(logs)
    judged = [log for log in logs if log.flights]
    reasons = [*problems, *(f"{log.path}: {problem}" for log in logs for problem in log.problems)]
    if not judged:
        raise NoMeasurement(f"no flight shows anything of a servo: {reasons[0]}" if reasons else "no flight")
    order = in_order(judged)
    numbered = list(enumerate(order.logs, start=1))
    axes = aircraft.motion.axes if aircraft.motion is not None else ()
    followed = [(name, _wear(aircraft, name)) for name in aircraft.surfaces]
    surfaces = []
    for name, wear in [*followed, *((axis, Wear(AXIS_LIMITS, {})) for axis in axes)]:
        flights = {number: log.flights[name] for number, log in numbered if name in log.flights}
        if flights:
            days = {number: log.start_utc and log.start_utc.date() for number, log in numbered if number in flights}
            surfaces.append(follow(name, flights, days, wear))
    not_judged = (*problems, *(log.path for log in logs if not log.flights))
    return AircraftTrend(aircraft.name, order, tuple(surfaces), tuple(reasons), not_judged, skipped)


_TOLERANCES = 3.0
"""Tolerances of a healthy servo that make its limit."""
_DELAYS = 5.0
"""A frame of a 50 Hz autopilot is 20 ms, seven times the usual tolerance of 3 ms."""
_TELLING = 0.5
"""A servo that changed by less than half of what a healthy one may differ by has not changed."""
_TELLING_WIDTH_DEG = 0.1
"""Smallest change of a dead band that is reported [deg]."""
AXIS_LIMITS = {"effect": 0.75, "offset_us": 60.0}
"""Of an axis: a quarter of its effect is gone, or an eighth of the usual travel goes into its trim."""


def _wear(aircraft: Aircraft, name: str) -> Wear:
    """What a surface may come to, and the smallest sudden change of it that is reported."""
    entry = aircraft.surfaces[name]
    drawn = {} if entry.healthy_current is None else followed_limits(entry.healthy_current)
    given = entry.limits.model_dump(exclude_none=True)
    swaps = tuple((swap.date, swap.removed) for swap in entry.swaps)
    if not entry.names_servo:
        return Wear(drawn | given, {}, entry.serial, swaps)
    tolerance, servo = entry.tolerances, aircraft.servo(name)
    bandwidth_hz, rate_deg_s = servo.transfer.bandwidth_rad_s / (2.0 * np.pi), servo.rate_limit_deg_s or np.inf
    derived = {
        "bias_deg": entry.threshold_deg,
        "delay_s": servo.transport_delay_s + _DELAYS * tolerance.delay_s,
        "bandwidth_hz": bandwidth_hz * (1.0 - _TOLERANCES * tolerance.bandwidth),
        "noise_deg": _TOLERANCES * tolerance.noise_deg,
        "residual_p95_deg": entry.threshold_deg,
    }
    if servo.rate_limit_deg_s is not None:
        derived["rate_limit_deg_s"] = rate_deg_s * (1.0 - _TOLERANCES * tolerance.rate)
    limits = {
        name: float(value) for name, value in (drawn | derived | given).items() if value > 0.0 or name == "margin"
    }
    telling = {
        "dead_band_deg": _TELLING_WIDTH_DEG,
        "bias_deg": _TELLING * tolerance.bias_deg,
        "delay_s": _TELLING * tolerance.delay_s,
        "bandwidth_hz": _TELLING * tolerance.bandwidth * bandwidth_hz,
        "rate_limit_deg_s": _TELLING * tolerance.rate * rate_deg_s,
        "noise_deg": _TELLING * tolerance.noise_deg,
    }
    return Wear(limits, telling, entry.serial, swaps)


def trend_document(seen: AircraftTrend) -> dict[str, Any]:
    """Everything that a trend found."""
    return {
        "schema": "servofd.trend/1",
        "aircraft": seen.aircraft or None,
        "order": {"by": seen.order.by, "reason": seen.order.reason},
        "flights": [
            {
                "number": number,
                "path": log.path,
                "run": log.run or None,
                "start_utc": log.start_utc.isoformat() if log.start_utc else None,
                "alarms": {name: flight.alarm for name, flight in log.flights.items() if flight.alarm},
            }
            for number, log in enumerate(seen.order.logs, start=1)
        ],
        "surfaces": {surface.surface: _surface(surface) for surface in seen.surfaces},
        "problems": list(seen.problems),
    }


def _surface(surface: SurfaceTrend) -> dict[str, Any]:
    return {
        "serials": [{"from_flight": number, "serial": serial or None} for number, serial in surface.serials],
        "events": [
            {
                "kind": event.kind,
                "flight": event.first,
                "reason": event.reason,
                "changes": {name: jump._asdict() for name, jump in event.jumps.items()},
            }
            for event in surface.events
        ],
        "quantities": {name: _quantity(one) for name, one in surface.quantities.items()},
        "missing": dict(surface.missing),
        "notes": list(surface.notes),
    }


def _quantity(one: QuantityTrend) -> dict[str, Any]:
    what = QUANTITIES[one.name]
    return {
        "title": what.title,
        "shown": {"unit": what.unit, "scale": what.scale, "digits": what.digits},
        "worse": what.worse,
        "flights": [int(number) for number in one.flights.number],
        "values": one.flights.value.tolist(),
        "deviations": one.flights.deviation.tolist(),
        "pieces": [_piece(piece) for piece in one.pieces],
        "now": one.now._asdict(),
        "per_flight": None if one.slope is None else one.slope._asdict(),
        "limit": one.limit,
        "forecast": asdict(one.forecast),
    }


def _piece(piece: Piece) -> dict[str, Any]:
    """First and last flight, and the line between them."""
    ends = {"first": piece.first, "last": piece.last}
    if piece.number.size < FEWEST_FOR_LINE:
        return ends
    begin, end = piece.line.at(piece.first), piece.line.at(piece.last)
    return ends | {"begin": begin._asdict(), "end": end._asdict()}
