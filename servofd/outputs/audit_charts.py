"""A judged surface as charts, after thesis Fig. 4.5: what was asked and done above, the residual below."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.detection.words import gravest
from servofd.outputs.chart import Chart, Curve, Mark, Panel, Span, bridged, thinned
from servofd.outputs.sentence import clock, spoken

if TYPE_CHECKING:
    from servofd.aircraft.segment import Segment
    from servofd.core.types import FloatArray
    from servofd.detection.bank.window import Fault
    from servofd.detection.residual import Residuals
    from servofd.detection.threshold import Threshold
    from servofd.detection.verdict import SurfaceAudit

MOST_FAULTS = 4
"""Faults that are shown from near; the table lists all."""
_MARGIN_S, _MARGIN = 2.0, 0.35
_SLACK = 0.06
"""Of a panel's height, above and below its curves."""


def flight_chart(surface: SurfaceAudit) -> Chart:
    """The whole flight of one surface."""
    segment, residuals, threshold = _drawn(surface)
    largest = "" if surface.statistics is None else f", at most {surface.statistics.max_abs_deg:.2f} deg"
    text = (
        f"Above, what {spoken(surface.surface)} was asked, what a healthy servo would have done, and what was "
        f"measured. Below, the residual{largest}, and its threshold, {surface.threshold_deg:.3g} deg."
    )
    first_s, last_s = float(residuals.time_s[0]), float(residuals.time_s[-1])
    return _chart("Whole flight", text, (first_s, last_s), surface, (segment, residuals, threshold))


def fault_charts(surface: SurfaceAudit) -> list[Chart]:
    """Faults and suspicions of a surface from near: that of the headline, then the first ones."""
    data, found = _drawn(surface), (*surface.faults, *surface.suspicions)
    if not found:
        return []
    first = gravest(surface.faults or surface.suspicions)
    shown = [first, *(fault for fault in found if fault is not first)]
    return [_near(surface, fault, data) for fault in shown[:MOST_FAULTS]]


def _drawn(surface: SurfaceAudit) -> tuple[Segment, Residuals, Threshold]:
    if surface.segment is None or surface.residuals is None or surface.threshold is None:
        raise ValueError(f"{surface.surface}: nothing to draw, {surface.reason}")
    return surface.segment, surface.residuals, surface.threshold


def _near(surface: SurfaceAudit, fault: Fault, data: tuple[Segment, Residuals, Threshold]) -> Chart:
    margin_s = max(_MARGIN_S, _MARGIN * (fault.alarm_s - fault.start_s))
    last_s = max(fault.alarm_s, fault.start_s) + margin_s
    if fault.end_s is not None and fault.end_s < last_s + margin_s:
        last_s = fault.end_s + margin_s
    time_s = data[1].time_s
    between_s = (max(fault.start_s - margin_s, float(time_s[0])), min(last_s, float(time_s[-1])))
    if between_s[1] <= between_s[0]:
        between_s = (float(time_s[0]), float(time_s[-1]))
    text = (
        f"It began at {clock(fault.start_s)} ({fault.start_s:.2f} s; shaded from there); in flight the alarm would "
        f"have been raised at {fault.alarm_s:.2f} s (vertical line)."
    )
    return _chart(f"{kind_of(fault).capitalize()} at {clock(fault.start_s)}, from near", text, between_s, surface, data)


def _chart(
    title: str,
    text: str,
    between_s: tuple[float, float],
    surface: SurfaceAudit,
    data: tuple[Segment, Residuals, Threshold],
) -> Chart:
    segment, residuals, threshold = data
    inside = slice(*np.searchsorted(residuals.time_s, (between_s[0], np.nextafter(between_s[1], np.inf))))
    asked = slice(
        max(int(np.searchsorted(segment.command_s, between_s[0])) - 1, 0),
        int(np.searchsorted(segment.command_s, between_s[1])) + 1,
    )
    time_s = residuals.time_s
    curves = (
        Curve("asked", "command", segment.command_s, segment.command_deg, holds=True),
        Curve("healthy servo", "simulated", time_s, residuals.simulated_deg),
        Curve("measured", "measured", *bridged(time_s, residuals.measured_deg)),
    )
    shown = [segment.command_deg[asked], residuals.simulated_deg[inside], residuals.measured_deg[inside]]
    deflection = Panel("deflection", "deg", curves, *_range(np.concatenate(shown)))
    judged = np.where(residuals.settled, residuals.residual_deg, np.nan)
    largest = float(np.nanmax(np.abs(judged[inside]), initial=0.0)) if np.isfinite(judged[inside]).any() else 0.0
    limit = 1.15 * max(largest, 1.3 * threshold.typical_deg)
    residual = Panel(
        "residual",
        "deg",
        (Curve("residual", "residual", *bridged(time_s, judged)), *_levels(residuals, threshold)),
        -limit,
        limit,
    )
    return Chart(title, text, *between_s, (deflection, residual), _spans(surface, float(time_s[-1])), _marks(surface))


def _levels(residuals: Residuals, threshold: Threshold) -> list[Curve]:
    """Both sides of the threshold; of a constant one only its ends."""
    time_s, level_deg = residuals.time_s, threshold.level_deg
    if threshold.kind == "constant":
        time_s, level_deg = time_s[[0, -1]], level_deg[[0, -1]]
    else:
        time_s, level_deg = thinned(time_s, level_deg, 600)
    return [Curve("threshold", "threshold", time_s, level_deg), Curve("", "threshold", time_s, -level_deg)]


def _spans(surface: SurfaceAudit, last_s: float) -> tuple[Span, ...]:
    return tuple(
        Span(role, fault.start_s, last_s if fault.end_s is None else fault.end_s, kind_of(fault))
        for role, found in (("fault", surface.faults), ("suspect", surface.suspicions))
        for fault in found
    )


def _marks(surface: SurfaceAudit) -> tuple[Mark, ...]:
    return tuple(
        Mark(role, fault.alarm_s, f"alarm {clock(fault.alarm_s)}")
        for role, found in (("fault", surface.faults), ("suspect", surface.suspicions))
        for fault in found
    )


def kind_of(fault: Fault) -> str:
    """Kind of a fault, as it is read aloud."""
    return "within tolerance" if fault.kind == "healthy" else spoken(fault.kind)


def _range(values: FloatArray) -> tuple[float, float]:
    """Lowest and highest value, with room for a line."""
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if known.size else (-1.0, 1.0)
    slack = max(_SLACK * (high - low), 0.5)
    return low - slack, high + slack
