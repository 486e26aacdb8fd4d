"""From logs to explanations: which channels, which servo, which context."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from logparsers import FlightLog, LogFile
from servofd.aircraft.schema import Aircraft, Surface
from servofd.aircraft.series import Series, cut
from servofd.core.errors import ConfigError, DesignError, NoMeasurement, UnknownName, suggest
from servofd.core.types import FloatArray
from servofd.detection.audit import audit_log
from servofd.detection.verdict import describe
from servofd.discrepancy.explanation import Explanation, explain_gap, judged_elsewhere
from servofd.discrepancy.known import A_TYPE, NOTHING
from servofd.discrepancy.own import load_own_effect
from servofd.discrepancy.validity import Undriven, undriven
from servofd.discrepancy.varying import varying
from servofd.feedback.flown import known_aircraft, logs_of, scaled_aircraft, surfaces_of
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
    flown = _opened(paths, aircraft, servo)
    for name in surfaces:
        if name not in flown.aircraft.surfaces:
            raise UnknownName(f"{flown.source}: {suggest('surface', name, flown.aircraft.surfaces)}")
    wanted = tuple(dict.fromkeys(surfaces)) or flown.surfaces
    if alone and len(wanted) > 1:
        raise UnknownName(f"{flown.source}: choose a surface: {', '.join(wanted)}")
    others = list(logs_of(also, flown.aircraft)) if also else []
    judged = [(log.label, {name: _also(log, flown.aircraft, name) for name in wanted}) for log in others]
    known, found, failures = flown.aircraft, [], []
    for name in wanted:
        try:
            one = _surface(flown, name, judged, progress)
        except (NoMeasurement, DesignError) as error:
            failures.append(f"{flown.source}: {name}: {error}")
            continue
        found.append(one)
        if name in flown.unnamed and one.record.side is None:  # with the poles that were found, for an audit
            poles = scaled(one.record.plant.transfer, one.selection.final.physics.scales)
            fitted = {"numerator": poles.numerator, "denominator": poles.denominator, "source": "servofd explain"}
            servo_found = Servo.model_validate(UNKNOWN_SERVO.model_dump() | fitted | {"delay_s": 0.0})
            known = _with_unknown_servo(known, name, servo_found)
    return ExplainedLogs(tuple(found), tuple(failures), known, flown.source, flown.logs)


@dataclass(frozen=True, slots=True, eq=False)
class _Flown:
    """Flights of one aircraft, or runs of a bench."""

    logs: tuple[FlightLog, ...]
    aircraft: Aircraft
    label: str
    unnamed: frozenset[str]
    """Surfaces whose servo is unknown: its poles have to be found as well."""

    @property
    def source(self) -> str:
        return self.logs[0].label if len(self.logs) == 1 else f"{self.label} ({len(self.logs)} runs)"

    @property
    def surfaces(self) -> tuple[str, ...]:
        """Those that are measured, and known to some log; all if there is none."""
        known = self.aircraft.surfaces
        logged = {channel for log in self.logs for channel in log.channels}
        return tuple(n for n, s in known.items() if s.measured and s.measured.channel in logged) or tuple(known)


def _opened(paths: Sequence[LogFile], aircraft: str | Path | Aircraft | None, servo: str | None) -> _Flown:
    known = known_aircraft(aircraft)
    logs = tuple(logs_of(paths, known))
    # The servo of a plain table is fitted along with what it may lack.
    flown = scaled_aircraft(logs[0], known)
    if servo is not None and servo != UNKNOWN:
        flown = flown.with_servo(servo)
    unnamed = frozenset(n for n, s in flown.surfaces.items() if servo == UNKNOWN or not s.names_servo)
    return _Flown(logs, flown, ", ".join(map(label_of, paths)), unnamed)


def _surface(
    flown: _Flown,
    name: str,
    also: Sequence[tuple[str, dict[str, Series]]],
    progress: Callable[[str], None],
) -> Explanation:
    aircraft = _with_unknown_servo(flown.aircraft, name) if name in flown.unnamed else flown.aircraft
    logs, segments = _segments(flown.logs, name, aircraft)
    model = aircraft.model(name)
    off: list[Undriven] = []
    said: dict[str, None] = {}
    for k, (log, segment) in enumerate(zip(logs, segments, strict=True)):
        off += undriven(segment, k)
        said |= dict.fromkeys(filter(None, (segment.refreshed,))) | dict.fromkeys(damage.note for damage in log.damage)
    conditions = _conditions(logs, aircraft.surfaces[name])
    said |= dict.fromkeys(_same_loads(logs))
    known = NOTHING if name in flown.unnamed else A_TYPE
    on_bench = aircraft.table is not None and bool(aircraft.table.run)  # experiments that begin at rest
    found = explain_gap(
        segments, model, on_bench=on_bench, known=known, off=off, conditions=conditions, progress=progress
    )
    found = replace(found, notes=(*found.notes, *list(said)[:_MOST_SAID]))
    if found.record.side is None:
        differing = varying(found.selection, conditions)
        found = replace(found, varying=differing, notes=(*found.notes, *(each.sentence for each in differing)))
    if found.fault_s is not None and len(flown.logs) == 1:  # which fault it is that sets in, if the audit can name it
        (verdict,) = audit_log(flown.logs[0], aircraft, surfaces=(name,)).surfaces
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
    """A surface in another log of the same aircraft."""
    try:
        return cut(log, name, surfaces_of(log, aircraft))
    except NoMeasurement as error:
        raise ConfigError(f"--also {log.label}: {name}: {error}; give a log of the same aircraft") from None


def _segments(logs: Sequence[FlightLog], surface: str, aircraft: Aircraft) -> tuple[list[FlightLog], list[Series]]:
    """The runs in which the surface was commanded and measured, and it in each of them."""
    used, segments, reasons = [], [], []
    for log in logs:
        try:
            segments.append(cut(log, surface, surfaces_of(log, aircraft)))
            used.append(log)
        except NoMeasurement as error:
            reasons.append(str(error))
    if not segments:
        raise NoMeasurement(reasons[0])
    return used, segments


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
    entry = aircraft.surfaces[surface].model_copy(update={"servo": name})
    return aircraft.model_copy(
        update={"surfaces": {**aircraft.surfaces, surface: entry}, "servos": {**aircraft.servos, name: servo}}
    )
