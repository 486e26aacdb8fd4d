"""Flights judged: one, its runs, many, and two beside each other; and logs as they are."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np

from logparsers import FlightLog
from servofd.aircraft.columns import aircraft_of_columns
from servofd.aircraft.schema import Aircraft
from servofd.axes.verdict import AxisAudit
from servofd.batch.find import META_FILE, find_logs, kind_of
from servofd.batch.key import Job
from servofd.core.errors import ConfigError, NoMeasurement, UnknownName, suggest
from servofd.core.series import latest
from servofd.detection.residual import ThresholdKind
from servofd.detection.verdict import LogAudit, SurfaceAudit
from servofd.feedback.flown import known_aircraft, layout_of, logs_of
from servofd.feedback.tables import as_described, frame_of, is_table
from servofd.fleets.overview import Overview, overview
from servofd.fleets.run import audit_fleet
from servofd.fleets.store import read_logs
from servofd.jobs import workflow
from servofd.outputs.audit_report import audit_report
from servofd.outputs.chart import Chart, axis_chart, flight_chart
from servofd.outputs.compare_report import Track, charts, compare_report, overlaid, track_of
from servofd.outputs.document import Document
from servofd.outputs.figure import chart_figure
from servofd.outputs.fleet_report import fleet_report, flight_name
from servofd.outputs.sentence import LEAST_CLEARED
from servofd.results.shown import Drawn, Shown, fields_of, frame, in_words_of_python

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from servofd.feedback.flown import Log
    from servofd.results.models import Flown


class AuditedSurface(Drawn, SurfaceAudit):
    """Verdict on one surface."""

    def chart(self) -> Chart:
        """The whole flight of the surface."""
        return flight_chart(self)

    def series(self) -> pd.DataFrame:
        """What was asked, simulated and measured, the residual and its threshold over time, all in degrees.

        One row for each position, with the time of the log as index [s]; `judged` is false while the filter settles and
        where nothing was measured. The command is the last that was sent before.
        """
        segment, residuals, threshold = self.segment, self.residuals, self.threshold
        if segment is None or residuals is None or threshold is None:
            raise NoMeasurement(f"{self.surface}: there is nothing to draw: {self.reason}")
        columns = {
            "time_s": residuals.time_s,
            "command_deg": latest(segment.command_s, segment.command_deg, residuals.time_s),
            **{name: getattr(residuals, name) for name in ("simulated_deg", "measured_deg", "residual_deg")},
            "threshold_deg": threshold.level_deg,
            "judged": residuals.settled,
        }
        return frame(columns).set_index("time_s")


class AuditedAxis(Drawn, AxisAudit):
    """What the motion of the aircraft tells of one axis."""

    def chart(self) -> Chart:
        """The whole flight of the axis."""
        return axis_chart(self)

    def series(self) -> pd.DataFrame:
        """Effect of the command that was expected, and what the motion shows, in the unit of the axis' model.

        `share` is the distance from healthy over its threshold; `judged` is false outside the calibrated regime.
        """
        shares = np.sqrt(np.maximum(self.score, 0.0))
        columns = {"time_s": self.time_s, "expected": self.asked, "shown": self.shown, "share": shares}
        return frame(columns | {"judged": self.inputs.usable}).set_index("time_s")


class Audit(Shown, LogAudit):
    """Verdicts on the surfaces of one run of a log.

    Each is `found["elevator"]` or `found.elevator`, and `found["roll"]` an axis. A loop over it gives itself, so that a
    loop over `audit` need not know whether a log holds runs. Two are equal if they say the same; ``a - b`` compares
    them. A pickle of it holds verdicts and curves, and not the other channels of the log.
    """

    @classmethod
    def _of(cls, found: LogAudit) -> Self:
        surfaces = tuple(AuditedSurface(**fields_of(one)) for one in found.surfaces)
        axes = tuple(AuditedAxis(**fields_of(one)) for one in found.axes)
        return cls(found.log, found.aircraft, surfaces, axes, found.common_causes)

    def __iter__(self) -> Iterator[Self]:
        """Itself, once."""
        return iter((self,))

    def __getitem__(self, name: str | int) -> Any:  # noqa: ANN401 - a surface, an axis or itself
        """Verdict on one surface or axis; by number the only run, itself, as in a loop."""
        if isinstance(name, int):
            return (self,)[name]
        found = self._named()
        if name not in found:
            raise UnknownName(suggest("surface", name, found))
        return found[name]

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - a surface or an axis
        """Verdict on one surface or axis, as far as its name is none that every result has."""
        found = {} if name.startswith("_") else self._named()
        if name not in found:
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}, and the log no such surface")
        return found[name]

    def __dir__(self) -> list[str]:
        """With the surfaces and axes, which a notebook completes."""
        return sorted({*super().__dir__(), *filter(str.isidentifier, self._named())})

    def _named(self) -> dict[str, Any]:
        return {one.axis: one for one in self.axes} | {one.surface: one for one in self.surfaces}

    def __eq__(self, other: object) -> bool:
        """Whether both say the same of the same log."""
        return isinstance(other, Audit) and self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash((self.log.label, self.log.duration_s, tuple(one.surface for one in self.surfaces)))

    def __sub__(self, other: Audit) -> Comparison:
        """Both beside each other."""
        return compare(self, other) if isinstance(other, Audit) else NotImplemented

    def _ipython_key_completions_(self) -> list[str]:
        return list(self._named())

    def __reduce__(self) -> tuple[Any, ...]:
        log = replace(self.log, channels={}, span_s=self.log.ends_s)
        return Audit, (log, self.aircraft, self.surfaces, self.axes, self.common_causes)

    def report(self) -> Document:
        """Verdicts in words, tables and charts."""
        return audit_report([self])

    def to_dict(self) -> dict[str, Any]:
        """As in JSON, schema servofd.audit/1."""
        return dict(self.report().data)

    def series(self, name: str) -> pd.DataFrame:
        """Numbers of one surface or axis over time (`AuditedSurface.series`, `AuditedAxis.series`)."""
        found: pd.DataFrame = self[name].series()
        return found

    def plot(self, name: str | None = None, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Figure of one surface or axis; of the worst surface that could be judged if none is named."""
        if name is None:
            drawn: list[Any] = [s for s in self.surfaces if s.threshold is not None or s.feedback == "current"]
            drawn = drawn or [*self.axes]
            if not drawn:
                raise NoMeasurement(f"there is nothing to draw: {self.sentence}")
            worst = min(drawn, key=lambda one: LEAST_CLEARED.index(one.status))
        figure: Figure = (worst if name is None else self[name]).plot(ax)
        return figure

    def _rows(self) -> list[dict[str, Any]]:
        return [_row(one) for one in self.surfaces] + [
            {"surface": axis.axis, "status": axis.status, "reason": axis.reason} for axis in self.axes
        ]


