"""What the verbs do with flights: audit, calibrate, and what motion tells of axes."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from logparsers import EmptyLog, LogError, MissingChannel, UnknownFormat
from logparsers.records import FlightLog
from servofd.aircraft.axes import MotionModel
from servofd.aircraft.outputs import is_numbered
from servofd.aircraft.schema import Aircraft
from servofd.aircraft.series import bus_of, cut
from servofd.batch.key import Job
from servofd.core.errors import CalibrationError, NoMeasurement, ServofdError, UnknownName, suggest
from servofd.core.types import FloatArray
from servofd.current.audit import healthy_currents, with_currents
from servofd.detection.audit import audit_log
from servofd.detection.flights import Flight, Span
from servofd.detection.kinds import STANDS_STILL
from servofd.detection.verdict import Fault, LogAudit, SurfaceAudit
from servofd.feedback.flown import each_once, flown_aircraft, known_aircraft, logs_of, surfaces_of

if TYPE_CHECKING:
    from servofd.axes.verdict import AxisAudit
    from servofd.calibrating.result import Calibration
    from servofd.feedback.flown import Log
    from servofd.flight.judge import FlightAlone

_SAME_RATE = 1.01
"""Two rates whose ratio is below this are the same."""


class UnmeasuredLog(NoMeasurement):
    """A log that could be read, but tells nowhere where a surface was; with what its motion alone says."""

    def __init__(self, reason: str, log: FlightLog | None = None, flight: FlightAlone | None = None) -> None:
        super().__init__(reason)
        self.log = log
        self.flight = flight


def audit(
    log: Log,
    job: Job = Job(),  # noqa: B008 - frozen
    *,
    threads: int | None = None,
    progress: Callable[[str], None] = lambda _surface: None,
) -> Iterator[LogAudit]:
    """Judge every surface of a log; one result for each run that the file holds, as `servofd.audit` describes it."""
    nothing = None
    cycles: dict[str, list[FloatArray]] = {}
    for run in logs_of(log, job.aircraft):
        try:
            flown = flown_aircraft(run, job.aircraft, job.servo, job.surfaces)
        except NoMeasurement as error:  # the other runs are judged first
            nothing = nothing or _alone(run, str(error), job)
            continue
        flown.check_names(job.surfaces, run.label)
        wanted: dict[str, Any] = {name: getattr(job, name) for name in ("threshold_deg", "threshold", "surfaces")}
        result = with_currents(audit_log(run, flown, **wanted, threads=threads, progress=progress), cycles)
        yield result if flown.motion is None else _with_axes(result, flown.motion)
    if nothing is not None:
        raise nothing


def _alone(run: FlightLog, reason: str, job: Job) -> UnmeasuredLog:
    """What one flight shows by itself, without an aircraft file."""
    from servofd.flight.judge import judge_flight

    flight = judge_flight(run) if job.aircraft is None else None
    if flight is None:
        return UnmeasuredLog(reason, run)
    return UnmeasuredLog(f"{run.label}: {flight.sentence}; {reason.removeprefix(f'{run.label}: ')}", run, flight)


@dataclass(frozen=True, slots=True)
class FailedLog:
    """A log without a verdict, and why; the log itself if it could be read, and what one flight tells by itself."""

    path: str
    error: str
    log: FlightLog | None = None
    is_log: bool = True
    """False for what no reader takes for a log."""
    flight: FlightAlone | None = None


def judged(
    path: str, job: Job, *, threads: int | None = None, progress: Callable[[str], None] = lambda _surface: None
) -> Iterator[LogAudit | FailedLog]:
    """Every run of a log; what is wrong with the log comes last, and stops nothing else."""
    try:
        yield from audit(path, job, threads=threads, progress=progress)
    except (LogError, ServofdError) as error:
        is_log = not isinstance(error, (UnknownFormat, EmptyLog, MissingChannel))
        known = getattr(error, "log", None), is_log, getattr(error, "flight", None)
        yield FailedLog(path, str(error), *known)
    except MemoryError:
        yield FailedLog(path, f"{path}: does not fit into the memory of the process that read it")


def _with_axes(result: LogAudit, motion: MotionModel) -> LogAudit:
    """The same audit, with what motion tells of axes and of faulty surfaces; a log without motion stays as it is."""
    from servofd.axes.judge import judge_motion
    from servofd.axes.read import motion_of

    try:
        axes = judge_motion(motion, motion_of(result.log, motion.rate_hz, motion.parameters))
    except NoMeasurement:
        if not result.surfaces:
            raise
        return result
    surfaces = tuple(_compared(surface, axes) for surface in result.surfaces)
    return replace(result, surfaces=surfaces, axes=axes)


_MOTIONS = {"roll": "rolls", "pitch": "pitches", "side": "yaws"}


def _compared(surface: SurfaceAudit, axes: Sequence[AxisAudit]) -> SurfaceAudit:
    """A surface at fault, with what the aircraft's motion tells of it: whether it was the servo that stood still."""
    axis = next((axis for axis in axes if surface.surface in axis.members), None)
    still = [fault for fault in (*surface.faults, *surface.suspicions) if fault.kind in STANDS_STILL]
    said = filter(None, (_seen_in_motion(fault, axis) for fault in still)) if axis is not None else iter(())
    text = next(said, "")
    return replace(surface, reason=f"{surface.reason}; {text}") if text else surface


