"""Where the events of the monitor go: screen, JSON lines, telemetry log, recording."""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from servofd.cli.options import Options
from servofd.cli.terminal import complain, has_screen, say, screen, tell
from servofd.core.errors import ConfigError
from servofd.detection.event import Event, Inputs
from servofd.detection.stream import Piece
from servofd.live.threads import Receiver, Worker
from servofd.live.view import Picture, View, event_line
from servofd.outputs.json_report import finite

if TYPE_CHECKING:
    from servofd.live.session import Session
    from servofd.outputs.live_recording import LiveRecording

_DRAW_S: Final = 0.2
"""Between two pictures on a screen, by the clock on the wall however fast a replay runs."""
_LINES_S: Final = 5.0
"""Between the lines of surfaces where there is no screen, by the clock of the stream."""


class Outputs:
    """Hands everything on; a disk that is full or a viewer that dies stops nothing else.

    What the options ask for is open until the stack `open_` closes it.
    """

    def __init__(self, options: Options, session: Session, title: str, open_: contextlib.ExitStack) -> None:
        self._session, self._view = session, View(session, title)
        self._draw: Callable[[Picture], None] | None = None
        """Draws on the screen, while there is one."""
        self._prints = options.json_lines != "-"
        self._lines: Worker | None = None
        self._stored: Worker | None = None
        self._recording: LiveRecording | None = None
        self.receiver: Receiver | None = None
        self._drawn_s = self._printed_s = float("-inf")
        self._waited = ""
        self._failed: dict[str, str] = {}
        self._told: set[str] = set()
        """Of these failures, those that were written to stderr."""
        open_.callback(self._complain)  # also of what fails when it is closed
        if options.json_lines and self._prints:
            self._lines = _writer(options.json_lines, "wb", open_)
        if options.tlog:
            self._stored = _writer(options.tlog, "ab", open_)
            session.store = self._stored.put
        if options.rrd or options.serve:
            self._record(options, open_)
        if self._prints:
            open_.callback(lambda: tell(*self._view.summary()))
        if self._prints and not options.plain and has_screen():
            self._draw = open_.enter_context(screen())
            open_.callback(setattr, self, "_draw", None)

    def events(self, events: list[Event]) -> None:
        """Tell each event everywhere."""
        for event in events:
            if self._lines is not None or not self._prints:
                line = json.dumps(event_document(event), allow_nan=False)
                say(line) if self._lines is None else self._lines.put(f"{line}\n".encode())
            self._note(event_line(event))
            if self._recording is not None:
                began_s = self._began_s(event.surface, event.boot - 1)
                self._recording.add(replace(event, time_s=event.time_s + began_s))

    def tick(self, now_s: float) -> None:
        """Draw, print and complain, each not too often."""
        for note in self._session.notes:
            self._note(f"   note    {note}")
        self._session.notes.clear()
        self._complain()
        written = sum(worker.queue.dropped for worker in (self._stored, self._lines) if worker is not None)
        received = self.receiver.chunks.dropped if self.receiver is not None else 0
        # What found a queue full: of what came in, and of what was to be written.
        self._view.dropped = received + written + (self._recording.dropped if self._recording is not None else 0)
        clock_s = time.monotonic()
        if self._draw is not None and clock_s - self._drawn_s >= _DRAW_S:
            self._drawn_s = clock_s
            self._draw(self._view.drawn(now_s))
        elif self._draw is None and self._prints:
            waiting = self._session.waiting()
            if now_s - self._printed_s >= _LINES_S or waiting != self._waited:
                self._printed_s, self._waited = now_s, waiting
                for line in self._view.plain(now_s):
                    say(line)

    def _began_s(self, surface: str, boot: int = -1) -> float:
        """When a boot began of the vehicle that has this surface, its latest if none is given [s]."""
        owners = (v.began_s[boot] for v in self._session.vehicles.values() if surface in v.monitors or not surface)
        return next(owners, 0.0)

    def _note(self, line: str) -> None:
        self._view.note(line)
        if self._draw is None and self._prints:
            say(line)

    def _complain(self) -> None:
        """Say once what could not be written: on the screen while there is one, and on stderr."""
        workers = {"telemetry log": self._stored, "JSON lines": self._lines}
        errors = {what: worker.error for what, worker in workers.items() if worker is not None and worker.error}
        for what, error in (errors | (self._recording.errors if self._recording is not None else {})).items():
            if what not in self._failed:
                self._failed[what] = f"{what}: no more is written: {error}"
                self._view.note(self._failed[what])
        for what in self._failed.keys() - self._told if self._draw is None else ():
            self._told.add(what)
            complain(self._failed[what])

    def _record(self, options: Options, open_: contextlib.ExitStack) -> None:
        # What Rerun would print of a full disk, in lines of its own, `LiveRecording.errors` tells; it reads this first.
        os.environ.setdefault("RUST_LOG", "off")
        from servofd.outputs.live_recording import LiveRecording, Samples
        from servofd.outputs.recording.content import Trace, live_verdicts

        first, *others = self._session.aircraft.values()
        each = {n: one for craft in (first, *others) for n, one in craft.surfaces.items() if one.can_be_watched}
        port = options.viewer_port if options.serve else None
        path = Path(options.rrd) if options.rrd else None
        # Of several vehicles it would not be known whose surface it was.
        known = None if others else live_verdicts(first, list(each), path.stem if path else "monitor")
        currents = {name for name, one in each.items() if one.is_told_by_current}
        beside = {name for name, one in each.items() if one.beside_channel}
        recording = self._recording = LiveRecording(
            first.name, list(each), currents=currents, beside=beside, path=path, port=port, properties=known
        )
        open_.callback(recording.close)
        if options.serve:
            complain(f"rerun rerun+http://127.0.0.1:{port}/proxy shows it live")

        def listen(surface: str, piece: Piece, inputs: Inputs) -> None:
            r, began_s = piece.residuals, self._began_s(surface)  # a recording has one time line
            residual_deg = np.where(r.settled, r.residual_deg, np.nan)
            columns = (r.time_s + began_s, inputs.asked_deg, r.simulated_deg, r.measured_deg, residual_deg)
            commands = (inputs.command_s + began_s, inputs.command_deg)
            trace = Trace(*columns, piece.threshold.level_deg, *commands, context=inputs.context)
            recording.add(Samples(surface, trace, is_beside=inputs.is_current))

        self._session.listener = listen


