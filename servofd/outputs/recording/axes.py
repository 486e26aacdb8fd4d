"""Axes of an aircraft without feedback in a recording: expected and seen effect, distance from healthy, state."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.axes.forms import FORMS
from servofd.outputs.recording.views import curves, lanes, stacked

if TYPE_CHECKING:
    from servofd.detection.verdict import AxisAudit
    from servofd.outputs.recording.stream import Recorder


def _place(axis: AxisAudit) -> str:
    return f"/axes/{axis.axis}"


def send_axis(recorder: Recorder, axis: AxisAudit) -> None:
    """Send what the motion tells of an axis."""
    place, usable = _place(axis), axis.inputs.usable
    effect = np.column_stack([axis.asked, axis.shown])
    recorder.lines(f"{place}/effect", ["expected", "seen"], ["simulated", "measured"])
    recorder.scalars(f"{place}/effect", axis.time_s, np.where(usable[:, np.newaxis], effect, np.nan))
    recorder.lines(f"{place}/distance", ["distance from healthy", "threshold"], ["residual", "threshold"])
    distance = np.column_stack([np.sqrt(np.maximum(axis.score, 0.0)), np.ones(axis.time_s.size)])
    recorder.scalars(f"{place}/distance", axis.time_s, np.where(usable[:, np.newaxis], distance, np.nan))
    recorder.states(f"{place}/state", _states(axis))


def _states(axis: AxisAudit) -> list[tuple[float, str]]:
    """When the state changes: what was judged, and what is told of it."""
    usable = axis.inputs.usable
    words = np.where(usable, "OK", "NO DATA")
    said = "FAULT" if axis.status == "fault" else "SUSPECT"
    for event in axis.events:
        if event.is_own:
            until_s = np.inf if event.end_s is None else event.end_s
            words[(axis.time_s >= event.start_s) & (axis.time_s < until_s)] = said
    first = np.flatnonzero(np.concatenate(([True], words[1:] != words[:-1])))
    return [(float(axis.time_s[k]), str(words[k])) for k in first]


def axis_tab(axis: AxisAudit) -> Any:  # noqa: ANN401 - rerun is untyped
    """Effect, distance and state of one axis, one below the other."""
    place, unit = _place(axis), FORMS[axis.model.form].unit
    views = [
        curves(f"{axis.axis}: effect of the command [{unit}]", [f"{place}/effect"], origin=place),
        curves(f"{axis.axis}: distance from healthy (1 = alarm)", [f"{place}/distance"], origin=place),
        lanes(f"{axis.axis}: state", [f"{place}/state"], origin=f"{place}/state"),
    ]
    return stacked(axis.axis, views, [4, 3, 1.4])
