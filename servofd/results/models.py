"""Servos identified, explained, calibrated, followed over many flights, and simulated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

from logparsers import FlightLog
from logparsers.units import MS_PER_S
from servofd.aircraft.axes import MotionModel, motion_to_toml
from servofd.aircraft.schema import Aircraft
from servofd.calibrating.result import Calibration, calibration_to_toml
from servofd.core.errors import ConfigError, NoMeasurement, UnknownName, suggest
from servofd.discrepancy.explanation import Explanation
from servofd.feedback.flown import log_files
from servofd.identification.result import Identification
from servofd.jobs import bench, simulating, workflow
from servofd.jobs.explaining import explain_logs
from servofd.outputs.calibrate_report import calibrate_report, motion_report
from servofd.outputs.document import Document, Table
from servofd.outputs.explain_report import explain_charts, explain_report
from servofd.outputs.figure import chart_figure
from servofd.outputs.identify_report import identify_charts, identify_report
from servofd.outputs.model_file import model_file
from servofd.outputs.trend_report import quantity_row, trend_chart, trend_report
from servofd.results.shown import Shown, fields_of, frame, in_words_of_python, shown
from servofd.simulation.flight import SimulatedFlight
from servofd.wear.trend import AircraftTrend, trend_document, trend_logs

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from servofd.feedback.flown import Log


class Identified(Shown, Identification):
    """A servo, how sure its numbers are, and the evidence."""

    def report(self) -> Document:
        """Numbers with their intervals, and figures."""
        return identify_report(self, f"{len(self.runs)} {'test' if len(self.runs) == 1 else 'tests'}")

    def plot(self) -> Figure:
        """Figure of the frequency response, or of the motion where there is none."""
        charts = identify_charts(self)
        return chart_figure(charts.get("response", charts["motion"]))

    def _rows(self) -> list[dict[str, Any]]:
        (table,) = (part for part in self.report().parts if isinstance(part, Table))
        return [dict(zip(map(str, table.head), row, strict=True)) for row in table.rows]


identify = shown("identify", bench.identify, Identified)


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
        return chart_figure(explain_charts(self.explanation)["traces"])

    def save(self, path: str | Path) -> Path:
        """Write the aircraft file with the better model, and give the path."""
        text, _ = model_file([self.explanation], self.aircraft, self.source, self.logs)
        return self._save(path, text)

    def _rows(self) -> list[dict[str, Any]]:
        document = self.explanation.document()
        rows = [{"effect": "as it was", "form": None, "sizes": "", **document["nominal"]}]
        for step in document["steps"]:
            sizes = ", ".join(f"{name} = {each['value']:.4g}" for name, each in step["parameters"].items())
            errors = {name: step[name] for name in ("train_rms_deg", "held_out_rms_deg")}
            rows.append({"effect": step["effect"], "form": step["form"], "sizes": sizes, **errors})
        return rows


@in_words_of_python
def explain(
    logs: Log | Sequence[Log],
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
    if not isinstance(surface, str | None):
        raise ConfigError(f"surface is the name of one surface, not {surface!r}")
    found = explain_logs(log_files(logs), aircraft, surfaces=(surface,) if surface else (), servo=servo, alone=True)
    if found.failures:
        raise NoMeasurement(found.failures[0])
    return Explained(found.explanations[0], found.aircraft, found.source, found.logs)


class Calibrated(Shown, Calibration):
    """An aircraft calibrated from good flights."""

    def to_toml(self) -> str:
        """The aircraft file, with its comments."""
        return calibration_to_toml(self)

    def save(self, path: str | Path) -> Path:
        """Write the aircraft file, and give the path."""
        return self._save(path, self.to_toml())

    def report(self) -> Document:
        """Tables of the surfaces, and the smallest faults."""
        return calibrate_report(self)

    def _rows(self) -> list[dict[str, Any]]:
        rows = []
        for one in self.surfaces:
            delay_ms, bandwidth_rad_s = MS_PER_S * one.estimates["delay_s"].value, one.bandwidth_rad_s.value
            row = {"surface": one.surface, "delay_ms": round(delay_ms, 1), "bandwidth_rad_s": round(bandwidth_rad_s, 1)}
            row |= {"held_out_rms_deg": round(one.held_out_rms_deg, 3)}
            row |= {f"smallest_{name}": size for name, size in one.detectable.document().items()}
            rows.append(row | {"flights": ", ".join(one.flights), "notes": "; ".join(one.notes)})
        return rows


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class CalibratedAxes(Shown):
    """What the motion of an aircraft without feedback tells of its axes, from good flights."""

    motion: MotionModel

    @property
    def aircraft(self) -> Aircraft:
        """As `servofd.audit` takes it."""
        return Aircraft(motion=self.motion)

    def to_toml(self) -> str:
        """The aircraft file."""
        return f'name = "aircraft"\n\n{motion_to_toml(self.motion)}'

    def save(self, path: str | Path) -> Path:
        """Write the aircraft file, and give the path."""
        return self._save(path, self.to_toml())

    def report(self) -> Document:
        """Table of the axes."""
        return motion_report(self.motion)

    def _rows(self) -> list[dict[str, Any]]:
        return [
            {"axis": name, "explained": round(axis.explained, 3), "delay_s": round(axis.delay_s, 3)}
            for name, axis in self.motion.axes.items()
        ]


@wraps(workflow.calibrate)
@in_words_of_python
def calibrate(*args: Any, **options: Any) -> Any:  # noqa: ANN401 - by what the flights hold
    """As `servofd.jobs.workflow.calibrate`; of flights without feedback, what motion tells of the axes."""
    try:
        return Calibrated(**fields_of(workflow.calibrate(*args, **options)))
    except NoMeasurement:
        if len(args) != 1 or options.get("aircraft") is not None:
            raise
        return CalibratedAxes(workflow.calibrate_axes(args[0], spans=options.get("spans", ())))


class Trend(Shown, AircraftTrend):
    """All surfaces of one aircraft over its flights."""

    def report(self) -> Document:
        """What changes over the flights, and since when."""
        return trend_report(trend_document(self))

    def plot(self, surface: str | None = None) -> Figure:
        """Figure of one surface over its flights; of the first that has an alarm, or of the first, if none is named."""
        known = {one.surface: one for one in self.surfaces}
        name = surface or next((one.surface for one in self.surfaces if one.alarms), next(iter(known)))
        if name not in known:
            raise UnknownName(suggest("surface", name, known))
        return chart_figure(trend_chart(name, trend_document(self)["surfaces"][name]))

    def _rows(self) -> list[dict[str, Any]]:
        names = ("quantity", "now", "per_flight", "limit", "forecast")
        return [
            {"surface": name} | dict(zip(names, quantity_row(one), strict=True))
            for name, surface in trend_document(self)["surfaces"].items()
            for one in surface["quantities"].values()
        ]


trend = shown("trend", trend_logs, Trend)


class Flown(SimulatedFlight):
    """A simulated flight, which is a log for every verb."""

    def to_pandas(self) -> pd.DataFrame:
        """As a plain table: time, and command and measured position of each surface [deg]."""
        columns = {"time_s": self.time_s}
        for k, name in enumerate(self.surfaces):
            columns |= {f"{name}_cmd_deg": self.command_deg[:, k], f"{name}_pos_deg": self.measured_deg[:, k]}
        return frame(columns)

    def __repr__(self) -> str:
        return f"Flown: {', '.join(self.surfaces)}, {self.time_s[-1]:.1f} s"


simulate = shown("simulate", simulating.simulate, Flown)
