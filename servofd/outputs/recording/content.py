"""What a recording holds, on its way into a file and back: curves, and verdicts as schema servofd.recording/1."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from pydantic import ValidationError

from logparsers.records import Damage, FlightLog
from servofd.aircraft.pace import WARM_UP_STEPS, link_period_s
from servofd.aircraft.schema import Aircraft
from servofd.aircraft.series import LeftOut, Series
from servofd.core.errors import RecordingError
from servofd.core.evidence import Detectable, ModelOrigin
from servofd.core.series import latest
from servofd.core.statistics import Estimate
from servofd.core.types import BoolArray, FloatArray
from servofd.detection.verdict import CommonCause, CurrentAudit, Fault, LogAudit, Statistics, SurfaceAudit
from servofd.onboard.seen import Seen, seen_of
from servofd.outputs.json_report import audit_document
from servofd.outputs.recording.stream import shown
from servofd.servo.context import NO_CONTEXT, Context


class Trace(NamedTuple):
    """Curves of one surface; all but the commands of shape (n,), one entry per measurement, NaN where unknown."""

    time_s: FloatArray
    command_deg: FloatArray
    simulated_deg: FloatArray
    """What a healthy servo does."""
    measured_deg: FloatArray
    residual_deg: FloatArray
    """NaN where it was not judged."""
    threshold_deg: FloatArray
    asked_s: FloatArray
    asked_deg: FloatArray
    """Each command on its own time stamp, shape (m,)."""
    left_out: tuple[LeftOut, ...] = ()
    context: Context = NO_CONTEXT

    @classmethod
    def of(cls, surface: SurfaceAudit) -> Self | None:
        """Curves that an audit judged; None if it had none."""
        segment, residuals = surface.segment, surface.residuals
        if segment is None or residuals is None:
            return None
        time_s = residuals.time_s
        asked_deg = held(segment.command_s, segment.command_deg, time_s)
        threshold_deg = np.full(time_s.size, np.nan) if surface.threshold is None else surface.threshold.level_deg
        residual_deg = np.where(residuals.settled, residuals.residual_deg, np.nan)
        curves = (time_s, asked_deg, residuals.simulated_deg, residuals.measured_deg, residual_deg, threshold_deg)
        return cls(*curves, segment.command_s, segment.command_deg, segment.left_out, segment.context)

    def segment(self, surface: str, command_period_s: float | None = None, *, is_streamed: bool = False) -> Series:
        """What an audit starts from, see `Series`: as of a log, without commands that are no numbers or come again."""
        given, seen = np.isfinite(self.asked_deg) & _rising(self.asked_s), _rising(self.time_s)
        asked, measured = (self.asked_s[given], self.asked_deg[given]), (self.time_s[seen], self.measured_deg[seen])
        link_s = link_period_s(asked[0][: WARM_UP_STEPS + 1]) if is_streamed else None
        return Series(surface, *asked, *measured, command_period_s, context=self.context, sent_period_s=link_s)


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """An audit, and the curves that it judged."""

    audit: LogAudit
    """Its log has no channels any more."""
    traces: Mapping[str, Trace]
    """By name of the surface; those without a residual have none."""
    notes: tuple[str, ...] = ()
    """What a reader of the recording should know: that it was cut, or judged anew."""
    on_board: Mapping[str, Seen] = field(default_factory=dict)
    """What a script on the autopilot saw of each surface that it watched; a recording read back has none."""
    context: Context = NO_CONTEXT
    """Airspeed and supply of a recording read back."""

    @classmethod
    def of(cls, audit: LogAudit) -> Self:
        """Everything of an audit that a recording tells; nothing that tells where on a machine its log was."""
        log = audit.log
        bare = replace(log, source=Path(log.source.name), channels={}, span_s=log.ends_s)
        traces = {s.surface: trace for s in audit.surfaces if (trace := Trace.of(s)) is not None}
        return cls(replace(audit, log=bare), traces, on_board=seen_of(log, audit.aircraft))

    @property
    def end_s(self) -> float:
        """Last time of all curves [s]."""
        return max((float(time_s[-1]) for time_s in self._times()), default=0.0)

    @property
    def start_s(self) -> float:
        """First time of all curves [s]."""
        return min((float(time_s[0]) for time_s in self._times()), default=0.0)

    def _times(self) -> list[FloatArray]:
        """Time stamps of all curves that hold any [s]."""
        found = [trace.time_s for trace in self.traces.values()]
        found += [s.current.time_s for s in self.audit.surfaces if s.current and s.current.time_s is not None]
        return [time_s for time_s in found if time_s.size]


def held(command_s: FloatArray, command_deg: FloatArray, time_s: FloatArray) -> FloatArray:
    """The last command before each time; NaN before the first."""
    if not command_s.size:
        return np.full(time_s.size, np.nan)
    return np.where(time_s >= command_s[0], latest(command_s, command_deg, time_s), np.nan)


def _rising(time_s: FloatArray) -> BoolArray:
    """Samples later than all before them: in a damaged recording some are not."""
    return time_s > np.concatenate([[-np.inf], np.maximum.accumulate(time_s)[:-1]])


SCHEMA = "servofd.recording/1"

LIVE = "recorded in flight"
"""Note of a recording whose verdicts have still to be made."""

MANY_VEHICLES = "servofd.monitor/1"
"""Schema of a recording of several vehicles at once, whose surfaces have no common aircraft."""

_WITHOUT_VERDICTS = {MANY_VEHICLES: "several vehicles at once", "servofd.explain/1": "servofd explain"}


_AS_IT_IS = ("status", "reason", "servo", "expected", "false_alarms_per_hour", "judged_share")
"""Fields of a surface that its verdict holds under the same names."""


def verdicts_of(recording: Recording) -> dict[str, Any]:
    """Properties of a recording: few words for people, and everything an audit found for machines."""
    from servofd.version import __version__

    audit, log = recording.audit, recording.audit.log
    (document,) = audit_document([audit])["logs"]
    for surface in audit.surfaces:
        entry, trace = document["surfaces"][surface.surface], recording.traces.get(surface.surface)
        entry |= {"expected": surface.expected}
        if trace is not None:  # for who reads the file with other programs
            entry |= {"left_out": trace.left_out}
    document |= {"vehicle": log.vehicle, "firmware": log.firmware, "span_s": log.span_s, "notes": recording.notes}
    # The aircraft without the words on where its servos were identified, which may name files.
    servos = {key: servo.model_copy(update={"source": "recorded"}) for key, servo in audit.aircraft.servos.items()}
    models = audit.aircraft.model_copy(update={"servos": servos}).model_dump(mode="json", exclude_none=True)
    return {
        "schema": SCHEMA,
        "version": __version__,
        "source": shown(log.source.name),
        "format": log.format,
        "vehicle": shown(log.vehicle),
        "aircraft": shown(audit.aircraft.name),
        "faults": sum(len(s.faults) for s in audit.surfaces),
        "surfaces": [shown(s.surface) for s in audit.surfaces],
        "statuses": [s.status for s in audit.surfaces],
        "verdicts": json.dumps(document),
        "models": json.dumps(models),  # in ASCII: the viewer cannot draw every letter
    }


def live_verdicts(aircraft: Aircraft, surfaces: Sequence[str], name: str) -> dict[str, Any]:
    """Properties of a recording that is still being made: the models, and no verdict yet."""
    watched, reason = [], "nothing of it was recorded"
    for key in surfaces:
        one = aircraft.surfaces[key]
        threshold, expected = (one.threshold, one.threshold_deg), one.measured is not None
        current = CurrentAudit("unknown", reason) if one.is_told_by_current or one.beside_channel else None
        watched.append(
            SurfaceAudit(key, "no_data", reason, one.servo, *threshold, expected, model=one.model, current=current)
        )
    log = FlightLog(Path(name), "live", {}, span_s=(0.0, 0.0))
    return verdicts_of(Recording(LogAudit(log, aircraft, tuple(watched)), {}, notes=(LIVE,)))


def audit_of(properties: Mapping[str, Any], name: str) -> tuple[LogAudit, tuple[str, ...]]:
    """Verdicts of a recording, and what its reader should know."""
    schema = properties.get("schema")
    if isinstance(schema, str) and schema in _WITHOUT_VERDICTS:
        what = f"a recording of {_WITHOUT_VERDICTS[schema]}"
        raise RecordingError(f"{name}: {what}: no verdicts to review; 'servofd review --view' shows it")
    if schema != SCHEMA:
        wrote = f"schema {schema}" if schema else "an older servofd, without a schema"
        raise RecordingError(f"{name}: written by {wrote}; this one reads {SCHEMA}: audit the log again with --rrd")
    try:
        document = json.loads(properties["verdicts"])
        aircraft = Aircraft.model_validate_json(properties["models"])
        surfaces = tuple(_surface(*entry) for entry in document["surfaces"].items())
        shared = document.get("common_causes", ())
        causes = tuple(CommonCause(**one | {"surfaces": tuple(one["surfaces"])}) for one in shared)
        return LogAudit(_log(document), aircraft, surfaces, common_causes=causes), tuple(document["notes"])
    except (KeyError, TypeError, ValueError, ValidationError) as error:
        why = f"its verdicts cannot be read ({type(error).__name__}); audit the log again"
        raise RecordingError(f"{name}: {why}") from None


def _log(document: Mapping[str, Any]) -> FlightLog:
    return FlightLog(
        Path(document["path"]),
        document["format"],
        channels={},
        damage=tuple(Damage(**damage) for damage in document["damage"]),
        run=document["run"] or "",
        start_utc=datetime.fromisoformat(document["start_utc"]) if document["start_utc"] else None,
        span_s=tuple(document["span_s"]),
        **{name: document[name] for name in ("vehicle", "firmware")},
    )


def _surface(name: str, entry: Mapping[str, Any]) -> SurfaceAudit:
    sizes = dict(entry["residual"] or {})
    outline = tuple(sizes.pop("outline", ()))
    return SurfaceAudit(
        surface=name,
        **{key: entry[key] for key in _AS_IT_IS},
        threshold_kind=entry["threshold"]["kind"],
        threshold_deg=entry["threshold"]["deg"],
        tried=entry.get("tried", True),
        faults=tuple(map(_fault, entry["faults"])),
        suspicions=tuple(map(_fault, entry["suspicions"])),
        statistics=Statistics(**sizes, simulation_error_rms_deg=entry["simulation_error_rms_deg"]) if sizes else None,
        model=ModelOrigin.model_validate(entry["model"]),
        detectable=Detectable.from_document(entry["detectable"]),
        outline=outline,
        current=_current(entry),
    )


def _current(entry: Mapping[str, Any]) -> CurrentAudit | None:
    """The verdict of a current; its curves are read with the others."""
    if "current" not in entry:
        return None
    known: dict[str, Any] = {}
    for which in ("faults", "suspicions"):
        each = map(_fault, entry[which])
        by_current = (fault if fault.witness == "current" else fault.confirmed_by for fault in each)
        known[which] = tuple(fault for fault in by_current if fault is not None)
    names = ("status", "reason", "explained_share", "ratio_to_good", "judged_share")
    return CurrentAudit(**{name: entry["current"][name] for name in names}, **known)


def _fault(entry: Mapping[str, Any]) -> Fault:
    return Fault(
        **{name: entry[name] for name in ("kind", "start_s", "alarm_s", "end_s", "probability", "level", "named_s")},
        parameters={k: Estimate(v, *entry["intervals"][k]) for k, v in entry["parameters"].items()},
        alternatives=tuple(entry["alternatives"]),
        witness=entry.get("witness", "position"),
        is_of_sensor=entry.get("is_of_sensor", False),
        confirmed_by=_fault(entry["confirmed_by"]) if entry.get("confirmed_by") else None,
    )
