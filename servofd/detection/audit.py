"""The verdict on each surface of a log."""

from __future__ import annotations

import difflib
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from servofd.aircraft.pace import WARM_UP_STEPS
from servofd.aircraft.series import Series, bus_of, cut, too_far
from servofd.core.errors import DesignError, NoMeasurement
from servofd.core.evidence import NOTHING_DETECTABLE
from servofd.detection.evidence import reported, status_of
from servofd.detection.flights import Flight
from servofd.detection.known import crude_line, hardly_moved
from servofd.detection.seen import TooShortError, healthy_of, too_few
from servofd.detection.verdict import (
    SERVO_OR_SENSOR,
    CommonCause,
    LogAudit,
    Statistics,
    SurfaceAudit,
    describe,
    two_digits,
)
from servofd.estimate.record import Record

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from logparsers.records import FlightLog
    from servofd.aircraft.schema import Aircraft, Surface
    from servofd.detection.residual import ThresholdKind
    from servofd.detection.seen import Healthy
    from servofd.detection.verdict import Fault

_FASTEST_RATE_HZ = 50_000.0
"""Rate of positions above which the unit of the time stamps is wrong [Hz]."""


def audit_log(
    log: FlightLog,
    aircraft: Aircraft,
    *,
    threshold_deg: float | None = None,
    threshold: ThresholdKind | None = None,
    surfaces: tuple[str, ...] = (),
    threads: int | None = None,
    progress: Callable[[str], None] = lambda _surface: None,
) -> LogAudit:
    """Judge the surfaces of one log.

    Parameters
    ----------
    log : FlightLog
        What was recorded.
    aircraft : Aircraft
        Surfaces, calibrations and servos.
    threshold_deg : float, optional
        Constant alarm level for all surfaces [deg]; each has its own in the aircraft.
    threshold : {"constant", "interval"}, optional
        Kind of threshold for all surfaces; each has its own in the aircraft.
    surfaces : tuple of str
        Which to judge; all if empty.
    threads : int, optional
        How many surfaces are judged at a time; one per core if None.
    progress : callable
        Called with the name of each surface that is done.

    Returns
    -------
    LogAudit
        One verdict per surface, in the order of the aircraft file.

    Examples
    --------
    >>> import logparsers
    >>> from servofd.aircraft.schema import load_aircraft
    >>> log = logparsers.read("sample_logs/faser_stuck_flight.mat")
    >>> audit_log(log, load_aircraft("faser"), surfaces=("elevator",)).surfaces[0].status
    'fault'
    """
    chosen = surfaces or tuple(aircraft.surfaces)

    bus = bus_of(log, aircraft)

    def one(name: str) -> SurfaceAudit:
        expected = _is_expected(log, aircraft, name)
        surface = judged_by(aircraft.surfaces[name], threshold_deg, threshold)
        try:
            segment = cut(log, name, aircraft, bus)
        except NoMeasurement as reason:
            verdict = _verdict_on(name, surface, expected=expected)(status="no_data", reason=str(reason))
        else:
            verdict = audit_segment(
                segment,
                aircraft,
                threshold_deg=threshold_deg,
                threshold=threshold,
                duration_s=log.duration_s,
                expected=expected,
            )
        progress(name)
        return verdict

    # The kernel runs without the interpreter's lock.
    with ThreadPoolExecutor(max_workers=threads or os.cpu_count()) as pool:
        found = tuple(pool.map(one, chosen))
    # Whoever names a level wants to know what reaches it, whatever the reason is.
    judged, causes = with_common_causes(found) if threshold_deg is None else (found, ())
    return LogAudit(log, aircraft, judged, common_causes=causes)


