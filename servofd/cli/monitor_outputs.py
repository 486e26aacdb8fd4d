"""Where the events of the monitor go: screen, JSON lines, telemetry log, recording."""

from __future__ import annotations

import contextlib
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from servofd.cli.terminal import complain, console
from servofd.core.errors import ConfigError
from servofd.live.threads import Worker
from servofd.live.view import View, event_line
from servofd.outputs.live_recording import LiveRecording, Samples
from servofd.outputs.recording.verdicts import live_verdicts

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from servofd.aircraft.schema import Aircraft
    from servofd.cli.options import Options
    from servofd.detection.monitor import Event, Inputs
    from servofd.detection.stream import Piece
    from servofd.live.session import Session
    from servofd.live.threads import Receiver

_DRAW_S, _LINES_S = 0.1, 5.0


class Outputs:
    """Hands everything on; a disk that is full or a viewer that dies stops nothing else."""

    def __init__(self, session: Session, title: str) -> None:
        self._session, self._view = session, View(session, title)
        self._screen: Any = None
        self._prints = True
        self._lines: Worker | None = None
        self._stored: Worker | None = None
        self._recording: LiveRecording | None = None
        self.receiver: Receiver | None = None
        self._drawn_s = self._printed_s = float("-inf")
        self._waited = ""
        self._failed: set[str] = set()

    @classmethod
    @contextlib.contextmanager
    def of(cls, options: Options, session: Session, title: str, aircraft: Mapping[int, Aircraft]) -> Iterator[Self]:
        """Open what the options ask for, and close it however the monitor ends."""
        made = cls(session, title)
        with contextlib.ExitStack() as open_:
            open_.callback(made._complain)  # what fails when it is closed
            if options.json_lines == "-":
                made._prints = False
            elif options.json_lines:
                made._lines = _writer(options.json_lines, "wb", open_)
            if options.tlog:
                made._stored = _writer(options.tlog, "ab", open_)
                session.store = made._stored.put
            if options.rrd or options.serve:
                made._record(options, aircraft, open_)
            if made._prints and not options.plain and sys.stdout.isatty():
                from rich.live import Live

                made._screen = open_.enter_context(Live(made._view.drawn(0.0), console=console(), auto_refresh=False))
            yield made
            if made._screen is not None:
                made._screen.update(made._view.drawn(made._drawn_s), refresh=True)

    def events(self, events: list[Event], now_s: float) -> None:
        """Tell each event everywhere."""
        for event in events:
            vehicle = self._owner(event)
            if self._lines is not None:
                self._lines.put(json.dumps(event_document(event, vehicle), allow_nan=False).encode() + b"\n")
            if not self._prints:
                print(json.dumps(event_document(event, vehicle), allow_nan=False), flush=True)
            self._note(event_line(event))
            if self._recording is not None:
                self._recording.add(event)
        if any(event.event == "alarm" for event in events):
            self._drawn_s = float("-inf")
            self.tick(now_s)

    def tick(self, now_s: float) -> None:
        """Draw, print and complain, each not too often."""
        for note in self._session.notes:
            self._note(f"   link    {note}")
        self._session.notes.clear()
        self._complain()
        self._view.dropped = self._dropped()
        if self._screen is not None and now_s - self._drawn_s >= _DRAW_S:
            self._drawn_s = now_s
            self._screen.update(self._view.drawn(now_s), refresh=True)
        elif self._screen is None and self._prints:
            waiting = self._session.waiting()
            if now_s - self._printed_s >= _LINES_S or waiting != self._waited:
                self._printed_s, self._waited = now_s, waiting
                for line in self._view.plain(now_s):
                    print(line, flush=True)

    def _dropped(self) -> int:
        """What found a queue full: of what came in, and of what was to be written."""
        written = sum(worker.queue.dropped for worker in (self._stored, self._lines) if worker is not None)
        received = self.receiver.chunks.dropped if self.receiver is not None else 0
        return received + written + (self._recording.dropped if self._recording is not None else 0)

    def _owner(self, event: Event) -> int | None:
        """Whose event this is; known if there is one vehicle, or the surface has one name."""
        owners = [v.system for v, m in self._session.watched if m.name == event.surface]
        return owners[0] if len(owners) == 1 and owners[0] else next(iter(self._session.vehicles), None) or None

    def _note(self, line: str) -> None:
        self._view.note(line)
        if self._screen is None and self._prints:
            print(line, flush=True)

    def _complain(self) -> None:
        """Say once what could not be written."""
        failed = {"telemetry log": self._stored, "JSON lines": self._lines}
        errors = {what: worker.error for what, worker in failed.items() if worker is not None and worker.error}
        if self._recording is not None:
            errors |= self._recording.errors
        for what, error in errors.items():
            if what not in self._failed:
                self._failed.add(what)
                complain(f"{what}: no more is written: {error}")

    def _record(self, options: Options, aircraft: Mapping[int, Aircraft], open_: contextlib.ExitStack) -> None:
        first = next(iter(aircraft.values()))
        surfaces = list(dict.fromkeys(name for craft in aircraft.values() for name in craft.surfaces))
        port = options.viewer_port if options.serve else None
        path = Path(options.rrd) if options.rrd else None
        # Of several vehicles nobody could tell whose surface it was.
        known = live_verdicts(first, surfaces, path.stem if path else "monitor") if len(aircraft) == 1 else None
        recording = LiveRecording(first.name, surfaces, path=path, port=port, properties=known)
        open_.callback(recording.close)
        self._recording = recording
        if options.serve:
            complain(f"rerun rerun+http://127.0.0.1:{port}/proxy shows it live")

        def listen(surface: str, piece: Piece, inputs: Inputs) -> None:
            r = piece.residuals
            residual_deg = np.where(r.settled, r.residual_deg, np.nan)
            columns = (r.time_s, inputs.asked_deg, r.simulated_deg, r.measured_deg, residual_deg)
            recording.add(
                Samples(
                    surface, *columns, piece.threshold.level_deg, inputs.command_s, inputs.command_deg, inputs.context
                )
            )

        self._session.listener = listen


def _writer(name: str, mode: str, open_: contextlib.ExitStack) -> Worker:
    try:
        file = Path(name).open(mode, buffering=0)  # noqa: SIM115 - closed by the worker
    except OSError as error:
        raise ConfigError(f"{name}: cannot write: {error.strerror}") from None
    worker = Worker(file.write, file.close)
    open_.callback(worker.close)
    return worker


def event_document(event: Event, vehicle: int | None = None) -> dict[str, Any]:
    """The event as other tools read it; what is not known is null."""
    document: dict[str, Any] = {
        "schema": "servofd.event/1",
        "time_s": _number(event.time_s),
        "surface": event.surface or None,
        "event": event.event,
        "kind": event.kind or None,
        "residual_deg": _number(event.residual_deg),
        "threshold_deg": _number(event.threshold_deg),
        "vehicle": vehicle,
    }
    if event.text:
        document["text"] = event.text
    if event.fault is not None:
        fault = event.fault
        document["fault"] = {
            "kind": fault.kind,
            "start_s": _number(fault.start_s),
            "alarm_s": _number(fault.alarm_s),
            "end_s": None if fault.end_s is None else _number(fault.end_s),
            "parameters": {name: _number(estimate.value) for name, estimate in fault.parameters.items()},
            "probability": _number(fault.probability),
            "alternatives": list(fault.alternatives),
        }
    return document


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
