"""Currents of a log laid beside the verdicts on its positions: one witness more for each surface that has one."""

from __future__ import annotations

import itertools
import operator
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from logparsers.records import FlightLog
from servofd.aircraft.current import CalibratedCurrent, CurrentSource
from servofd.aircraft.current_source import current_sources, read_current, supplies
from servofd.aircraft.pace import OUTAGE_S
from servofd.aircraft.schema import Aircraft
from servofd.aircraft.series import SURROUNDINGS, asked, channel_of, signal_of
from servofd.core.errors import CalibrationError, NoMeasurement
from servofd.core.types import FloatArray
from servofd.current.both import AGREE_S, agree, beside, confirmed
from servofd.current.evidence import largest_of
from servofd.current.judge import BY_CURRENT, EXPLAINED_OWN, judged, limits_of, verdict_of
from servofd.current.model import CurrentSeries, Motion, Seen, fit_current, see
from servofd.current.shared import faults_of_wire, own_currents, parted
from servofd.current.stream import OfCurrent, motion_model
from servofd.current.wear import features_of, wear_of
from servofd.detection.causes import with_common_causes
from servofd.detection.evidence import LEAST_OF_THE_LOG, MOST_OF_THE_LOG
from servofd.detection.verdict import (
    SERVO_OR_SENSOR,
    CommonCause,
    CurrentAudit,
    Fault,
    LogAudit,
    SurfaceAudit,
    accusation,
)
from servofd.servo.context import Context

_GRAVEST: Final = ("fault", "suspect", "healthy", "unknown", "no_data")


def with_currents(audit: LogAudit, cycles: dict[str, list[FloatArray]]) -> LogAudit:
    """The same audit with what the currents of its log tell.

    `cycles` keeps for each surface what the runs before it in the same file showed of wear.
    """
    log, aircraft = audit.log, audit.aircraft
    sources, unfit = current_sources(log, aircraft)
    by_channel: dict[str, list[str]] = {}
    for name, source in sources.items():
        by_channel.setdefault(source.channel, []).append(name)
    verdicts = {surface.surface: surface for surface in audit.surfaces}
    currents: dict[str, CurrentAudit] = {}
    events: tuple[CommonCause, ...] = ()
    for names in by_channel.values():
        if len(names) > 1:
            found, new = _together(log, aircraft, verdicts, sources, names)
            currents, events = currents | found, events + new
        elif names[0] in verdicts:
            name = names[0]
            before = cycles.setdefault(name, [])
            verdicts[name], currents[name] = _judged(log, aircraft, verdicts[name], sources[name], before)
    currents = {name: _of_the_log(current, log.duration_s) for name, current in currents.items()}
    currents |= {name: CurrentAudit("unknown", reason) for name, reason in unfit.items()}
    surfaces = [_joined(surface, currents.get(name)) for name, surface in verdicts.items()]
    common, causes = tuple(surfaces), audit.common_causes
    if any(s.current.faults or s.current.suspicions for s in surfaces if s.current):
        common, new = with_common_causes(surfaces, supplies(log, aircraft))
        causes = (*(one for one in causes if all(abs(one.since_s - other.since_s) > AGREE_S for other in new)), *new)
    return replace(audit, surfaces=common, common_causes=(*causes, *events))


def _of_the_log(current: CurrentAudit, duration_s: float) -> CurrentAudit:
    """What a current tells, and of how much of the log: of less than half of it clears no servo."""
    if current.time_s is None or current.time_s.size < 2 or not duration_s > 0.0:
        return current
    steps_s = np.diff(current.time_s)
    read_s = float(np.minimum(steps_s, max(3.0 * float(np.median(steps_s)), OUTAGE_S)).sum())
    share = min(current.judged_share * read_s / duration_s, 1.0)
    status, reason = current.status, current.reason
    if status == "healthy" and share < LEAST_OF_THE_LOG:
        status, reason = "unknown", f"judged for too little of the log; as far as it was judged, {reason}"
    if share < MOST_OF_THE_LOG:
        reason += f"; its current tells of {share:.0%} of the log"
    return replace(current, status=status, reason=reason, judged_share=share)


