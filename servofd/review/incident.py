"""An incident, cut out of a long flight."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servofd.errors import RecordingError
from servofd.review.check import statistics_of

if TYPE_CHECKING:
    from servofd.detection.bank.flight import Fault
    from servofd.detection.verdict import Status, SurfaceAudit
    from servofd.outputs.recording.content import Recording
    from servofd.types import FloatArray


def between(recording: Recording, from_s: float, to_s: float) -> Recording:
    """Keep what happened from one time to another.

    Verdicts are those of the whole flight: a fault is kept if any of it lies in between, with its name and onset.

    Examples
    --------
    >>> from servofd.outputs.recording.write import recording_of
    >>> from servofd.workflow import audit
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
        attitude=_rows(recording.attitude, from_s, to_s),
        position=_rows(recording.position, from_s, to_s),
        geo=_rows(recording.geo, from_s, to_s),
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


def _rows(rows: FloatArray | None, from_s: float, to_s: float) -> FloatArray | None:
    if rows is None:
        return None
    kept: FloatArray = rows[np.logical_and(rows[:, 0] >= from_s, rows[:, 0] <= to_s)]
    return kept if len(kept) > 1 else None
