"""The verbs as functions for a notebook: results that show themselves, and become a table, a figure or a page."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, Self, TypeVar, overload

from servofd.batch.key import Job
from servofd.calibrating.result import Calibration, calibration_to_toml
from servofd.core.errors import ConfigError, NoMeasurement, UnknownName, needs, suggest
from servofd.core.files import write_whole
from servofd.detection.verdict import LogAudit, SurfaceAudit
from servofd.feedback.flown import known_aircraft, log_files
from servofd.identification.result import Identification
from servofd.jobs import bench, workflow
from servofd.jobs.explaining import explain_logs
from servofd.outputs.audit_report import audit_report
from servofd.outputs.calibrate_report import calibrate_figure, calibrate_report
from servofd.outputs.document import Table
from servofd.outputs.explain_report import explain_figures, explain_report
from servofd.outputs.figure import audit_figure
from servofd.outputs.identify_report import identify_figures, identify_report
from servofd.outputs.model_file import model_file
from servofd.outputs.page import html_page
from servofd.outputs.sentence import spoken
from servofd.outputs.trend_report import quantity_row, trend_picture, trend_report
from servofd.wear.trend import AircraftTrend, trend_document, trend_logs

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    import pandas as pd
    from matplotlib.figure import Figure

    from logparsers import FlightLog
    from servofd.aircraft.schema import Aircraft
    from servofd.detection.threshold import ThresholdKind
    from servofd.discrepancy.explanation import Explanation
    from servofd.outputs.document import Document


class Shown(ABC):
    """A result that a notebook shows, and that becomes a table or a page."""

    __slots__ = ()

    @abstractmethod
    def report(self) -> Document:
        """What the verb found, as the command line prints it and its page shows it."""

    @abstractmethod
    def _rows(self) -> list[dict[str, Any]]:
        """One for each surface or quantity."""

    @property
    def sentence(self) -> str:
        """What it comes to, in a sentence."""
        return self.report().sentence

    @property
    def status(self) -> str:
        """``healthy``, ``suspect``, ``fault``, ``unknown`` or ``no_data``: which colour it has."""
        return self.report().status

    def to_html(self) -> str:
        """Text of its page."""
        return html_page(self.report())

    @classmethod
    def _of(cls, found: Any) -> Self:  # noqa: ANN401 - the data type that it extends
        return cls(**{field.name: getattr(found, field.name) for field in fields(found)})

    def to_pandas(self) -> pd.DataFrame:
        """One row for each surface or quantity."""
        needs("pandas")
        import pandas as pd

        return pd.DataFrame(self._rows())

    def save_html(self, path: str | Path) -> Path:
        """Write its page, and give the path."""
        write_whole(path, self.to_html().encode())
        return Path(path)

    def __repr__(self) -> str:
        """Short: one line, and one for each surface or quantity."""
        rows = [list(map(str, list(row.values())[:_SHORT])) for row in self._rows()]
        widths = [max((len(row[k]) for row in rows), default=0) for k in range(len(rows[0]) if rows else 0)]
        lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
        report, name = self.report(), type(self).__name__
        head = f"{name}: {report.sentence.removeprefix(f'{name}: ')}{f' ({report.facts})' if report.facts else ''}"
        return "\n".join([head, *(f"  {line}" for line in lines)])

    def _repr_html_(self) -> str:
        rows = self._rows()
        return html_page(
            self.report(),
            "cell.html",
            head=[spoken(name) for name in (rows[0] if rows else ())][:_SHOWN],
            rows=[["" if value is None else value for value in row.values()][:_SHOWN] for row in rows],
        )


_SHORT, _SHOWN = 3, 6
"""Columns of a row in a terminal, and in a notebook."""

P = ParamSpec("P")
Result = TypeVar("Result", bound=Shown)


def _shown(name: str, verb: Callable[P, object], kind: type[Result]) -> Callable[P, Result]:
    """The verb as the command line calls it, with a result that shows itself."""

    @wraps(verb)
    def call(*args: P.args, **options: P.kwargs) -> Result:
        return kind._of(verb(*args, **options))

    call.__name__ = call.__qualname__ = name
    return call


class Audit(LogAudit, Shown):
    """Verdicts on the surfaces of one run of a log.

    A loop over it gives itself, so that a loop over `audit` need not know whether a log holds runs.
    """

    __slots__ = ()
    __repr__ = Shown.__repr__

    def __iter__(self) -> Iterator[Self]:
        """Itself, once."""
        return iter((self,))

    @overload
    def __getitem__(self, surface: str) -> SurfaceAudit: ...

    @overload
    def __getitem__(self, surface: int) -> Self: ...

    def __getitem__(self, surface: str | int) -> SurfaceAudit | Self:
        """Verdict on one surface; by number the only run, itself, as in a loop."""
        if isinstance(surface, int):
            return (self,)[surface]
        found = {one.surface: one for one in self.surfaces}
        if surface not in found:
            raise UnknownName(suggest("surface", surface, found))
        return found[surface]

    def report(self) -> Document:
        """Verdicts in words, tables and charts."""
        return audit_report([self])

    def to_dict(self) -> dict[str, Any]:
        """As in JSON, schema servofd.audit/1."""
        return dict(self.report().data)

    def series(self, surface: str) -> pd.DataFrame:
        """Measured and simulated deflection, residual and threshold of one surface, over time; all in degrees."""
        needs("pandas")
        import pandas as pd

        one = self[surface]
        if one.residuals is None or one.threshold is None:
            raise ConfigError(f"{surface}: no residual: {one.reason}")
        return pd.DataFrame(
            {
                "measured_deg": one.residuals.measured_deg,
                "simulated_deg": one.residuals.simulated_deg,
                "residual_deg": one.residuals.residual_deg,
                "threshold_deg": one.threshold.level_deg,
                "judged": one.residuals.settled,
            },
            index=pd.Index(one.residuals.time_s, name="time_s"),
        )

    def plot(self, surface: str | None = None) -> Figure:
        """Figure of one surface; of the worst that could be judged if none is named."""
        needs("matplotlib")
        drawn = [one for one in self.surfaces if one.residuals is not None and one.threshold is not None]
        if surface is None and not drawn:
            raise ConfigError(f"nothing to draw: {self.sentence}")
        chosen = self[surface] if surface is not None else min(drawn, key=lambda one: _WORST_FIRST.index(one.status))
        return audit_figure(chosen)

    def _rows(self) -> list[dict[str, Any]]:
        return [_row(one) for one in self.surfaces] + [
            {"surface": axis.axis, "status": axis.status, "reason": axis.reason} for axis in self.axes
        ]


_WORST_FIRST = ("fault", "suspect", "unknown", "healthy", "no_data")


def _row(one: SurfaceAudit) -> dict[str, Any]:
    first = next(iter((*one.faults, *one.suspicions)), None)
    return {
        "surface": one.surface,
        "status": one.status,
        "reason": one.reason,
        "kind": first.kind if first else None,
        "start_s": first.start_s if first else None,
        "alarm_s": first.alarm_s if first else None,
        "end_s": first.end_s if first else None,
        "probability": first.probability if first else None,
        "servo": one.servo,
        "model": one.model.origin,
        "judged_share": one.judged_share,
        "threshold_deg": one.threshold_deg,
        "max_abs_deg": one.statistics.max_abs_deg if one.statistics else None,
        **{f"detectable_{name}": size for name, size in one.detectable.document().items()},
    }


class Audits(tuple[Audit, ...]):
    """The runs of one log, each with its verdicts."""

    __slots__ = ()

    def __repr__(self) -> str:
        """One result after the other."""
        return "\n".join(map(repr, self))

    def _repr_html_(self) -> str:
        return "".join(one._repr_html_() for one in self)

    def to_pandas(self) -> pd.DataFrame:
        """One row for each run and surface."""
        needs("pandas")
        import pandas as pd

        return pd.DataFrame([{"run": one.log.run} | row for one in self for row in one._rows()])

    def save_html(self, path: str | Path) -> Path:
        """Write the page of all runs, and give the path."""
        write_whole(path, html_page(audit_report(self)).encode())
        return Path(path)


def audit(
    log: str | Path | pd.DataFrame,
    aircraft: Aircraft | str | Path | None = None,
    *,
    servo: str | None = None,
    threshold_deg: float | None = None,
    threshold: ThresholdKind | None = None,
    surfaces: tuple[str, ...] = (),
) -> Audit | Audits:
    """Judge every surface of a log.

    Parameters
    ----------
    log : str, Path or DataFrame
        The log; or a table with ``time_s`` (a column, or the index) and, for each surface, ``<surface>_cmd_deg`` and
        ``<surface>_pos_deg``.
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

    Returns
    -------
    Audit or Audits
        One result; of a log that holds several runs one for each.

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
    job = Job(known_aircraft(aircraft), servo, threshold_deg, threshold, surfaces)
    found = [Audit._of(result) for result in workflow.audit(log, job)]
    return found[0] if len(found) == 1 else Audits(found)


