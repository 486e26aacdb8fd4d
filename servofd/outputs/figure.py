"""The audit as pictures, after thesis Fig. 4.5: deflections above, residual and alarm below."""

from __future__ import annotations

import textwrap
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.core.files import write_whole
from servofd.outputs.chart import bridged, thinned
from servofd.outputs.palette import COLOURS
from servofd.outputs.picture import finish, new_figure, saved

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from servofd.aircraft.segment import Segment
    from servofd.core.types import BoolArray, FloatArray
    from servofd.detection.residual import Residuals
    from servofd.detection.threshold import Threshold
    from servofd.detection.verdict import SurfaceAudit

_DRAWN = ("time_s", "simulated_deg", "measured_deg", "residual_deg", "settled")
_TITLE_COLUMNS = 130
_WIDEST = 4000
"""Points drawn per curve; more cannot be told apart, and slow the drawing down."""


def save_figure(audit: SurfaceAudit, path: Path, title: str) -> None:
    """Draw one surface into a PNG file."""
    figure = audit_figure(audit)
    reason = textwrap.fill(audit.reason, _TITLE_COLUMNS)
    figure.axes[0].set_title(f"{title}   {audit.surface}: {audit.status}\n{reason}", loc="left", fontsize=10)
    write_whole(path, saved(figure, Path(path).suffix.lstrip(".") or "png"))


def audit_figure(
    audit: SurfaceAudit, between_s: tuple[float, float] | None = None, *, points: int = _WIDEST, legend: str = "beside"
) -> Figure:
    """Draw one surface, all of it or what lies between two times.

    Parameters
    ----------
    between_s : tuple of float, optional
        First and last time to show [s].
    points : int
        Points drawn per curve, at most; the extremes of each column survive.
    legend : {"beside", "above"}
        Where the names of the curves stand.
    """
    if audit.segment is None or audit.residuals is None or audit.threshold is None:
        raise ValueError(f"{audit.surface}: nothing to draw, {audit.reason}")
    segment, residuals, threshold = audit.segment, audit.residuals, audit.threshold
    if between_s is not None:
        segment, residuals, threshold = _cut(segment, residuals, threshold, between_s)
    height, width = (6.5, 11.0) if legend == "beside" else (5.6, 9.0)
    figure, (upper, lower) = new_figure(2, height=height, width=width, ratios=(3, 2))
    _draw_deflection(upper, segment, residuals, points)
    _draw_residual(lower, residuals, threshold, points)
    for axes in (upper, lower):
        _shade(axes, audit, named=axes is upper)
    finish(upper, lower, legend=legend)
    if between_s is not None:
        lower.set_xlim(*between_s)
    return figure


def _cut(
    segment: Segment, residuals: Residuals, threshold: Threshold, between_s: tuple[float, float]
) -> tuple[Segment, Residuals, Threshold]:
    """What lies between two times, and the command that holds when it begins."""
    first, last = np.searchsorted(segment.command_s, between_s)
    kept = slice(max(int(first) - 1, 0), int(last) + 1)
    inside = slice(*np.searchsorted(residuals.time_s, between_s))
    return (
        replace(segment, command_s=segment.command_s[kept], command_deg=segment.command_deg[kept]),
        replace(residuals, **{name: getattr(residuals, name)[inside] for name in _DRAWN}),
        replace(threshold, level_deg=threshold.level_deg[inside]),
    )


def _draw_deflection(axes: Axes, segment: Segment, residuals: Residuals, points: int) -> None:
    time_s, command_deg = thinned(segment.command_s, segment.command_deg, points)
    axes.plot(time_s, command_deg, color=COLOURS["command"], lw=0.9, drawstyle="steps-post", label="command")
    time_s, simulated_deg = thinned(residuals.time_s, residuals.simulated_deg, points)
    axes.plot(time_s, simulated_deg, color=COLOURS["simulated"], lw=2.0, label="simulated")
    time_s, measured_deg = thinned(*bridged(residuals.time_s, residuals.measured_deg), points)
    axes.plot(time_s, measured_deg, color=COLOURS["measured"], lw=0.9, label="measured")
    axes.set_ylabel("deflection [deg]")


def _draw_residual(axes: Axes, residuals: Residuals, threshold: Threshold, points: int) -> None:
    judged = np.where(residuals.settled, residuals.residual_deg, np.nan)
    time_s, residual_deg = thinned(*bridged(residuals.time_s, judged), points)
    axes.plot(time_s, residual_deg, color="black", lw=0.8, label="residual")
    level_s, level_deg = thinned(residuals.time_s, threshold.level_deg, points)
    for sign in (1.0, -1.0):
        about = "about " if threshold.kind == "interval" else ""
        label = f"threshold {about}±{threshold.typical_deg:.3g} deg" if sign > 0 else None
        axes.plot(level_s, sign * level_deg, color=COLOURS["fault"], lw=1.0, ls="--", label=label)
    largest = float(np.nanmax(np.abs(judged))) if np.any(residuals.settled) else 0.0
    limit = 1.15 * max(largest, 1.3 * threshold.typical_deg)
    axes.set_ylim(-limit, limit)
    alarm = (np.abs(judged) >= threshold.level_deg).astype(float)
    axes.fill_between(
        *_thin_flags(residuals.time_s, alarm, -limit, -0.92 * limit, points),
        color=COLOURS["fault"],
        lw=0,
        label="alarm",
    )
    axes.set_ylabel("residual [deg]")
    axes.set_xlabel("time [s]")


def _shade(axes: Axes, audit: SurfaceAudit, *, named: bool) -> None:
    """Time from onset to end of each fault and suspicion; their names at the top if `named`."""
    if audit.residuals is None:
        return
    last_s = float(audit.residuals.time_s[-1])
    for found, colour, label in ((audit.faults, "fault", "fault"), (audit.suspicions, "suspect", "suspicion")):
        for number, fault in enumerate(found):
            end_s = last_s if fault.end_s is None else fault.end_s
            shown = label if number == 0 else None
            axes.axvspan(fault.start_s, end_s, color=COLOURS[colour], alpha=0.12, lw=0, label=shown)
            axes.axvline(fault.alarm_s, color=COLOURS[colour], lw=0.8)
            if named:
                name = "within tolerance" if fault.kind == "healthy" else fault.kind.replace("_", " ")
                place = axes.get_xaxis_transform()
                style: dict[str, Any] = {"va": "top", "fontsize": 9, "clip_on": True, "color": COLOURS[colour]}
                axes.text(fault.start_s, 1.0, f" {name}", transform=place, **style)


def _thin_flags(
    time_s: FloatArray, flags: FloatArray, bottom: float, top: float, points: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Outline of a bar that is there while a flag is set."""
    thin_s, thin = thinned(time_s, flags, points)
    raised: BoolArray = thin > 0.0
    return thin_s, np.full(thin_s.size, bottom), np.where(raised, top, bottom)
