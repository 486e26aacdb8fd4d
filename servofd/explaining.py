"""From logs to explanations: which channels, which servo, which context."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import logparsers
from servofd.aircraft import Aircraft, load_aircraft
from servofd.discrepancy.elsewhere import judged_elsewhere
from servofd.discrepancy.explanation import Explanation, explain_runs
from servofd.errors import ConfigError, DesignError, NoMeasurement, UnknownName, suggest
from servofd.segment import cut
from servofd.workflow import aircraft_for, layout_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from logparsers import FlightLog
    from servofd.discrepancy.own import OwnEffect
    from servofd.segment import Segment

__all__ = ["ExplainedLog", "ExplainedLogs", "explain_log", "explain_logs"]


@dataclass(frozen=True, slots=True, eq=False)
class ExplainedLog:
    """An explanation, and the aircraft it was made for."""

    explanation: Explanation
    aircraft: Aircraft
    source: str


@dataclass(frozen=True, slots=True, eq=False)
class ExplainedLogs:
    """Explanations of several surfaces."""

    explanations: tuple[Explanation, ...]
    failures: tuple[str, ...]
    """Why other surfaces could not be explained, a sentence each."""
    aircraft: Aircraft
    source: str


def explain_log(
    path: str | Path,
    aircraft: str | Path | Aircraft | None = None,
    *,
    surface: str | None = None,
    servo: str | None = None,
    progress: Callable[[str], None] = lambda _step: None,
) -> ExplainedLog:
    """Explain where a log and the model of one of its servos disagree.

    Parameters
    ----------
    path : str or Path
        The log.
    aircraft : str, Path or Aircraft, optional
        Aircraft file, or its content; found as for an audit if left out.
    surface : str, optional
        Which surface; may be left out if there is only one.
    servo : str, optional
        Servo to assume: a name of the library, or a servo file.
    progress : callable
        Called with the name of each effect that was tried.

    Raises
    ------
    LogError
        If the log is of no use.
    ServofdError
        If the aircraft is not what it should be, a name is unknown, or the log cannot show what is missing.
    """
    flown = _opened([path], aircraft, servo)
    if surface is None and len(flown.surfaces) > 1:
        raise UnknownName(f"{flown.source}: choose a surface: {', '.join(flown.surfaces)}")
    found = _explained(flown, (surface,) if surface else flown.surfaces, (), None, progress)
    if found.failures:
        raise NoMeasurement(found.failures[0])
    return ExplainedLog(found.explanations[0], found.aircraft, found.source)


def explain_logs(
    paths: Sequence[str | Path],
    aircraft: str | Path | Aircraft | None = None,
    *,
    surfaces: tuple[str, ...] = (),
    servo: str | None = None,
    also: Sequence[str | Path] = (),
    own: OwnEffect | None = None,
    progress: Callable[[str], None] = lambda _step: None,
) -> ExplainedLogs:
    """Explain several surfaces of an aircraft, from one flight or from several together.

    Parameters
    ----------
    paths : sequence of str or Path
        Logs of one aircraft. With several, or several runs in a file, every other one is held out whole.
    aircraft : str, Path or Aircraft, optional
        Aircraft file, or its content; found as for an audit if left out.
    surfaces : tuple of str
        Which; all that are measured if empty.
    servo : str, optional
        Servo to assume: a name of the library, or a servo file.
    also : sequence of str or Path
        Further logs of the same aircraft, on which the model that was found is only judged.
    own : OwnEffect, optional
        An effect of the user's own, tried beside those of the catalogue.
    progress : callable
        Called with the name of each effect that was tried.

    Returns
    -------
    ExplainedLogs
        What cannot be told of one surface does not keep the others from being explained.

    Raises
    ------
    LogError
        If a log is of no use.
    ServofdError
        If the aircraft is not what it should be, a name is unknown, or a log of `also` does not hold the surfaces.

    Examples
    --------
    >>> found = explain_logs(["sample_logs/hidden/hidden_10.csv"])
    >>> found.explanations[0].conclusion in ("nothing_missing", "explained", "partly_explained", "unexplained")
    True
    """
    flown = _opened(paths, aircraft, servo)
    for name in surfaces:
        if name not in flown.aircraft.surfaces:
            raise UnknownName(f"{flown.source}: {suggest('surface', name, flown.aircraft.surfaces)}")
    wanted = tuple(dict.fromkeys(surfaces)) or flown.surfaces
    others = [log for path in also for log in logparsers.read_all(path, layout_of(flown.aircraft))]
    judged = [(log.label, {name: _also(log, flown.aircraft, name) for name in wanted}) for log in others]
    return _explained(flown, wanted, judged, own, progress)


@dataclass(frozen=True, slots=True, eq=False)
class _Flown:
    """Flights of one aircraft."""

    logs: tuple[FlightLog, ...]
    aircraft: Aircraft

    @property
    def source(self) -> str:
        return ", ".join(log.label for log in self.logs)

    @property
    def surfaces(self) -> tuple[str, ...]:
        """Those that are measured, and known to some log."""
        return tuple(
            name
            for name, surface in self.aircraft.surfaces.items()
            if surface.measured is not None
            and any(channel in log.channels for log in self.logs for channel in (surface.measured.channel,))
        ) or tuple(self.aircraft.surfaces)


def _opened(paths: Sequence[str | Path], aircraft: str | Path | Aircraft | None, servo: str | None) -> _Flown:
    known = aircraft if isinstance(aircraft, Aircraft) or aircraft is None else load_aircraft(aircraft)
    logs = tuple(log for path in paths for log in logparsers.read_all(path, layout_of(known)))
    flown = known or aircraft_for(logs[0])
    return _Flown(logs, flown.with_servo(servo) if servo is not None else flown)


def _explained(
    flown: _Flown,
    surfaces: Sequence[str],
    also: Sequence[tuple[str, dict[str, Segment]]],
    own: OwnEffect | None,
    progress: Callable[[str], None],
) -> ExplainedLogs:
    found, failures = [], []
    for name in surfaces:
        try:
            found.append(_surface(flown, name, also, own, progress))
        except (NoMeasurement, DesignError) as error:
            failures.append(f"{flown.source}: {name}: {error}")
    return ExplainedLogs(tuple(found), tuple(failures), flown.aircraft, flown.source)


def _surface(
    flown: _Flown,
    name: str,
    also: Sequence[tuple[str, dict[str, Segment]]],
    own: OwnEffect | None,
    progress: Callable[[str], None],
) -> Explanation:
    if name not in flown.aircraft.surfaces:
        raise UnknownName(f"{flown.source}: {suggest('surface', name, flown.aircraft.surfaces)}")
    model = flown.aircraft.model(name)
    segments = [cut(log, name, flown.aircraft.surfaces[name]) for log in flown.logs]
    found = explain_runs(segments, model, own=own, progress=progress)
    judged = tuple(judged_elsewhere(label, there[name], model, found.physics, own) for label, there in also)
    return replace(found, also=judged)


def _also(log: FlightLog, aircraft: Aircraft, name: str) -> Segment:
    """A surface in another log of the same aircraft."""
    try:
        return cut(log, name, aircraft.surfaces[name])
    except NoMeasurement as error:
        raise ConfigError(f"--also {log.label}: {name}: {error}; give a log of the same aircraft") from None