class Identified(Identification, Shown):
    """A servo, how sure its numbers are, and the evidence."""

    __slots__ = ()
    __repr__ = Shown.__repr__

    def report(self) -> Document:
        """Numbers with their intervals, and figures."""
        return identify_report(self, f"{len(self.runs)} {'test' if len(self.runs) == 1 else 'tests'}")

    def plot(self) -> Figure:
        """Figure of the frequency response, or of the motion where there is none."""
        needs("matplotlib")
        return identify_figures(self)[0].figure

    def _rows(self) -> list[dict[str, Any]]:
        (table,) = (part for part in self.report().parts if isinstance(part, Table))
        return [dict(zip(map(str, table.head), row, strict=True)) for row in table.rows]


identify = _shown("identify", bench.identify, Identified)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Explained(Shown):
    """What the model of a servo lacked, and how the gap shrinks."""

    explanation: Explanation
    aircraft: Aircraft
    source: str
    logs: tuple[FlightLog, ...]

    @property
    def answer(self) -> str:
        """What is missing, how much, whether that is a fault, and what to do next."""
        return self.explanation.answer

    def report(self) -> Document:
        """What is missing in words, tables and figures."""
        return explain_report([self.explanation], self.source)

    @property
    def steps(self) -> pd.DataFrame:
        """One row for each effect, the one that helps most first: its size, and the error with it."""
        return self.to_pandas()

    def plot(self) -> Figure:
        """Figure of the motion where the models differ most."""
        needs("matplotlib")
        return explain_figures(self.explanation, "explain")[0].figure

    def save(self, path: str | Path) -> Path:
        """Write the aircraft file with the better model, and give the path."""
        text, _ = model_file([self.explanation], self.aircraft, self.source, self.logs)
        write_whole(path, text.encode())
        return Path(path)

    def _rows(self) -> list[dict[str, Any]]:
        document = self.explanation.document()
        first = {"effect": "as it was", "form": None, "sizes": "", **document["nominal"]}
        steps = [
            {
                "effect": step["effect"],
                "form": step["form"],
                "sizes": ", ".join(f"{name} = {each['value']:.4g}" for name, each in step["parameters"].items()),
                "train_rms_deg": step["train_rms_deg"],
                "held_out_rms_deg": step["held_out_rms_deg"],
            }
            for step in document["steps"]
        ]
        return [first, *steps]


