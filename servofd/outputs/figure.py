"""The charts of pages as pictures: of a surface, after thesis Fig. 4.5, for a folder and for notebooks."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from servofd.core.files import write_whole
from servofd.outputs.chart import flight_chart, thinned
from servofd.outputs.palette import COLOURS
from servofd.outputs.picture import finish, new_figure, saved

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from servofd.detection.verdict import SurfaceAudit
    from servofd.outputs.chart import Chart

_TITLE_COLUMNS = 130
"""Characters in a line of a figure's title."""
_WIDEST = 4000
"""Points drawn per curve; more cannot be seen, and slow the drawing down."""
_WIDTHS = {"simulated": 2.0, "threshold": 1.0, "alarm": 5.0}
_COLOURS = {"residual": "black", "threshold": COLOURS["fault"], "alarm": COLOURS["fault"]}


def save_figure(audit: SurfaceAudit, path: Path, title: str) -> None:
    """Draw one surface into a PNG file."""
    figure = audit_figure(audit)
    reason = textwrap.fill(audit.reason, _TITLE_COLUMNS)
    figure.axes[0].set_title(f"{title}   {audit.surface}: {audit.status}\n{reason}", loc="left", fontsize=10)
    write_whole(path, saved(figure, Path(path).suffix.lstrip(".") or "png"))


def audit_figure(audit: SurfaceAudit) -> Figure:
    """Draw the whole flight of one surface."""
    return chart_figure(flight_chart(audit))


def chart_figure(chart: Chart, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Draw a chart of a page, all of it, or into given axes as many of its panels as these are."""
    if ax is None:
        figure, all_axes = new_figure(len(chart.panels), height=6.5, width=11.0, ratios=(3, 2, 2)[: len(chart.panels)])
    else:
        all_axes = tuple(np.ravel(np.asarray(ax, dtype=object)))
        figure = cast("Figure", all_axes[0].get_figure(root=True))
    panels = chart.panels[: len(all_axes)]
    for panel, axes in zip(panels, all_axes, strict=False):
        for curve in panel.curves:
            time_s, values = thinned(curve.time_s, curve.values, _WIDEST)
            axes.plot(
                time_s,
                values,
                color=_COLOURS.get(curve.role) or COLOURS[curve.role],
                lw=_WIDTHS.get(curve.role, 0.9),
                ls="--" if curve.role == "threshold" else "-",
                drawstyle="steps-post" if curve.holds else "default",
                label=curve.name or None,
            )
        for span in chart.spans:
            axes.axvspan(span.start_s, span.end_s, color=COLOURS[span.role], alpha=0.12, lw=0)
        for mark in chart.marks:
            axes.axvline(mark.time_s, color=COLOURS[mark.role], lw=0.8)
        axes.set_ylim(panel.low, panel.high)
    upper = all_axes[0]
    for span in chart.spans:
        style: dict[str, Any] = {"va": "top", "fontsize": 9, "clip_on": True, "color": COLOURS[span.role]}
        upper.text(span.start_s, 1.0, f" {span.label}", transform=upper.get_xaxis_transform(), **style)
    finish(*all_axes[: len(panels)], x="time [s]", y=[f"{panel.title} [{panel.unit}]" for panel in panels])
    return figure
