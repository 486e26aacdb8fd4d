"""A Rerun recording that grows in flight: to a viewer on this machine, to a file, or both.

A thread of its own hands samples over in batches (single ones would cost 60 us each), and drops the oldest when it
cannot keep up: the monitor never waits for a viewer or a disk. A killed process loses one batch of the file at most.
"""

from __future__ import annotations

import contextlib
import itertools
import threading
from collections import defaultdict, deque
from collections.abc import Mapping, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rerun as rr

from servofd.core.errors import ConfigError
from servofd.core.types import FloatArray
from servofd.detection.event import Event
from servofd.outputs.palette import SERIES
from servofd.outputs.recording.content import MANY_VEHICLES, Trace
from servofd.outputs.recording.layout import ALARM_LINE, LINK, REPORT, live_layout
from servofd.outputs.recording.stream import STATES, Recorder, application_name, surface_place
from servofd.outputs.recording.surface import around, breaks_s, send_current, send_curves, send_styles, style_current
from servofd.outputs.sentence import spoken
from servofd.servo.context import Context

_TO_VIEWER_S, _TO_FILE_S = 0.2, 2.0
"""Time between two batches to the viewer, and to the file [s]."""
_PATIENCE_S = 5.0
"""A sink that has not taken a batch by then is given up."""
_ROOM = 4_000
"""Entries that may wait for the next batch; the oldest are dropped."""
_LEVELS = {"alarm": "ERROR", "named": "ERROR", "no_data": "WARN", "link_lost": "WARN"}
_STATE_AFTER = {"alarm": "FAULT", "clear": "OK", "no_data": "NO DATA"}
_ABOUT = "Recorded in flight. `servofd review` of this recording gives the verdicts, as an audit of the log would."


class Samples(NamedTuple):
    """What was evaluated of one surface, and the commands that have come since the samples before."""

    surface: str
    trace: Trace
    is_beside: bool = False
    """Whether it is a current, in amperes, beside the position."""


class LiveRecording:
    """Recording of a running monitor, to a file, to viewers on a port of the loopback interface, or both.

    `currents` are the surfaces that are watched by their current alone: their samples are in amperes. Those `beside`
    are watched by it and by their position.

    What ``servofd review`` needs to judge it afterwards are its `properties` (`recording.content.live_verdicts`).
    """

    def __init__(
        self,
        name: str,
        surfaces: list[str],
        *,
        currents: Set[str] = frozenset(),
        beside: Set[str] = frozenset(),
        path: Path | None = None,
        port: int | None = None,
        properties: Mapping[str, Any] | None = None,
    ) -> None:
        self._entries: deque[Samples | Event] = deque(maxlen=_ROOM)
        self.dropped = 0
        self._stop = threading.Event()
        self._sinks = []
        for kind, every_s, target in (("viewer", _TO_VIEWER_S, port), ("recording", _TO_FILE_S, path)):
            if target is None:
                continue
            try:
                recorder = _opened(application_name(name or "plain", "live"), surfaces, currents, beside, target)
                recorder.properties(name or "monitor", properties or {"schema": MANY_VEHICLES})
                recorder.document(REPORT, f"# {name or 'monitor'}\n\n{_ABOUT}\n")
            except (OSError, RuntimeError, ValueError, OverflowError) as error:  # rerun's own
                raise ConfigError(f"{target}: cannot record: {str(error).splitlines()[0][:160]}") from None
            self._sinks.append(_Sink(kind, recorder, round(every_s / _TO_VIEWER_S), currents))
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
                sink.recorder.stream.disconnect()

    def _run(self) -> None:
        ticks, last = 0, False
        while not last:
            last = self._stop.wait(_TO_VIEWER_S)
            ticks += 1
            fresh = [self._entries.popleft() for _ in range(len(self._entries))]
            for sink in self._sinks:
                if not sink.error:
                    sink.kept += fresh
                    if last or ticks % sink.every == 0:
                        sink.hand_over()


@dataclass(slots=True)
class _Lane:
    """State of one surface, as it was shown last."""

    faulty: bool = False
    shown: str = ""
    tail_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    """Times of the last samples [s]; what comes long after them begins a new curve."""