def explain(
    logs: str | Path | pd.DataFrame | Sequence[str | Path | pd.DataFrame],
    aircraft: str | Path | Aircraft | None = None,
    *,
    surface: str | None = None,
    servo: str | None = None,
) -> Explained:
    """Explain where a servo and its model disagree; parameters as of `servofd.explain_logs`.

    Examples
    --------
    >>> found = explain("sample_logs/hidden/hidden_11.csv", servo="hs225bb-eq31")
    >>> found.answer.split(",")[0][:10]
    'Play of 1.'
    >>> found.steps["effect"].tolist()
    ['as it was', 'backlash']
    """
    found = explain_logs(log_files(logs), aircraft, surfaces=(surface,) if surface else (), servo=servo, alone=True)
    if found.failures:
        raise NoMeasurement(found.failures[0])
    return Explained(found.explanations[0], found.aircraft, found.source, found.logs)


class Calibrated(Calibration, Shown):
    """An aircraft calibrated from good flights."""

    __slots__ = ()
    __repr__ = Shown.__repr__

    def to_toml(self) -> str:
        """The aircraft file, with its comments."""
        return calibration_to_toml(self)

    def save(self, path: str | Path) -> Path:
        """Write the aircraft file, and give the path."""
        write_whole(path, self.to_toml().encode())
        return Path(path)

    def report(self) -> Document:
        """Tables of the surfaces, and the smallest faults."""
        return calibrate_report(self)

    def plot(self) -> Figure:
        """Figure of the smallest faults that flights like these show."""
        needs("matplotlib")
        return calibrate_figure(self)

    def _rows(self) -> list[dict[str, Any]]:
        return [
            {
                "surface": one.surface,
                "delay_ms": round(1e3 * one.estimates["delay_s"].value, 1),
                "bandwidth_rad_s": round(one.bandwidth_rad_s.value, 1),
                "held_out_rms_deg": round(one.held_out_rms_deg, 3),
                **{f"smallest_{name}": size for name, size in one.detectable.document().items()},
                "flights": ", ".join(one.flights),
                "notes": "; ".join(one.notes),
            }
            for one in self.surfaces
        ]


calibrate = _shown("calibrate", workflow.calibrate, Calibrated)


class Trend(AircraftTrend, Shown):
    """All surfaces of one aircraft over its flights."""

    __slots__ = ()
    __repr__ = Shown.__repr__

    def report(self) -> Document:
        """What changes over the flights, and since when."""
        return trend_report(trend_document(self))

    def plot(self, surface: str | None = None) -> Figure:
        """Figure of one surface over its flights; of the first that has an alarm, or of the first, if none is named."""
        needs("matplotlib")
        known = {one.surface: one for one in self.surfaces}
        name = surface or next((one.surface for one in self.surfaces if one.alarms), next(iter(known)))
        if name not in known:
            raise UnknownName(suggest("surface", name, known))
        return trend_picture(name, trend_document(self)["surfaces"][name]).figure

    def _rows(self) -> list[dict[str, Any]]:
        names = ("quantity", "now", "per_flight", "limit", "forecast")
        return [
            {"surface": name} | dict(zip(names, quantity_row(one), strict=True))
            for name, surface in trend_document(self)["surfaces"].items()
            for one in surface["quantities"].values()
        ]


trend = _shown("trend", trend_logs, Trend)
