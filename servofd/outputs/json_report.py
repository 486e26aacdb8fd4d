"""The audit as JSON, schema servofd.audit/1."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from logparsers.records import FlightLog
from servofd.aircraft.axes import MOST_OF_THE_FLIGHT
from servofd.aircraft.series import take_off_s
from servofd.detection.verdict import Fault, LogAudit, SurfaceAudit
from servofd.jobs.workflow import FailedLog
from servofd.outputs.sentence import whole_sentence

if TYPE_CHECKING:
    from servofd.axes.verdict import AxisAudit, AxisEvent
    from servofd.flight.change import AxisChange
    from servofd.flight.judge import FlightAlone


_OF_FAULT = ("kind", "level", "start_s", "alarm_s", "end_s", "probability", "named_s", "witness")


def audit_document(results: Sequence[LogAudit | FailedLog]) -> dict[str, Any]:
    """Everything an audit found, as plain dictionaries and lists."""
    return {"schema": "servofd.audit/1", "logs": [_log(result) for result in results]}


def worst_outline(document: dict[str, Any]) -> tuple[str, list[float | None]]:
    """The worst surface or axis of a log, of several the nearest to its threshold or furthest over it; its outline."""
    entries = document["surfaces"] | document.get("axes", {})
    outlines = {name: (one.get("residual") or one).get("outline") or [] for name, one in entries.items()}

    def gravity(name: str) -> tuple[int, float]:
        most = max((share or 0.0 for share in outlines[name]), default=-1.0)
        return {"fault": 2, "suspect": 1}.get(entries[name]["status"], 0) * bool(outlines[name]), most

    name = max(outlines, key=gravity, default="")
    return (name, outlines[name]) if outlines.get(name) else ("", [])


def to_json(document: Mapping[str, Any]) -> str:
    """Text of a document; values that JSON cannot hold (NaN, infinity) become null."""
    return json.dumps(finite(document), indent=2, allow_nan=False) + "\n"


def _log(result: LogAudit | FailedLog) -> dict[str, Any]:
    if isinstance(result, FailedLog):
        known: dict[str, Any] = {"path": result.path, "format": None, "duration_s": None, "damage": []}
        if result.log is not None:
            known |= _about(result.log) | {"path": result.path}
        alone = {} if result.flight is None else {"sentence": result.flight.sentence, "flight": _flight(result.flight)}
        return {**known, "error": result.error, "surfaces": {}, **alone}
    return {
        **_about(result.log),
        "error": None,
        "sentence": whole_sentence(result),
        "common_causes": [asdict(cause) for cause in result.common_causes],
        "surfaces": {surface.surface: _surface(surface) for surface in result.surfaces},
        "axes": {axis.axis: _axis(axis) for axis in result.axes},
    }


def _about(log: FlightLog) -> dict[str, Any]:
    """What is known of a log before anything is judged."""
    return {
        "path": str(log.source),
        "run": log.run or None,
        "format": log.format,
        "start_utc": log.start_utc.isoformat() if log.start_utc else None,
        "duration_s": log.duration_s,
        "take_off_s": take_off_s(log),
        "damage": [asdict(damage) for damage in log.damage_summary],
    }


_OF_CHANGE = ("alarm_s", "explained_share", "judged_share", "judged_from_s", "judged_until_s", "since_s", "status")
_OF_AXIS = ("status", "reason", "since_s", "false_alarms_per_hour", "judged_share")
_OF_CURRENT = ("status", "reason", "explained_share", "ratio_to_good", "since_s", "judged_share")
_OF_EVENT = ("start_s", "alarm_s", "end_s", "from_start")
_OF_STATISTICS = ("mean_deg", "std_deg", "max_abs_deg")
_OF_SURFACE = ("status", "reason", "servo", "judged_share", "false_alarms_per_hour", "feedback", "tried")


def _named(of: object, names: Sequence[str]) -> dict[str, Any]:
    return {name: getattr(of, name) for name in names}


def _flight(flight: FlightAlone) -> dict[str, Any]:
    return {
        "checks": [{"name": check.name, **asdict(check)} for check in flight.checks],
        "axes": {name: _change(axis) for name, axis in flight.axes.items()},
    }


def _change(axis: AxisChange) -> dict[str, Any]:
    sizes = {"lost_share": axis.lost_share, "offset_us": axis.offset_us}
    found = {name: size and size._asdict() for name, size in sizes.items()}
    return {**_named(axis, _OF_CHANGE), "reason": axis.text, "members": list(axis.members), **found}


def _axis(axis: AxisAudit) -> dict[str, Any]:
    sizes = {"lost_share": axis.lost_share, "offset_us": axis.offset_us}
    smallest = {"loss_share": axis.detectable.loss, "offset_us": axis.detectable.offset_us}
    return {
        **_named(axis, _OF_AXIS),
        "members": list(axis.members),
        **{name: size and size.value for name, size in sizes.items()},
        "intervals": {name: size and [size.low, size.high] for name, size in sizes.items()},
        "outline": list(axis.outline),
        "identifiable": axis.identifiable >= MOST_OF_THE_FLIGHT,
        "identifiable_share": axis.identifiable,
        "detectable": {name: size if math.isfinite(size) else None for name, size in smallest.items()},
        "events": [_event(event, own_command=axis.model.own_command) for event in axis.events],
    }


def _event(event: AxisEvent, *, own_command: bool) -> dict[str, Any]:
    sizes = {"lost_share": event.lost_share, "offset_us": event.offset_us} if own_command else {}
    found = {name: size and size._asdict() for name, size in (sizes | {"lag_s": event.lag_s}).items()}
    return {**_named(event, _OF_EVENT), "lost_share": None, "offset_us": None, **found, "cause": event.cause or None}


def _surface(surface: SurfaceAudit) -> dict[str, Any]:
    statistics = surface.statistics
    return {
        **_named(surface, _OF_SURFACE),
        "model": surface.model.model_dump(),
        "detectable": surface.detectable.document(),
        "threshold": {"kind": surface.threshold_kind, "deg": surface.threshold_deg},
        "residual": statistics and _named(statistics, _OF_STATISTICS) | {"outline": list(surface.outline)},
        "simulation_error_rms_deg": statistics and statistics.simulation_error_rms_deg,
        **({} if surface.current is None else {"current": _named(surface.current, _OF_CURRENT)}),
        "faults": _faults(surface.surface, surface.faults),
        "suspicions": _faults(f"{surface.surface}-suspected", surface.suspicions),
    }


def _faults(name: str, faults: Sequence[Fault]) -> list[dict[str, Any]]:
    """Each with its name among those of its surface, in the order in which they were raised."""
    return [_fault(f"{name}-{place}", fault) for place, fault in enumerate(faults, start=1)]


def _fault(identity: str, fault: Fault) -> dict[str, Any]:
    return (
        _named(fault, _OF_FAULT)
        | ({"is_of_sensor": True} if fault.is_of_sensor else {})
        | {
            "id": identity,
            "confirmed_by": fault.confirmed_by and _fault(f"{identity}-confirmed", fault.confirmed_by),
            "parameters": {name: estimate.value for name, estimate in fault.parameters.items()},
            "intervals": {name: [estimate.low, estimate.high] for name, estimate in fault.parameters.items()},
            "alternatives": list(fault.alternatives),
        }
    )


def finite(value: Any) -> Any:  # noqa: ANN401 - any JSON value
    """A value with null where JSON cannot hold a number.

    Examples
    --------
    >>> finite({"a": [float("nan"), 1.0]})
    {'a': [None, 1.0]}
    """
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [finite(item) for item in value]
    return value
