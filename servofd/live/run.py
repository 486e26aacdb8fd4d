"""The loops of the monitor: a live link, a telemetry log, or any other log at a chosen speed."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from logparsers import FlightLog
from servofd.detection.event import Event
from servofd.live.session import Session
from servofd.live.threads import Receiver
from servofd.live.vehicle import Vehicle

_STEP_S, _LONGEST_STEP_S, _CALM_STEP_S = 0.02, 0.1, 2.0
"""Of a replay: data is evaluated in steps of this length; of a longer one where the difference cannot be seen, and of
the longest while no alarm is to be looked at and every surface sends: a piece of any length raises the same alarms."""
_TOGETHER_S = 0.003
"""Of a live link: what arrives within so long is evaluated together, as an autopilot sends it together."""
_AT_EASE_S = 0.04
"""The same while no residual is anywhere near its threshold: each waking costs more than ten messages do."""

_ROUNDING_S = 0.02
"""The last samples of two steps of a log are so much closer to each other than the steps are long."""


class Watcher(Protocol):
    """Whoever wants to know."""

    def events(self, events: list[Event]) -> None:
        """Something happened."""

    def tick(self, now_s: float) -> None:
        """Time goes by."""


@dataclass(slots=True)
class Pace:
    """Holds a replay to a speed; 0 is as fast as it goes."""

    speed: float
    _begun: tuple[float, float] | None = None
    _asked_s: float = 0.0
    """Since the last step, when it was last asked whether the session rests [s]."""

    @property
    def step_s(self) -> float:
        """Of the log, evaluated at once [s]."""
        return min(_STEP_S * max(self.speed, 1.0), _LONGEST_STEP_S) if self.speed > 0.0 else _LONGEST_STEP_S

    def is_due(self, since_s: float, session: Session) -> bool:
        """Whether to evaluate what has come in so long [s]; looks at an alarm that stands have their times."""
        if since_s < self._asked_s + self.step_s:
            self._asked_s = min(self._asked_s, since_s)
            return False
        self._asked_s = since_s
        return self.speed > 0.0 or since_s >= _CALM_STEP_S or not session.rests(since_s + self.step_s)

    def wait(self, at_s: float) -> None:
        """Wait until this instant of the log is due [s]."""
        if self.speed <= 0.0:
            return
        now_s = time.monotonic()
        if self._begun is None:
            self._begun = (now_s, at_s)
        due_s = self._begun[0] + (at_s - self._begun[1]) / self.speed
        if due_s > now_s:
            time.sleep(due_s - now_s)


def watch_link(session: Session, receiver: Receiver, watcher: Watcher, duration_s: float) -> None:
    """Watch a live link for so long [s]."""
    end_s = time.monotonic() + duration_s
    while time.monotonic() < end_s:
        events: list[Event] = []
        chunks, at_ease = receiver.chunks.take(min(0.05, max(end_s - time.monotonic(), 0.0))), session.at_ease
        if chunks:
            time.sleep(_AT_EASE_S if at_ease else _TOGETHER_S)
            chunks += receiver.chunks.take(0.0)
        for arrival_s, data in chunks:
            events += session.take(arrival_s, data)
        now_s = receiver.now_s()
        events += session.step(now_s, final=at_ease)
        watcher.events(events)
        watcher.tick(now_s)


def replay_telemetry(session: Session, path: Path, watcher: Watcher, pace: Pace, duration_s: float) -> float:
    """Replay a telemetry log to its end or to Ctrl-C; returns the arrival time of the last frame [s]."""
    from logparsers.replay import replayed

    first_s = stepped_s = now_s = float("nan")
    with suppress(KeyboardInterrupt):
        for now_s, frame in replayed(path):
            if not now_s - first_s <= duration_s:
                if np.isfinite(first_s):
                    break
                first_s = stepped_s = now_s
            events = session.take(now_s, frame)
            is_due = pace.is_due(abs(now_s - stepped_s), session)
            if is_due:
                pace.wait(now_s)
                stepped_s = now_s
                events += session.step(now_s)
            watcher.events(events)
            if is_due:
                watcher.tick(now_s)
    return now_s


def replay_log(session: Session, log: FlightLog, watcher: Watcher, pace: Pace, duration_s: float) -> float:
    """Replay the channels of any log to its end or to Ctrl-C; returns the last time [s]."""
    (aircraft,) = session.aircraft.values()
    vehicle = Vehicle(0, aircraft, is_stream=False)
    session.vehicles[0] = vehicle
    now_s, stepped_s, start_s = 0.0, -np.inf, log.span_s[0] if log.span_s else 0.0
    with suppress(KeyboardInterrupt):
        for now_s, samples in _steps(log, vehicle, pace.step_s):
            if now_s - start_s > duration_s:
                break
            pace.wait(now_s)
            vehicle.received_s = now_s
            vehicle.give(samples)
            if pace.is_due(now_s - stepped_s + _ROUNDING_S, session):
                stepped_s = now_s
                watcher.events(session.step(now_s))
                watcher.tick(now_s)
    return now_s


def _steps(log: FlightLog, vehicle: Vehicle, step_s: float) -> Iterator[tuple[float, list[tuple[str, float, float]]]]:
    """Samples of the wanted channels in the order of time, step by step."""
    names = [name for name in vehicle.channels if name in log.channels]
    if not names:
        return
    times = [log[name].time_s for name in names]
    owner = np.repeat(np.arange(len(names)), [t.size for t in times])
    together_s = np.concatenate(times)
    values = np.concatenate([log[name].values for name in names])
    order = np.argsort(together_s, kind="stable")
    bounds = np.flatnonzero(np.diff(np.floor(together_s[order] / step_s))) + 1
    for rows in np.split(order, bounds):
        samples = zip(owner[rows].tolist(), together_s[rows].tolist(), values[rows].tolist(), strict=True)
        yield float(together_s[rows[-1]]), [(names[k], at_s, value) for k, at_s, value in samples]