def _row(one: SurfaceAudit) -> dict[str, Any]:
    first = next(iter((*one.faults, *one.suspicions)), None)
    return {
        "surface": one.surface,
        "status": one.status,
        "reason": one.reason,
        **{name: getattr(first, name, None) for name in ("kind", "start_s", "alarm_s", "end_s", "probability")},
        "servo": one.servo,
        "model": one.model.origin,
        "judged_share": one.judged_share,
        "threshold_deg": one.threshold_deg,
        "max_abs_deg": one.statistics.max_abs_deg if one.statistics else None,
        **{f"detectable_{name}": size for name, size in one.detectable.document().items()},
    }


class Audits(Shown, tuple[Audit, ...]):
    """The runs of one log, each with its verdicts."""

    def __repr__(self) -> str:
        """One result after the other."""
        return "\n".join(map(repr, self))

    def _repr_html_(self) -> str:
        return "".join(one._repr_html_() for one in self)

    def report(self) -> Document:
        """All runs, and the verdicts of each."""
        return audit_report(self)

    def _rows(self) -> list[dict[str, Any]]:
        return [{"run": one.log.run} | row for one in self for row in one._rows()]


@in_words_of_python
def audit(
    log: Log | Flown,
    aircraft: Aircraft | str | Path | None = None,
    *,
    servo: str | None = None,
    threshold_deg: float | None = None,
    threshold: ThresholdKind | None = None,
    surfaces: tuple[str, ...] = (),
    columns: Mapping[str, str] | None = None,
) -> Any:  # noqa: ANN401 - only the disk knows whether a path is a log or a folder
    """Judge every surface of a log, or of each log of a folder.

    Parameters
    ----------
    log : str, Path, open file, DataFrame or dict of arrays
        The log; or a folder, pattern or address of many; or a table whose clock is a column (``time_s``, ``t_ms``,
        dates) or the index, with ``<surface>_cmd_deg`` and ``<surface>_pos_deg`` for each surface.
    aircraft : Aircraft, str or Path, optional
        An aircraft, its file, or the name of one that comes with servofd; what the log itself says if left out.
    servo : str, optional
        Servo of all surfaces: a name of the library, or a servo file; ``unknown``, which it is for plain tables and
        autopilots' logs that come without an aircraft, fits each servo to the log.
    threshold_deg : float, optional
        Constant alarm level for all surfaces [deg].
    threshold : {"constant", "interval"}, optional
        Kind of threshold for all surfaces.
    surfaces : tuple of str
        Which to judge; all if empty.
    columns : mapping of str to str, optional
        What the columns of a table are, where their names do not say it, as `pandas.DataFrame.rename` takes it:
        ``{"t": "time_ms", "de": "elevator_cmd_rad", "de_meas": "elevator_pos_rad"}``; units are s, ms, us, ns, and deg,
        rad, us (of pulse).

    Returns
    -------
    Audit, Audits or Fleet
        One result; of a log that holds several runs one for each; of a folder what its logs say together.

    Raises
    ------
    LogError
        If the log is of no use.
    ServofdError
        If the aircraft is not what it should be, or a name is unknown.

    Examples
    --------
    >>> found = audit("sample_logs/faser_stuck_flight.mat", surfaces=("elevator", "rudder"))
    >>> found.sentence
    'ELEVATOR JAMMED at 0:05 (-0.2 deg). Do not fly.'
    >>> found.to_pandas()[["surface", "status"]].values.tolist()
    [['elevator', 'fault'], ['rudder', 'healthy']]
    """
    if threshold not in (None, "constant", "interval"):
        raise ConfigError(f"threshold is 'constant' or 'interval'; a level in degrees is threshold_deg={threshold}")
    if threshold_deg is not None and not (isinstance(threshold_deg, Real) and 0.0 < threshold_deg < math.inf):
        raise ConfigError(f"threshold_deg is a positive number of degrees, not {threshold_deg!r}")
    known = known_aircraft(aircraft)
    if columns is not None:
        if known is not None:
            raise ConfigError("columns and aircraft both say what the columns are; give one of them")
        log, known = _described(log, columns)
    names = (surfaces,) if isinstance(surfaces, str) else tuple(surfaces)
    job = Job(known, servo, threshold_deg, threshold, names)
    if isinstance(log, str | Path) and not _is_one_log(str(log)):
        return _fleet_of([str(log)], job)
    found = [Audit._of(result) for result in workflow.audit(cast("Log", log), job)]
    return found[0] if len(found) == 1 else Audits(found)


