"""A recording read back without its log: whether its curves fit its verdicts, and what a monitor saw, judged."""

from __future__ import annotations

import tempfile
import warnings
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from rerun.chunk import RrdReader

from logparsers.detect import RECORDING
from servofd.aircraft.series import is_streamed
from servofd.core.errors import RecordingError
from servofd.core.files import beginning
from servofd.core.types import FloatArray, IntArray
from servofd.current.audit import again_by_current
from servofd.detection.audit import audit_segment
from servofd.detection.verdict import WITHIN_SIGMAS, CurrentAudit, Statistics
from servofd.outputs.recording.content import LIVE, Recording, Trace, audit_of
from servofd.outputs.recording.stream import PROPERTIES, TIME_BOOT, seconds, surface_place
from servofd.outputs.recording.surface import AIRSPEED, SUPPLY
from servofd.outputs.recording.viewer import run_rerun
from servofd.servo.context import Context

_CURVES = "Scalars:scalars"
_PROPERTIES = f"/__properties/{PROPERTIES}"
_KEPT = ("deflection", "residual", "command", "seconds", "command_seconds", "current")
_PANICS = (101, 102)
"""Exit codes of a Rust program, and of Rerun's, that came to its wits' end."""


def read_recording(path: str | Path) -> Recording:
    """Read what an audit wrote, complete or left behind by a process that was killed: every value as it was audited."""
    stored = _Stored.of(Path(path))
    if not stored.properties:
        what = "not a recording of servofd" if stored.entities else "an empty recording"
        raise RecordingError(f"{path}: {what}; 'servofd audit LOG --rrd FILE' writes one")
    audit, notes = audit_of(stored.properties, Path(path).name)
    columns: list[FloatArray] = []  # airspeed and supply, as far as they were recorded
    for place in (AIRSPEED, SUPPLY):
        time_s, values = stored.curves(place, f"{place}/seconds") or (np.zeros(0), np.zeros((0, 1)))
        columns += [time_s, values[:, 0]]
    context = Context(*columns)
    found = ((one.surface, _trace(stored, one.surface, context)) for one in audit.surfaces)
    traces = {name: trace for name, trace in found if trace is not None}
    surfaces = tuple(replace(s, current=s.current and _drawn(stored, s.surface, s.current)) for s in audit.surfaces)
    return Recording(replace(audit, surfaces=surfaces), traces, notes, context=context)


