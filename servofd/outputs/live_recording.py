"""A Rerun recording that grows in flight: to a viewer on this machine, to a file, or both.

A thread of its own hands samples over in batches (single ones would cost 60 us each), and drops the oldest when it
cannot keep up: the monitor never waits for a viewer or a disk. A killed process loses one batch of the file at most.
"""

from __future__ import annotations

import contextlib
import os
import re
import threading
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from servofd.outputs.recording.stream import Recorder

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from servofd.detection.events import Event
    from servofd.types import FloatArray

__all__ = ["LiveRecording", "Samples"]

_TO_VIEWER_S, _TO_FILE_S = 0.2, 2.0
_PATIENCE_S = 5.0
"""A sink that has not taken a batch by then is given up."""
_ROOM = 4_000
_LAST_S = 60.0
_TIMELINE = "time_boot"
_GREY, _BLUE, _ORANGE, _RED = 0x999999FF, 0x56B4E9FF, 0xE69F00FF, 0xD55E00FF
_STATES = {"alarm": "ALARM", "named": "ALARM", "clear": "OK", "no_data": "no data"}
_GLOBAL_VIEW = "view/5c0dca6a-e63f-9cf7-f657-2602590474cc/TimeAxis"
"""Where a blueprint keeps the range that linked time axes share."""


class Samples(NamedTuple):
    """What was evaluated of one surface; columns of shape (n,)."""

    surface: str
    time_s: FloatArray
    command_deg: FloatArray
    simulated_deg: FloatArray
    measured_deg: FloatArray
    residual_deg: FloatArray
    threshold_deg: FloatArray


@dataclass(slots=True)
class _Sink:
    """A viewer or a file, until it fails."""

    stream: Any
    every_s: float
    name: str
    kept: list[Samples | Event] = field(default_factory=list)
    error: str = ""


class LiveRecording:
    """Recording of a running monitor.

    Parameters
    ----------
    name : str
        Of the aircraft.
    surfaces : list of str
        What will be shown.
    path : Path, optional
        File to write.
    port : int, optional
        Port of the loopback interface on which viewers may connect.
    properties : Mapping, optional
        What ``servofd review`` needs to judge it afterwards; see `servofd.outputs.recording.verdicts.live_verdicts`.
    """

    def __init__(
        self,
        name: str,
        surfaces: list[str],
        *,
        path: Path | None = None,
        port: int | None = None,
        properties: Mapping[str, Any] | None = None,
    ) -> None:
        # What it would print of a full disk, in lines of its own, `errors` tells.
        os.environ.setdefault("RUST_LOG", "off")
        import rerun as rr

        self._rr: Any = rr
        self._entries: deque[Samples | Event] = deque(maxlen=_ROOM)
        self.dropped = 0
        self._stop = threading.Event()
        application = "servofd-" + re.sub(r"[^A-Za-z0-9_ -]", "-", name or "plain")[:100]
        layout = _layout(surfaces)
        self._sinks: list[_Sink] = []
        if port is not None:
            viewer = rr.RecordingStream(application)
            viewer.set_sinks(rr.GrpcServerSink("127.0.0.1", port), default_blueprint=layout)
            self._sinks.append(_Sink(viewer, _TO_VIEWER_S, "viewer"))
        if path is not None:
            file = rr.RecordingStream(application)
            file.save(str(path), default_blueprint=layout)
            self._sinks.append(_Sink(file, _TO_FILE_S, "recording"))
        for sink in self._sinks:
            rr.set_log_time_enabled(False, recording=sink.stream)
            _style(rr, sink.stream, surfaces)
            if properties is not None:
                Recorder(sink.stream).properties(name or "monitor", properties)
        self._thread = threading.Thread(target=self._run, name="servofd record", daemon=True)
        self._thread.start()

    def add(self, entry: Samples | Event) -> None:
        """Record samples or an event; never waits."""
        self.dropped += len(self._entries) == self._entries.maxlen
        self._entries.append(entry)

    @property
    def errors(self) -> dict[str, str]:
        """What failed, and why: keys ``viewer`` and ``recording``."""
        return {sink.name: sink.error for sink in self._sinks if sink.error}

    def close(self) -> None:
        """Write what is left, and end the file properly; never waits for a sink that is stuck."""
        self._stop.set()
        self._thread.join(2.0 * _PATIENCE_S)
        for sink in self._sinks:
            with contextlib.suppress(Exception):
                sink.stream.disconnect()

    def _run(self) -> None:
        ticks = 0
        while True:
            last = self._stop.wait(_TO_VIEWER_S)
            ticks += 1
            fresh = [self._entries.popleft() for _ in range(len(self._entries))]
            for sink in self._sinks:
                if sink.error:
                    continue
                sink.kept += fresh
                if last or ticks % max(round(sink.every_s / _TO_VIEWER_S), 1) == 0:
                    self._hand_over(sink)
            if last:
                return

    def _hand_over(self, sink: _Sink) -> None:
        try:
            self._send(sink.stream, sink.kept)
        except (RuntimeError, ValueError, OSError) as error:
            sink.error = f"{error}; is the disk full?" if sink.name == "recording" else str(error)
        sink.kept = []

    def _send(self, stream: Any, entries: list[Samples | Event]) -> None:  # noqa: ANN401 - rerun's own
        rr = self._rr
        by_surface: dict[str, list[Samples]] = {}
        for entry in entries:
            if isinstance(entry, Samples):
                by_surface.setdefault(entry.surface, []).append(entry)
            else:
                self._event(stream, entry)
        for surface, pieces in by_surface.items():
            columns = [np.concatenate(column) for column in list(zip(*pieces, strict=True))[1:]]
            at = [_time(rr, columns[0])]
            path = f"/surfaces/{surface}"
            stream.send_columns(f"{path}/deflection", at, rr.Scalars.columns(scalars=np.column_stack(columns[1:4])))
            levels = np.column_stack([columns[4], columns[5], -columns[5]])
            stream.send_columns(f"{path}/residual", at, rr.Scalars.columns(scalars=levels))
        stream.flush(timeout_sec=_PATIENCE_S)

    def _event(self, stream: Any, event: Event) -> None:  # noqa: ANN401 - rerun's own
        rr = self._rr
        at = [_time(rr, np.array([event.time_s if np.isfinite(event.time_s) else 0.0]))]
        words = " ".join(filter(None, (event.surface, event.event, event.kind, event.text)))
        level = "ERROR" if event.event in ("alarm", "named") else "INFO"
        stream.send_columns("/events", at, rr.TextLog.columns(text=[words], level=[level]))
        if event.surface:
            state = _STATES.get(event.event, "")
            stream.send_columns(f"/surfaces/{event.surface}/state", at, rr.StateChange.columns(state=[state]))


