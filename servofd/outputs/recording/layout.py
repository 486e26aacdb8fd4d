"""What the viewer shows on opening: an overview, a tab for each surface, the aircraft; the whole flight at once."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.outputs.recording.clock import TIME_BOOT
from servofd.outputs.recording.scene import GEO
from servofd.outputs.recording.stream import surface_place
from servofd.outputs.recording.surface import deflection_range, residual_range

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.outputs.recording.content import Recording, Trace
    from servofd.types import FloatArray

__all__ = ["ALARM_LINE", "audit_layout", "blueprint", "surface_tab"]

ALARM_LINE = "/surfaces_alarm"
"""Entity of the line at 1 in the overview."""

_ALL_AXES = "view/5c0dca6a-e63f-9cf7-f657-2602590474cc/TimeAxis"
"""Where Rerun 0.41 keeps the range that linked time axes share (its ``GLOBAL_VIEW_ID``); not documented, hence the
picture test."""


def blueprint(tabs: Sequence[Any], view_range: Any, play_state: str = "paused") -> Any:  # noqa: ANN401 - rerun is untyped
    """Tabs with linked time axes, side panels folded.

    Parameters
    ----------
    tabs : sequence of views or containers
        In order.
    view_range : rerun TimeRange
        What all time axes show at first.
    play_state : str
        ``"paused"``, or ``"following"`` for something live.
    """
    import rerun.blueprint as rrb

    class _Linked(rrb.Blueprint):  # type: ignore[misc]
        """Linked axes ignore the range of their own view, and would open on a minute around the cursor."""

        def _log_to_stream(self, stream: Any) -> None:  # noqa: ANN401
            super()._log_to_stream(stream)
            stream.log(_ALL_AXES, rrb.TimeAxis(view_range=view_range))

    return _Linked(
        rrb.Tabs(*tabs),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIME_BOOT, play_state=play_state),
    )


def audit_layout(recording: Recording) -> Any:  # noqa: ANN401
    """Layout of an audit's recording."""
    import rerun as rr

    whole = rr.TimeRange(start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite())
    shown = {name: trace for name, trace in recording.traces.items() if trace.time_s.size}
    names = [surface.surface for surface in recording.audit.surfaces]
    tabs = [_overview(names, list(shown))]
    tabs += [surface_tab(name, trace) for name, trace in shown.items()]
    if shown:
        tabs.append(_aircraft(recording))
    return blueprint(tabs, whole)


def surface_tab(name: str, trace: Trace) -> Any:  # noqa: ANN401
    """Deflection, residual and state of one surface, one below the other."""
    import rerun.blueprint as rrb

    place = surface_place(name)
    return rrb.Vertical(
        _plot(f"{place}/deflection", f"{name}: deflection [deg]", deflection_range(trace)),
        _plot(f"{place}/residual", f"{name}: residual and thresholds [deg]", residual_range(trace)),
        rrb.StateTimelineView(origin=f"{place}/state", name=f"{name}: state", time_view=_linked()),
        row_shares=[4, 3, 1.4],
        name=name,
    )


def _overview(names: Sequence[str], shown: Sequence[str]) -> Any:  # noqa: ANN401
    import rerun.blueprint as rrb

    events = rrb.TextLogView(origin="/", contents=[f"{surface_place(n)}/events" for n in names], name="Events")
    report = rrb.TextDocumentView(origin="/report", name="Report")
    below = rrb.Horizontal(events, report, column_shares=[1, 1])
    if not shown:
        return rrb.Vertical(below, name="Overview")
    lanes = rrb.StateTimelineView(
        origin="/", contents=[f"{surface_place(n)}/state" for n in shown], name="State", time_view=_linked()
    )
    ratios = rrb.TimeSeriesView(
        origin="/",
        contents=[ALARM_LINE, *(f"{surface_place(n)}/{what}" for n in shown for what in ("ratio", "onset"))],
        name="|residual| / threshold (1 = alarm)",
        axis_x=_linked(),
        axis_y=rrb.ScalarAxis(range=(0.0, 5.0)),
        plot_legend=rrb.PlotLegend(corner="LeftTop"),
    )
    lane_share = 0.8 + 0.4 * len(shown)
    return rrb.Vertical(lanes, ratios, below, row_shares=[lane_share, 3, 2.6], name="Overview")


def _plot(place: str, name: str, span: tuple[float, float]) -> Any:  # noqa: ANN401
    """Curves of one entity over the shading of its faults."""
    import rerun.blueprint as rrb

    parent, _, which = place.rpartition("/")
    return rrb.TimeSeriesView(
        origin=parent,
        contents=[place, f"{parent}/shade/{which}/**"],
        name=name,
        axis_x=_linked(),
        axis_y=rrb.ScalarAxis(range=span),
        plot_legend=rrb.PlotLegend(corner="LeftTop"),
        interaction=rrb.PlotInteraction(tooltip_mode="All"),
    )


def _aircraft(recording: Recording) -> Any:  # noqa: ANN401
    import rerun.blueprint as rrb

    away = 1.0 if recording.position is None else 1.35
    position = (-2.1 * away, -1.4 * away, -1.15 * away)
    eye = rrb.EyeControls3D(position=position, look_target=(-0.3, 0.0, 0.0), eye_up=(0.0, 0.0, -1.0))
    views = [rrb.Spatial3DView(origin="/aircraft", name="Surfaces (blue: as a healthy servo)", eye_controls=eye)]
    if recording.position is not None:
        track = rrb.Spatial3DView(
            origin="/flight/local", name="Track from the first fix [m]", eye_controls=_above(recording.position[:, 1:])
        )
        views.append(track)
    if recording.geo is not None:
        views.append(rrb.MapView(origin=GEO, name="Map"))
    return rrb.Horizontal(*views, name="Aircraft")


def _above(track_m: FloatArray) -> Any:  # noqa: ANN401
    """Eye that sees a whole track of shape (n, 3) [m] from the south."""
    import rerun.blueprint as rrb

    low, high = track_m.min(axis=0), track_m.max(axis=0)
    middle, size = (low + high) / 2.0, max(float(np.linalg.norm(high - low)), 10.0)
    return rrb.EyeControls3D(position=middle + np.array([0.0, -0.9, 0.8]) * size, look_target=middle, eye_up=(0, 0, 1))


def _linked() -> Any:  # noqa: ANN401
    import rerun.blueprint as rrb

    return rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal)
