"""From a log to an explanation: which channels, which servo, which context."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import logparsers
from servofd.aircraft import Aircraft, load_aircraft
from servofd.discrepancy.explanation import Explanation, explain_gap
from servofd.errors import NoMeasurement, UnknownName, suggest
from servofd.segment import cut
from servofd.workflow import aircraft_for, layout_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from logparsers import FlightLog

__all__ = ["ExplainedLog", "explain_log"]


@dataclass(frozen=True, slots=True, eq=False)
class ExplainedLog:
    """An explanation, and the aircraft it was made for."""

    explanation: Explanation
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
    known = load_aircraft(aircraft) if isinstance(aircraft, str | Path) else aircraft
    logs = logparsers.read_all(path, layout_of(known))
    if len(logs) > 1:
        raise NoMeasurement(f"{path}: holds {len(logs)} runs; explain takes one: choose it with [table] where")
    log = logs[0]
    flown = known or aircraft_for(log)
    if servo is not None:
        flown = flown.with_servo(servo)
    name = _chosen(log, flown, surface)
    try:
        segment = cut(log, name, flown.surfaces[name])
        found = explain_gap(
            segment,
            flown.model(name),
            progress=progress,
        )
    except NoMeasurement as error:
        raise NoMeasurement(f"{log.label}: {name}: {error}") from None
    return ExplainedLog(found, flown, log.label)


def _chosen(log: FlightLog, aircraft: Aircraft, surface: str | None) -> str:
    if surface is None and len(aircraft.surfaces) == 1:
        return next(iter(aircraft.surfaces))
    if surface is None:
        raise UnknownName(f"{log.label}: choose a surface with -s: {', '.join(aircraft.surfaces)}")
    if surface not in aircraft.surfaces:
        raise UnknownName(f"{log.label}: {suggest('surface', surface, aircraft.surfaces)}")
    return surface