def audit_segment(
    segment: Series,
    aircraft: Aircraft,
    *,
    duration_s: float,
    threshold_deg: float | None = None,
    threshold: ThresholdKind | None = None,
    expected: bool = True,
) -> SurfaceAudit:
    """Judge one surface.

    Threshold and its kind are those of the aircraft, unless others are asked for.
    """
    name = segment.surface
    surface = judged_by(aircraft.surfaces[name], threshold_deg, threshold)
    verdict = _verdict_on(name, surface, expected=expected)
    # Whoever names a level wants to know what reaches it, and that alone.
    healthy = healthy_of(surface, aircraft.model(name), asked=threshold_deg is not None)
    problem = _too_little(segment, healthy)
    if problem:
        return verdict(status="unknown", reason=problem, segment=segment)
    if not surface.model.predicts:
        asked_deg = float(np.ptp(segment.command_deg)) if segment.command_deg.size else 0.0
        reason, tried = _unpredicted(surface, segment, asked_deg), asked_deg >= _HARDLY_ASKED_DEG
        return verdict(status="unknown", reason=reason, segment=segment, tried=tried)
    try:
        seen = healthy.beside(segment)
    except (DesignError, TooShortError) as error:
        return verdict(status="unknown", reason=str(error), segment=segment)
    rows, residuals = seen.residuals.settled, seen.residuals
    statistics = Statistics.of(residuals.residual_deg[rows], residuals.error_deg[rows])
    faults, suspicions, shown = seen.found.faults, seen.found.suspicions, seen.detectable()
    status, reason = status_of(residuals, seen.threshold, faults, suspicions, shown, seen.well(statistics.max_abs_deg))
    if seen.against:
        status, reason = "unknown", seen.against
        faults, suspicions, shown = (), (), NOTHING_DETECTABLE
    if seen.doubt:
        status = "suspect" if status in ("healthy", "unknown") else status
        reason = f"{seen.doubt}; {reason}"
    if seen.beyond:
        status, reason = ("unknown" if status == "healthy" else status), f"{reason}; {seen.beyond}"
    return reported(
        verdict,
        seen.segment,
        residuals,
        seen.threshold,
        min(seen.judged_s / max(duration_s, 1e-9), 1.0),
        status,
        reason,
        seen.notes,
        faults=faults,
        suspicions=suspicions,
        statistics=statistics,
        false_alarms_per_hour=seen.false_alarms_per_hour(),
        detectable=shown,
    )


def judged_by(surface: Surface, threshold_deg: float | None, threshold: ThresholdKind | None) -> Surface:
    """The surface with the threshold that was asked for."""
    if threshold_deg is not None:
        known = surface.tolerances if surface.tells_small_faults else None
        change = {"threshold_deg": threshold_deg, "threshold": "constant", "tolerance": known}
        surface = surface.model_copy(update=change)
    return surface if threshold is None else surface.model_copy(update={"threshold": threshold})


def _verdict_on(name: str, surface: Surface, *, expected: bool) -> partial[SurfaceAudit]:
    """Maker of a verdict that already knows which surface it is about."""
    return partial(
        SurfaceAudit,
        surface=name,
        servo=surface.servo,
        threshold_kind=surface.threshold,
        threshold_deg=surface.threshold_deg,
        model=surface.model,
        expected=expected,
    )


def _is_expected(log: FlightLog, aircraft: Aircraft, name: str) -> bool:
    """Whether this log should tell about a surface.

    An aircraft may have more surfaces than a log holds. But a channel that is missing while a similar one is
    claimed by no surface has most likely been misspelt, and that must not pass for "not in this log".
    """
    surface = aircraft.surfaces[name]
    if surface.measured is None:
        return False
    wanted = (surface.command.channel, surface.measured.channel)
    if any(channel in log.channels for channel in wanted):
        return True
    claimed = {c.channel for s in aircraft.surfaces.values() for c in (s.command, s.measured) if c is not None}
    unclaimed = [channel for channel in log.channels if channel not in claimed]
    return any(difflib.get_close_matches(channel, unclaimed, n=1, cutoff=0.8) for channel in wanted)


def _too_little(segment: Series, healthy: Healthy) -> str:
    """Why this segment cannot be judged, or nothing."""
    if not segment.period_s > 0.0:
        return "fewer than two position samples"
    if 1.0 / segment.period_s > _FASTEST_RATE_HZ:
        return f"position comes at {1.0 / segment.period_s:.2g} Hz: check the unit of the time stamps"
    first = slice(WARM_UP_STEPS + 1)
    few = too_few(
        healthy,
        segment.period_s,
        segment.command_s[first],
        segment.measured_s[first],
        is_link=segment.sent_period_s is not None,
    )
    return few or too_far(segment)


USUAL_GAINS = (0.8, 1.25)
"""Gains of a servo whose scale is right."""
_HARDLY_ASKED_DEG, _HARDLY_MOVED = 1.0, 0.05
"""A command that moves by less shows nothing [deg]; a position that moves by less than this share does not follow."""


