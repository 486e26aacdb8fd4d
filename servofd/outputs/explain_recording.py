"""Explanations as Rerun recordings: both simulations beside the measurement, and what they miss."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from servofd.discrepancy.locate import bad_seconds
from servofd.outputs.document import markdown
from servofd.outputs.explain_report import explain_report
from servofd.outputs.recording.content import held
from servofd.outputs.recording.layout import REPORT, REPORT_VIEW, blueprint, curves, lanes, stacked
from servofd.outputs.recording.stream import Recorder, application_name, recording_file, shown, surface_place

if TYPE_CHECKING:
    from servofd.discrepancy.explanation import Explanation


_AROUND_S = 10.0
"""That a layout shows before and after the worst second."""
_LANES = ("before", "after")
_AGREES, _DIFFERS = "noise only", "disagrees"
_STATES = {_AGREES: "ok", _DIFFERS: "fault"}


def save_explanation(found: Explanation, path: str | Path, source: str) -> None:
    """Write nominal and extended simulation, residuals and bad blocks into one .rrd file, with its layout inside."""
    place = surface_place(found.surface)
    views = [
        curves("Deflection [deg]", place, "/deflection"),
        curves("Measured minus simulated [deg]", place, "/error"),
        lanes("Seconds that disagree by more than noise", place, *(f"/{lane}" for lane in _LANES)),
    ]
    tabs = [stacked("Curves", views, [4, 3, 1.6]), REPORT_VIEW]
    layout, application = blueprint(tabs, around_s=_worst(found)), application_name("explain", found.surface, source)
    with recording_file(path, application, layout) as recorder:
        whole = {"schema": "servofd.explain/1", "surface": shown(found.surface), "conclusion": found.conclusion}
        recorder.properties(source, whole)
        recorder.document(REPORT, markdown(explain_report([found], source)))
        _send_curves(recorder, place, found)
        for lane, fit in zip(_LANES, (found.selection.nominal, found.selection.final), strict=True):
            changes = {float(found.record.time_s[0]): _AGREES}
            for begin_s, end_s in bad_seconds(found.record, fit.error_deg, found.selection.sigma_deg):
                changes |= {begin_s: _DIFFERS, end_s: _AGREES}
            recorder.states(f"{place}/{lane}", sorted(changes.items()), _STATES)


def _send_curves(recorder: Recorder, place: str, found: Explanation) -> None:
    record, nominal, final = found.record, found.selection.nominal.error_deg, found.selection.final.error_deg
    measured_deg = record.measured_deg
    command_deg = held(record.commands.effective_s, record.commands.command_deg, record.time_s)
    deflections = np.column_stack([command_deg, measured_deg - nominal, measured_deg - final, measured_deg])
    errors = np.where(record.counts[:, None], np.column_stack([nominal, final]), np.nan)
    names = ["command", "as it was", "with what was found", "measured"]
    recorder.lines(f"{place}/deflection", names, ["command", "fault", "simulated", "measured"])
    recorder.scalars(f"{place}/deflection", record.time_s, deflections)
    recorder.lines(f"{place}/error", _LANES, ["fault", "simulated"])
    recorder.scalars(f"{place}/error", record.time_s, errors)


def _worst(found: Explanation) -> tuple[float, float] | None:
    """Stretch around the second that the servo as it was disagrees with most [s]; None for the whole of a short log."""
    time_s, rows = found.record.time_s, found.record.counts
    if time_s[-1] - time_s[0] <= 2.0 * _AROUND_S or not rows.any():
        return None
    second = np.floor(time_s[rows] - time_s[0]).astype(np.int64)
    power = np.bincount(second, found.selection.nominal.error_deg[rows] ** 2)
    middle_s = float(time_s[0]) + int(power.argmax()) + 0.5
    return max(middle_s - _AROUND_S, float(time_s[0])), min(middle_s + _AROUND_S, float(time_s[-1]))
