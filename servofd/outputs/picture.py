"""Figures of matplotlib, for files and notebooks: made, finished, and saved."""

from __future__ import annotations

import io
import warnings
from typing import TYPE_CHECKING

import numpy as np

from servofd.core.errors import needs
from servofd.outputs.plain import plain

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def saved(figure: Figure, kind: str = "png") -> bytes:
    r"""Picture of a figure, the same bytes for the same data, whatever names from outside stand in it."""
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        text.set_text(plain(text.get_text()))
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # names in scripts that the font lacks
        figure.savefig(buffer, format=kind, dpi=110, metadata={"Date": None} if kind == "svg" else None)
    return buffer.getvalue()


def new_figure(
    rows: int = 1,
    columns: int = 1,
    *,
    height: float = 3.6,
    width: float = 9.0,
    share_x: bool = True,
    ratios: tuple[float, ...] | None = None,
) -> tuple[Figure, tuple[Axes, ...]]:
    """Figure with its axes, row by row; sizes in inches, `ratios` those of the rows' heights."""
    needs("matplotlib")
    from matplotlib import rcParams
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as NewFigure

    rcParams["text.parse_math"] = False  # a dollar in a name is a dollar
    figure = NewFigure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    all_axes = figure.subplots(rows, columns, sharex=share_x, height_ratios=ratios)
    return figure, tuple(np.atleast_1d(all_axes).ravel())


def finish(*all_axes: Axes, x: str = "", y: Sequence[str] = (), legend: str = "beside") -> None:
    """Names of the axes, that of `x` below the last; grid; and the legend beside or above, where it hides nothing."""
    if x:
        all_axes[-1].set_xlabel(x)
    for axes, name in zip(all_axes, y, strict=False):
        axes.set_ylabel(name)
    for axes in all_axes:
        axes.grid(visible=True, color="0.9")
        axes.spines[["top", "right"]].set_visible(False)
        for axis in (axes.xaxis, axes.yaxis):
            if axis.get_scale() == "log":
                axis.set_major_formatter("{x:g}")  # the usual one writes formulas
        count = len(axes.get_legend_handles_labels()[1])
        if count and legend == "beside":
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
        elif count:
            axes.legend(
                loc="lower left",
                bbox_to_anchor=(0.0, 1.0),
                ncols=count,
                frameon=False,
                borderaxespad=0.2,
                handlelength=1.5,
                columnspacing=1.0,
                fontsize=9,
            )
