"""How good the data of one surface are: rates, gaps, and how much of them could be judged."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from servofd.detection.verdict import SurfaceAudit
    from servofd.types import FloatArray

_JITTER_QUANTILE = 0.95


def quality_rows(surface: SurfaceAudit) -> list[tuple[str, str]]:
    """Rows of a table: quantity with unit, and its value.

    Parameters
    ----------
    surface : SurfaceAudit
        Judged or not; without a segment there is nothing to tell.

    Examples
    --------
    >>> from servofd.detection.verdict import SurfaceAudit
    >>> from servofd.segment import Segment
    >>> t = np.arange(0.0, 10.0, 0.02)
    >>> segment = Segment("rudder", t, 0.0 * t, t, np.where(t < 5.0, 0.0, np.nan))
    >>> rows = dict(quality_rows(SurfaceAudit("rudder", "unknown", "", "x", "constant", 1.5, True, segment=segment)))
    >>> rows["position rate [Hz]"], rows["positions missing [%]"]
    ('50 (95 % of steps within 1.00 times the median)', '50')
    """
    segment = surface.segment
    if segment is None:
        return []
    measured = np.isfinite(segment.measured_deg)
    rows = [
        ("command rate [Hz]", _rate(segment.command_s)),
        ("longest time without a command [s]", _gap(segment.command_s)),
        ("position rate [Hz]", _rate(segment.measured_s[measured])),
        ("longest time without a position [s]", _gap(segment.measured_s[measured])),
        ("positions missing [%]", f"{100.0 * (1.0 - measured.mean()):.2g}" if measured.size else "100"),
    ]
    if segment.command_period_s is not None:
        rows.append(("commands thinned by the log", f"one every {1e3 * segment.command_period_s:.3g} ms was sent"))
    if segment.frozen_s > 0.0:
        rows.append(("frozen telemetry [s]", f"{segment.frozen_s:.1f}"))
    if surface.residuals is not None:
        settled = surface.residuals.settled
        rows.append(("positions judged [%]", f"{100.0 * settled.mean():.3g}"))
        rows.append(("starts of the filter", str(int(np.count_nonzero(surface.residuals.restart)))))
    return rows


def _rate(time_s: FloatArray) -> str:
    step_s = np.diff(time_s)
    if not step_s.size:
        return "none"
    median_s = float(np.median(step_s))
    jitter = float(np.quantile(step_s, _JITTER_QUANTILE)) / median_s
    return f"{1.0 / median_s:.4g} (95 % of steps within {jitter:.2f} times the median)"


def _gap(time_s: FloatArray) -> str:
    step_s = np.diff(time_s)
    if not step_s.size:
        return "-"
    longest = int(np.argmax(step_s))
    return f"{step_s[longest]:.3g} (at {time_s[longest]:.2f} s)"
