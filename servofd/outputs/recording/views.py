"""Views of the Rerun viewer as servofd lays them out: linked time axes, legends top left, side panels folded."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from servofd.outputs.recording.clock import TIME_BOOT
from servofd.outputs.recording.stream import shown

if TYPE_CHECKING:
    from collections.abc import Sequence

_ALL_AXES = "view/5c0dca6a-e63f-9cf7-f657-2602590474cc/TimeAxis"
"""Where Rerun 0.41 keeps the range that linked time axes share (its ``GLOBAL_VIEW_ID``); not documented, hence the
picture test."""


def blueprint(tabs: Sequence[Any], last_s: float | None = None, around_s: tuple[float, float] | None = None) -> Any:  # noqa: ANN401 - rerun is untyped
    """Tabs with linked time axes, side panels folded.

    Parameters
    ----------
    last_s : float, optional
        Follow what comes live, and show so much of it [s]; the whole flight if left out.
    around_s : tuple of float, optional
        Where the time axes begin and end on opening [s]; a double click shows the whole.
    """
    import rerun as rr
    import rerun.blueprint as rrb

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
        rrb.Tabs(*tabs),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIME_BOOT, play_state="paused" if last_s is None else "following"),
    )


def curves(name: str, places: Sequence[str], *, origin: str = "/", span: tuple[float, float] | None = None) -> Any:  # noqa: ANN401
    """Plot of some entities.

    Parameters
    ----------
    span : (float, float), optional
        Bottom and top of the plot; it fits itself to the curves if left out.
    """
    import rerun.blueprint as rrb

    return rrb.TimeSeriesView(
        origin=origin,
        contents=list(places),
        name=shown(name),
        axis_x=_linked(),
        axis_y=None if span is None else rrb.ScalarAxis(range=span),
        plot_legend=rrb.PlotLegend(corner="LeftTop"),
        interaction=rrb.PlotInteraction(tooltip_mode="All"),
    )


def lanes(name: str, places: Sequence[str], *, origin: str = "/") -> Any:  # noqa: ANN401
    """Coloured lanes, one of each entity; `origin` as for `curves`."""
    import rerun.blueprint as rrb

    return rrb.StateTimelineView(origin=origin, contents=list(places), name=shown(name), time_view=_linked())


def messages(name: str, places: Sequence[str]) -> Any:  # noqa: ANN401
    """Lines of text logs."""
    import rerun.blueprint as rrb

    return rrb.TextLogView(origin="/", contents=list(places), name=shown(name))


def document(name: str, place: str) -> Any:  # noqa: ANN401
    """A text."""
    import rerun.blueprint as rrb

    return rrb.TextDocumentView(origin=place, name=shown(name))


def stacked(name: str, views: Sequence[Any], shares: Sequence[float]) -> Any:  # noqa: ANN401
    """Views one below the other, by shares of the height."""
    import rerun.blueprint as rrb

    return rrb.Vertical(*views, row_shares=list(shares), name=shown(name))


def _linked() -> Any:  # noqa: ANN401
    import rerun.blueprint as rrb

    return rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal)