def _seen_in_motion(fault: Fault, axis: AxisAudit) -> str:
    from servofd.axes.judge import lost_between

    lost = lost_between(axis, fault.start_s, math.inf if fault.end_s is None else fault.end_s)
    if lost is None:
        return ""
    moved, stood = (lost.low <= value <= lost.high for value in (0.0, 1.0 / len(axis.members)))
    shown = f"lost share of {axis.axis} {lost.value:.2f} [{lost.low:.2f}, {lost.high:.2f}]"
    if moved and not stood:
        return f"the aircraft {_MOTIONS.get(axis.axis, 'moves')} as commanded ({shown}): the sensor, not the servo"
    if stood and not moved:
        return f"the aircraft's motion confirms it ({shown}): the servo, not its sensor"
    return ""


def calibrate_axes(
    paths: Log | Sequence[Log], *, false_alarms_per_hour: float = 1.0, spans: tuple[Span, ...] = ()
) -> MotionModel:
    """Calibrate what an aircraft's motion tells of its axes, on flights that are known to be good."""
    from servofd.axes.calibrate import calibrate_motion
    from servofd.axes.read import motion_of

    found, silent = [], []
    for log in each_once(logs_of(paths)):
        try:
            found.append((log, motion_of(log)))
        except NoMeasurement as error:
            silent.append(str(error))
    if not found:
        raise NoMeasurement("; ".join(dict.fromkeys(silent)))
    rate_hz = min(flight.rate_hz for _, flight in found)
    flights = [one if one.rate_hz < _SAME_RATE * rate_hz else motion_of(log, rate_hz) for log, one in found]
    if spans:
        flights = [flight.within(spans) for flight in flights]
    model = calibrate_motion(flights, false_alarms_per_hour=false_alarms_per_hour)
    return model.model_copy(update={"left_out": (*silent, *model.left_out)})


def calibrate(
    logs: Log | Sequence[Log],
    aircraft: Aircraft | str | Path | None = None,
    *,
    surfaces: tuple[str, ...] = (),
    spans: tuple[Span, ...] = (),
    runs: tuple[str, ...] = (),
    force: bool = False,
    progress: Callable[[str], None] = lambda _surface: None,
) -> Calibration:
    """Calibrate an aircraft on flights that are known to be good.

    Parameters
    ----------
    logs : str, Path, DataFrame or sequence of them
        Logs of the same aircraft.
    aircraft : Aircraft, str or Path
        What is known of it, its file, or the name of one that comes with servofd; drafted from the logs if left out.
    surfaces : tuple of str
        Which to calibrate; all that were measured if empty.
    spans : tuple of (from_s, to_s)
        Which parts of each log are good [s]; all of it if empty.
    runs : tuple of str
        Which runs of a file that holds several; all if empty.
    force : bool
        Calibrate also where the loss of a third of travel and of two thirds of speed would not show.
    progress : callable
        Called with the name of each surface that is done.

    Raises
    ------
    LogError
        If a log is of no use.
    ServofdError
        If the aircraft is not what it should be, or the flights are not good.

    Examples
    --------
    >>> import servofd
    >>> found = servofd.calibrate("sample_logs/faser_healthy_flight.mat", "faser", surfaces=("elevator",))
    >>> found.surfaces[0].held_out_rms_deg < 0.2, "[surfaces.elevator" in found.to_toml()
    (True, True)
    """
    from servofd.calibrating.calibrate import calibrate_aircraft
    from servofd.calibrating.result import Calibration

    known = known_aircraft(aircraft) or drafted_aircraft(logs, spans)
    known.check_names(surfaces)
    try:
        flights = flights_of(logs, known, surfaces=surfaces, spans=spans, runs=runs)
        found = calibrate_aircraft(known, flights, force=force, progress=progress)
        found = replace(found, aircraft=_with_kept_servos(found.aircraft, found.kept, logs))
    except NoMeasurement as error:  # no position: the currents alone
        found = Calibration(known, (), dict.fromkeys(surfaces or known.surfaces, str(error)))
    good = (log for log in each_once(logs_of(logs, known)) if not runs or log.run in runs)
    currents, unfit = healthy_currents(((log, surfaces_of(log, found.aircraft)) for log in good), spans)
    wanted = surfaces or known.surfaces
    currents = {name: current for name, current in currents.items() if name in wanted}
    unfit = {name: reason for name, reason in unfit.items() if name in wanted}
    if not found.surfaces and not currents:
        raise CalibrationError("; ".join([next(iter(found.kept.values())), *dict.fromkeys(unfit.values())]))
    return found.with_currents(currents, unfit)