def _described(log: Any, columns: Mapping[str, str]) -> tuple[Any, Aircraft]:  # noqa: ANN401 - a log or a table
    """A log, and the aircraft that its columns belong to."""
    if is_table(log):
        log, columns = as_described(frame_of(log), columns)
    return log, aircraft_of_columns(columns)


class Fleet(Shown, Overview):
    """What many logs say together."""

    def report(self) -> Document:
        """Flights, the worst first, then surfaces and faults."""
        return fleet_report(self.document())

    def _rows(self) -> list[dict[str, Any]]:
        names = ("path", "run", "status", "sentence", "start_utc", "duration_s", "surface")
        rows = [{name: flight[name] for name in names} for flight in self.flights]
        return [{"flight": flight_name(row)} | {k: v for k, v in row.items() if k != "run"} for row in rows]


def _is_one_log(text: str) -> bool:
    """Whether it names one file, or tables of the messages of one flight."""
    kind = kind_of(text)
    return kind == "file" or (kind == "pattern" and len(find_logs([text]).logs) == 1)


def _fleet_of(inputs: list[str], job: Job) -> Fleet:
    """Judge all logs of some folders side by side; a bar shows how far it is."""
    from rich.console import Console
    from rich.progress import track

    logs = find_logs(inputs, layout_of(job.aircraft)).logs
    bar = Console(stderr=True)
    unseen = not (bar.is_terminal or bar.is_jupyter)
    judging = audit_fleet(logs, job)
    judged = track(judging, f"{len(logs)} logs", len(logs), console=bar, transient=True, disable=unseen)
    return Fleet(**fields_of(overview([row for one in judged for row in one.rows])))