def _writer(name: str, mode: str, open_: contextlib.ExitStack) -> Worker:
    try:
        file = Path(name).open(mode, buffering=0)  # noqa: SIM115 - closed by the worker
    except OSError as error:
        raise ConfigError(f"{name}: cannot write: {error.strerror}") from None
    worker = Worker(file.write, file.close)
    open_.callback(worker.close)
    return worker


def event_document(event: Event) -> dict[str, Any]:
    """The event as other tools read it; what is not known is null."""
    document: dict[str, Any] = {"schema": "servofd.event/1"}
    for name in ("time_s", "surface", "event", "kind", "residual_deg", "threshold_deg", "vehicle", "boot"):
        value = getattr(event, name)
        document[name] = (value or None) if name in ("surface", "kind", "vehicle") else value
    if event.id:
        document |= {"id": event.id, "severity": event.severity.name.lower()}
    if event.text:
        document["text"] = event.text
    if event.fault is not None:
        names = ("kind", "start_s", "alarm_s", "end_s", "probability", "witness")
        document["fault"] = {name: getattr(event.fault, name) for name in names} | {
            "parameters": {name: estimate.value for name, estimate in event.fault.parameters.items()},
            "alternatives": list(event.fault.alternatives),
        }
        if event.fault.other:
            document["fault"] |= {"other_witness": event.fault.other}
    return dict(finite(document))