def _together(
    log: FlightLog,
    aircraft: Aircraft,
    verdicts: Mapping[str, SurfaceAudit],
    sources: Mapping[str, CurrentSource],
    names: Sequence[str],
) -> tuple[dict[str, CurrentAudit], tuple[CommonCause, ...]]:
    """What one current tells of several servos."""
    known = ((name, aircraft.surfaces[name].healthy_current) for name in names)
    calibrated = {name: one for name, one in known if one is not None}
    if len(calibrated) < len(names):
        reason = (
            f"channel {sources[names[0]].channel!r} is the current of {', '.join(names)} together: calibrate all of "
            "them on good flights to tell them apart"
        )
        return dict.fromkeys(names, CurrentAudit("unknown", reason)), ()
    try:
        series = {name: current_series(log, name, aircraft, sources[name]) for name in names}
    except NoMeasurement as error:
        return dict.fromkeys(names, CurrentAudit("unknown", str(error))), ()
    seen = {name: see(one, calibrated[name]) for name, one in own_currents(series, calibrated).items()}
    followed = {name for name, verdict in verdicts.items() if verdict.status == "healthy"}
    failed = {name: verdict.faults for name, verdict in verdicts.items() if name in seen}
    faults, events, until_s = faults_of_wire(seen, followed, failed)
    if np.isfinite(until_s):
        seen = {name: _read_until(one, until_s) for name, one in seen.items()}
    others = {name: [one for other in names if other != name for one in faults[other]] for name in names}
    return {name: verdict_of(seen[name], faults[name], others=others[name]) for name in names}, events


def again_by_current(surface: SurfaceAudit, aircraft: Aircraft, context: Context, duration_s: float) -> SurfaceAudit:
    """The verdict on the current that a monitor recorded of a surface without a position; as it is if there is none."""
    drawn, own = surface.current, aircraft.surfaces[surface.surface]
    known, source = own.healthy_current, own.current
    if drawn is None or drawn.time_s is None or drawn.current_a is None or drawn.command is None:
        return surface
    if known is None or source is None or drawn.time_s.size < 2:
        return surface
    watched = OfCurrent(surface.surface, motion_model(aircraft, surface.surface), source, known)
    seen = watched.seen(np.stack([drawn.time_s, drawn.current_a]), drawn.command, context)
    surface, found = _two(surface, seen, judged(seen))
    return _joined(surface, _of_the_log(found, duration_s))


def _read_until(seen: Seen, until_s: float) -> Seen:
    """The same, without what a sensor read after it failed."""
    note = f"from {until_s:.0f} s on its sensor reads nothing while servos move: it failed"
    series = replace(seen.series, notes=(*seen.series.notes, note))
    return seen._replace(series=series, usable=seen.usable & (series.time_s < until_s))


def healthy_currents(
    flown: Iterable[tuple[FlightLog, Aircraft]], spans: Sequence[tuple[float, float]] = ()
) -> tuple[dict[str, CalibratedCurrent], dict[str, str]]:
    """Currents of good flights by surface, and why there is none of others.

    `flown`: flights, or cycles of a bench, in their order, and the aircraft in the channels of each, with the servos
    whose motion the currents belong to. `spans`: which parts of each log are good [s]; all of it if empty.
    """
    wires: dict[tuple[str, ...], list[dict[str, CurrentSeries]]] = {}
    reasons: dict[str, str] = {}
    for log, known in flown:
        by_channel: dict[str, dict[str, CurrentSeries]] = {}
        sources, unfit = current_sources(log, known)
        reasons |= unfit
        for name, source in sources.items():
            try:
                by_channel.setdefault(source.channel, {})[name] = current_series(log, name, known, source)
            except NoMeasurement as error:
                reasons[name] = str(error)
        for wire in by_channel.values():
            pieces = [{name: one.within(*span) for name, one in wire.items()} for span in spans] or [wire]
            wires.setdefault(tuple(wire), []).extend(
                piece for piece in pieces if all(one.time_s.size > 1 for one in piece.values())
            )
    parts: dict[str, list[CurrentSeries]] = {}
    for names, together in wires.items():
        try:
            own = parted(together) if len(names) > 1 and together else together
        except CalibrationError as error:
            reasons |= dict.fromkeys(names, str(error))
            continue
        for name in names:
            parts.setdefault(name, []).extend(flight[name] for flight in own)
    found: dict[str, CalibratedCurrent] = {}
    for name, flights in parts.items():
        try:
            found[name] = _healthy(flights, is_alone=all(name not in names for names in wires if len(names) > 1))
        except CalibrationError as error:
            reasons[name] = str(error)
    for names in wires:
        if set(names) <= found.keys():
            each_flight = zip(*(parts[name] for name in names), strict=False)
            limits = limits_of([{one.surface: see(one, found[one.surface]) for one in each} for each in each_flight])
            found |= {name: found[name].model_copy(update={"limits_nats": limits}) for name in names}
    return found, {name: reason for name, reason in reasons.items() if name not in found}