def _unpredicted(surface: Surface, segment: Series, asked_deg: float) -> str:
    """Why no servo could be fitted to this log, and what to record."""
    moved_deg = float(np.nanmax(segment.measured_deg) - np.nanmin(segment.measured_deg))
    record = "record a minute of full and free control movements with this surface, fast and slow"
    share, asked = surface.model.explained_share, f"{two_digits(asked_deg)} deg"
    if asked_deg < _HARDLY_ASKED_DEG:
        return f"its command stays within {asked}, too little motion to tell how it would follow: {record}"
    if moved_deg < _HARDLY_MOVED * asked_deg:
        line = crude_line(Record.of(segment))
        if line is not None:
            return (
                f"its position is {line.gain:.2g}x the command throughout: check the scale of the calibration, or its "
                "unit (radians are 0.017 times degrees)"
            )
        return (
            f"its position stays within {two_digits(moved_deg)} deg while its command moves by {asked}: jammed "
            "from the beginning, or no reading of this surface"
        )
    if share is None:
        counting = segment.at(np.isfinite(segment.measured_deg))
        lacking = hardly_moved([Flight("", counting)]) or f"{counting.duration_s:.0f} s of it were not enough"
        return f"no servo can be fitted to this log: {lacking}; {record}"
    return (
        f"no servo predicts this surface from its command, which stays within {asked} (a fitted one "
        f"explains {max(share, 0.0):.0%} of the motion): check that command and position belong together, or {record}"
    )


_TOGETHER_S, _STILL_TOGETHER_S = 1.0, 0.5
_FEWEST, _MOST_SHARE = 3, 0.5
"""So many surfaces, and this share of those that were judged, do not fail in one instant."""
_FROZEN = ("stuck", "hardover", "deadband", "floating")
_AT_START_S = 5.0
"""Time after the first sample within which a fault was there from the beginning [s]."""
_FROZEN_SAMPLES = 5
"""Equal readings of a position that froze."""
_ASKED_DEG = 0.5
"""Readings of a servo that is asked to move so far change: none is coarser."""
_OF_NO_SERVO = ("bus", "servo_type")
"""Causes that are no fault of any servo."""


def with_common_causes(
    surfaces: Sequence[SurfaceAudit],
) -> tuple[tuple[SurfaceAudit, ...], tuple[CommonCause, ...]]:
    """Return the verdicts, and what befell most surfaces in one instant.

    Its members keep their own faults; where a supply gave way, who was only suspected of being slow is at fault with
    them: what several show at once is no chance. A bus that stands still or a wrong servo type is no fault of any
    servo, and becomes a suspicion.
    """
    judged = [s for s in surfaces if s.is_judged]
    result = list(surfaces)
    causes: list[CommonCause] = []
    for at_s in sorted(_since_s(s, fault) for s in judged for fault in s.faults):
        if any(cause.since_s <= at_s <= cause.since_s + _TOGETHER_S for cause in causes):
            continue
        struck = {s.surface: fault for s in result if (fault := _struck(s, at_s)) is not None}
        still = [s.surface for s in result if s.surface not in struck and _stands_still(s, at_s)]
        is_common = len(struck) + len(still) >= max(_FEWEST, _MOST_SHARE * len(judged))
        if not is_common or sum(fault.level == "fault" for fault in struck.values()) < 1:
            continue
        cause = _cause(list(struck.items()), still, at_s, _first_s(result))
        causes.append(cause)
        for place, surface in enumerate(result):
            if surface.surface in struck and cause.kind in _OF_NO_SERVO:
                result[place] = _excused(surface, at_s, cause)
            elif surface.surface in struck and cause.kind == "supply":
                result[place] = _convicted(surface, struck[surface.surface])
    return tuple(result), tuple(causes)


def _first_s(surfaces: Sequence[SurfaceAudit]) -> float:
    """When the first surface is seen [s]."""
    seen = (s.residuals or s.current for s in surfaces)
    begun_s = [float(one.time_s[0]) for one in seen if one is not None and one.time_s is not None and one.time_s.size]
    return min(begun_s, default=0.0)


def _struck(surface: SurfaceAudit, at_s: float) -> Fault | None:
    """What befell a surface at an instant: a fault, or a suspicion of one."""
    found = [fault for fault in surface.faults if _is_at(_since_s(surface, fault), at_s)]
    found += [fault for fault in surface.suspicions if _is_at(fault.start_s, at_s)]
    return found[0] if found else None


def _since_s(surface: SurfaceAudit, fault: Fault) -> float:
    """When a fault began; or when its reading froze to the last bit, if that was before it showed [s]."""
    if surface.residuals is None:
        return fault.start_s
    measured_deg, time_s = surface.residuals.measured_deg, surface.residuals.time_s
    seen = np.flatnonzero(np.isfinite(measured_deg) & (time_s <= fault.alarm_s))
    if seen.size == 0:
        return fault.start_s
    other = np.flatnonzero(measured_deg[seen] != measured_deg[seen[-1]])
    first = int(other[-1]) + 1 if other.size else 0
    frozen = seen.size - first >= _FROZEN_SAMPLES
    return min(fault.start_s, float(time_s[seen[first]])) if frozen else fault.start_s