@dataclass(slots=True)
class _Sink:
    """One stream, and what waits to go there."""

    name: str
    """``viewer`` or ``recording``."""
    recorder: Recorder
    every: int
    """Batches of the fastest one that make one of this."""
    currents: Set[str]
    """Surfaces whose samples are in amperes."""
    kept: list[Samples | Event] = field(default_factory=list)
    lanes: defaultdict[tuple[str, bool], _Lane] = field(default_factory=lambda: defaultdict(_Lane))
    """Of each surface, and of each current beside one."""
    around_s: dict[str, float] = field(default_factory=dict)
    """Until when airspeed and supply were sent [s]."""
    error: str = ""
    """Why nothing goes there any more."""

    def hand_over(self) -> None:
        """Send what has come, or note why that cannot be done."""
        try:
            self._send()
        except (RuntimeError, ValueError, OSError) as error:
            self.error = f"{error}; is the disk full?" if self.name == "recording" else str(error)
        self.kept = []

    def _send(self) -> None:
        """Runs of samples joined, events between them."""
        waiting: dict[tuple[str, bool], list[Trace]] = {}
        for entry in self.kept:
            if isinstance(entry, Samples):
                waiting.setdefault((entry.surface, entry.is_beside), []).append(entry.trace)
                continue
            # In order: what it was before the event, it was until the event.
            if (entry.surface, False) in waiting:
                self._samples(entry.surface, waiting.pop((entry.surface, False)))
            self._event(entry)
        for (surface, is_beside), pieces in waiting.items():
            self._samples(surface, pieces, is_beside=is_beside)
        self.recorder.stream.flush(timeout_sec=_PATIENCE_S)

    def _samples(self, surface: str, pieces: list[Trace], *, is_beside: bool = False) -> None:
        columns, context = list(zip(*pieces, strict=True))[:8], pieces[-1].context
        trace = Trace._make([*(np.concatenate(column) for column in columns), (), context])
        time_s, place, lane = trace.time_s, surface_place(surface), self.lanes[surface, is_beside]
        if time_s.size and not is_beside:
            self._around(context)
            if lane.shown in ("", "NO DATA"):
                self._state(surface, float(time_s[0]), "FAULT" if lane.faulty else "OK")
        known_s = np.concatenate([lane.tail_s, time_s])
        broken_s, lane.tail_s = breaks_s(known_s), known_s[-10:]
        self.recorder.scalars(f"{place}/command", trace.asked_s, trace.asked_deg)
        if is_beside or surface in self.currents:
            columns_a = (time_s, trace.measured_deg, trace.simulated_deg, trace.threshold_deg)
            send_current(self.recorder, place, broken_s, columns_a)
        elif time_s.size:  # there is none beside a current that is watched alone
            send_curves(self.recorder, place, broken_s, trace)
            self.recorder.scalars(ALARM_LINE, time_s[[0, -1]], np.ones(2))

    def _around(self, context: Context) -> None:
        """Airspeed and supply, as far as they are news."""
        for place, _, at_s, values in around(context):
            new = slice(int(np.searchsorted(at_s, self.around_s.get(place, -np.inf), side="right")), None)
            if at_s[new].size:
                self.recorder.scalars(place, at_s[new], values[new])
                self.around_s[place] = float(at_s[-1])

    def _event(self, event: Event) -> None:
        time_s = event.time_s if np.isfinite(event.time_s) else 0.0
        words = spoken(f"{event.event} {event.kind}".strip())
        if np.isfinite(event.residual_deg):
            words += f", residual {event.residual_deg:+.2f} of {event.threshold_deg:.2f} deg"
        words = ": ".join(filter(None, (event.surface, words, event.text)))
        place = f"{surface_place(event.surface)}/events" if event.surface else LINK
        self.recorder.texts(place, [(time_s, _LEVELS.get(event.event, "INFO"), words)])
        if event.surface and event.event in _STATE_AFTER:
            if event.event != "no_data":
                self.lanes[event.surface, False].faulty = event.event == "alarm"
            self._state(event.surface, time_s, _STATE_AFTER[event.event])

    def _state(self, surface: str, time_s: float, word: str) -> None:
        place = surface_place(surface)
        self.lanes[surface, False].shown = word
        self.recorder.states(f"{place}/state", [(time_s, word)])
        self.recorder.line_colours(f"{place}/residual", [(time_s, (STATES[word], "threshold", "threshold"))])


def _opened(
    application: str, surfaces: list[str], currents: Set[str], beside: Set[str], target: Path | int
) -> Recorder:
    """A file, or a port of the loopback interface for viewers, with layout and styles."""
    stream = rr.RecordingStream(application, send_properties=False)
    rr.set_log_time_enabled(False, recording=stream)
    if isinstance(target, Path):
        stream.save(str(target), default_blueprint=live_layout(surfaces, currents, beside))
    else:
        sink = rr.GrpcServerSink("127.0.0.1", target)
        stream.set_sinks(sink, default_blueprint=live_layout(surfaces, currents, beside, following=True))
    recorder = Recorder(stream)
    for surface, tint in zip(surfaces, itertools.cycle(SERIES), strict=False):
        if surface in currents | beside:
            style_current(recorder, surface_place(surface))
        if surface not in currents:
            send_styles(recorder, surface, tint)
    recorder.lines(ALARM_LINE, ["threshold"], ["threshold"])
    return recorder
