"""Verdicts as text that a recording carries, and back: schema servofd.recording/1."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from logparsers.records import Damage, FlightLog
from servofd.aircraft.schema import Aircraft
from servofd.core.errors import RecordingError
from servofd.core.evidence import Detectable, ModelOrigin
from servofd.core.statistics import Estimate
from servofd.detection.verdict import CommonCause, CurrentAudit, Fault, LogAudit, Statistics, SurfaceAudit
from servofd.outputs.json_report import audit_document
from servofd.outputs.recording.content import Recording
from servofd.outputs.recording.stream import shown

SCHEMA = "servofd.recording/1"

LIVE = "recorded in flight"
"""Note of a recording whose verdicts have still to be made."""

MANY_VEHICLES = "servofd.monitor/1"
"""Schema of a recording of several vehicles at once, whose surfaces have no common aircraft."""

_WITHOUT_VERDICTS = {
    MANY_VEHICLES: "several vehicles at once",
    "servofd.explain/1": "servofd explain",
    "servofd.identify/1": "servofd identify",
}


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
