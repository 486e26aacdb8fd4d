"""The verdict on a surface whose servo was fitted to good flights.

An alarm is raised where a statistic stays above its threshold twice in a row or passes it by far, or three residuals in
a row on one side pass theirs; its name and times come from `servofd.detection.refit`, and the tests begin anew where it
ended.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from servofd.aircraft.segment import Segment
from servofd.detection.changes import (
    STATISTICS,
    Memory,
    detectable,
    exceeded,
    follow,
    no_sum,
    shown,
    thresholds_of,
    watched,
)
from servofd.detection.evidence import reported, status_of, too_short
from servofd.detection.refit import LOUD, named
from servofd.detection.residual import Residuals
from servofd.detection.threshold import Threshold
from servofd.detection.verdict import Statistics
from servofd.estimate.record import Record, load_at

if TYPE_CHECKING:
    from functools import partial

    from servofd.aircraft.calibrated import CalibratedServo
    from servofd.aircraft.schema import Surface
    from servofd.core.types import FloatArray
    from servofd.detection.bank.window import Fault
    from servofd.detection.changes import Watched
    from servofd.detection.residual import Commands
    from servofd.detection.verdict import SurfaceAudit

_MOST_FAULTS: Final = 20
_RESIDUALS: Final = STATISTICS.index("left_2s")
"""So many statistics are of the residual over its total sigma, not of what is left of it."""
_AGAIN_S: Final = 1.0
_STILL_FAST: Final = 0.69
"""Speed goes with the supply, and friction with the temperature: a fifth each, between good flights."""
_STILL_ALL: Final = 0.93
_LASTING: Final = ("slow", "loss_of_effectiveness", "bias", "deadband")
_TOLD_BEFORE: Final = ("slow", "loss_of_effectiveness", "bias")
_NONE: Final = (("bias_deg", 0.0), ("gain", 1.0), ("bandwidth_scale", 1.0))
"""What a healthy servo has."""
_LEAST_DEG: Final = {"oscillation": ("amplitude_deg", 0.2), "deadband": ("width_deg", 0.2)}
"""What the narrow-band test counts as an oscillation, and less play than any servo has."""
_SHORTEST_WEAR_S: Final = 2.0
_SAME_S: Final = 5.0
"""What is raised so soon after the end of a fault belongs to it."""
_LITTLE_KNOWN: Final = 5.0
"""Times its usual deviation a residual may reach where a servo moves as it never did in its good flights."""
_OFTEN_BEYOND: Final = 0.2
FALSE_ALARMS_PER_HOUR: Final = 0.05
"""Of one surface: 2 faults in 41 h of healthy flight of 31 simulated aircraft of even seed; 2 in 49 h of 37 of odd seed
confirm it (`benchmarks/calibration_campaign.py`). The rate of a rarer alarm has not been measured."""


def audit_calibrated(
    segment: Segment, surface: Surface, verdict: partial[SurfaceAudit], duration_s: float
) -> SurfaceAudit:
    """Judge one surface by what its good flights were like."""
    known = surface.calibrated
    if known is None:
        raise ValueError(f"{segment.surface}: not calibrated")
    flight = _watched(known, segment)
    rows = flight.judged
    steps_s = np.minimum(np.diff(flight.record.time_s, append=np.nan), 3.0 * segment.period_s)
    judged_s = float(np.nansum(steps_s[rows]))
    beyond = _beyond(flight)
    short = too_short(judged_s)
    if short:
        return verdict(status="unknown", reason=beyond or short, segment=segment)
    residuals, threshold = _shown(flight)
    found = judged(flight)
    sizes = detectable([flight])
    error_deg = flight.error_deg[rows]
    statistics = Statistics.of(error_deg, (flight.record.measured_deg - flight.reading_deg)[rows])
    well = f"as in its good flights (largest residual {statistics.max_abs_deg:.2f} deg{_untold(flight)})"
    status, reason = status_of(residuals, threshold, found.faults, found.suspicions, sizes, well)
    if beyond:
        status, reason = ("unknown" if status == "healthy" else status), f"{reason}; {beyond}"
    after = []
    if known.airspeed_m_s and not segment.context.airspeed_s.size:
        after.append(f"no airspeed in this log: taken to be about {known.airspeed_m_s:.0f} m/s, as in the good flights")
    if not known.airspeed_m_s and segment.context.airspeed_s.size:
        after.append("its good flights told no airspeed: calibrate it on logs that do, for fewer false alarms")
    return reported(
        verdict,
        segment,
        residuals,
        threshold,
        min(judged_s / max(duration_s, 1e-9), 1.0),
        status,
        reason,
        after,
        faults=found.faults,
        suspicions=found.suspicions,
        statistics=statistics,
        false_alarms_per_hour=FALSE_ALARMS_PER_HOUR,
        detectable=sizes,
    )


class Found(NamedTuple):
    """What became of a flight."""

    faults: tuple[Fault, ...]
    suspicions: tuple[Fault, ...]
    grid_s: FloatArray
    statistics: FloatArray


def judged(flight: Watched) -> Found:
    """Find and name the faults of a flight."""
    limits = thresholds_of(flight.known)
    time_s, error_deg = flight.record.time_s, flight.error_deg
    faults: list[Fault] = []
    suspicions: list[Fault] = []
    begin, grids, tables = 0, [], []
    earliest_s = float(time_s[0]) if time_s.size else 0.0
    for _ in range(_MOST_FAULTS):
        part = slice(begin, None)
        memory = Memory(flight.tests)
        _, triple, grid_s, statistics = follow(
            flight.tests, memory, time_s[part], error_deg[part], flight.slopes[part], flight.noise_deg[part]
        )
        raised_s, ratio, is_far = _alarm(limits, time_s[part], triple, grid_s, statistics[:, : len(STATISTICS)])
        keep = grid_s <= raised_s
        statistics = statistics[:, : len(STATISTICS)]
        grids.append(grid_s[keep])
        tables.append(statistics[keep])
        if not np.isfinite(raised_s):
            break
        fault = _weighed(named(flight, raised_s, ratio, earliest_s=earliest_s), ratio, is_far=is_far)
        if faults and fault.kind != "healthy" and raised_s - (faults[-1].end_s or raised_s) < _SAME_S:
            fault = _joined(faults.pop(), fault)
        (suspicions if fault.kind == "healthy" else faults).append(fault)
        if fault.end_s is None:
            if fault.kind != "healthy":
                break
            earliest_s = raised_s + 20.0
        else:
            earliest_s = max(fault.end_s, raised_s)
        begin = int(np.searchsorted(time_s, earliest_s + _AGAIN_S))
        if begin >= time_s.size - 2:
            break
    return Found(tuple(faults), tuple(suspicions), np.concatenate(grids), np.concatenate(tables))


def _weighed(fault: Fault, ratio: float, *, is_far: bool) -> Fault:
    """The same fault, or none: what barely passes its threshold has to be one that servos have.

    A servo that is a little slow is still a good one, on a cold day or a low supply; and none is worn, weak or bent for
    a moment only, nor is an offset one that may as well be none. Where the residual itself stays within what good
    flights do, wear of no size is none, and what raised the alarm has to tell of it before.
    """
    speed, gain = fault.parameters.get("bandwidth_scale"), fault.parameters.get("gain")
    still_fast = fault.kind == "slow" and speed is not None and speed.value >= _STILL_FAST
    short = fault.kind in _LASTING and fault.end_s is not None and fault.end_s - fault.start_s < _SHORTEST_WEAR_S
    little = fault.kind == "loss_of_effectiveness" and gain is not None and gain.value >= _STILL_ALL
    nothing = any(
        fault.parameters[key].low <= none <= fault.parameters[key].high
        for key, none in _NONE
        if key in fault.parameters
    )
    size, least = _LEAST_DEG.get(fault.kind, ("", 0.0))
    tiny = size in fault.parameters and fault.parameters[size].value < least
    untold = fault.kind in _TOLD_BEFORE and fault.start_s >= fault.alarm_s
    if (
        still_fast
        or (not is_far and (tiny or untold))
        or (ratio < LOUD and (short or little or nothing or fault.kind == "unknown"))
    ):
        own = () if fault.kind == "unknown" else (fault.kind,)
        return replace(fault, kind="healthy", parameters={}, alternatives=(*own, *fault.alternatives)[:3])
    return fault


def _joined(first: Fault, then: Fault) -> Fault:
    """One fault of two that follow each other at once; named as the longer one is."""
    end_s, begun_s = first.end_s or first.alarm_s, then.alarm_s
    lasted_s = (np.inf if then.end_s is None else then.end_s) - begun_s
    longer = then if lasted_s >= end_s - first.alarm_s else first
    return replace(longer, start_s=first.start_s, alarm_s=first.alarm_s, end_s=then.end_s)


def _alarm(
    limits: FloatArray, time_s: FloatArray, triple: FloatArray, grid_s: FloatArray, statistics: FloatArray
) -> tuple[float, float, bool]:
    """When the first alarm is raised [s], infinite if never, and the largest statistic over its threshold then.

    Last whether the residual itself passes a threshold, not only a test of what it may mean.
    """
    direct = np.flatnonzero(triple >= limits[0])
    first_s = float(time_s[direct[0]]) if direct.size else np.inf
    ratios = exceeded(limits, np.zeros(limits.size), statistics)
    raised = np.flatnonzero(ratios >= 1.0)
    second_s = float(grid_s[raised[0]]) if raised.size else np.inf
    at_s = min(first_s, second_s)
    if not np.isfinite(at_s):
        return np.inf, float(ratios.max(initial=0.0)), False
    soon = statistics[(grid_s >= at_s) & (grid_s <= at_s + 5.0)] / limits
    return at_s, float(max(soon.max(initial=1.0), 1.0)), bool(soon[:, :_RESIDUALS].max(initial=0.0) >= 1.0)


def judge_stretch(
    known: CalibratedServo, residuals: Residuals, commands: Commands, sent_period_s: float | None
) -> Found:
    """Judge what a stream remembers of a surface."""
    segment = Segment("", commands.effective_s, commands.command_deg, residuals.time_s, residuals.measured_deg)
    segment = replace(segment, sent_period_s=sent_period_s, context=residuals.context)
    return judged(_watched(known, segment))


def _watched(known: CalibratedServo, segment: Segment) -> Watched:
    has_airspeed = segment.context.airspeed_s.size > 0
    record = Record.of(segment, known.supply_v, known.airspeed_m_s)
    return watched(known if has_airspeed else known.without_airspeed(), record)


def _shown(flight: Watched) -> tuple[Residuals, Threshold]:
    record = flight.record
    return shown(
        (record.time_s, flight.reading_deg, record.measured_deg, flight.error_deg),
        flight.judged,
        np.isfinite(record.start_deg),
        thresholds_of(flight.known)[0],
        flight.sigma_deg,
        no_sum(record.period_s),
    )


def _beyond(flight: Watched) -> str:
    """That much of a flight was faster than what was calibrated, and is not judged; nothing if little was."""
    last_m_s = flight.known.last_judged_m_s
    share = float(np.mean(flight.record.load > load_at(last_m_s))) if flight.record.load.size else 0.0
    if share < _OFTEN_BEYOND:
        return ""
    return (
        f"{share:.0%} of it flown at more than {last_m_s:.0f} m/s, of which the flights of its calibration (up to "
        f"{flight.known.fastest_m_s:.0f} m/s) tell nothing: calibrate it on one that is as fast"
    )


def _untold(flight: Watched) -> str:
    """That the largest residual stands where calibration knew little, or nothing."""
    rows = np.flatnonzero(flight.judged)
    peak = rows[np.argmax(np.abs(flight.error_deg[rows]))]
    known_deg = float(np.median(flight.sigma_deg[rows]))
    return ", in motion faster than theirs" if flight.sigma_deg[peak] > _LITTLE_KNOWN * known_deg else ""
