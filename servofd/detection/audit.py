"""The verdict on each surface of a log."""

from __future__ import annotations

import difflib
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from servofd.aircraft.current_source import supplies
from servofd.aircraft.pace import WARM_UP_STEPS
from servofd.aircraft.series import Series, bus_of, cut, too_far
from servofd.core.errors import DesignError, NoMeasurement
from servofd.core.evidence import NOTHING_DETECTABLE
from servofd.core.series import outline
from servofd.detection.causes import before_it_fell, with_common_causes
from servofd.detection.evidence import (
    LEAST_OF_THE_LOG,
    MOST_OF_THE_LOG,
    TRIED_DEG,
    coverage,
    not_judgeable,
    why_not_cleared,
)
from servofd.detection.known import crude_line, hardly_moved
from servofd.detection.lasting import slow_together
from servofd.detection.own import departed
from servofd.detection.seen import Healthy, TooShortError, rarely_asked, too_few
from servofd.detection.verdict import LogAudit, Statistics, SurfaceAudit, accusation, describe, two_digits
from servofd.estimate.record import Record

if TYPE_CHECKING:
    from collections.abc import Callable

    from logparsers.records import FlightLog
    from servofd.aircraft.schema import Aircraft, Surface
    from servofd.core.evidence import Detectable
    from servofd.detection.residual import ThresholdKind
    from servofd.detection.seen import Seen
    from servofd.detection.verdict import Status

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

    def one(name: str, slow_since_s: float = np.inf) -> SurfaceAudit:
        expected = _is_expected(log, aircraft, name)
        surface = judged_by(aircraft.surfaces[name], threshold_deg, threshold)
        try:
            segment = cut(log, name, aircraft, bus)
            segment = replace(segment, context=before_it_fell(segment.context))
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
                slow_since_s=slow_since_s,
            )
        if np.isinf(slow_since_s):  # a second look at a surface is of one that is done
            progress(name)
        return verdict

    # The kernel runs without the interpreter's lock.
    with ThreadPoolExecutor(max_workers=threads or os.cpu_count()) as pool:
        found = tuple(pool.map(one, chosen))
        since_s = slow_together([each.lasting for each in found if each.lasting is not None])
        if np.isfinite(since_s) and threshold_deg is None:
            found = tuple(pool.map(partial(one, slow_since_s=since_s), chosen))
    # Whoever names a level wants to know what reaches it, whatever the reason is.
    judged, causes = with_common_causes(found, supplies(log, aircraft)) if threshold_deg is None else (found, ())
    return LogAudit(log, aircraft, judged, common_causes=causes)


def audit_segment(
    segment: Series,
    aircraft: Aircraft,
    *,
    duration_s: float,
    threshold_deg: float | None = None,
    threshold: ThresholdKind | None = None,
    expected: bool = True,
    slow_since_s: float = np.inf,
) -> SurfaceAudit:
    """Judge one surface.

    Threshold and its kind are those of the aircraft, unless others are asked for. `slow_since_s` is since when the
    servos of the log are slower together, if they are.
    """
    name = segment.surface
    surface = judged_by(aircraft.surfaces[name], threshold_deg, threshold)
    verdict = _verdict_on(name, surface, expected=expected)
    # Whoever names a level wants to know what reaches it, and that alone.
    healthy = Healthy(surface, aircraft.model(name), asked=threshold_deg is not None)
    problem = _too_little(segment, healthy)
    if problem:
        return verdict(status="unknown", reason=problem, segment=segment)
    if not surface.model.predicts:
        asked_deg = float(np.ptp(segment.command_deg)) if segment.command_deg.size else 0.0
        reason, tried = _unpredicted(surface, segment, asked_deg), asked_deg >= _HARDLY_ASKED_DEG
        doubt = departed(segment)
        if doubt:
            return verdict(status="suspect", reason=f"{doubt}; {reason}", segment=segment, tried=tried)
        return verdict(status="unknown", reason=reason, segment=segment, tried=tried)
    try:
        seen = healthy.beside(segment, slow_since_s)
    except (DesignError, TooShortError) as error:
        return verdict(status="unknown", reason=str(error), segment=segment)
    return _reported(verdict, seen, duration_s)