def _with_kept_servos(aircraft: Aircraft, kept: Collection[str], logs: Log | Sequence[Log]) -> Aircraft:
    """The same, where surfaces that were left as they were have a servo as well: a monitor fits none in flight."""
    names = [n for n in kept if aircraft.surfaces[n].measured is not None and not aircraft.surfaces[n].names_servo]
    for log in logs_of(logs, aircraft) if names else ():
        try:
            fitted = flown_aircraft(log, aircraft, only=names)
        except NoMeasurement:
            continue
        own = {name: fitted.surfaces[name] for name in names}
        servos = {surface.servo: fitted.servos[surface.servo] for surface in own.values()}
        changed = {"surfaces": aircraft.surfaces | own, "servos": aircraft.servos | servos}
        return aircraft.model_copy(update=changed).of_no_log()
    return aircraft


def drafted_aircraft(paths: Log | Sequence[Log], spans: tuple[Span, ...] = ()) -> Aircraft:
    """The aircraft as the first good log describes it that tells of servos and of what they turn; else of servos alone.

    The logs are good in some spans [s]; everywhere if there are none.
    """
    from servofd.feedback.fitted import scaled_aircraft

    reason, first = "", None
    for log in logs_of(paths):
        try:
            found = surfaces_of(log)
        except NoMeasurement as error:
            reason = str(error)
            continue
        if not all(is_numbered(name) for name in found.surfaces):
            return scaled_aircraft(log, found, spans)
        first = first or (log, found)
    if first is None:
        raise NoMeasurement(reason)
    return scaled_aircraft(*first, spans)


def flights_of(
    paths: Log | Sequence[Log],
    aircraft: Aircraft,
    *,
    surfaces: tuple[str, ...] = (),
    spans: tuple[Span, ...] = (),
    runs: tuple[str, ...] = (),
) -> dict[str, list[Flight]]:
    """Each surface in each log that measured it."""
    from servofd.detection.flights import Flight, cropped

    flights: dict[str, list[Flight]] = {name: [] for name in surfaces or aircraft.surfaces}
    reasons, seen = [], set()
    for log in each_once(logs_of(paths, aircraft)):
        seen.add(log.run)
        if runs and log.run not in runs:
            continue
        known = surfaces_of(log, aircraft)
        bus = bus_of(log, known)
        for name, there in flights.items():
            try:
                segment = cropped(cut(log, name, known, bus), spans)
            except NoMeasurement as error:
                if known.surfaces[name].measured is not None:
                    reasons.append(f"{log.label}: {name}: {error}")
                continue
            if segment.measured_s.size:
                there.append(Flight(Path(log.label).name, segment))
            else:
                reasons.append(f"{log.label}: {name}: nothing was measured in the part that was chosen")
    missing = [run for run in runs if run not in seen]
    if missing:
        raise UnknownName(suggest("run", missing[0], sorted(seen)))
    if not any(flights.values()):
        raise NoMeasurement("; ".join(reasons) or "no measured channel is known")
    return flights