@dataclass(frozen=True, slots=True)
class _Stored:
    """Curves and properties of a file, as they are stored."""

    properties: Mapping[str, Any]
    entities: frozenset[str]
    chunks: Mapping[str, list[tuple[IntArray, FloatArray]]] = field(repr=False)
    """By entity: times [us] and values of shape (n, k)."""

    @classmethod
    def of(cls, path: Path) -> _Stored:
        """Read all of it; of a file that was cut short or damaged what is whole, which the viewer's program saves."""
        if not is_recording(path):  # what is none at all Rerun does not look at
            if path.stat().st_size == 0:
                raise RecordingError(f"{path}: the file is empty; 'servofd audit LOG --rrd FILE' writes a recording")
            raise RecordingError(f"{path}: not a Rerun recording (.rrd); logs are for 'servofd audit'")
        # Another process reads it first: at some damage, as at a NUL in the name of a column, Rerun's library ends the
        # process that it is in.
        met = run_rerun("rrd", "print", "-vv", str(path.resolve()))
        if met.returncode < 0 or met.returncode in _PANICS or "\0" in met.stdout:
            raise RecordingError(f"{path}: damaged beyond what Rerun's library can read")
        try:
            return cls._of(path)
        except (ValueError, RuntimeError, OSError) as error:
            if "No recording store" in str(error):
                return cls({}, frozenset(), {})
        with tempfile.TemporaryDirectory(prefix="servofd-") as folder:
            saved = Path(folder) / "saved.rrd"
            # Only that program may go on after an error; its Python interface stops at it.
            run_rerun("rrd", "optimize", "--continue-on-error", str(path.resolve()), "-o", str(saved))
            try:
                return cls._of(saved)
            except (ValueError, RuntimeError, OSError):
                raise RecordingError(f"{path}: cut short or damaged, and nothing of it can be read") from None

    @classmethod
    def _of(cls, path: Path) -> _Stored:
        properties: dict[str, Any] = {}
        entities = set()
        chunks: dict[str, list[tuple[IntArray, FloatArray]]] = defaultdict(list)
        with warnings.catch_warnings():  # one that a killed process left has no index, and is read from front to back
            warnings.filterwarnings("ignore", message="RRD file has no footer")
            reader = RrdReader(str(path))
        if len(recordings := reader.recordings()) > 1:
            raise RecordingError(
                f"{path}: holds {len(recordings)} recordings, and one is judged at a time; "
                "'servofd audit LOG --rrd FILE' writes one for each log"
            )
        for chunk in reader.stream():
            entities.add(chunk.entity_path)
            if chunk.entity_path == _PROPERTIES:
                properties |= _values(chunk)
            elif (curve := _curve(chunk)) is not None:
                chunks[chunk.entity_path].append(curve)
        return cls(properties, frozenset(entities), chunks)

    def curves(self, place: str, exact: str = "") -> tuple[FloatArray, FloatArray] | None:
        """Times [s] and values of shape (n, k) of one entity, in order of time.

        An entity `exact` has the times to the last bit, where they are no whole microseconds; unless it is damaged.
        """
        parts = self.chunks.get(place)
        if not parts:
            return None
        time_us = np.concatenate([part[0] for part in parts])
        values = np.concatenate([part[1] for part in parts])
        if np.any(np.diff(time_us) < 0):
            order = np.argsort(time_us, kind="stable")
            time_us, values = time_us[order], values[order]
        # Rows that only break the curve follow a sample by one microsecond.
        broken = (np.diff(time_us, prepend=np.int64(0)) == 1) & np.all(np.isnan(values), axis=1)
        if broken.any():
            time_us, values = time_us[~broken], values[~broken]
        time_s, stamps = seconds(time_us), self.curves(exact)
        if stamps is not None and len(stamps[1]) == len(time_s) and np.all(np.abs(stamps[1][:, 0] - time_s) < 1e-6):
            time_s = stamps[1][:, 0]
        return time_s, values


def is_recording(path: Path) -> bool:
    """Whether a file begins as Rerun's recordings do."""
    try:
        return beginning(path, 4).startswith(RECORDING)
    except OSError as error:
        raise RecordingError(f"{path}: cannot read this file: {error.strerror}") from None


def _curve(chunk: Any) -> tuple[IntArray, FloatArray] | None:  # noqa: ANN401 - rerun is untyped here
    """Times [us] and values of a chunk of a curve that is read back; None of any other."""
    place = chunk.entity_path
    kept = place.startswith("/flight/") or (place.startswith("/surfaces/") and place.rsplit("/", 1)[-1] in _KEPT)
    batch = chunk.to_record_batch() if kept and not chunk.is_static else None
    if batch is None or not {_CURVES, TIME_BOOT} <= set(batch.schema.names):
        return None
    time_ns = batch.column(TIME_BOOT).to_numpy(zero_copy_only=False).astype(np.int64)
    cells = batch.column(_CURVES)
    values = cells.flatten().to_numpy(zero_copy_only=False)
    return time_ns // 1000, values.reshape(len(cells), -1)


def _values(chunk: Any) -> dict[str, Any]:  # noqa: ANN401
    """Properties by name; lists of one value as that value."""
    batch = chunk.to_record_batch()
    found = {}
    for name in batch.schema.names:
        cells = batch.column(name).to_pylist()
        if cells and isinstance(cells[-1], list):
            found[name.rsplit(":", 1)[-1]] = cells[-1][0] if len(cells[-1]) == 1 else cells[-1]
    return found


