"""An explanation as a Rerun recording: both simulations beside the measurement, and where each disagrees with it.

Entities below ``/surfaces/<name>``: ``deflection`` (command, as it was, with what was found, measured [deg]), ``error``
(before and after [deg]), ``before`` and ``after`` (lanes: seconds that disagree by more than noise) and ``report``.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.discrepancy.locate import bad_seconds
from servofd.outputs.files import whole_file

if TYPE_CHECKING:
    from pathlib import Path

    from servofd.discrepancy.explanation import Explanation
    from servofd.types import FloatArray

__all__ = ["save_explanation"]

_CHUNK_ROWS = 65_536
_TIMELINE = "time_boot"
_GREY, _BLUE, _ORANGE, _RED, _GREEN = 0x999999FF, 0x56B4E9FF, 0xE69F00FF, 0xD55E00FF, 0x009E73FF
_LANES = ("before", "after")
_AGREES, _DIFFERS = "noise only", "disagrees"


def save_explanation(found: Explanation, path: Path, source: str) -> None:
    """Write nominal and extended simulation, residuals and bad blocks into one .rrd file, with its layout inside.

    Parameters
    ----------
    found : Explanation
        What was found.
    path : Path
        File to write.
    source : str
        Where the data came from.
    """
    import rerun as rr

    place = f"/surfaces/{found.surface}"
    name = re.sub(r"[^A-Za-z0-9_ -]", "-", found.surface)[:100]
    with whole_file(path) as temporary, rr.RecordingStream(f"servofd-explain-{name}") as recording:
        rr.set_log_time_enabled(False, recording=recording)
        recording.save(str(temporary), default_blueprint=_blueprint(place))
        _log_curves(recording, place, found)
        _log_lanes(recording, place, found)
        recording.log(
            f"{place}/report", rr.TextDocument(_report(found, source), media_type="text/markdown"), static=True
        )
        recording.send_property(
            "servofd", rr.AnyValues(source=source, surface=found.surface, conclusion=found.conclusion)
        )


def _log_curves(recording: Any, place: str, found: Explanation) -> None:  # noqa: ANN401 - rerun is untyped here
    record, nominal, final = found.record, found.selection.nominal.error_deg, found.selection.final.error_deg
    latest = np.searchsorted(record.commands.effective_s, record.time_s, side="right") - 1
    command_deg = np.where(latest >= 0, record.commands.command_deg[np.maximum(latest, 0)], np.nan)
    measured_deg = record.measured_deg
    deflection = np.column_stack([command_deg, measured_deg - nominal, measured_deg - final, measured_deg])
    errors = np.where(record.counts[:, None], np.column_stack([nominal, final]), np.nan)
    names = ["command", "as it was", "with what was found", "measured"]
    _send(recording, f"{place}/deflection", record.time_s, deflection, names, [_GREY, _RED, _BLUE, _ORANGE])
    _send(recording, f"{place}/error", record.time_s, errors, ["before", "after"], [_RED, _BLUE])


def _log_lanes(recording: Any, place: str, found: Explanation) -> None:  # noqa: ANN401
    import rerun as rr

    lanes = rr.StateConfiguration(
        values=[_AGREES, _DIFFERS],
        labels=[_AGREES, _DIFFERS],
        colors=np.array([_GREEN, _RED], dtype=np.uint32),
    )
    for lane, fit in zip(_LANES, (found.selection.nominal, found.selection.final), strict=True):
        changes = {float(found.record.time_s[0]): _AGREES}
        for begin_s, end_s in bad_seconds(found.record, fit.error_deg, found.selection.sigma_deg):
            changes |= {begin_s: _DIFFERS, end_s: _AGREES}
        recording.log(f"{place}/{lane}", lanes, static=True)
        times = _time_column(np.array(sorted(changes)))
        states = [changes[time_s] for time_s in sorted(changes)]
        recording.send_columns(f"{place}/{lane}", [times], rr.StateChange.columns(state=states))


def _send(
    recording: Any,  # noqa: ANN401
    path: str,
    time_s: FloatArray,
    values: FloatArray,
    names: list[str],
    colours: list[int],
) -> None:
    import rerun as rr

    # MinMax: the default draws a lone spike at half its height.
    style = rr.SeriesLines(names=names, colors=np.array(colours, dtype=np.uint32), aggregation_policy="MinMax")
    recording.log(path, style, static=True)
    for begin in range(0, time_s.size, _CHUNK_ROWS):
        rows = slice(begin, begin + _CHUNK_ROWS)
        recording.send_columns(path, [_time_column(time_s[rows])], rr.Scalars.columns(scalars=values[rows]))


def _time_column(time_s: FloatArray) -> Any:  # noqa: ANN401
    import rerun as rr

    # Whole microseconds: floats of seconds would be off by a nanosecond here and there.
    return rr.TimeColumn(_TIMELINE, duration=np.round(time_s * 1e6).astype(np.int64).astype("timedelta64[us]"))


def _report(found: Explanation, source: str) -> str:
    document = found.document()
    rows = [("as it was", document["nominal"])]
    rows += [(f"+ {step['effect']} {step['form'] or ''}", step) for step in document["steps"]]
    table = "\n".join(f"| {name} | {e['train_rms_deg']:.4f} | {e['held_out_rms_deg']:.4f} |" for name, e in rows)
    where = "\n".join(f"- {sentence.replace('|', chr(92) + '|')}" for sentence in document["where"])
    notes = "\n".join(f"- {note}" for note in document["notes"])
    return (
        f"# {source}: {found.surface}: {found.conclusion.replace('_', ' ')}\n\n{where}\n\n"
        f"| model | fitted [deg rms] | held out [deg rms] |\n|---|---|---|\n{table}\n\n"
        f"Noise floor: {document['noise_floor_rms_deg']:.3g} deg\n\n{notes}\n"
    )


def _blueprint(place: str) -> Any:  # noqa: ANN401
    import rerun.blueprint as rrb

    lanes = rrb.StateTimelineView(
        origin="/", contents=[f"{place}/{lane}" for lane in _LANES], name="Seconds that disagree by more than noise"
    )
    curves = rrb.Vertical(
        rrb.TimeSeriesView(origin=f"{place}/deflection", name="Deflection [deg]"),
        rrb.TimeSeriesView(origin=f"{place}/error", name="Measured minus simulated [deg]"),
        lanes,
        row_shares=[4, 3, 1.6],
        name="Curves",
    )
    report = rrb.TextDocumentView(origin=f"{place}/report", name="Report")
    panels = [
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=_TIMELINE),
    ]
    return rrb.Blueprint(rrb.Tabs(curves, report), *panels)
