"""From logs to explanations: which channels, which servo, which context."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from logparsers import FlightLog, LogFile
from servofd.aircraft.schema import Aircraft, Surface
from servofd.aircraft.series import Series, cut
from servofd.core.errors import ConfigError, DesignError, NoMeasurement, UnknownName
from servofd.core.types import FloatArray
from servofd.detection.audit import audit_log
from servofd.detection.verdict import describe
from servofd.discrepancy.explanation import Explanation, explain_gap, judged_elsewhere
from servofd.discrepancy.known import A_TYPE, NOTHING
from servofd.discrepancy.own import load_own_effect
from servofd.discrepancy.validity import undriven
from servofd.discrepancy.varying import varying
from servofd.feedback.flown import known_aircraft, logs_of, surfaces_of
from servofd.jobs.bench import label_of
from servofd.servo.effect import Effect
from servofd.servo.library import Servo
from servofd.servo.loop import scaled
from servofd.servo.registry import include

_SAME_FAULT_S = 3.0
"""Two onsets closer than this are one fault [s]."""
UNKNOWN = "unknown"
"""Name of an unknown servo."""
UNKNOWN_SERVO = Servo(
    title="third order, its poles fitted",
    numerator=(200.0 * 31.4**2,),
    denominator=(1.0, 200.0 + 1.6 * 31.4, 31.4**2 + 200.0 * 1.6 * 31.4, 200.0 * 31.4**2),
    delay_s=0.004,
    hold="zoh",
    source="start of the search for the poles: hobby servos have 2 to 20 Hz",
)


_MOST_SAID = 4
"""Sentences about the readings; a log of many runs has one each."""
_STEADY = 0.5
"""Of the spread between runs, that within one: more, and a mean says little about the run."""
_WORSE = 1.05
"""What chance makes of an error of a thousand samples is less."""


@dataclass(frozen=True, slots=True, eq=False)
class ExplainedLogs:
    """Explanations of several surfaces."""

    explanations: tuple[Explanation, ...]
    failures: tuple[str, ...]
    """Why other surfaces could not be explained, a sentence each."""
    aircraft: Aircraft
    source: str
    logs: tuple[FlightLog, ...]
    """What was explained; `also` is not among them."""


def explain_logs(
    paths: Sequence[LogFile],
    aircraft: str | Path | Aircraft | None = None,
    *,
    surfaces: tuple[str, ...] = (),
    servo: str | None = None,
    also: Sequence[str | Path] = (),
    own: type[Effect] | str | Path | None = None,
    alone: bool = False,
    progress: Callable[[str], None] = lambda _step: None,
) -> ExplainedLogs:
    """Explain surfaces of an aircraft, from one flight or from several together.

    Parameters
    ----------
    paths : sequence of str or Path
        Logs of one aircraft. With several, or several runs in a file, every other one is held out whole.
    aircraft : str, Path or Aircraft, optional
        Aircraft file, or its content; found as for an audit if left out.
    surfaces : tuple of str
        Which; all that are measured if empty.
    servo : str, optional
        Servo to assume: a name of the library, a servo file, or ``unknown`` for one of second order whose poles are
        fitted as well. A bench record whose aircraft file names no servo is of an unknown one.
    also : sequence of str or Path
        Further logs of the same aircraft, on which the model that was found is only judged.
    own : class of Effect, str or Path, optional
        An effect of the user's own, or the file that defines it; every verb knows it from now on.
    alone : bool
        Whether more than one surface is an error.
    progress : callable
        Called with the name of each effect that was tried.

    Returns
    -------
    ExplainedLogs
        What cannot be explained of one surface does not keep the others from being explained.

    Raises
    ------
    LogError
        If a log is of no use.
    ServofdError
        If the aircraft is not what it should be, a name is unknown, or a log of `also` does not hold the surfaces.

    """
    if own is not None:
        include(load_own_effect(own) if isinstance(own, str | Path) else own)
    known = known_aircraft(aircraft)
    logs = tuple(logs_of(paths, known))
    source = logs[0].label if len(logs) == 1 else f"{', '.join(map(label_of, paths))} ({len(logs)} runs)"
    # The servo of a plain table is fitted along with what it may lack.
    flown = surfaces_of(logs[0], known, fitted=())
    if servo is not None and servo != UNKNOWN:
        flown = flown.with_servo(servo)
    flown.check_names(surfaces, source)
    wanted = tuple(dict.fromkeys(surfaces)) or _measured(flown, logs)
    if alone and len(wanted) > 1:
        raise UnknownName(f"{source}: choose a surface: {', '.join(wanted)}")
    others = list(logs_of(also, flown)) if also else []
    judged = [(log.label, {name: _also(log, flown, name) for name in wanted}) for log in others]
    explained, found, failures = flown, [], []
    for name in wanted:
        is_unnamed = servo == UNKNOWN or not flown.surfaces[name].names_servo  # its poles have to be found as well
        try:
            one = _surface(logs, flown, name, is_unnamed, judged, progress)
        except (NoMeasurement, DesignError) as error:
            failures.append(f"{source}: {name}: {error}")
            continue
        found.append(one)
        if is_unnamed and one.record.side is None:  # with the poles that were found, for an audit
            poles = scaled(one.record.model.transfer, one.selection.final.physics.scales)
            fitted = {"numerator": poles.numerator, "denominator": poles.denominator, "source": "servofd explain"}
            servo_found = Servo.model_validate(UNKNOWN_SERVO.model_dump() | fitted | {"delay_s": 0.0})
            explained = _with_unknown_servo(explained, name, servo_found)
    return ExplainedLogs(tuple(found), tuple(failures), explained, source, logs)


def _measured(aircraft: Aircraft, logs: Sequence[FlightLog]) -> tuple[str, ...]:
    """Surfaces that are measured, and known to some log; all if there is none."""
    known, logged = aircraft.surfaces, {channel for log in logs for channel in log.channels}
    return tuple(n for n, s in known.items() if s.measured and s.measured.channel in logged) or tuple(known)


def _surface(
    flown: Sequence[FlightLog],
    aircraft: Aircraft,
    name: str,
    is_unnamed: bool,
    also: Sequence[tuple[str, dict[str, Series]]],
    progress: Callable[[str], None],
) -> Explanation:
    aircraft = _with_unknown_servo(aircraft, name) if is_unnamed else aircraft
    logs, segments = _segments(flown, name, aircraft)
    model = aircraft.model(name)
    off = [one for k, segment in enumerate(segments) for one in undriven(segment, k)]
    said: list[str] = []
    for log, segment in zip(logs, segments, strict=True):
        said += [segment.refreshed, *(damage.note for damage in log.damage)]
    said += _same_loads(logs)
    conditions = _conditions(logs, aircraft.surfaces[name])
    known = NOTHING if is_unnamed else A_TYPE
    on_bench = aircraft.table is not None and bool(aircraft.table.run)  # experiments that begin at rest
    found = explain_gap(
        segments, model, on_bench=on_bench, known=known, off=off, conditions=conditions, progress=progress
    )
    found = replace(found, notes=(*found.notes, *list(dict.fromkeys(filter(None, said)))[:_MOST_SAID]))
    if found.record.side is None:
        differing = varying(found.selection, conditions)
        found = replace(found, varying=differing, notes=(*found.notes, *(each.sentence for each in differing)))
    if found.fault_s is not None and len(flown) == 1:  # which fault it is that sets in, if the audit can name it
        (verdict,) = audit_log(flown[0], aircraft, surfaces=(name,)).surfaces
        named = next((one for one in verdict.faults if abs(one.start_s - found.fault_s) < _SAME_FAULT_S), None)
        if named is not None and named.kind != "unknown":
            found = replace(found, notes=(*found.notes, f"the audit can name that fault: {describe(named)}"))
    judged = tuple(judged_elsewhere(label, there[name], model, found.physics) for label, there in also)
    worse = [
        f"{Path(there.path).name}: the model does worse there than without what was found: is it the same servo?"
        for there in judged
        if there.extended_rms_deg > _WORSE * max(there.nominal_rms_deg, there.noise_floor_rms_deg)
    ]
    return replace(found, also=judged, notes=(*found.notes, *worse))


def _also(log: FlightLog, aircraft: Aircraft, name: str) -> Series:
    try:
        return cut(log, name, surfaces_of(log, aircraft))
    except NoMeasurement as error:
        raise ConfigError(f"--also {log.label}: {name}: {error}; give a log of the same aircraft") from None


def _segments(logs: Sequence[FlightLog], surface: str, aircraft: Aircraft) -> tuple[list[FlightLog], list[Series]]:
    """The runs in which the surface was commanded and measured, and it in each of them."""
    found, reasons = [], []
    for log in logs:
        try:
            found.append((log, cut(log, surface, surfaces_of(log, aircraft))))
        except NoMeasurement as error:
            reasons.append(error)
    if not found:
        raise reasons[0]
    return [log for log, _ in found], [segment for _, segment in found]


def _conditions(logs: Sequence[FlightLog], surface: Surface) -> dict[str, FloatArray]:
    """What else was logged in every run and hardly changed within one: its mean, by the name of its channel."""
    own = {surface.command.channel, surface.measured.channel if surface.measured else ""}
    result = {}
    for name in set.intersection(*(set(log.channels) for log in logs)) - own:
        each = [log[name].values[np.isfinite(log[name].values)] for log in logs]
        if all(values.size for values in each):
            means = np.array([np.mean(values) for values in each])
            within = float(np.mean([np.std(values) for values in each]))
            if within < _STEADY * float(np.std(means)):
                result[name] = means
    return dict(sorted(result.items()))


def _same_loads(logs: Sequence[FlightLog]) -> list[str]:
    """Of each load that is the same in every run, a sentence."""
    found = []
    for name in sorted(set.intersection(*(set(log.channels) for log in logs))) if len(logs) > 1 else []:
        values = np.unique(np.concatenate([log[name].values for log in logs]))
        if name.startswith("load_") and values.size == 1:
            found.append(f"{name} is {values[0]:.6g} in every run: its influence cannot be found")
    return found


def _with_unknown_servo(aircraft: Aircraft, surface: str, servo: Servo = UNKNOWN_SERVO) -> Aircraft:
    name = f"{surface}-{UNKNOWN}"
    surfaces = aircraft.surfaces | {surface: aircraft.surfaces[surface].model_copy(update={"servo": name})}
    return aircraft.model_copy(update={"surfaces": surfaces, "servos": aircraft.servos | {name: servo}})
