"""The audit as pictures, after thesis Fig. 4.5: deflections above, residual and alarm below."""

from __future__ import annotations

import textwrap
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

_TITLE_COLUMNS = 130
_WIDEST = 4000
"""Points drawn per curve; more cannot be told apart, and slow the drawing down."""


def save_figure(audit: SurfaceAudit, path: Path, title: str) -> None:
    """Draw one surface into a PNG file."""
    figure = audit_figure(audit)
    reason = textwrap.fill(audit.reason, _TITLE_COLUMNS)
    figure.axes[0].set_title(f"{title}   {audit.surface}: {audit.status}\n{reason}", loc="left", fontsize=10)
    write_whole(path, saved(figure, Path(path).suffix.lstrip(".") or "png"))


def audit_figure(audit: SurfaceAudit) -> Figure:
    """Draw one surface."""
    if audit.segment is None or audit.residuals is None or audit.threshold is None:
        raise ValueError(f"{audit.surface}: nothing to draw, {audit.reason}")
    figure, (upper, lower) = new_figure(2, height=6.5, width=11.0, ratios=(3, 2))
    _draw_deflection(upper, audit.segment, audit.residuals)
    _draw_residual(lower, audit.residuals, audit.threshold)
    for axes in (upper, lower):
        _shade(axes, audit, named=axes is upper)
    finish(upper, lower)
    return figure


def _draw_deflection(axes: Axes, segment: Segment, residuals: Residuals) -> None:
    time_s, command_deg = thinned(segment.command_s, segment.command_deg, _WIDEST)
    axes.plot(time_s, command_deg, color=COLOURS["command"], lw=0.9, drawstyle="steps-post", label="command")
    time_s, simulated_deg = thinned(residuals.time_s, residuals.simulated_deg, _WIDEST)
    axes.plot(time_s, simulated_deg, color=COLOURS["simulated"], lw=2.0, label="simulated")
    time_s, measured_deg = thinned(*bridged(residuals.time_s, residuals.measured_deg), _WIDEST)
    axes.plot(time_s, measured_deg, color=COLOURS["measured"], lw=0.9, label="measured")
    axes.set_ylabel("deflection [deg]")


def _draw_residual(axes: Axes, residuals: Residuals, threshold: Threshold) -> None:
    judged = np.where(residuals.settled, residuals.residual_deg, np.nan)
    time_s, residual_deg = thinned(*bridged(residuals.time_s, judged), _WIDEST)
    axes.plot(time_s, residual_deg, color="black", lw=0.8, label="residual")
    level_s, level_deg = thinned(residuals.time_s, threshold.level_deg, _WIDEST)
    for sign in (1.0, -1.0):
        about = "about " if threshold.kind == "interval" else ""
        label = f"threshold {about}±{threshold.typical_deg:.3g} deg" if sign > 0 else None
        axes.plot(level_s, sign * level_deg, color=COLOURS["fault"], lw=1.0, ls="--", label=label)
    largest = float(np.nanmax(np.abs(judged))) if np.any(residuals.settled) else 0.0
    limit = 1.15 * max(largest, 1.3 * threshold.typical_deg)
    axes.set_ylim(-limit, limit)
    alarm = (np.abs(judged) >= threshold.level_deg).astype(float)
    axes.fill_between(
        *_thin_flags(residuals.time_s, alarm, -limit, -0.92 * limit),
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
    time_s: FloatArray, flags: FloatArray, bottom: float, top: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Outline of a bar that is there while a flag is set."""
    thin_s, thin = thinned(time_s, flags, _WIDEST)
    raised: BoolArray = thin > 0.0
    return thin_s, np.full(thin_s.size, bottom), np.where(raised, top, bottom)