def _drawn(stored: _Stored, surface: str, current: CurrentAudit) -> CurrentAudit:
    """The verdict of a current, with its curves."""
    found, asked = (stored.curves(surface_place(surface, name)) for name in ("current", "command"))
    if found is None:
        return current
    time_s, (drawn_a, healthy_a, high_a, _) = found[0], found[1].T
    command, sigma_a = asked and (asked[0], asked[1][:, 0]), (high_a - healthy_a) / WITHIN_SIGMAS
    return replace(current, time_s=time_s, current_a=drawn_a, healthy_a=healthy_a, sigma_a=sigma_a, command=command)


def _trace(stored: _Stored, surface: str, context: Context) -> Trace | None:
    deflection = stored.curves(surface_place(surface, "deflection"), surface_place(surface, "seconds"))
    residual = stored.curves(surface_place(surface, "residual"))
    if deflection is None or residual is None:
        return None
    (time_s, shown), judged = deflection, residual[1]
    asked = stored.curves(surface_place(surface, "command"), surface_place(surface, "command_seconds")) or deflection
    rows = min(len(time_s), len(judged))  # a recording that was cut short may lack the last of them
    (command, simulated, measured), (residual_deg, level_deg) = shown[:rows, :3].T, judged[:rows, :2].T
    curves = (time_s[:rows], command, simulated, measured, residual_deg, level_deg)
    return Trace(*curves, asked[0], asked[1][:, 0], context=context)


def statistics_of(trace: Trace) -> Statistics | None:
    """Size of the residual while it was judged, from the recorded curves; None if it never was."""
    judged = np.isfinite(trace.residual_deg)
    if not judged.any():
        return None
    with np.errstate(over="ignore", invalid="ignore"):  # of a damaged recording
        error_deg = (trace.measured_deg - trace.simulated_deg)[judged]
    return Statistics.of(trace.residual_deg[judged], error_deg)


def contradictions(recording: Recording) -> list[str]:
    """One sentence for each surface whose recorded curves are not the ones that were judged.

    Statistics are computed from the curves in the same way as by the audit, so that they agree to the last bit, or
    the recording is incomplete, or was altered.
    """
    found, other = [], "the verdict was made from other curves than are recorded here"
    for surface in recording.audit.surfaces:
        trace = recording.traces.get(surface.surface)
        now = None if trace is None else statistics_of(trace)
        if surface.statistics is not None and now != surface.statistics:
            until = f"end at {trace.time_s[-1]:.2f} s" if trace is not None and trace.time_s.size else "are missing"
            found.append(f"{surface.surface}: {other} (they {until}): incomplete or altered")
    return found


def rejudged(recording: Recording) -> Recording:
    """Judge the recorded commands, and deflections or currents, of a monitor, as an audit of the log would.

    The recording has the aircraft's models and tolerances, so that new alarms get names as well.
    """
    audit = recording.audit
    audit = replace(audit, log=replace(audit.log, span_s=(recording.start_s, recording.end_s)))
    surfaces, duration_s = [], audit.log.duration_s
    for surface in audit.surfaces:
        trace, known = recording.traces.get(surface.surface), audit.aircraft.surfaces[surface.surface]
        if trace is not None and trace.time_s.size > 1:
            streamed = is_streamed(audit.log.format, known.command.channel)
            segment = trace.segment(surface.surface, known.command_period_s, is_streamed=streamed)
            judged = audit_segment(segment, audit.aircraft, duration_s=duration_s, expected=surface.expected)
            is_drawn = surface.current is not None and surface.current.time_s is not None
            surface = replace(judged, current=surface.current if is_drawn else None)  # noqa: PLW2901 - judged again
        surfaces.append(again_by_current(surface, audit.aircraft, recording.context, duration_s))
    again = Recording.of(replace(audit, surfaces=tuple(surfaces)))
    notes = (*(n for n in recording.notes if n != LIVE), "judged again, by the recorded threshold")
    return Recording(replace(again.audit, log=audit.log), {**recording.traces, **again.traces}, notes)
