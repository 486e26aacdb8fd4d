"""An identification as a Rerun recording: the servo that was found, simulated beside each test, and what it misses.

Entities below ``/surfaces/<name>``, or ``/surfaces/<name> 2`` and on for further tests: ``deflection`` (command,
simulated, measured [deg]) and ``error`` (measured minus simulated [deg]); ``/report``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.core.series import latest
from servofd.outputs.identify_page import identified, sentence_of
from servofd.outputs.recording.layout import REPORT
from servofd.outputs.recording.stream import application_name, recording_file, shown, surface_place
from servofd.outputs.recording.surface import DEFLECTIONS, WIDTHS
from servofd.outputs.recording.views import blueprint, curves, document, stacked

if TYPE_CHECKING:
    from pathlib import Path
    from typing import Any

    from servofd.core.types import FloatArray
    from servofd.identification.records import Run
    from servofd.identification.result import Identification
    from servofd.outputs.recording.stream import Recorder


def save_identification(found: Identification, path: str | Path, source: str) -> None:
    """Write all tests, the servo that was found and its error into one .rrd file, with its layout inside."""
    names = [found.surface, *(f"{found.surface} {k}" for k in range(2, len(found.runs) + 1))]
    tabs = [*map(_tab, names), document("Report", REPORT)]
    with recording_file(path, application_name("identify", found.surface, source), blueprint(tabs)) as recorder:
        recorder.properties(source, {"schema": "servofd.identify/1", "surface": shown(found.surface)})
        recorder.document(REPORT, _report(found, source))
        for name, run, error_deg in zip(names, found.runs, found.errors_deg, strict=True):
            _send_run(recorder, surface_place(name), run, error_deg)


def _send_run(recorder: Recorder, place: str, run: Run, error_deg: FloatArray) -> None:
    simulated_deg = run.measured_deg - error_deg
    deflections = np.column_stack(
        [latest(run.command_s, run.command_deg, run.measured_s), simulated_deg, run.measured_deg]
    )
    recorder.lines(f"{place}/deflection", DEFLECTIONS, DEFLECTIONS, widths=WIDTHS)
    recorder.scalars(f"{place}/deflection", run.measured_s, deflections)
    recorder.lines(f"{place}/error", ["measured - simulated"], ["residual"])
    recorder.scalars(f"{place}/error", run.measured_s, error_deg)


def _report(found: Identification, source: str) -> str:
    table = "\n".join(f"| {name} | {value} | {interval} |" for name, value, interval in identified(found))
    notes = "\n".join(f"- {note}" for note in found.notes)
    return (
        f"# {source}: {found.surface}\n\n{sentence_of(found)}\n\n"
        f"| | value | 95% interval |\n|---|---|---|\n{table}\n\n{notes}\n"
    )


def _tab(name: str) -> Any:  # noqa: ANN401 - rerun is untyped
    place = surface_place(name)
    views = [
        curves(f"{name}: deflection [deg]", [f"{place}/deflection"], origin=place),
        curves(f"{name}: measured minus simulated [deg]", [f"{place}/error"], origin=place),
    ]
    return stacked(name, views, [4, 3])
