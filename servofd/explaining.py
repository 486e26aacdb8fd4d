"""From a log to an explanation: which channels, which servo, which context."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import logparsers
from servofd.aircraft import Aircraft, load_aircraft
from servofd.bench import bench_aircraft
from servofd.detection.audit import audit_log
from servofd.detection.words import describe
from servofd.discrepancy.explanation import Explanation, explain_gap
from servofd.errors import NoMeasurement, UnknownName, suggest
from servofd.models.physics import scaled_transfer
from servofd.segment import cut
from servofd.servos import Servo
from servofd.workflow import aircraft_for, layout_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from logparsers import FlightLog
    from servofd.segment import Segment

__all__ = ["UNKNOWN", "ExplainedLog", "explain_log"]

_SAME_FAULT_S = 3.0
UNKNOWN = "unknown"
"""Name of a servo that nobody knows."""
_UNKNOWN_SERVO = Servo(
    title="second order, its poles fitted",
    bandwidth_hz=5.0,
    damping=0.8,
    delay_s=0.0,
    hold="zoh",
    source="start of the search for the poles: hobby servos have 2 to 20 Hz",
)


@dataclass(frozen=True, slots=True, eq=False)
class ExplainedLog:
    """An explanation, and the aircraft it was made for."""

    explanation: Explanation
    aircraft: Aircraft
    source: str


def explain_log(
    path: str | Path | Sequence[str | Path],
    aircraft: str | Path | Aircraft | None = None,
    *,
    surface: str | None = None,
    servo: str | None = None,
    progress: Callable[[str], None] = lambda _step: None,
) -> ExplainedLog:
    """Explain where logs and the model of one of its servos disagree.

    Parameters
    ----------
    path : str, Path or sequence of them
        The log, or several of the same servo. Of several, and of the runs of a bench record, every other one is held
        out whole.
    aircraft : str, Path or Aircraft, optional
        Aircraft file, or its content; found as for an audit if left out.
    surface : str, optional
        Which surface; may be left out if there is only one.
    servo : str, optional
        Servo to assume: a name of the library, a servo file, or ``unknown`` for one of second order whose poles are
        fitted as well. A bench record whose aircraft file names no servo is of an unknown one.
    progress : callable
        Called with the name of each effect that was tried.

    Raises
    ------
    LogError
        If a log is of no use.
    ServofdError
        If the aircraft is not what it should be, a name is unknown, or the logs cannot show what is missing.
    """
    paths = [path] if isinstance(path, str | Path) else list(path)
    known = load_aircraft(aircraft) if isinstance(aircraft, str | Path) else aircraft
    known = known or bench_aircraft(paths[0])
    logs = [log for each in paths for log in logparsers.read_all(each, layout_of(known))]
    flown = known or aircraft_for(logs[0])
    name = _chosen(logs[0], flown, surface)
    free_poles = servo == UNKNOWN or (servo is None and known is not None and _is_bench(known, name))
    if free_poles:
        flown = _with_unknown_servo(flown, name)
    elif servo is not None:
        flown = flown.with_servo(servo)
    on_bench = known is not None and known.table is not None and bool(known.table.run)
    label = logs[0].label if len(logs) == 1 else f"{', '.join(map(str, paths))} ({len(logs)} runs)"
    try:
        segments = _segments(logs, name, flown)
        found = explain_gap(segments, flown.model(name), on_bench=on_bench, free_poles=free_poles, progress=progress)
    except NoMeasurement as error:
        raise NoMeasurement(f"{label}: {name}: {error}") from None
    if found.fault_s is not None and len(logs) == 1:
        found = _with_kind(found, found.fault_s, logs[0], flown)
    return ExplainedLog(found, _with_fitted_poles(flown, name, found) if free_poles else flown, label)


def _with_kind(found: Explanation, fault_s: float, log: FlightLog, aircraft: Aircraft) -> Explanation:
    """An explanation that says which fault it is that sets in, if the audit can name it."""
    (verdict,) = audit_log(log, aircraft, surfaces=(found.surface,)).surfaces
    named = [fault for fault in verdict.faults if abs(fault.start_s - fault_s) < _SAME_FAULT_S]
    if not named or named[0].kind == "unknown":
        return found
    return replace(found, notes=(*found.notes, f"the audit can name that fault: {describe(named[0])}"))


def _is_bench(aircraft: Aircraft, surface: str) -> bool:
    """Whether an aircraft file describes a table of experiments, and no servo."""
    entry = aircraft.surfaces[surface]
    return aircraft.table is not None and bool(aircraft.table.run) and "servo" not in entry.model_fields_set


def _segments(logs: Sequence[FlightLog], surface: str, aircraft: Aircraft) -> list[Segment]:
    """One for each run in which the surface was commanded and measured."""
    segments, reasons = [], []
    for log in logs:
        try:
            segments.append(cut(log, surface, aircraft.surfaces[surface]))
        except NoMeasurement as error:
            reasons.append(str(error))
    if not segments:
        raise NoMeasurement(reasons[0])
    return segments


def _with_unknown_servo(aircraft: Aircraft, surface: str, servo: Servo = _UNKNOWN_SERVO) -> Aircraft:
    entry = aircraft.surfaces[surface].model_copy(update={"servo": UNKNOWN})
    return aircraft.model_copy(
        update={"surfaces": {**aircraft.surfaces, surface: entry}, "servos": {**aircraft.servos, UNKNOWN: servo}}
    )


def _with_fitted_poles(aircraft: Aircraft, surface: str, found: Explanation) -> Aircraft:
    """The aircraft with the servo whose poles were found, for an audit."""
    fitted = found.selection.fitter.physics(found.selection.final.effects, found.selection.final.values)
    transfer = scaled_transfer(found.record.plant.transfer, fitted)
    servo = Servo(
        title=_UNKNOWN_SERVO.title,
        numerator=transfer.numerator,
        denominator=transfer.denominator,
        delay_s=0.0,
        hold="zoh",
        source="servofd explain",
    )
    return _with_unknown_servo(aircraft, surface, servo)


def _chosen(log: FlightLog, aircraft: Aircraft, surface: str | None) -> str:
    if surface is None and len(aircraft.surfaces) == 1:
        return next(iter(aircraft.surfaces))
    if surface is None:
        raise UnknownName(f"{log.label}: choose a surface with -s: {', '.join(aircraft.surfaces)}")
    if surface not in aircraft.surfaces:
        raise UnknownName(f"{log.label}: {suggest('surface', surface, aircraft.surfaces)}")
    return surface
