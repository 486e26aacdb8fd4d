"""What a watcher sees: one line per surface, the link, and the last events."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.console import RenderableType
    from rich.text import Text

    from servofd.axes.verdict import AxisAudit
    from servofd.detection.monitor import Event, SurfaceMonitor
    from servofd.live.session import Session
    from servofd.live.vehicle import Vehicle

_BAR = 20
_EVENTS = 8
_STYLES = {
    "watched": "green",
    "ALARM": "bold red",
    "no data": "yellow",
    "waiting": "dim",
    "settling": "cyan",
    "not judged": "dim",
}


def event_line(event: Event) -> str:
    """An event as one line of words."""
    who = f"{event.surface}: " if event.surface else ""
    what = {
        "alarm": f"ALARM, residual {event.residual_deg:+.2f} deg, threshold {event.threshold_deg:.2f} deg",
        "named": "within tolerance" if event.kind == "healthy" else f"it is: {event.kind}",
        "clear": "cleared: within tolerance" if event.kind == "healthy" else f"clear ({event.kind})",
        "no_data": "no data",
        "link_lost": "LINK LOST",
        "link_restored": "link restored",
    }[event.event]
    more = f": {event.text}" if event.text else ""
    if event.fault is not None and event.event == "named":
        from servofd.detection.verdict import describe

        what, more = describe(event.fault), ""
    return f"{event.time_s:7.2f} s  {who}{what}{more}"


def status_of(monitor: SurfaceMonitor) -> str:
    """One word, or the kind of fault that stands."""
    if monitor.standing:
        return "ALARM"
    if not monitor.is_watched:
        return "no data" if monitor.silenced else "waiting"
    if monitor.reading is None or not monitor.reading.settled:
        return "settling"
    return "watched"


class View:
    """Keeps the last events of a session, and draws it under a title that says where it comes from."""

    def __init__(self, session: Session, title: str) -> None:
        self._session, self._title = session, title
        self._events: deque[str] = deque(maxlen=_EVENTS)
        self.dropped = 0

    def note(self, line: str) -> None:
        """Add a line to those at the bottom."""
        self._events.append(line)

    def drawn(self, arrival_now_s: float) -> RenderableType:
        """The picture of the moment; `arrival_now_s` is the receiver's clock [s]."""
        from rich.console import Group
        from rich.table import Table
        from rich.text import Text

        table = Table(box=None, pad_edge=False, expand=False)
        for heading in ("surface", "status", "command", "measured", "residual", "", "threshold", "rate", "age"):
            table.add_column(heading, justify="left" if heading in ("surface", "status", "") else "right")
        for vehicle, monitor in self._session.watched:
            self._row(table, vehicle, monitor)
        tables: list[RenderableType] = [table] if self._session.watched else []
        if any(True for _ in self._axes()):
            tables.append(self._axis_table())
        lines = [Text(self._link(arrival_now_s), style="dim")]
        waiting = self._session.waiting()
        if waiting:
            lines.append(Text(waiting, style="yellow"))
        return Group(Text(f"servofd monitor  {self._title}", style="bold"), *tables, *lines, *map(Text, self._events))

    def plain(self, arrival_now_s: float) -> list[str]:
        """The same in plain lines, one per surface."""
        lines = []
        for vehicle, monitor in self._session.watched:
            reading = monitor.reading
            where = "" if len(self._session.vehicles) == 1 else f"{vehicle.system}/"
            if reading is None:
                lines.append(f"{where}{monitor.name}: {status_of(monitor)}")
            else:
                lines.append(
                    f"{reading.time_s:7.2f} s  {where}{monitor.name}: {_status(monitor)}, command "
                    f"{reading.command_deg:+.1f} deg, measured {reading.measured_deg:+.1f} deg, residual "
                    f"{reading.residual_deg:+.2f} of {reading.threshold_deg:.2f} deg, {monitor.rate_hz:.0f} Hz"
                )
        for vehicle, audit in self._axes():
            lines.append(
                f"{vehicle.now_s:7.2f} s  {self._axis_name(vehicle, audit)}: {_axis_status(vehicle, audit)}, "
                f"lost share {_lost(audit)}, {_level(audit):.0%} of its threshold"
            )
        waiting = self._session.waiting()
        return [*lines, self._link(arrival_now_s), *([waiting] if waiting else [])]

    def _axes(self) -> Iterator[tuple[Vehicle, AxisAudit]]:
        """Axes of all vehicles by the latest judgement of their motion."""
        for vehicle in self._session.vehicles.values():
            for audit in vehicle.axes.audits if vehicle.axes is not None else ():
                if audit.axis != "thrust" and audit.score.size:
                    yield vehicle, audit

    def _axis_table(self) -> RenderableType:
        from rich.table import Table
        from rich.text import Text

        table = Table(box=None, pad_edge=False, expand=False)
        for heading in ("axis", "status", "lost share", "of its threshold"):
            table.add_column(heading)
        for vehicle, audit in self._axes():
            word, level = _axis_status(vehicle, audit), _level(audit)
            status = Text(word, style=_STYLES[word])
            table.add_row(self._axis_name(vehicle, audit), status, _lost(audit), _bar(level))
        return table

    def _axis_name(self, vehicle: Vehicle, audit: AxisAudit) -> str:
        from servofd.axes.verdict import named

        where = "" if len(self._session.vehicles) == 1 else f"{vehicle.system}/"
        return f"{where}{audit.axis} ({named(audit.members, audit.axis)})"

    def _row(self, table: object, vehicle: Vehicle, monitor: SurfaceMonitor) -> None:
        from rich.text import Text

        name = monitor.name if len(self._session.vehicles) == 1 else f"{vehicle.system}/{monitor.name}"
        word, reading = status_of(monitor), monitor.reading
        status = Text(_status(monitor), style=_STYLES[word])
        if reading is None:
            cells = [name, status, "", "", "", "", "", "", ""]
        else:
            share = abs(reading.residual_deg) / reading.threshold_deg if reading.threshold_deg > 0.0 else math.nan
            cells = [name, status, f"{reading.command_deg:+.1f}", f"{reading.measured_deg:+.1f}"]
            cells += [f"{reading.residual_deg:+.2f}", _bar(share), f"{reading.threshold_deg:.2f} deg"]
            cells += [f"{monitor.rate_hz:.0f} Hz", f"{max(vehicle.now_s - reading.time_s, 0.0):.1f} s"]
        table.add_row(*cells)  # type: ignore[attr-defined]

    def _link(self, arrival_now_s: float) -> str:
        parts = []
        for vehicle in self._session.vehicles.values():
            received = sum(losses.received for losses in vehicle.losses.values())
            lost = sum(losses.lost for losses in vehicle.losses.values())
            share = lost / max(received + lost, 1)
            age_s = arrival_now_s - vehicle.heard_s
            state = "LOST" if vehicle.is_lost else f"heard {max(age_s, 0.0):.1f} s ago"
            late_s = vehicle.clock.latency.late_s
            state += f", {late_s:.0f} s late" if late_s >= 1.0 else ""
            now = f"{vehicle.now_s:.1f} s" if math.isfinite(vehicle.now_s) else "?"
            parts.append(f"vehicle {vehicle.system}: {state}, its time {now}, {received} frames, {share:.1%} skipped")
            if vehicle.log is not None and vehicle.log.said:
                parts.append(vehicle.log.said)
        damaged, dropped = self._session.damaged_bytes, self.dropped
        more = f"{damaged} damaged bytes" if damaged else ""
        if dropped:
            more += f"{', ' if more else ''}{dropped} dropped here: queue full"
        return "; ".join([*parts, *([more] if more else [])]) or "nobody heard yet"


def _status(monitor: SurfaceMonitor) -> str:
    word = status_of(monitor)
    return f"ALARM {monitor.standing}" if word == "ALARM" else word


def _bar(share: float) -> Text:
    """How much of a threshold is reached."""
    from rich.text import Text

    full = min(round(share * _BAR), _BAR) if math.isfinite(share) else 0
    return Text("█" * full + "·" * (_BAR - full), style="red" if share >= 1.0 else "green")


def _axis_status(vehicle: Vehicle, audit: AxisAudit) -> str:
    if vehicle.axes is not None and vehicle.axes.stands(audit.axis):
        return "ALARM"
    return "watched" if audit.inputs.usable[-1] and audit.model.own_command else "not judged"


def _level(audit: AxisAudit) -> float:
    return float(audit.score[-1]) / audit.model.suspect


def _lost(audit: AxisAudit) -> str:
    if audit.lost_share is None:
        return "unknown"
    value, low, high = audit.lost_share
    return f"{value:+.2f} [{low:+.2f}, {high:+.2f}]"
