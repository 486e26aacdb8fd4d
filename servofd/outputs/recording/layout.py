"""What the viewer shows on opening: an overview and a tab for each surface; the whole flight at once."""

from __future__ import annotations

from collections.abc import Sequence, Set
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from servofd.axes.model import FORMS
from servofd.axes.verdict import AxisAudit, AxisEvent
from servofd.detection.verdict import Fault
from servofd.outputs.recording.content import Recording
from servofd.outputs.recording.stream import TIME_BOOT, shown, surface_place
from servofd.outputs.recording.surface import axis_place, deflection_range, residual_range

_ALL_AXES = "view/5c0dca6a-e63f-9cf7-f657-2602590474cc/TimeAxis"
"""Where Rerun 0.41 keeps the range that linked time axes share (its ``GLOBAL_VIEW_ID``); a picture tests it."""


def blueprint(
    tabs: Sequence[Any],
    last_s: float | None = None,
    around_s: tuple[float, float] | None = None,
    opened: int = 0,
    marked_s: tuple[float, float] | None = None,
) -> Any:  # noqa: ANN401 - rerun is untyped
    """Tabs with linked time axes, side panels folded.

    `last_s`: follow what comes live, and show so much of it [s]; the whole flight if left out. `around_s`: where the
    time axes begin and end on opening [s]; a double click shows the whole. `opened`: which of the tabs is open.
    `marked_s`: begin and end of what is marked on the time line [s]. A layout cannot move the cursor: it stands at the
    start.
    """
    edge = rr.TimeRangeBoundary
    begin, end = edge.infinite(), edge.infinite()
    if last_s is not None:
        begin, end = edge.cursor_relative(seconds=-last_s), edge.cursor_relative(seconds=0.0)
    elif around_s is not None:
        begin, end = (edge.absolute(seconds=time_s) for time_s in around_s)

    class _Linked(rrb.Blueprint):  # type: ignore[misc]
        """Linked axes ignore the range of their own view, and would open on a minute around the cursor."""

        def _log_to_stream(self, stream: Any) -> None:  # noqa: ANN401
            super()._log_to_stream(stream)
            stream.log(_ALL_AXES, rrb.TimeAxis(view_range=rr.TimeRange(start=begin, end=end)))

    return _Linked(
        rrb.Tabs(*tabs, active_tab=opened),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(
            state="collapsed",
            timeline=TIME_BOOT,
            play_state="paused" if last_s is None else "following",
            time_selection=marked_s and rr.encodings.AbsoluteTimeRange(*(round(1e9 * time_s) for time_s in marked_s)),
        ),
    )


def curves(name: str, origin: str, *entities: str, span: tuple[float, float] | None = None) -> Any:  # noqa: ANN401
    """Plot of entities below `origin`, from bottom to top of `span`; it fits itself to the curves without one."""
    return rrb.TimeSeriesView(
        origin=origin or "/",
        contents=[f"{origin}{entity}" for entity in entities],
        name=shown(name),
        axis_x=rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal),
        axis_y=None if span is None else rrb.ScalarAxis(range=span),
        plot_legend=rrb.PlotLegend(corner="LeftTop"),
        interaction=rrb.PlotInteraction(tooltip_mode="All"),
    )


def lanes(name: str, origin: str, *entities: str) -> Any:  # noqa: ANN401
    """Coloured lanes, one of each entity below `origin`."""
    axis, contents = rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal), [f"{origin}{one}" for one in entities]
    return rrb.StateTimelineView(origin=origin or "/", contents=contents, name=shown(name), time_view=axis)


def stacked(name: str, views: Sequence[Any], shares: Sequence[float]) -> Any:  # noqa: ANN401
    """Views one below the other, by shares of the height."""
    return rrb.Vertical(*views, row_shares=list(shares), name=shown(name))


ALARM_LINE = "/surfaces_alarm"
"""Entity of the line at 1 in the overview."""

REPORT = "/report"
"""Entity of the report."""
REPORT_VIEW = rrb.TextDocumentView(origin=REPORT, name="Report")
"""The report in a layout."""

LINK = "/link"
"""Entity of messages about a live link, and of no surface."""

_AROUND_S, _BEFORE_S = 60.0, 15.0
"""How much an audit's layout shows around the first fault, and how much of that before it."""
_LAST_S = 60.0
"""That a layout shows which follows."""