@in_words_of_python
def fleet(folder: str | Path, aircraft: Aircraft | str | Path | None = None, *, servo: str | None = None) -> Fleet:
    """What the logs of a folder say together.

    Parameters
    ----------
    folder : str or Path
        Results of ``servofd audit LOGS/ -o FOLDER``, which are read; or logs, which are judged.
    aircraft, servo
        As for `audit`, of logs.

    Examples
    --------
    >>> fleet("sample_logs/faser_stuck_flight.ma?", servo="hs225bb-eq31").statuses
    {'fault': 1}
    """
    if (Path(folder) / META_FILE).is_file():
        return Fleet(**fields_of(overview(read_logs(Path(folder)))))
    return _fleet_of([str(folder)], Job(known_aircraft(aircraft), servo))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Comparison(Shown):
    """Two flights beside each other."""

    first: Audit
    second: Audit

    @property
    def names(self) -> list[str]:
        """Of both flights."""
        logs = (self.first.log, self.second.log)
        return [flight_name({"path": log.source.name, "run": log.run}) for log in logs]

    def report(self) -> Document:
        """Verdicts of the same surfaces beside each other, and their curves over each other."""
        documents = [one.to_dict() for one in (self.first, self.second)]
        return compare_report(self.names, documents, parts=[charts(self._both(), self.names, (0.0, 0.0))])

    def plot(self, surface: str | None = None, at_s: tuple[float, float] = (0.0, 0.0)) -> Figure:
        """Figure of one surface in both flights, the first if none is named; `at_s` of each lies at 0 [s]."""
        both = self._both()
        if surface is not None and surface not in both:
            raise UnknownName(suggest("surface of both flights", surface, both))
        for name in [surface] if surface else both:
            return chart_figure(overlaid(name, both[name], self.names, at_s))
        raise NoMeasurement("no surface was judged in both flights")

    def _both(self) -> dict[str, tuple[Track, Track]]:
        others = {one.surface: track_of(one) for one in self.second.surfaces}
        pairs = {one.surface: (track_of(one), others.get(one.surface)) for one in self.first.surfaces}
        return {name: (a, b) for name, (a, b) in pairs.items() if a is not None and b is not None}

    def _rows(self) -> list[dict[str, Any]]:
        rows = []
        for name, entries in self.report().data["surfaces"].items():
            row: dict[str, Any] = {"surface": name}
            row |= {f"status_{one}": entry and entry["status"] for one, entry in zip("ab", entries, strict=True)}
            sizes = ((entry or {}).get("residual") for entry in entries)
            first, second = (size and size["max_abs_deg"] for size in sizes)
            apart = None if first is None or second is None else first - second
            rows.append(row | {"max_abs_deg_a": first, "max_abs_deg_b": second, "max_abs_deg_difference": apart})
        return rows


def compare(first: Audit, second: Audit) -> Comparison:
    """Two flights beside each other, surface by surface; ``first - second`` is the same.

    Examples
    --------
    >>> flights = ["sample_logs/faser_healthy_flight.mat", "sample_logs/faser_stuck_flight.mat"]
    >>> compare(*(audit(log, surfaces=("elevator",)) for log in flights)).sentence
    'Elevator differs.'
    """
    for one in (first, second):
        if not isinstance(one, Audit):
            raise TypeError(f"two results of servofd.audit are compared, and not one of type {type(one).__name__}")
    return Comparison(first, second)


@in_words_of_python
def load(
    log: Log, aircraft: Aircraft | str | Path | None = None, *, columns: Mapping[str, str] | None = None
) -> FlightLog | tuple[FlightLog, ...]:
    """Channels of a log, as whatever is judged would read them; of a log with several runs one for each.

    Examples
    --------
    >>> load("sample_logs/faser_stuck_flight.mat")["de_pos"].unit
    'rad_or_count'
    """
    if columns is not None:
        log, aircraft = _described(log, columns)
    found = tuple(logs_of(log, known_aircraft(aircraft)))
    return found[0] if len(found) == 1 else found
