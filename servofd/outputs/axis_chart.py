"""An axis as a chart: what its command should do and what the aircraft did, and how far that is from healthy."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.axes.forms import FORMS
from servofd.outputs.chart import Chart, Curve, Mark, Panel, Span

if TYPE_CHECKING:
    from servofd.axes.verdict import AxisAudit

_MOST_OF_IT = 0.998
_HEADROOM = 1.1
_HIGHEST = 20.0


def axis_chart(axis: AxisAudit) -> Chart:
    """The whole flight of one axis."""
    time_s, usable = axis.time_s, axis.inputs.usable
    asked, shown = (np.where(usable, values, np.nan) for values in (axis.asked, axis.shown))
    both = np.concatenate([asked[usable], shown[usable], [0.0]])
    low, high = (float(x) for x in np.quantile(both, (1.0 - _MOST_OF_IT, _MOST_OF_IT)))
    margin = 0.1 * (high - low) + 1e-9
    unit = FORMS[axis.model.form].unit
    effect = Panel(
        "effect of the command",
        unit,
        (Curve("expected", "simulated", time_s, asked), Curve("as the motion shows", "measured", time_s, shown)),
        low - margin,
        high + margin,
    )
    score = np.sqrt(np.clip(axis.score, 0.0, _HIGHEST**2))
    top = _HEADROOM * max(1.2, float(score.max()))
    distance = Panel(
        "distance from healthy over its threshold",
        "1",
        (
            Curve("distance", "residual", time_s, np.where(usable, score, np.nan)),
            Curve("threshold", "threshold", time_s[[0, -1]], np.ones(2)),
        ),
        0.0,
        top,
    )
    text = (
        "Above, the part of the motion that the command should cause, and the part that nothing else explains; a lost "
        "surface keeps the second from following the first. Below, how far lost share and offset are from those of "
        "healthy flights. Where nothing is drawn, nothing was judged."
    )
    last_s = float(time_s[-1])
    spans = tuple(Span("fault", e.start_s, e.end_s or last_s, "lost") for e in axis.events if not e.cause)
    marks = tuple(Mark("alarm", e.alarm_s, "alarm") for e in axis.events if not e.cause)
    return Chart("Whole flight", text, float(time_s[0]), last_s, (effect, distance), spans, marks)
