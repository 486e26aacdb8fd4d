"""Another verdict from a recording: with another threshold, or on what was recorded live."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from servofd.detection.audit import audit_segment, judged_by
from servofd.outputs.recording.content import Recording
from servofd.outputs.recording.verdicts import LIVE

if TYPE_CHECKING:
    from servofd.detection.threshold import ThresholdKind
    from servofd.detection.verdict import SurfaceAudit


def rejudged(
    recording: Recording, *, threshold_deg: float | None = None, threshold: ThresholdKind | None = None
) -> Recording:
    """Judge the recorded commands and deflections again, as an audit of the log would.

    The recording has the aircraft's models and tolerances, so that new alarms get names as well.

    Parameters
    ----------
    recording : Recording
        As it was read.
    threshold_deg : float, optional
        Constant alarm level for all surfaces [deg].
    threshold : {"constant", "interval"}, optional
        Kind of threshold for all surfaces.

    Examples
    --------
    >>> from servofd.outputs.recording.write import recording_of
    >>> from servofd.workflow import audit
    >>> (found,) = audit("sample_logs/faser_stuck_flight.mat", surfaces=("elevator",))
    >>> [s.faults[0].alarm_s < found.surfaces[0].faults[0].alarm_s
    ...  for s in rejudged(recording_of(found), threshold_deg=0.8).audit.surfaces]
    [True]
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
        trace.segment(surface.surface, known.command_period_s),
        recording.audit.aircraft,
        duration_s=recording.audit.log.duration_s,
        threshold_deg=threshold_deg,
        threshold=threshold,
        expected=surface.expected,
    )