def _stands_still(surface: SurfaceAudit, at_s: float) -> bool:
    """Whether its readings stop at this time, or freeze to the last bit although it is asked to move, without alarm."""
    seen = surface.residuals
    if seen is None:
        return False
    known = np.isfinite(seen.measured_deg)
    time_s, measured_deg, simulated_deg = seen.time_s[known], seen.measured_deg[known], seen.simulated_deg[known]
    begin, end = np.searchsorted(time_s, (at_s + _STILL_TOGETHER_S, at_s + 2.0 * _STILL_TOGETHER_S))
    if begin == end:
        return bool(begin > 0 and time_s[begin - 1] >= at_s - _STILL_TOGETHER_S)
    froze = end - begin >= _FROZEN_SAMPLES and np.ptp(measured_deg[begin:end]) == 0.0
    return bool(froze and np.ptp(simulated_deg[begin:end]) > _ASKED_DEG)


def _is_at(start_s: float, at_s: float) -> bool:
    return 0.0 <= start_s - at_s <= _TOGETHER_S


def _cause(struck: Sequence[tuple[str, Fault]], still: Sequence[str], at_s: float, first_s: float) -> CommonCause:
    """What happened to all of them, and what to look at."""
    names = tuple([name for name, _ in struck] + list(still))
    faults = [fault for _, fault in struck]
    ends_s = [fault.end_s for fault in faults if fault.end_s is not None]
    end_s = float(np.median(ends_s)) if len(ends_s) == len(faults) else None
    count = f"{len(names)} surfaces left their models together at {at_s:.2f} s"
    slow = [fault for fault in faults if "slow" in (fault.kind, *fault.alternatives)]
    if at_s - first_s <= _AT_START_S:
        text = f"{count}: look for a wrong servo type, calibration or pairing (--servo unknown fits servos to this log)"
        return CommonCause("servo_type", at_s, end_s, names, text)
    if 2 * sum("unpowered" in (fault.kind, *_confirming(fault)) for fault in faults) > len(faults):
        text = f"{len(names)} servos draw no current since {at_s:.2f} s: look at their supply, its fuse and its plugs"
        return CommonCause("supply", at_s, end_s, names, text)
    if still or 2 * sum(fault.kind in _FROZEN for fault in faults) > len(faults):
        until = "" if end_s is None else f", for {end_s - at_s:.1f} s"
        text = f"{count}: their positions stand still{until}; look for a frozen or late bus, or a failed supply"
        return CommonCause("bus", at_s, end_s, names, text)
    if 2 * len(slow) > len(faults):
        shares = [f.parameters["bandwidth_scale"].value for f in slow if "bandwidth_scale" in f.parameters]
        speed = f"{float(np.median(shares)):.0%} of their speed" if shares else "less than their speed"
        text = f"{len(names)} servos have {speed} since {at_s:.2f} s: measure their supply under load"
        return CommonCause("supply", at_s, end_s, names, text)
    return CommonCause("unknown", at_s, end_s, names, f"{count}: look at the servo supply, the bus and the clocks")


def _confirming(fault: Fault) -> tuple[str, ...]:
    """What another witness takes the fault for."""
    return () if fault.confirmed_by is None else (fault.confirmed_by.kind,)


def _convicted(surface: SurfaceAudit, given: Fault) -> SurfaceAudit:
    """The surface at fault of what it was suspected of, since others show the same at once."""
    if given in surface.faults or "slow" not in (given.kind, *given.alternatives):
        return surface
    fault = replace(given, kind="slow", level="fault")
    suspicions = tuple(one for one in surface.suspicions if one is not given)
    faults = tuple(sorted((*surface.faults, fault), key=lambda one: one.start_s))
    reason = f"{SERVO_OR_SENSOR}{'; then '.join(describe(one) for one in faults)}; others show the same at once"
    return replace(surface, status="fault", faults=faults, suspicions=suspicions, reason=reason)


def _excused(surface: SurfaceAudit, at_s: float, cause: CommonCause) -> SurfaceAudit:
    """The surface without the faults of an instant that are no servo's, and with the sentence."""
    text = f"{cause.text}: one cause, and no servo's"
    shared = [fault for fault in surface.faults if _is_at(_since_s(surface, fault), at_s)]
    own = tuple(fault for fault in surface.faults if fault not in shared)
    common = tuple(replace(fault, level="suspect") for fault in shared)
    suspicions = tuple(sorted((*surface.suspicions, *common), key=lambda fault: fault.start_s))
    if own:
        whole, left = ("; then ".join(describe(fault) for fault in faults) for faults in (surface.faults, own))
        reason = f"{surface.reason.replace(whole, left)}; {text}"
        return replace(surface, faults=own, suspicions=suspicions, reason=reason)
    return replace(surface, status="suspect", faults=(), suspicions=suspicions, reason=text)
