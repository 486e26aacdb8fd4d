"""A recording read back: whether its curves fit its verdicts, other verdicts from it, a part of it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servofd.aircraft.series import is_streamed
from servofd.core.errors import RecordingError
from servofd.detection.audit import audit_segment, judged_by
from servofd.detection.verdict import Statistics
from servofd.outputs.recording.content import Recording
from servofd.outputs.recording.verdicts import LIVE

if TYPE_CHECKING:
    from servofd.detection.threshold import ThresholdKind
    from servofd.detection.verdict import Fault, Status, SurfaceAudit
    from servofd.outputs.recording.content import Trace


def statistics_of(trace: Trace) -> Statistics | None:
    """Size of the residual while it was judged, from the recorded curves; None if it never was."""
    judged = np.isfinite(trace.residual_deg)
    if not judged.any():
        return None
    with np.errstate(over="ignore", invalid="ignore"):  # of a damaged recording
        error_deg = (trace.measured_deg - trace.simulated_deg)[judged]
    return Statistics.of(trace.residual_deg[judged], error_deg)


def contradictions(recording: Recording) -> list[str]:
    """One sentence for each surface whose recorded curves are not the ones that were judged.

    Statistics are computed from the curves in the same way as by the audit, so that they agree to the last bit, or
    the recording is incomplete, or was altered.
    """
    found = []
    for surface in recording.audit.surfaces:
        if surface.statistics is None:
            continue
        trace = recording.traces.get(surface.surface)
        now = None if trace is None else statistics_of(trace)
        if now != surface.statistics:
            until = f"end at {trace.time_s[-1]:.2f} s" if trace is not None and trace.time_s.size else "are missing"
            found.append(
                f"{surface.surface}: the verdict was made from other curves than are recorded here (they {until}): "
                "incomplete or altered"
            )
    return found


def rejudged(
    recording: Recording, *, threshold_deg: float | None = None, threshold: ThresholdKind | None = None
) -> Recording:
    """Judge the recorded commands and deflections again, as an audit of the log would.

    The recording has the aircraft's models and tolerances, so that new alarms get names as well.
    """
    audit = recording.audit
    if LIVE in recording.notes:
        audit = replace(audit, log=replace(audit.log, span_s=(recording.start_s, recording.end_s)))
        recording = replace(recording, audit=audit)
    judged = tuple(_judged(recording, surface, threshold_deg, threshold) for surface in audit.surfaces)
    again = Recording.of(replace(audit, surfaces=judged))
    by = f"{threshold_deg:g} deg" if threshold_deg is not None else threshold or "the recorded threshold"
    notes = (*(n for n in recording.notes if n != LIVE), f"judged again, by {by}")
    return replace(
        recording, audit=replace(again.audit, log=audit.log), traces={**recording.traces, **again.traces}, notes=notes
    )


def _judged(
    recording: Recording, surface: SurfaceAudit, threshold_deg: float | None, threshold: ThresholdKind | None
) -> SurfaceAudit:
    trace = recording.traces.get(surface.surface)
    known = recording.audit.aircraft.surfaces[surface.surface]
    if trace is None or trace.time_s.size < 2:
        asked = judged_by(known, threshold_deg, threshold)
        return replace(surface, threshold_kind=asked.threshold, threshold_deg=asked.threshold_deg)
    return audit_segment(
        trace.segment(
            surface.surface,
            known.command_period_s,
            is_streamed=is_streamed(recording.audit.log.format, known.command.channel),
        ),
        recording.audit.aircraft,
        duration_s=recording.audit.log.duration_s,
        threshold_deg=threshold_deg,
        threshold=threshold,
        expected=surface.expected,
    )


def between(recording: Recording, from_s: float, to_s: float) -> Recording:
    """Keep what happened from one time to another.

    Verdicts are those of the whole flight: a fault is kept if any of it lies in between, with its name and onset.

    Examples
    --------
    >>> from servofd.outputs.recording.write import recording_of
    >>> from servofd import audit
    >>> (found,) = audit("sample_logs/faser_stuck_flight.mat")
    >>> cut = between(recording_of(found), 0.0, 4.0)
    >>> cut.audit.has_fault, cut.audit.surfaces[0].reason
    (False, 'no alarm from 0 to 4 s')
    """
    begin_s, end_s = recording.start_s, recording.end_s
    if not from_s < to_s:
        raise RecordingError(f"--between {from_s:g} {to_s:g}: the first time must be before the second")
    if from_s > end_s or to_s < begin_s or not recording.traces:
        raise RecordingError(f"--between {from_s:g} {to_s:g}: the recording runs from {begin_s:g} to {end_s:g} s")
    traces = {name: trace.between(from_s, to_s) for name, trace in recording.traces.items()}
    short = replace(recording, traces=traces)
    surfaces = tuple(_of(surface, short, from_s, to_s) for surface in recording.audit.surfaces)
    log = replace(recording.audit.log, span_s=(max(from_s, begin_s), min(to_s, end_s)))
    return replace(
        short,
        audit=replace(recording.audit, log=log, surfaces=surfaces),
        notes=(*recording.notes, f"cut from {from_s:g} to {to_s:g} s of {begin_s:g} to {end_s:g} s"),
    )


def _of(surface: SurfaceAudit, recording: Recording, from_s: float, to_s: float) -> SurfaceAudit:
    """Verdict on one surface, as far as it belongs to these seconds."""
    trace = recording.traces.get(surface.surface)
    if trace is None or not surface.is_judged:
        return surface
    faults, suspicions = (
        tuple(f for f in found if _touches(f, from_s, to_s)) for found in (surface.faults, surface.suspicions)
    )
    statistics = statistics_of(trace)
    status: Status = "fault" if faults else "suspect" if suspicions else "healthy"
    reason = surface.reason if status == surface.status else f"no alarm from {from_s:g} to {to_s:g} s"
    if statistics is None:
        status, reason = "no_data", f"nothing was judged from {from_s:g} to {to_s:g} s"
        faults = suspicions = ()
    return replace(surface, status=status, reason=reason, faults=faults, suspicions=suspicions, statistics=statistics)


def _touches(fault: Fault, from_s: float, to_s: float) -> bool:
    return fault.start_s <= to_s and (fault.end_s is None or fault.end_s >= from_s)
