"""Whether the curves of a recording are those that its verdicts speak of."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.detection.statistics import Statistics

if TYPE_CHECKING:
    from servofd.outputs.recording.content import Recording, Trace


def statistics_of(trace: Trace) -> Statistics | None:
    """Size of the residual while it was judged, from the recorded curves; None if it never was.

    Examples
    --------
    >>> from servofd.outputs.recording.content import Trace
    >>> t, r = np.arange(3.0), np.array([np.nan, 1.0, -3.0])
    >>> statistics_of(Trace(t, t, t, t + 0.5, r, t, t, t)).max_abs_deg
    3.0
    """
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