def _time(rr: Any, time_s: FloatArray) -> Any:  # noqa: ANN401
    microseconds = np.round(time_s * 1e6).astype("timedelta64[us]")
    return rr.TimeColumn(_TIMELINE, duration=microseconds)


def _style(rr: Any, stream: Any, surfaces: list[str]) -> None:  # noqa: ANN401
    for surface in surfaces:
        colours = np.array([_GREY, _BLUE, _ORANGE], dtype=np.uint32)
        names = ["command", "healthy servo", "measured"]
        path = f"/surfaces/{surface}"
        stream.log(f"{path}/deflection", rr.SeriesLines(colors=colours, names=names), static=True)
        colours = np.array([_BLUE, _RED, _RED], dtype=np.uint32)
        names = ["residual", "threshold", "-threshold"]
        stream.log(f"{path}/residual", rr.SeriesLines(colors=colours, names=names), static=True)


def _layout(surfaces: list[str]) -> Any:  # noqa: ANN401
    """One column per surface, the last minute following."""
    import rerun.blueprint as rrb

    class Following(rrb.Blueprint):  # type: ignore[misc]
        def _log_to_stream(self, stream: Any) -> None:  # noqa: ANN401
            super()._log_to_stream(stream)
            last = rrb.TimeAxis(view_range=_last_minute())
            stream.log(_GLOBAL_VIEW, last, static=True)

    axis = rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal)
    tabs = [
        rrb.Vertical(
            rrb.TimeSeriesView(origin=f"/surfaces/{s}/deflection", name=f"{s} [deg]", axis_x=axis),
            rrb.TimeSeriesView(origin=f"/surfaces/{s}/residual", name=f"{s}: residual [deg]", axis_x=axis),
            name=s,
        )
        for s in surfaces
    ]
    events = rrb.TextLogView(origin="/events", name="events")
    panel = rrb.TimePanel(timeline=_TIMELINE, play_state="following", state="collapsed")
    return Following(rrb.Vertical(rrb.Grid(*tabs), events, row_shares=[5, 1]), panel, collapse_panels=True)


def _last_minute() -> Any:  # noqa: ANN401
    import rerun as rr

    seconds = [rr.TimeRangeBoundary.cursor_relative(seconds=at_s) for at_s in (-_LAST_S, 0.0)]
    return rr.TimeRange(start=seconds[0], end=seconds[1])
