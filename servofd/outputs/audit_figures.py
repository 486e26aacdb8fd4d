"""An audit as pictures of a page: the whole flight, each fault from near, and how often the residual is how large."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.detection.probability import false_alarms_per_hour
from servofd.outputs.figure import audit_figure
from servofd.outputs.palette import COLOURS
from servofd.outputs.picture import Picture, finish, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from servofd.detection.audit import SurfaceAudit
    from servofd.detection.bank.isolate import Fault
    from servofd.detection.odds import SurfaceOdds
    from servofd.types import FloatArray

__all__ = ["MOST_FAULTS", "flight_pictures", "residual_picture"]

MOST_FAULTS = 4
"""Faults that are shown from near; the table lists all."""
_POINTS, _POINTS_NEAR = 1000, 600
"""Of a curve: about a column of pixels each at the width of a page."""
_MARGIN_S, _MARGIN = 2.0, 0.35
_BINS = 80
_LEVELS = 60


def flight_pictures(surface: SurfaceAudit, name: str) -> list[Picture]:
    """The whole flight, then each of the first faults.

    Parameters
    ----------
    surface : SurfaceAudit
        A surface with residuals.
    name : str
        Begins the names of the pictures; different for each surface of a page.
    """
    whole = Picture(
        name,
        "Whole flight",
        f"Above, command, simulated and measured deflection of {surface.surface}; below, the residual"
        + (f", at most {surface.statistics.max_abs_deg:.2f} deg" if surface.statistics is not None else "")
        + f", and its threshold, {surface.threshold_deg:.3g} deg.",
        audit_figure(surface, points=_POINTS, legend="above"),
    )
    found = (*surface.faults, *surface.suspicions)[:MOST_FAULTS]
    return [whole, *(_near(surface, fault, f"{name}-{k}") for k, fault in enumerate(found, start=1))]


def _near(surface: SurfaceAudit, fault: Fault, name: str) -> Picture:
    margin_s = max(_MARGIN_S, _MARGIN * (fault.alarm_s - fault.start_s))
    last_s = max(fault.alarm_s, fault.start_s) + margin_s
    if fault.end_s is not None and fault.end_s < last_s + margin_s:
        last_s = fault.end_s + margin_s
    kind = fault.kind.replace("_", " ")
    text = (
        f"The best estimate of the onset is {fault.start_s:.2f} s (shaded from there); the vertical line at "
        f"{fault.alarm_s:.2f} s is the moment at which the alarm would have been raised in flight."
    )
    figure = audit_figure(surface, (fault.start_s - margin_s, last_s), points=_POINTS_NEAR, legend="above")
    return Picture(name, f"From near: {kind} at {fault.start_s:.2f} s", text, figure)


def residual_picture(surface: SurfaceAudit, odds: SurfaceOdds | None, name: str) -> Picture | None:
    """Histogram of the residual, and how often per hour its size rises through a level; None if nothing was judged.

    Left, counts before and after the first onset. Right, the measured rate of upcrossings beside that of a Gaussian
    residual of the same size and colour, and beside the fitted tail if there are data enough for one.
    """
    residuals, threshold = surface.residuals, surface.threshold
    if residuals is None or threshold is None or not residuals.settled.any():
        return None
    found = (*surface.faults, *surface.suspicions)
    onset_s = min((fault.start_s for fault in found), default=np.inf)
    healthy = residuals.settled & (residuals.time_s < onset_s)
    figure, axes = new_figure(1, 1 if odds is None else 2, height=3.4, share_x=False)
    left = axes[0]
    level_deg = threshold.typical_deg
    _draw_histogram(left, residuals.residual_deg[healthy], residuals.residual_deg[residuals.settled & ~healthy])
    for sign in (-1.0, 1.0):
        left.axvline(sign * level_deg, color=COLOURS["fault"], lw=1.0, ls="--", label="threshold" if sign > 0 else None)
    text = "How often the residual had which size, on a logarithmic scale; dashed lines are the threshold. "
    if odds is None:
        text += "There is too little healthy data to tell how often noise alone would reach it."
    else:
        text += _draw_rates(axes[1], np.where(healthy, residuals.residual_deg, np.nan), level_deg, odds)
    finish(*axes, legend="above")
    return Picture(name, "How large the residual was", text, figure)


def _draw_histogram(axes: Axes, before_deg: FloatArray, after_deg: FloatArray) -> None:
    both = np.concatenate([before_deg, after_deg])
    edges = np.linspace(both.min(), both.max() + 1e-9, _BINS + 1).tolist()
    for values, colour, label in ((after_deg, "fault", "after onset"), (before_deg, "residual", "healthy")):
        if values.size:
            axes.hist(values, edges, color=COLOURS[colour], label=label, histtype="stepfilled")
    axes.set_yscale("log")
    axes.set_ylim(bottom=0.7)
    axes.set_xlabel("residual [deg]")
    axes.set_ylabel("samples")


def _draw_rates(axes: Axes, healthy_deg: FloatArray, level_deg: float, odds: SurfaceOdds) -> str:
    size_deg = np.abs(healthy_deg)
    known = size_deg[np.isfinite(size_deg)]
    axes.set_yscale("log")
    axes.set_xlabel("|residual| [deg]")
    axes.set_ylabel("upcrossings per hour")
    axes.axvline(level_deg, color=COLOURS["fault"], lw=1.0, ls="--")
    hours = known.size * odds.noise.sample_time_s / 3600.0
    levels = np.linspace(0.0, max(float(known.max()), level_deg) * 1.05, _LEVELS)[1:]
    counted = [np.count_nonzero((size_deg[:-1] < x) & (size_deg[1:] >= x)) / hours for x in levels]
    noise, tail = odds.noise, odds.tail
    gaussian = [
        false_alarms_per_hour(noise.margin_deg(x), noise.sigma_deg, noise.correlation, noise.sample_time_s)
        for x in levels
    ]
    axes.step(levels, np.where(np.array(counted) > 0.0, counted, np.nan), color=COLOURS["residual"], label="measured")
    axes.plot(levels, np.maximum(gaussian, 1e-12), color=COLOURS["simulated"], lw=1.2, label="Gaussian")
    axes.set_ylim(1e-6, None)
    if tail is None:
        return (
            f"Right, how often per hour its size rose through each level in {hours:.2g} h of healthy data, beside a "
            "Gaussian residual of the same variance and correlation; there are too few data for a fit of the tail."
        )
    far = levels[levels >= tail.level_deg]
    fitted = [tail.false_alarms_per_hour(x).value for x in far]
    axes.plot(far, fitted, color=COLOURS["suspect"], lw=1.6, ls="--", label="fitted tail")
    return (
        f"Right, how often per hour its size rose through each level in {hours:.2g} h of healthy data, beside a "
        f"Gaussian residual and a Pareto tail fitted to {tail.peaks} peaks (index {tail.index:.2f})."
    )