def _healthy(flights: Sequence[CurrentSeries], *, is_alone: bool) -> CalibratedCurrent:
    """The current of one servo in its good flights; where several draw, spread is of none alone, and no wear known."""
    known = fit_current(flights)
    known = known.model_copy(update={"moving_a": round(largest_of([see(each, known) for each in flights]), 4)})
    if not is_alone:
        return known
    usual_a = float(np.mean([np.mean(each.current_a) for each in flights]))
    return known.model_copy(update={"wear": wear_of([features_of(see(each, known)) for each in flights], usual_a)})


def current_series(log: FlightLog, name: str, aircraft: Aircraft, source: CurrentSource) -> CurrentSeries:
    """What a log holds of the current of a surface, beside the motion that its commands ask for.

    Raises `NoMeasurement` if it holds none, or no command.
    """
    read = read_current(log, source)
    surface = aircraft.surfaces[name]
    command_s, command_deg = asked(surface, channel_of(log, surface.command.channel, "command"))
    if not command_s[0] <= read.time_s[-1] or not read.time_s[0] <= command_s[-1]:
        raise NoMeasurement(
            f"current channel {source.channel!r} has a clock of its own: read from {read.time_s[0]:.6g} to "
            f"{read.time_s[-1]:.6g} s, commands from {command_s[0]:.6g} to {command_s[-1]:.6g} s"
        )
    airspeed_s, airspeed_m_s = signal_of(log, SURROUNDINGS["airspeed_m_s"])
    volts_s, volts_v = (read.voltage_s, read.voltage_v)
    if not volts_s.size:
        volts_s, volts_v = signal_of(log, SURROUNDINGS["servo_voltage_v"])
    context = Context(airspeed_s=airspeed_s, airspeed_m_s=airspeed_m_s, voltage_s=volts_s, voltage_v=volts_v)
    motion = Motion.of(motion_model(aircraft, name), command_s, command_deg, float(read.time_s[-1]))
    return CurrentSeries(name, read.time_s, read.current_a, motion, context, read.notes)


_PARTS_OF_LOG: Final = (3, 2, 1)
"""Into how many parts a log is cut, one after the other; how late its readings come is known from the first ones."""


def own_current(series: CurrentSeries) -> CalibratedCurrent:
    """Return the healthy current that a log shows by itself: of the part that predicts the whole most sharply.

    Raises `CalibrationError` if no part of the log has enough motion and current.
    """
    first_s, last_s = float(series.time_s[0]), float(series.time_s[-1])
    found: list[tuple[bool, float, CalibratedCurrent]] = []
    sharpest = operator.itemgetter(0, 1)
    reason, late_s = "", None
    for count in _PARTS_OF_LOG:
        best = min(found, key=sharpest, default=None)
        if best is not None and not best[0]:
            late_s = best[2].late_s
        for from_s, to_s in itertools.pairwise(np.linspace(first_s, last_s, count + 1).tolist()):
            part = series.within(from_s, np.nextafter(to_s, np.inf))
            try:
                known = fit_current([part], is_own=True, late_s=late_s)
            except CalibrationError as error:
                reason = reason or str(error)
                continue
            known = known.model_copy(update={"fitted_between_s": (round(from_s, 2), round(to_s, 2))})
            sharpness_a = float(np.mean(see(series, known).noise_a))
            found.append((known.explained_share < EXPLAINED_OWN, sharpness_a, known))
    if not found:
        raise CalibrationError(reason)
    known = min(found, key=sharpest)[2]
    part = series.within(*(known.fitted_between_s or (first_s, last_s)))
    return known.model_copy(update={"limits_nats": limits_of([{series.surface: see(part, known)}])})


