"""What the monitor says on the link: alarms in words, health in numbers, and that it is there.

It never commands the vehicle.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from servofd.detection.events import Event
    from servofd.detection.monitor import SurfaceMonitor

__all__ = ["Alerts", "health", "status_text"]

_LONGEST = 50
_NAME_LONGEST = 10
_CRITICAL, _ERROR, _WARNING, _NOTICE, _INFO = 2, 3, 4, 5, 6  # MAV_SEVERITY
_SEVERITIES: Final = {
    "hardover": _CRITICAL,
    "stuck": _CRITICAL,
    "floating": _CRITICAL,
    "oscillation": _CRITICAL,
    "unknown": _CRITICAL,
    "loss_of_effectiveness": _ERROR,
    "bias": _ERROR,
    "slow": _WARNING,
    "deadband": _WARNING,
}
"""By what the fault does to the aircraft: control lost, trim lost, control worse."""
_SHOWN: Final = (
    "position_deg",
    "bias_deg",
    "amplitude_deg",
    "width_deg",
    "rate_limit_deg_s",
    "bandwidth_scale",
    "gain",
)
_UNITS: Final = {"bandwidth_scale": "x", "gain": "x", "rate_limit_deg_s": " deg/s"}
_ONBOARD, _NO_AUTOPILOT, _ACTIVE, _STATE_CRITICAL = 18, 8, 4, 5  # MAV_TYPE, MAV_AUTOPILOT, MAV_STATE
_SAME_S, _WINDOW_S, _MOST = 30.0, 10.0, 10
_PERIOD_S = 1.0

Message = tuple[str, dict[str, Any]]


def status_text(event: Event) -> tuple[int, str] | None:
    """Severity and words of an event, 50 characters at most; None for what a ground station sees itself.

    Examples
    --------
    >>> from servofd.detection.events import Event
    >>> status_text(Event(30.4, "elevator", "alarm", "unknown", -2.1, 1.5))
    (2, 'servo elevator: ALARM, off by 2.1 deg')
    >>> status_text(Event(60.0, "elevator", "clear", "stuck"))
    (5, 'servo elevator: moves as commanded again')
    """
    if event.event in ("link_lost", "link_restored") or not event.surface:
        return None
    who = f"servo {event.surface}: "
    if event.event == "clear":
        what = "cleared: within tolerance" if event.kind == "healthy" else "moves as commanded again"
        return _NOTICE, _short(who, what)
    if event.event == "no_data":
        return _WARNING, _short(who, "not watched: " + event.text)
    severity = _SEVERITIES.get(event.kind, _NOTICE)
    if event.event == "alarm":
        return severity, _short(who, f"ALARM, off by {abs(event.residual_deg):.1f} deg")
    kind = event.kind.replace("_", " ").upper() if event.kind != "healthy" else "within tolerance"
    return severity, _short(who, kind + _size(event))


def _size(event: Event) -> str:
    if event.fault is None:
        return ""
    known = next((name for name in _SHOWN if name in event.fault.parameters), "")
    if not known:
        return ""
    return f" {event.fault.parameters[known].value:.2g}{_UNITS.get(known, ' deg')}"


def _short(who: str, what: str) -> str:
    """Rather shorten the name than the news; plain letters only."""
    room = _LONGEST - len(what)
    name = who if len(who) <= room else who[: max(room - 3, 8)] + "~: "
    return (name + what).encode("ascii", "replace").decode()[:_LONGEST]


def health(monitor: SurfaceMonitor) -> float:
    """How far a surface is from its alarm: 1 with no residual, 0 at the threshold or in alarm, -1 if unknown."""
    if monitor.standing:
        return 0.0
    reading = monitor.reading
    if not monitor.is_watched or reading is None or not reading.settled or not reading.threshold_deg > 0.0:
        return -1.0
    return max(0.0, 1.0 - abs(reading.residual_deg) / reading.threshold_deg)


class Alerts:
    """Messages to send; says nothing twice within 30 s, and no more than 10 things within 10 s.

    Examples
    --------
    >>> from servofd.detection.events import Event
    >>> alerts = Alerts()
    >>> event = Event(1.0, "rudder", "alarm", "unknown", 2.0, 1.5)
    >>> [len(alerts.of(event, at_s)) for at_s in (0.0, 1.0, 40.0)]
    [1, 0, 1]
    """

    def __init__(self) -> None:
        self._said: dict[str, float] = {}
        self._lately: deque[float] = deque()
        self._beat_s = float("-inf")
        self.held_back = 0

    def of(self, event: Event, now_s: float) -> list[Message]:
        """Text about an event; `now_s` is the receiver's clock [s]."""
        said = status_text(event)
        if said is None:
            return []
        severity, text = said
        while self._lately and self._lately[0] < now_s - _WINDOW_S:
            self._lately.popleft()
        if now_s - self._said.get(text, float("-inf")) < _SAME_S or len(self._lately) >= _MOST:
            self.held_back += 1
            return []
        self._said = {old: at_s for old, at_s in self._said.items() if now_s - at_s < _SAME_S} | {text: now_s}
        self._lately.append(now_s)
        return [("STATUSTEXT", {"severity": severity, "text": text})]

    def periodic(self, monitors: dict[str, SurfaceMonitor], vehicle_s: float, now_s: float) -> list[Message]:
        """Heartbeat and health of each surface, once a second."""
        if now_s - self._beat_s < _PERIOD_S:
            return []
        self._beat_s = now_s
        alarmed = any(monitor.standing for monitor in monitors.values())
        state = _STATE_CRITICAL if alarmed else _ACTIVE
        beat = {"type": _ONBOARD, "autopilot": _NO_AUTOPILOT, "system_status": state, "mavlink_version": 3}
        boot_ms = int(vehicle_s * 1e3) % 2**32 if math.isfinite(vehicle_s) else 0
        names = _health_names(monitors)
        numbers: list[Message] = [
            ("NAMED_VALUE_FLOAT", {"time_boot_ms": boot_ms, "name": names[name], "value": health(monitor)})
            for name, monitor in monitors.items()
        ]
        return [("HEARTBEAT", beat), *numbers]


def _health_names(surfaces: dict[str, SurfaceMonitor]) -> dict[str, str]:
    """Ten letters for each surface, all different."""
    names: dict[str, str] = {}
    for surface in surfaces:
        name = "SF_" + surface.upper().replace("AILERON", "AIL").replace("ELEVATOR", "ELEV").replace("RUDDER", "RUD")
        name, number = name.encode("ascii", "replace").decode()[:_NAME_LONGEST], 2
        while name in names.values():
            name, number = name[: _NAME_LONGEST - len(str(number))] + str(number), number + 1
        names[surface] = name
    return names
