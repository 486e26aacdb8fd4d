"""Events of the monitor as JSON lines (``servofd.event/1``)."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from servofd.detection.events import Event


def event_document(event: Event, vehicle: int | None = None) -> dict[str, Any]:
    """The event as other tools read it; what is not known is null.

    Examples
    --------
    >>> from servofd.detection.events import Event
    >>> event_document(Event(30.41, "elevator", "alarm", "unknown", -2.1, 1.5), 1)["residual_deg"]
    -2.1
    """
    document: dict[str, Any] = {
        "schema": "servofd.event/1",
        "time_s": _number(event.time_s),
        "surface": event.surface or None,
        "event": event.event,
        "kind": event.kind or None,
        "residual_deg": _number(event.residual_deg),
        "threshold_deg": _number(event.threshold_deg),
        "vehicle": vehicle,
    }
    if event.text:
        document["text"] = event.text
    if event.fault is not None:
        fault = event.fault
        document["fault"] = {
            "kind": fault.kind,
            "start_s": _number(fault.start_s),
            "alarm_s": _number(fault.alarm_s),
            "end_s": None if fault.end_s is None else _number(fault.end_s),
            "parameters": {name: _number(estimate.value) for name, estimate in fault.parameters.items()},
            "probability": _number(fault.probability),
            "alternatives": list(fault.alternatives),
        }
    return document


def event_json(event: Event, vehicle: int | None = None) -> str:
    """One line of JSON, without its end.

    Examples
    --------
    >>> from servofd.detection.events import Event
    >>> event_json(Event(1.0, "", "link_lost"))[:60]
    '{"schema": "servofd.event/1", "time_s": 1.0, "surface": null'
    """
    return json.dumps(event_document(event, vehicle), allow_nan=False)


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