def _reported(verdict: Callable[..., SurfaceAudit], seen: Seen, duration_s: float) -> SurfaceAudit:
    """The verdict with what was seen of a flight of some length [s], and what was not."""
    segment, residuals, threshold, found = seen.segment, seen.residuals, seen.threshold, seen.found
    rows, share = residuals.settled, min(seen.judged_s / max(duration_s, 1e-9), 1.0)
    statistics = Statistics.of(residuals.residual_deg[rows], residuals.error_deg[rows])
    shown = NOTHING_DETECTABLE if found.against else seen.detectable()
    status, reason = _earned(seen, shown, statistics.max_abs_deg)
    uncovered, remarks = coverage(segment, residuals)
    problem = uncovered or ("judged for too little of the log" if share < LEAST_OF_THE_LOG else "")
    if status == "healthy" and problem:
        status, reason = "unknown", f"{problem}; as far as it was judged, {reason}"
    reason = "; ".join((reason, *remarks))
    if share < MOST_OF_THE_LOG:
        reason += f"; judged for {share:.0%} of the log"
    if np.isfinite(found.looked_to_s):
        reason += f"; so many alarms that what came after {found.looked_to_s:.0f} s was not looked at"
    if segment.left_out_in_words:
        reason += f"; {segment.left_out_in_words}"
    if segment.frozen_s > 0.0:
        reason += f"; {segment.frozen_s:.1f} s of frozen telemetry not judged"
        if segment.frozen_to_end and status != "fault":
            status, reason = "no_data", "telemetry froze and never came back; before that, " + reason
    asked_deg = float(np.ptp(segment.command_deg)) if segment.command_deg.size else 0.0
    sizes_deg = np.where(rows, residuals.residual_deg, np.nan)
    return verdict(
        status=status,
        reason="; ".join((reason, *seen.notes)),
        tried=status != "unknown" or shown.loss_share is not None or asked_deg >= TRIED_DEG,
        faults=() if found.against else found.faults,
        suspicions=() if found.against else found.suspicions,
        statistics=statistics,
        false_alarms_per_hour=seen.false_alarms_per_hour(),
        segment=segment,
        residuals=residuals,
        threshold=threshold,
        threshold_deg=threshold.typical_deg,
        detectable=shown,
        judged_share=share,
        outline=outline(residuals.time_s, sizes_deg, threshold.level_deg),
        lasting=seen.lasting,
    )


def _earned(seen: Seen, shown: Detectable, largest_deg: float) -> tuple[Status, str]:
    """What a surface has earned, and why, by its largest residual [deg] and the faults that would have shown."""
    status: Status = "unknown"
    found, reason = seen.found, seen.found.against
    if not reason and found.faults:
        status, reason = "fault", accusation(found.faults)
    elif not reason and found.suspicions:
        looks = "; ".join(describe(fault) for fault in found.suspicions)
        status, reason = "suspect", f"no alarm stands, but look at it: {looks}"
    reason = reason or why_not_cleared(seen.residuals, shown, seen.threshold.typical_deg)
    if not reason:
        status, reason = "healthy", "; ".join(filter(None, (seen.well(largest_deg), not_judgeable(shown))))
    if seen.doubt:
        status, reason = ("suspect" if status in ("healthy", "unknown") else status), f"{seen.doubt}; {reason}"
    if seen.beyond:
        status, reason = ("unknown" if status == "healthy" else status), f"{reason}; {seen.beyond}"
    return status, reason


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
        lacking = hardly_moved([counting]) or f"{counting.duration_s:.0f} s of it were not enough"
        return f"no servo can be fitted to this log: {lacking}; {record}"
    return rarely_asked(segment) or (
        f"no servo predicts this surface from its command, which stays within {asked} (a fitted one "
        f"explains {max(share, 0.0):.0%} of the motion): check that command and position belong together, or {record}"
    )
