"""The audit as a Rerun recording; the only file that imports rerun.

Entities below ``/surfaces/<name>``: ``deflection`` (command, simulated, measured [deg]), ``residual`` (residual and
both thresholds [deg]), ``flag`` (0 or 1), ``state`` and ``events``; the time line is ``time_boot``.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.detection.words import describe
from servofd.outputs.files import whole_file

if TYPE_CHECKING:
    from pathlib import Path

    from servofd.detection.audit import LogAudit, SurfaceAudit
    from servofd.detection.residual import Residuals
    from servofd.segment import Segment
    from servofd.types import FloatArray

__all__ = ["save_recording"]

_CHUNK_ROWS = 65_536
_TIMELINE = "time_boot"
_RGBA = {"grey": 0x999999FF, "blue": 0x56B4E9FF, "orange": 0xE69F00FF, "red": 0xD55E00FF, "green": 0x009E73FF}


def save_recording(audit: LogAudit, path: Path) -> None:
    """Write everything the audit looked at and found into one .rrd file, with its layout inside.

    Parameters
    ----------
    audit : LogAudit
        Result of an audit.
    path : Path
        File to write.
    """
    import rerun as rr

    name = re.sub(r"[^A-Za-z0-9_ -]", "-", audit.aircraft.name or "plain")[:100]
    with whole_file(path) as temporary, rr.RecordingStream(f"servofd-{name}") as recording:
        rr.set_log_time_enabled(False, recording=recording)
        recording.save(str(temporary), default_blueprint=_blueprint(audit))
        for surface in audit.surfaces:
            _log_surface(recording, surface)
        recording.log("/report", rr.TextDocument(_report(audit), media_type="text/markdown"), static=True)
        recording.send_property(
            "servofd",
            rr.AnyValues(
                source=audit.log.source.name,
                format=audit.log.format,
                faults=sum(len(s.faults) for s in audit.surfaces),
                surfaces=[s.surface for s in audit.surfaces],
            ),
        )


def _log_surface(recording: Any, audit: SurfaceAudit) -> None:  # noqa: ANN401 - rerun is untyped here
    import rerun as rr

    if audit.segment is None or audit.residuals is None or audit.threshold is None:
        return
    place, residuals = f"/surfaces/{audit.surface}", audit.residuals
    _style(recording, f"{place}/deflection", ["command", "simulated", "measured"], ["grey", "blue", "orange"])
    _style(recording, f"{place}/residual", ["residual", "+threshold", "-threshold"], ["green", "red", "red"])
    command_deg = _command_at(audit.segment, residuals)
    judged_deg = np.where(residuals.settled, residuals.residual_deg, np.nan)
    limit_deg = audit.threshold.level_deg
    deflection = np.column_stack([command_deg, residuals.simulated_deg, residuals.measured_deg])
    _send(recording, f"{place}/deflection", residuals.time_s, deflection)
    _send(recording, f"{place}/residual", residuals.time_s, np.column_stack([judged_deg, limit_deg, -limit_deg]))
    flag = np.abs(judged_deg) >= limit_deg
    edges = np.flatnonzero(np.diff(flag, prepend=~flag[0])) if flag.size else np.array([], dtype=int)
    recording.log(f"{place}/flag", rr.SeriesLines(names="alarm", interpolation_mode="StepAfter"), static=True)
    _send(recording, f"{place}/flag", residuals.time_s[edges], flag[edges].astype(float))
    _log_states(recording, place, audit, residuals)


def _log_states(recording: Any, place: str, audit: SurfaceAudit, residuals: Residuals) -> None:  # noqa: ANN401
    """Coloured lane and text for each change of state."""
    import rerun as rr

    states = [(residuals.time_s[0], "OK" if audit.is_judged else "NO DATA")]
    texts = []
    for found, state, level in ((audit.faults, "FAULT", "ERROR"), (audit.suspicions, "SUSPECT", "WARN")):
        for fault in found:
            states.append((fault.alarm_s, state))
            texts.append((fault.alarm_s, level, f"{audit.surface}: {describe(fault)}"))
            if fault.end_s is not None:
                states.append((fault.end_s, "OK"))
                texts.append((fault.end_s, "INFO", f"{audit.surface}: last sign of it"))
    states.sort(key=lambda change: change[0])
    texts.sort(key=lambda text: text[0])
    if not texts:
        texts.append((residuals.time_s[-1], "INFO", f"{audit.surface}: {audit.status}, {audit.reason}"))
    configuration = rr.StateConfiguration(
        values=["OK", "SUSPECT", "FAULT", "NO DATA"],
        labels=["OK", "SUSPECT", "FAULT", "NO DATA"],
        colors=np.array([_RGBA["green"], _RGBA["orange"], _RGBA["red"], _RGBA["grey"]], dtype=np.uint32),
    )
    recording.log(f"{place}/state", configuration, static=True)
    times = [time_s for time_s, _ in states]
    recording.send_columns(
        f"{place}/state",
        [_time_column(np.array(times))],
        rr.StateChange.columns(state=[state for _, state in states]),
    )
    recording.send_columns(
        f"{place}/events",
        [_time_column(np.array([time_s for time_s, _, _ in texts]))],
        rr.TextLog.columns(text=[text for _, _, text in texts], level=[level for _, level, _ in texts]),
    )


def _style(recording: Any, path: str, names: list[str], colours: list[str]) -> None:  # noqa: ANN401
    import rerun as rr

    rgba = np.array([_RGBA[colour] for colour in colours], dtype=np.uint32)
    # MinMax: the default draws a lone spike at half its height.
    recording.log(path, rr.SeriesLines(names=names, colors=rgba, aggregation_policy="MinMax"), static=True)


def _send(recording: Any, path: str, time_s: FloatArray, values: FloatArray) -> None:  # noqa: ANN401
    import rerun as rr

    for begin in range(0, time_s.size, _CHUNK_ROWS):
        rows = slice(begin, begin + _CHUNK_ROWS)
        recording.send_columns(path, [_time_column(time_s[rows])], rr.Scalars.columns(scalars=values[rows]))


def _time_column(time_s: FloatArray) -> Any:  # noqa: ANN401
    import rerun as rr

    # Whole microseconds: floats of seconds would be off by a nanosecond here and there.
    return rr.TimeColumn(_TIMELINE, duration=np.round(time_s * 1e6).astype(np.int64).astype("timedelta64[us]"))


def _command_at(segment: Segment, residuals: Residuals) -> FloatArray:
    """Command that was held at each measurement [deg]."""
    latest = np.searchsorted(segment.command_s, residuals.time_s, side="right") - 1
    held: FloatArray = np.where(latest >= 0, segment.command_deg[np.maximum(latest, 0)], np.nan)
    return held


def _report(audit: LogAudit) -> str:
    rows = "\n".join(f"| {s.surface} | {s.status} | {s.reason.replace('|', chr(92) + '|')} |" for s in audit.surfaces)
    damage = "\n".join(f"- {d.kind}: {d.note}" for d in audit.log.damage) or "none"
    return (
        f"# {audit.log.source.name}\n\n| surface | status | reason |\n|---|---|---|\n{rows}\n\n"
        f"**Damage of the log:** {damage}\n"
    )


def _blueprint(audit: LogAudit) -> Any:  # noqa: ANN401
    import rerun.blueprint as rrb

    shown = [s.surface for s in audit.surfaces if s.residuals is not None]
    lanes = rrb.StateTimelineView(
        origin="/", contents=[f"/surfaces/{name}/state" for name in shown], name="State of each surface"
    )
    events = rrb.TextLogView(origin="/", contents=[f"/surfaces/{name}/events" for name in shown], name="Events")
    report = rrb.TextDocumentView(origin="/report", name="Report")
    overview = rrb.Vertical(lanes, rrb.Horizontal(events, report), name="Overview")
    tabs = [
        rrb.Vertical(
            rrb.TimeSeriesView(origin=f"/surfaces/{name}/deflection", name="Deflection [deg]"),
            rrb.TimeSeriesView(origin=f"/surfaces/{name}/residual", name="Residual and thresholds [deg]"),
            rrb.StateTimelineView(origin=f"/surfaces/{name}/state", name="State"),
            row_shares=[4, 3, 1.4],
            name=name,
        )
        for name in shown
    ]
    panels = [
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=_TIMELINE),
    ]
    return rrb.Blueprint(rrb.Tabs(overview, *tabs), *panels)
