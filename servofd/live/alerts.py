"""What the monitor says on the link: alarms in words, health in numbers, and that it is there.

It never commands the vehicle. A ground station shows the last few texts, and a radio loses some: alarms and their names
leave at once and once more a second later, whatever else there is to say; the rest is gathered, and waits its turn.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Final

from logparsers.protocol import LONGEST_TEXT, Autopilot, Kind, Severity, State
from servofd.aircraft.names import short_names
from servofd.detection.event import Event
from servofd.detection.kinds import KINDS, filled
from servofd.live.alarms import over
from servofd.live.requests import Message

if TYPE_CHECKING:
    from servofd.detection.monitor import SurfaceMonitor

_NAME_LONGEST: Final = 10
"""Characters of the name of a NAMED_VALUE_FLOAT (MAVLink)."""
_LEAST_ROOM: Final = 12
"""For a surface's name, however long the rest of a text would like to be."""
_PERIOD_S: Final = 1.0
_AGAIN_S: Final = 1.0
"""An urgent text is said twice: of a link that loses 30 %, one in eleven is lost and not three in ten."""
_GATHER_S, _PAUSE_S = 1.0, 10.0
"""So long what is not urgent is gathered, and so long it waits for its turn; one line in ten seconds buries nothing."""
_MOST_NOTES: Final = 6
"""News of the link that wait their turn: the latest of a minute."""


def health(monitor: SurfaceMonitor) -> float:
    """How far a surface is from its alarm: 1 with no residual, 0 at the threshold or in alarm, -1 if unknown."""
    if monitor.standing:
        return 0.0
    reading = monitor.reading
    if not monitor.is_watched or reading is None or not reading.settled or not reading.threshold_deg > 0.0:
        return -1.0
    return max(0.0, 1.0 - abs(reading.residual_deg) / reading.threshold_deg)


class Alerts:
    """Messages to send about one vehicle."""

    def __init__(self, surfaces: Iterable[str]) -> None:
        self._surfaces = list(surfaces)
        self._health = short_names(self._surfaces, _NAME_LONGEST - len("SF_"))
        self._urgent: dict[str, list[tuple[float, int, str]]] = {}
        """By surface: what is still to be said about its alarm, and when."""
        self._unwatched: dict[str, str] = {}
        self._notes: list[str] = []
        self._gathered_s, self._spoke_s, self._beat_s = math.inf, -math.inf, -math.inf

    def take(self, event: Event, now_s: float) -> None:
        """Take an event; `now_s` is the receiver's clock [s]."""
        if event.event in ("link_lost", "link_restored") or not event.surface:
            return  # a ground station sees that itself
        if event.event == "no_data":
            self._unwatched[event.surface] = event.text
            self._gathered_s = min(self._gathered_s, now_s)
            return
        severity, text = event.severity, self._text([event.surface], _words(event))
        again = [] if event.event == "clear" else [(now_s + _AGAIN_S, severity, text)]
        self._urgent[event.surface] = [(now_s, severity, text), *again]

    def note(self, text: str, now_s: float) -> None:
        """Have something said about the whole vehicle."""
        self._notes.append(text)
        self._gathered_s = min(self._gathered_s, now_s)

    def watched(self, surface: str) -> None:
        """Nothing need be said of this surface's silence any more."""
        self._unwatched.pop(surface, None)

    def due(self, now_s: float) -> list[Message]:
        """What leaves now."""
        found = []
        for surface, texts in self._urgent.items():
            found += [(severity, text) for at_s, severity, text in texts if at_s <= now_s]
            self._urgent[surface] = [entry for entry in texts if entry[0] > now_s]
        if now_s - self._gathered_s >= _GATHER_S and now_s - self._spoke_s >= _PAUSE_S:
            quiet = self._quiet()
            self._spoke_s = now_s if quiet else self._spoke_s
            found += [(Severity.WARNING, text) for text in quiet]
            self._gathered_s = now_s if self._notes else math.inf
        return [("STATUSTEXT", {"severity": severity, "text": text}) for severity, text in found]

    def periodic(
        self, monitors: Mapping[str, SurfaceMonitor], gravest: Severity | None, vehicle_s: float, now_s: float
    ) -> list[Message]:
        """Heartbeat, by the gravest alarm that stands, and health of each surface, once a second."""
        if now_s - self._beat_s < _PERIOD_S:
            return []
        self._beat_s = now_s
        state = State.ACTIVE if gravest is None or gravest >= Severity.NOTICE else State.CRITICAL
        beat = {"type": Kind.ONBOARD_CONTROLLER, "autopilot": Autopilot.INVALID, "mavlink_version": 3}
        messages: list[Message] = [("HEARTBEAT", beat | {"system_status": state})]
        boot_ms = int(vehicle_s * 1e3) % 2**32 if math.isfinite(vehicle_s) else 0
        for name, monitor in monitors.items():
            number = {"time_boot_ms": boot_ms, "name": f"SF_{self._health[name]}", "value": health(monitor)}
            messages.append(("NAMED_VALUE_FLOAT", number))
        return messages

    def _quiet(self) -> list[str]:
        """One line for each reason not to watch surfaces, and one of those on the link: the others wait their turn."""
        reasons: dict[str, list[str]] = defaultdict(list)
        for surface, text in self._unwatched.items():
            # The shortest that says why; times and remedies are in the monitor's own view.
            reasons[re.split(" since|[:;,]", text, maxsplit=1)[0]].append(surface)
        self._unwatched.clear()
        notes = list(dict.fromkeys(self._notes))[-_MOST_NOTES:]
        self._notes = notes[1:]
        texts = [self._text(surfaces, f"not watched: {reason}") for reason, surfaces in reasons.items()]
        return texts + [note[:LONGEST_TEXT] for note in notes[:1]]

    def _text(self, surfaces: list[str], what: str) -> str:
        """Names, then what there is to say of them; what does not fit is cut off the latter."""
        room = max(LONGEST_TEXT - len(what) - 1, _LEAST_ROOM)
        whole = ", ".join(short_names(self._surfaces, room)[surface] for surface in surfaces)
        who = whole if len(whole) <= room else f"{len(surfaces)} surfaces"
        return f"{who} {what}"[:LONGEST_TEXT]


def _words(event: Event) -> str:
    """What follows the surface's name."""
    if event.event == "clear":
        if event.text and event.kind != "healthy":
            return event.text.partition(":")[0]
        return "cleared: within tolerance" if event.kind == "healthy" else over(event.fault)
    if event.event == "alarm" and event.fault is None:
        if event.text:
            return "AXIS ALARM by its motion"
        known = f"off by {abs(event.residual_deg):.1f} deg" if math.isfinite(event.residual_deg) else ""
        grave = "ALARM" if event.severity < Severity.NOTICE or not known else ""
        return ", ".join(filter(None, (grave, known)))
    if event.kind == "unknown":
        return "at fault"
    fault = event.fault
    values = {name: estimate.value for name, estimate in fault.parameters.items()} if fault is not None else {}
    sensor = " (sensor?)" if fault is not None and fault.is_of_sensor else ""
    return filled(KINDS[event.kind].clause, values).replace("±", "+-") + sensor
