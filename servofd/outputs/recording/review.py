"""A recording read back: whether its curves fit its verdicts, and the verdicts of what a monitor recorded."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servofd.aircraft.series import is_streamed
from servofd.detection.audit import audit_segment
from servofd.detection.verdict import Statistics
from servofd.outputs.recording.content import Recording
from servofd.outputs.recording.verdicts import LIVE

if TYPE_CHECKING:
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
    found, other = [], "the verdict was made from other curves than are recorded here"
    for surface in recording.audit.surfaces:
        trace = recording.traces.get(surface.surface)
        now = None if trace is None else statistics_of(trace)
        if surface.statistics is not None and now != surface.statistics:
            until = f"end at {trace.time_s[-1]:.2f} s" if trace is not None and trace.time_s.size else "are missing"
            found.append(f"{surface.surface}: {other} (they {until}): incomplete or altered")
    return found


def rejudged(recording: Recording) -> Recording:
    """Judge the recorded commands and deflections of a monitor, as an audit of the log would.

    The recording has the aircraft's models and tolerances, so that new alarms get names as well.
    """
    audit = recording.audit
    audit = replace(audit, log=replace(audit.log, span_s=(recording.start_s, recording.end_s)))
    surfaces = []
    for surface in audit.surfaces:
        trace, known = recording.traces.get(surface.surface), audit.aircraft.surfaces[surface.surface]
        if trace is not None and trace.time_s.size > 1:
            streamed = is_streamed(audit.log.format, known.command.channel)
            segment = trace.segment(surface.surface, known.command_period_s, is_streamed=streamed)
            expected, duration_s = surface.expected, audit.log.duration_s
            surfaces.append(audit_segment(segment, audit.aircraft, duration_s=duration_s, expected=expected))
        else:
            surfaces.append(surface)
    again = Recording.of(replace(audit, surfaces=tuple(surfaces)))
    notes = (*(n for n in recording.notes if n != LIVE), "judged again, by the recorded threshold")
    return Recording(replace(again.audit, log=audit.log), {**recording.traces, **again.traces}, notes)
