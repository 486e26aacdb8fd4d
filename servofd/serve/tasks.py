"""What is done with several flights, or one surface, at a click: a calibration, a trend, an explanation."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal, Self

from logparsers import LogError
from servofd.aircraft.axes import motion_to_toml
from servofd.aircraft.schema import Aircraft
from servofd.calibrating.result import calibration_to_toml
from servofd.core.errors import NoMeasurement, ServofdError
from servofd.core.files import make_folder, write_whole
from servofd.jobs.explaining import explain_logs
from servofd.jobs.workflow import calibrate, calibrate_axes
from servofd.outputs.calibrate_report import calibrate_report, motion_report
from servofd.outputs.document import Document
from servofd.outputs.explain_report import explain_report
from servofd.outputs.page import html_page
from servofd.outputs.trend_report import trend_report
from servofd.serve.judge import so_far

Verb = Literal["calibrate", "trend", "explain"]
TASK, PAGE = "task.json", "page.html"
_OPTION = re.compile(r" \(--?[a-z][a-z-]*\)")
"""Of the command line, in a sentence."""


@dataclass(frozen=True, slots=True)
class Task:
    """One of them; `id` names its folder."""

    id: str
    verb: Verb
    title: str
    state: str = "waiting"
    status: str = ""
    sentence: str = ""
    wrote: str = ""
    """Aircraft file of the folder that a calibration wrote."""
    flights: tuple[str, ...] = ()
    """Digests of the logs."""

    @classmethod
    def read(cls, folder: Path) -> Self | None:
        """The one that left this folder; None if there is none that can be read."""
        with suppress(OSError, ValueError, TypeError, KeyError):
            known = json.loads((folder / TASK).read_text(encoding="utf-8"))
            return cls(**known | {"flights": tuple(known["flights"])})
        return None


def do(task: Task, folder: str, logs: list[str], aircraft: Aircraft | None, surface: str, output: str) -> Task:
    """Do it; page and result go into the folder, an aircraft file to `output`; what is wrong is part of the result."""
    target = Path(folder)
    make_folder(target)
    wrote = ""
    try:
        if task.verb == "calibrate":
            report, wrote = _calibrated(logs, aircraft, Path(output), so_far(target, "Calibrated"))
        elif task.verb == "trend":
            from servofd.wear.trend import trend_document, trend_logs

            if aircraft is None:
                choose = "choose its file, or calibrate one from good flights first"
                raise NoMeasurement(f"a trend follows one aircraft: {choose}")
            pages = {Path(log).name: f"/flights/{flight}" for log, flight in zip(logs, task.flights, strict=True)}
            report = trend_report(trend_document(trend_logs(logs, aircraft, workers=0)), pages)
        else:
            wanted, tried = (surface,) if surface else (), so_far(target, "Tried")
            found = explain_logs(logs, aircraft, surfaces=wanted, alone=bool(surface), progress=tried)
            if not found.explanations:
                raise NoMeasurement("; ".join(found.failures))
            report = explain_report(found.explanations, ", ".join(Path(log).name for log in logs), found.failures)
    except (LogError, ServofdError) as error:
        text = _OPTION.sub("", str(error))
        for log in logs:
            text = text.replace(log, Path(log).name)
        report = Document(task.title, "unknown", f"Could not {task.verb}.", text)
    write_whole(target / PAGE, html_page(report).encode())
    said = f"{report.sentence} {report.facts if report.status == 'unknown' else ''}".strip()
    done = replace(task, state="done", status=report.status, sentence=said, wrote=wrote)
    write_whole(target / TASK, json.dumps(asdict(done)).encode())
    return done


def _calibrated(
    logs: list[str], aircraft: Aircraft | None, output: Path, progress: Callable[[str], None]
) -> tuple[Document, str]:
    """An aircraft from good flights; of flights without feedback from its motion."""
    try:
        found = calibrate(logs, aircraft, progress=progress)
    except NoMeasurement:
        model = calibrate_axes(logs)
        text, report = f'name = "{output.stem}"\n\n{motion_to_toml(model)}', motion_report(model)
    else:
        text, report = calibration_to_toml(found), calibrate_report(found)
    write_whole(output, text.encode())
    return report, output.name
