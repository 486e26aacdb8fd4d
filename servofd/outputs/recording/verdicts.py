"""Verdicts as text that a recording carries, and back: schema servofd.recording/1."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pydantic import ValidationError

from logparsers.records import Damage, FlightLog
from servofd.aircraft.schema import Aircraft
from servofd.aircraft.series import LeftOut
from servofd.core.errors import RecordingError
from servofd.core.evidence import Detectable, ModelOrigin
from servofd.core.statistics import Estimate
from servofd.detection.verdict import CommonCause, CurrentAudit, Fault, LogAudit, Statistics, SurfaceAudit
from servofd.outputs.json_report import audit_document
from servofd.outputs.recording.stream import shown

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servofd.outputs.recording.content import Recording

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


class Verdicts(NamedTuple):
    """What the properties of a recording tell."""

    audit: LogAudit
    notes: tuple[str, ...]
    left_out: Mapping[str, tuple[LeftOut, ...]]
    """By surface: stretches that do not count, and why."""


def verdicts_of(recording: Recording) -> dict[str, Any]:
    """Properties of a recording: few words for people, and everything an audit found for machines."""
    from servofd.version import __version__

    audit, log = recording.audit, recording.audit.log
    (document,) = audit_document([audit])["logs"]
    for surface in audit.surfaces:
        entry, trace = document["surfaces"][surface.surface], recording.traces.get(surface.surface)
        entry |= {"expected": surface.expected}
        if trace is not None:
            entry |= {"left_out": trace.left_out}
    document |= {"vehicle": log.vehicle, "firmware": log.firmware, "span_s": log.span_s, "notes": recording.notes}
    document["start_utc"] = log.start_utc.isoformat() if log.start_utc else None
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
        "models": _models(audit.aircraft),
    }


def live_verdicts(aircraft: Aircraft, surfaces: Sequence[str], name: str) -> dict[str, Any]:
    """Properties of a recording that is still being made: the models, and no verdict yet."""
    from servofd.outputs.recording.content import Recording

    watched = tuple(
        SurfaceAudit(
            surface=key,
            status="no_data",
            reason="nothing of it was recorded",
            servo=aircraft.surfaces[key].servo,
            threshold_kind=aircraft.surfaces[key].threshold,
            threshold_deg=aircraft.surfaces[key].threshold_deg,
            expected=aircraft.surfaces[key].measured is not None,
            model=aircraft.surfaces[key].model,
        )
        for key in surfaces
    )
    log = FlightLog(Path(name), "live", {}, span_s=(0.0, 0.0))
    return verdicts_of(Recording(LogAudit(log, aircraft, watched), {}, notes=(LIVE,)))


def audit_of(properties: Mapping[str, Any], name: str) -> Verdicts:
    """Verdicts of a recording, and what its reader should know."""
    schema = properties.get("schema")
    if isinstance(schema, str) and schema in _WITHOUT_VERDICTS:
        raise RecordingError(
            f"{name}: a recording of {_WITHOUT_VERDICTS[schema]}: no verdicts to review; "
            "'servofd review --view' shows it"
        )
    if schema != SCHEMA:
        wrote = f"schema {schema}" if schema else "an older servofd, without a schema"
        raise RecordingError(f"{name}: written by {wrote}; this one reads {SCHEMA}: audit the log again with --rrd")
    try:
        document = json.loads(properties["verdicts"])
        aircraft = Aircraft.model_validate_json(properties["models"])
        surfaces = tuple(_surface(key, entry) for key, entry in document["surfaces"].items())
        left_out = {
            key: tuple(LeftOut(*each) for each in entry.get("left_out", ()))
            for key, entry in document["surfaces"].items()
        }
        causes = tuple(
            CommonCause(**{**one, "surfaces": tuple(one["surfaces"])}) for one in document.get("common_causes", ())
        )
        audit = LogAudit(_log(document), aircraft, surfaces, common_causes=causes)
        return Verdicts(audit, tuple(document["notes"]), left_out)
    except (KeyError, TypeError, ValueError, ValidationError) as error:
        raise RecordingError(
            f"{name}: its verdicts cannot be read ({type(error).__name__}); audit the log again"
        ) from None


def _models(aircraft: Aircraft) -> str:
    """The aircraft, without the words on where its servos were identified: those may name files."""
    servos = {key: servo.model_copy(update={"source": "recorded"}) for key, servo in aircraft.servos.items()}
    # In ASCII: the viewer cannot draw every letter.
    return json.dumps(aircraft.model_copy(update={"servos": servos}).model_dump(mode="json", exclude_none=True))


def _log(document: Mapping[str, Any]) -> FlightLog:
    return FlightLog(
        source=Path(document["path"]),
        format=document["format"],
        channels={},
        damage=tuple(Damage(**damage) for damage in document["damage"]),
        run=document["run"] or "",
        vehicle=document["vehicle"],
        firmware=document["firmware"],
        start_utc=datetime.fromisoformat(document["start_utc"]) if document["start_utc"] else None,
        span_s=tuple(document["span_s"]),
    )


def _surface(name: str, entry: Mapping[str, Any]) -> SurfaceAudit:
    statistics = entry["residual"]
    if statistics is not None:
        statistics = Statistics(
            statistics["mean_deg"],
            statistics["std_deg"],
            statistics["max_abs_deg"],
            entry["simulation_error_rms_deg"],
        )
    return SurfaceAudit(
        surface=name,
        status=entry["status"],
        reason=entry["reason"],
        servo=entry["servo"],
        threshold_kind=entry["threshold"]["kind"],
        threshold_deg=entry["threshold"]["deg"],
        expected=entry["expected"],
        tried=entry.get("tried", True),
        faults=tuple(_fault(fault) for fault in entry["faults"]),
        suspicions=tuple(_fault(fault) for fault in entry["suspicions"]),
        statistics=statistics,
        false_alarms_per_hour=entry["false_alarms_per_hour"],
        model=ModelOrigin.model_validate(entry["model"]),
        detectable=Detectable.from_document(entry["detectable"]),
        judged_share=entry["judged_share"],
        outline=tuple(entry["residual"].get("outline", ())) if entry["residual"] else (),
        current=_current(entry),
    )


def _current(entry: Mapping[str, Any]) -> CurrentAudit | None:
    """The verdict of a current; its curves are read with the others."""
    if "current" not in entry:
        return None
    current = entry["current"]
    faults, suspicions = (
        tuple(fault for one in entry[which] if (fault := _by_current(_fault(one))) is not None)
        for which in ("faults", "suspicions")
    )
    return CurrentAudit(
        current["status"],
        current["reason"],
        current["explained_share"],
        current["ratio_to_good"],
        faults,
        suspicions,
        judged_share=current["judged_share"],
    )


def _by_current(fault: Fault) -> Fault | None:
    return fault if fault.witness == "current" else fault.confirmed_by


def _fault(entry: Mapping[str, Any]) -> Fault:
    parameters = {k: Estimate(v, *entry["intervals"][k]) for k, v in entry["parameters"].items()}
    return Fault(
        entry["kind"],
        entry["start_s"],
        entry["alarm_s"],
        entry["end_s"],
        parameters,
        entry["probability"],
        tuple(entry["alternatives"]),
        entry["level"],
        entry["named_s"],
        entry.get("witness", "position"),
        _fault(entry["confirmed_by"]) if entry.get("confirmed_by") else None,
    )