def audit_layout(recording: Recording) -> Any:  # noqa: ANN401 - rerun is untyped
    """Layout of an audit's recording."""
    drawn = {name: trace for name, trace in recording.traces.items() if trace.time_s.size}
    currents = [s.surface for s in recording.audit.surfaces if s.current is not None and s.current.time_s is not None]
    alone = [name for name in currents if name not in drawn]
    tabs = [
        _overview([surface.surface for surface in recording.audit.surfaces], list(drawn)),
        *(_surface(n, deflection_range(t), residual_range(t), has_current=n in currents) for n, t in drawn.items()),
        *map(_by_current, alone),
        *map(_axis, recording.audit.axes),
    ]
    alarms: list[tuple[str, Fault | AxisEvent]] = [
        *((surface.surface, fault) for surface in recording.audit.surfaces for fault in surface.faults),
        *((axis.axis, event) for axis in recording.audit.axes for event in axis.events if event.is_own),
    ]
    if not alarms:
        return blueprint(tabs)
    names = [*drawn, *alone, *(axis.axis for axis in recording.audit.axes)]
    name, first = min(alarms, key=lambda alarm: alarm[1].alarm_s)
    marked_s, around_s = (min(first.start_s, first.alarm_s), first.alarm_s), None
    if recording.end_s - recording.start_s > _AROUND_S:  # an alarm and what led to it
        begin_s = max(marked_s[0] - _BEFORE_S, recording.start_s)
        around_s = begin_s, min(max(first.alarm_s + _BEFORE_S, begin_s + _AROUND_S), recording.end_s)
    return blueprint(tabs, None, around_s, 1 + names.index(name), marked_s)


def live_layout(
    surfaces: Sequence[str],
    currents: Set[str] = frozenset(),
    beside: Set[str] = frozenset(),
    *,
    following: bool = False,
) -> Any:  # noqa: ANN401
    """Layout of what a monitor records (`LiveRecording`): the whole flight, or the last minute, following."""
    tabs = [_by_current(n) if n in currents else _surface(n, has_current=n in beside) for n in surfaces]
    return blueprint([_overview(surfaces, surfaces), *tabs], _LAST_S if following else None)


def _by_current(name: str) -> Any:  # noqa: ANN401 - rerun is untyped
    """What was asked of a surface without a position, and what its servo drew."""
    place = surface_place(name)
    views = [curves(f"{name}: command [deg]", place, "/command"), curves(f"{name}: current [A]", place, "/current")]
    return stacked(name, views, [2, 3])


def _surface(
    name: str,
    deflection: tuple[float, float] | None = None,
    residual: tuple[float, float] | None = None,
    *,
    has_current: bool = False,
) -> Any:  # noqa: ANN401
    """Deflection, residual and state of one surface, one below the other, from bottom to top of given ranges [deg]."""
    place, residuals = surface_place(name), ("/residual", "/onboard", "/shade/residual/**")
    views = [
        curves(f"{name}: deflection [deg]", place, "/deflection", "/shade/deflection/**", span=deflection),
        curves(f"{name}: residual and thresholds [deg]", place, *residuals, span=residual),
        *([curves(f"{name}: current [A]", place, "/current")] if has_current else []),
        lanes(f"{name}: state", f"{place}/state", ""),
    ]
    return stacked(name, views, [4, *[3] * (len(views) - 2), 1.4])


def _overview(names: Sequence[str], shown: Sequence[str]) -> Any:  # noqa: ANN401
    places = [LINK, *(f"{surface_place(name)}/events" for name in names)]
    events = rrb.TextLogView(origin="/", contents=places, name="Events")
    below = rrb.Horizontal(events, REPORT_VIEW, column_shares=[1, 1])
    if not shown:
        return rrb.Vertical(below, name="Overview")
    ratios = [f"{surface_place(name)}/{what}" for name in shown for what in ("ratio", "onset")]
    views = [
        lanes("State", "", *(f"{surface_place(name)}/state" for name in shown)),
        curves("|residual| / threshold (1 = alarm; drawn up to 5)", "", ALARM_LINE, *ratios, span=(0.0, 5.0)),
        below,
    ]
    return stacked("Overview", views, [0.8 + 0.4 * len(shown), 3, 2.6])


def _axis(axis: AxisAudit) -> Any:  # noqa: ANN401 - rerun is untyped
    """Effect, distance and state of one axis, one below the other."""
    place, unit = axis_place(axis), FORMS[axis.model.form].unit
    views = [
        curves(f"{axis.axis}: effect of the command [{unit}]", place, "/effect"),
        curves(f"{axis.axis}: distance from healthy (1 = alarm)", place, "/distance"),
        lanes(f"{axis.axis}: state", f"{place}/state", ""),
    ]
    return stacked(axis.axis, views, [4, 3, 1.4])