def _judged(
    log: FlightLog, aircraft: Aircraft, surface: SurfaceAudit, source: CurrentSource, before: list[FloatArray]
) -> tuple[SurfaceAudit, CurrentAudit]:
    """What the position of one surface tells, as its current leaves it, and its current."""
    name = surface.surface
    try:
        series = current_series(log, name, aircraft, source)
        known = aircraft.surfaces[name].healthy_current or own_current(series)
    except (NoMeasurement, CalibrationError) as error:
        return surface, CurrentAudit("unknown", str(error))
    seen = see(series, known)
    found = judged(seen, before)
    before.append(features_of(seen))
    return _two(surface, seen, found)


def _two(surface: SurfaceAudit, seen: Seen, found: CurrentAudit) -> tuple[SurfaceAudit, CurrentAudit]:
    """The verdicts on the position of a surface and on its current, each as the other leaves it."""
    if surface.segment is None:
        return surface, found
    where, follows = (surface.segment.measured_s, surface.segment.measured_deg), surface.status == "healthy"
    is_own = seen.known.fitted_between_s is not None
    raised = (*found.faults, *found.suspicions) if follows and is_own else found.faults
    both = beside(seen, raised, surface.faults, where, follows=follows)
    if both.is_denied:
        said = f"{found.reason}; {_FOLLOWED if is_own else _MOVES}"
        found = replace(found, status="unknown", reason=said, faults=(), suspicions=())
    elif both.current != found.faults:
        said = accusation(both.current, BY_CURRENT)
        found = replace(found, faults=both.current, status="fault", reason=said)
    reason = _retold(surface.reason, surface.faults, both.position)
    return replace(surface, faults=both.position, reason=reason), found


def _retold(reason: str, before: Sequence[Fault], now: Sequence[Fault], who: str = SERVO_OR_SENSOR) -> str:
    """A reason with faults as they are `now`, and what else it said."""
    head = accusation(before)
    return accusation(now, who) + reason.removeprefix(head) if before and reason.startswith(head) else reason


_FOLLOWED: Final = "but its position followed: calibrate what it draws on a good flight"
"""What the servo of a log alone draws when it is well is not known."""
_MOVES: Final = "but its position followed: the sensor of the current is at fault"


def _joined(surface: SurfaceAudit, current: CurrentAudit | None) -> SurfaceAudit:
    """The verdict of two witnesses."""
    if current is None:
        return surface
    joined = replace(surface, current=current)
    if current.time_s is None:  # it could not be judged, which takes nothing from what the position says
        return joined if surface.is_judged else replace(joined, reason=f"{surface.reason}; {current.reason}")
    known, left = confirmed(surface.faults, current.faults)
    faults = tuple(sorted((*known, *left), key=lambda fault: fault.start_s))
    suspicions = tuple(sorted((*surface.suspicions, *current.suspicions), key=lambda fault: fault.start_s))
    joined = replace(joined, faults=faults, suspicions=suspicions)
    if surface.segment is None:  # nothing but its current tells
        return replace(
            joined,
            status=current.status,
            reason=current.reason,
            judged_share=current.judged_share,
            tried=current.asked,
            expected=True,
        )
    status = min(surface.status, current.status, key=_GRAVEST.index)
    if surface.status in ("unknown", "no_data") and current.status == "healthy":
        status = surface.status  # a current alone clears no position that was there and could not be judged
    who = "servo: " if all(fault.confirmed_by for fault in known) else SERVO_OR_SENSOR
    reason = _retold(surface.reason, surface.faults, known, who)
    if left or current.status == "suspect" or _MOVES in current.reason:
        reason = f"{reason}; {current.reason}" if surface.status != "healthy" else f"{current.reason}; {reason}"
    if agree(known, left):
        reason += "; position and current agree"
    return replace(joined, status=status, reason=reason)
