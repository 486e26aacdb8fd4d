"""Figures of matplotlib, for files and notebooks: the charts of pages as pictures, made, finished and saved."""

from __future__ import annotations

import io
import textwrap
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from servofd.core.errors import needs
from servofd.core.files import write_whole
from servofd.detection.verdict import SurfaceAudit
from servofd.outputs.chart import Chart, Curve, flight_chart, thinned
from servofd.outputs.palette import COLOURS
from servofd.outputs.plain import plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_TITLE_COLUMNS = 130
"""Characters in a line of a figure's title."""
_WIDEST = 4000
"""Points drawn per curve; more cannot be seen, and slow the drawing down."""
_WIDTHS = {"simulated": 2.0, "likely": 2.0, "threshold": 1.0, "alarm": 5.0}
"""Widths of lines by their role [points], where not 0.9."""
_DASHED = ("threshold", "before")
_COLOURS = {
    **COLOURS,
    **dict.fromkeys(("threshold", "alarm", "before"), COLOURS["fault"]),
    **dict.fromkeys(("after", "likely"), COLOURS["simulated"]),
    "residual": "black",
    "raw": COLOURS["command"],
    "other2": COLOURS["suspect"],
}


def save_figure(audit: SurfaceAudit, path: Path, title: str) -> None:
    """Draw one surface into a PNG file."""
    reason = textwrap.fill(audit.reason, _TITLE_COLUMNS)
    write_whole(path, chart_png(flight_chart(audit), f"{title}   {audit.surface}: {audit.status}\n{reason}"))


def chart_png(chart: Chart, title: str = "") -> bytes:
    """A chart as PNG, under its title or another: the same bytes for the same data, whatever names stand in it."""
    from matplotlib.text import Text

    figure = chart_figure(chart)
    figure.axes[0].set_title(title or chart.title, loc="left", fontsize=10)
    for text in figure.findobj(Text):
        text.set_text(plain(text.get_text()))
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # names in scripts that the font lacks
        figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


def chart_figure(chart: Chart, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Draw a chart of a page, all of it, or into given axes as many of its panels as these are."""
    if ax is None:
        figure, all_axes = _new_figure((3, *(2,) * (len(chart.panels) - 1)))
    else:
        all_axes = tuple(np.ravel(np.asarray(ax, dtype=object)))
        figure = cast("Figure", all_axes[0].get_figure(root=True))
    panels = chart.panels[: len(all_axes)]
    for panel, axes in zip(panels, all_axes, strict=False):
        for curve in panel.curves:
            _draw(axes, curve)
        for span in chart.spans:
            axes.axvspan(span.start, span.end, color=_COLOURS[span.role], alpha=0.12, lw=0)
        for mark in chart.marks:
            axes.axvline(mark.x, color=_COLOURS[mark.role], lw=0.8)
        axes.set_ylim(panel.low, panel.high)
        if chart.axis:
            axes.set_xlim(chart.first, chart.last)
        if chart.log:
            axes.set_xscale("log")
            axes.xaxis.set_major_formatter("{x:g}")  # the usual one writes formulas
        axes.set_ylabel(panel.label)
        axes.grid(visible=True, color="0.9")
        axes.spines[["top", "right"]].set_visible(False)
        if axes.get_legend_handles_labels()[1]:  # beside, where it hides nothing
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    upper = all_axes[0]
    for span in chart.spans:
        style: dict[str, Any] = {"va": "top", "fontsize": 9, "clip_on": True, "color": _COLOURS[span.role]}
        upper.text(span.start, 1.0, f" {span.label}", transform=upper.get_xaxis_transform(), **style)
    all_axes[len(panels) - 1].set_xlabel(chart.axis or "time [s]")
    return figure


def _draw(axes: Axes, curve: Curve) -> None:
    colour, width = _COLOURS[curve.role], _WIDTHS.get(curve.role, 0.9)
    if curve.style == "bars":
        axes.vlines(curve.x, curve.values, curve.values if curve.until is None else curve.until, color=colour, lw=width)
        return
    style: dict[str, Any] = {"color": colour, "lw": width, "label": curve.name or None}
    if curve.style == "dots":
        style |= {"lw": 0.0, "marker": ".", "ms": 1.5 if curve.role == "raw" else 6.0}
        axes.plot(curve.x, curve.values, **style)
        return
    style |= {"ls": "--"} if curve.role in _DASHED else {}
    style |= {"drawstyle": "steps-post"} if curve.style == "steps" else {}
    axes.plot(*thinned(curve.x, curve.values, _WIDEST), **style)


def _new_figure(ratios: tuple[int, ...]) -> tuple[Figure, tuple[Axes, ...]]:
    """Figure with axes one below the other over the same x, by the ratios of their heights."""
    needs("matplotlib")
    from matplotlib import rcParams
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as NewFigure

    rcParams["text.parse_math"] = False  # a dollar in a name is a dollar
    figure = NewFigure(figsize=(11.0, 2.0 + 0.9 * sum(ratios)), layout="constrained")
    FigureCanvasAgg(figure)
    all_axes = figure.subplots(len(ratios), sharex=True, height_ratios=ratios)
    return figure, tuple(np.atleast_1d(all_axes))
