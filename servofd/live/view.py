"""What a watcher sees: a row for each surface, the vehicle and the link in words, and the last alarms."""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Iterator, Sequence
from itertools import zip_longest
from typing import TYPE_CHECKING, NamedTuple

from logparsers.protocol import Severity
from servofd.detection.event import Event, Reading
from servofd.detection.kinds import KINDS
from servofd.detection.verdict import describe
from servofd.live.alarms import Alarm, over

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderResult
    from rich.text import Text

    from servofd.detection.monitor import SurfaceMonitor
    from servofd.live.session import Session
    from servofd.live.vehicle import Vehicle

_BAR = 8
"""Characters of the bar of a residual."""
_KEPT = 50
"""Lines that are kept for the bottom of the screen."""
_TABLE, _WIDE = 48, 96
"""Columns from which rows have columns, and from which their words stand beside their numbers."""
_WORDS, _NAME = 24, 8
"""Columns that words and names need at least."""
_LATE_S = 1.0
_STATUS = {Severity.CRITICAL: "ALARM", Severity.WARNING: "WARNING", Severity.NOTICE: "notice"}
_STYLES = {
    "watched": "green",
    "ALARM": "bold red",
    "WARNING": "bold yellow",
    "notice": "magenta",
    "no data": "yellow",
    "waiting": "dim",
    "settling": "cyan",
    "not judged": "dim",
}
_LATER = "fly on, check it on the ground"
"""About one that is but a notice."""


def event_line(event: Event) -> str:
    """An event as one line of words."""
    who = f"{event.surface}: " if event.surface else ""
    off = f"off by {event.residual_deg:+.2f} deg from where a good servo would be"
    size = f", {off}, threshold {event.threshold_deg:.2f} deg"
    size = size if math.isfinite(event.residual_deg) else ", does not follow its command" * (not event.text)
    what = {
        "alarm": f"{_STATUS.get(event.severity, 'ALARM')}{size}",
        "named": event.kind.replace("_", " "),
        "clear": "taken back: within tolerance" if event.kind == "healthy" else over(event.fault),
        "no_data": "no data",
        "link_lost": "LINK LOST",
        "link_restored": "link restored",
    }[event.event]
    more = f": {event.text}" if event.text else ""
    by_current = event.fault is not None and event.fault.witness == "current" and event.event == "alarm"
    if event.fault is not None and (event.event == "named" or by_current):
        said = re.sub(r" \(alarm at [^)]*\)", "", describe(event.fault))  # it is this one, whatever an audit would say
        what, more = f"{_STATUS[event.severity]}, {said}", ""
    return f"{_at(event.time_s)}  {who}{what}{more}"


def _at(time_s: float) -> str:
    """A time of the vehicle; nothing, as wide, where it is not known yet."""
    return f"{time_s:7.2f} s" if math.isfinite(time_s) else 9 * " "


def said_of(alarm: Alarm) -> str:
    """What an alarm is, in a few words."""
    if alarm.fault is not None:
        other = {"": "", "sensor": " or, by its current, its sensor"}.get(alarm.fault.other, " by position and current")
        return re.split(r",? (?:since|from) -?\d|, perhaps", describe(alarm.fault), maxsplit=1)[0] + other
    if alarm.kind == "unknown" and math.isfinite(alarm.residual_deg):
        return f"off by {alarm.residual_deg:+.1f} deg"
    return "does not follow its command" if alarm.kind == "unknown" else alarm.kind.replace("_", " ")


def status_of(monitor: SurfaceMonitor, alarm: Alarm | None, *, is_lost: bool) -> str:
    """One word: how grave the alarm is that stands, or how it is watched; `is_lost` if its vehicle is silent."""
    if alarm is not None:
        return _STATUS[alarm.severity]
    if is_lost:
        return "no data"
    if not monitor.is_watched:
        return "no data" if monitor.silenced else "waiting"
    if monitor.reading is None or not monitor.reading.settled:
        return "settling"
    return "watched"


class Row(NamedTuple):
    """One surface or axis."""

    at_s: float
    """Time of the vehicle [s]."""
    name: str
    status: str
    numbers: tuple[str, ...] = ()
    """Command, measured, residual, threshold [deg]."""
    level: float = math.nan
    """Share of its threshold that is reached."""
    since: str = ""
    words: str = ""
    """What is wrong, and what to do."""


_HEAD = Row(
    math.nan, "surface", "status", ("command", "measured", "residual", "threshold"), math.nan, "since", "what to do"
)


class View:
    """Keeps the last events of a session, and draws it under a title that says where it comes from."""

    def __init__(self, session: Session, title: str) -> None:
        self._session, self._title = session, title
        self._events: deque[str] = deque(maxlen=_KEPT)
        self.dropped = 0

    def note(self, line: str) -> None:
        """Add a line to those at the bottom."""
        self._events.append(line)

    def drawn(self, arrival_now_s: float) -> Picture:
        """The picture of the moment; `arrival_now_s` is the receiver's clock [s]."""
        rows, below = [*self._surfaces(), *self._axes()], self._below(arrival_now_s)
        return Picture(f"servofd monitor  {self._title} (degrees)", rows, below, tuple(self._events))

    def plain(self, arrival_now_s: float) -> list[str]:
        """The same in plain lines, one for each surface."""
        lines = []
        for row in (*self._surfaces(), *self._axes()):
            said = ", ".join(filter(None, (row.status, *_said(row))))
            lines.append(f"{_at(row.at_s)}  {row.name}: {said}")
        return lines + self._below(arrival_now_s)

    def summary(self) -> list[str]:
        """What was found, a line for each alarm and one for each surface without any."""
        lines = []
        for vehicle in self._session.vehicles.values():
            for alarm in vehicle.alarms.all:
                end_s = math.inf if alarm.end_s is None else alarm.end_s
                until = f"to {end_s:.1f} s" if math.isfinite(end_s) else "to the end"
                until += f" of boot {alarm.boot}" * (vehicle.alarms.boot > 1)
                word = "taken back" if alarm.dismissed else _STATUS[alarm.severity]
                lines.append(
                    f"{self._of(vehicle, alarm.surface)}: {word}, {said_of(alarm)}, from {alarm.since_s:.1f} s {until}"
                )
            alarmed = {alarm.surface for alarm in vehicle.alarms.all}
            lines += [
                f"{self._of(vehicle, monitor.name)}: {'; '.join(filter(None, ('no alarm', monitor.unjudged)))}"
                for monitor in vehicle.monitors.values()
                if monitor.name not in alarmed
            ]
        return lines

    def _of(self, vehicle: Vehicle, name: str) -> str:
        return name if len(self._session.vehicles) == 1 else f"{vehicle.system}/{name}"

    def _surfaces(self) -> Iterator[Row]:
        for vehicle, monitor in self._session.watched:
            alarm, reading = vehicle.alarms.standing(monitor.name), monitor.reading
            name, word = self._of(vehicle, monitor.name), status_of(monitor, alarm, is_lost=vehicle.is_lost)
            since, to_do = _since_and_to_do(alarm)
            words = (monitor.silenced if word in ("no data", "waiting") else to_do) or monitor.stands_in
            is_current = monitor.quantity == "current"
            if is_current and word == "no data":
                reading = None  # what was read last is not what is drawn now
            numbers = _numbers(reading, " A" * is_current)
            yield Row(vehicle.now_s, name, word, numbers, _share(reading), since, words)
            if monitor.drawn is not None:
                is_late = vehicle.is_lost or vehicle.now_s - monitor.drawn.time_s > monitor.patience_s
                beside = "no data" if is_late else "watched" if monitor.drawn.settled else "settling"
                drawn = None if is_late else monitor.drawn
                said = f"no current since {monitor.drawn.time_s:.1f} s" * is_late
                yield Row(vehicle.now_s, f"{name} current", beside, _numbers(drawn, " A"), _share(drawn), words=said)

    def _axes(self) -> Iterator[Row]:
        """Axes of all vehicles by the latest judgement of their motion."""
        from servofd.axes.verdict import named

        for vehicle in self._session.vehicles.values():
            for audit in vehicle.axes.audits if vehicle.axes is not None else ():
                if audit.axis == "thrust" or not audit.score.size:
                    continue
                alarm = vehicle.alarms.standing(audit.axis)
                usable = audit.inputs.usable[-1] and audit.model.own_command
                word = _STATUS[alarm.severity] if alarm is not None else "watched" if usable else "not judged"
                level = float(audit.score[-1]) / audit.model.suspect
                lost = "unknown" if audit.lost_share is None else "{:+.2f} [{:+.2f}, {:+.2f}]".format(*audit.lost_share)
                words = f"lost share {lost}, {level:.0%} of its threshold"
                name = self._of(vehicle, f"{audit.axis} ({named(audit.members, audit.axis)})")
                since, to_do = _since_and_to_do(alarm)
                yield Row(vehicle.now_s, name, word, (), level, since, "; ".join(filter(None, (to_do, words))))

    def _below(self, arrival_now_s: float) -> list[str]:
        """Each vehicle and its link in words, and what is still missing."""
        lines = []
        for vehicle in self._session.vehicles.values():
            received = sum(losses.received for losses in vehicle.losses.values())
            lost = sum(losses.lost for losses in vehicle.losses.values())
            quiet_s, late_s = max(arrival_now_s - vehicle.received_s, 0.0), vehicle.clock.latency.late_s
            state = f"LOST, silent for {quiet_s:.0f} s" if vehicle.is_lost else f"last message {quiet_s:.1f} s ago"
            state += f", {late_s:.0f} s late" if late_s >= _LATE_S else ""
            now = f"{vehicle.now_s:.1f} s since it booted" if math.isfinite(vehicle.now_s) else "its time not known yet"
            rates = [monitor.rate_hz for monitor in vehicle.monitors.values() if math.isfinite(monitor.rate_hz)]
            by_position = any(monitor.quantity == "position" for monitor in vehicle.monitors.values())
            what = "positions" if by_position else "currents"
            pace = f"; {min(rates):.0f} {what} a second" if rates else ""
            sent = received + lost
            frames = f"; {lost / sent:.1%} of {sent} frames did not come here" if received else ""
            log = f"; {vehicle.log.said}" if vehicle.log is not None and vehicle.log.said else ""
            lines.append(f"vehicle {vehicle.system}: {now}; {state}{pace}{frames}{log}")
        damaged, dropped = self._session.damaged_bytes, self.dropped
        counts = [f"{damaged} damaged bytes"] * bool(damaged) + [f"{dropped} dropped here: queue full"] * bool(dropped)
        lines = [*lines, *filter(None, ["; ".join(counts)])] or ["no vehicle yet"]
        return [*lines, *filter(None, [self._session.waiting()])]


class Picture:
    """A moment of the monitor, laid out for whatever width and height it is drawn in."""

    def __init__(self, title: str, rows: Sequence[Row], below: Sequence[str], events: Sequence[str]) -> None:
        self.title, self.rows, self.below, self.events = title, rows, below, events

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Lines of the picture: rows first, of the events as many as there is room for."""
        from rich.text import Text

        width, height = options.max_width, options.height or options.size.height
        head: list[Text] = [Text(self.title, style="bold")]
        head += _table(self.rows, console, width) if width >= _TABLE else _list(self.rows)
        head += [Text(""), *(Text(line) for line in self.below), Text("")]
        lines = [line for text in head for line in text.wrap(console, width) or [text]]
        tail: list[Text] = []
        for event in reversed(self.events):
            more = list(Text(event).wrap(console, width))
            if len(lines) + len(tail) + len(more) > height - 1:
                break
            tail[:0] = more
        for line in (*lines, *tail):
            line.rstrip()
            line.no_wrap, line.end = True, "\n"
            yield line


def _table(rows: Sequence[Row], console: Console, width: int) -> list[Text]:
    """Rows in columns; their words beside them where there is room, else below them."""
    from rich.cells import cell_len, set_cell_size
    from rich.text import Text

    if not rows:
        return []
    everything = [_HEAD, *rows]
    numbers = list(zip_longest(*(row.numbers for row in everything), fillvalue=""))
    widths = [max(map(cell_len, column)) for column in numbers]
    status, since = max(len(row.status) for row in everything), max(len(row.since) for row in everything)
    is_wide = width >= _WIDE
    used = status + sum(widths) + 2 * (len(widths) + 1) + (since + _BAR + 4) * is_wide
    name = min(max(cell_len(row.name) for row in everything), max(width - used, _NAME))
    beside = width - used - name - 2
    lines: list[Text] = []
    for row, cells in zip(everything, zip(*numbers, strict=True), strict=True):
        style = "dim" if row is _HEAD else ""
        line = Text(set_cell_size(row.name, name) + "  ", style=style)
        line.append(row.status.ljust(status), style=_STYLES.get(row.status, ""))
        line.append("".join(f"  {cell:>{size}}" for cell, size in zip(cells, widths, strict=True)))
        lines.append(line)
        if is_wide:
            line.append("  ").append_text(Text(" " * _BAR) if row is _HEAD else _bar(row.level))
            line.append(f"  {row.since:>{since}}")
            first, *more = Text(row.words).wrap(console, max(beside, _WORDS)) or [Text()]
            line.append("  ").append_text(first)
            lines += [Text(" " * (width - beside)).append_text(words) for words in more]
        elif row.words and row is not _HEAD:
            words = Text(f"{f'since {row.since}: ' * bool(row.since)}{row.words}").wrap(console, width - 2)
            lines += [Text("  ").append_text(one) for one in words]
    return lines


def _list(rows: Sequence[Row]) -> list[Text]:
    """Rows one below the other, where there is room for nothing else."""
    from rich.text import Text

    lines = []
    for row in rows:
        lines.append(Text.assemble(f"{row.name} ", (row.status, _STYLES[row.status])))
        lines += [Text(words) for words in _said(row) if words]
    return lines


def _numbers(reading: Reading | None, unit: str) -> tuple[str, ...]:
    """As the screen has them; of what is not in degrees with its unit."""
    if reading is None:
        return ()
    measured = f"{reading.measured_deg:.2f}" if unit else f"{reading.measured_deg:+.1f}"
    numbers = measured, f"{reading.residual_deg:+.2f}", f"{reading.threshold_deg:.2f}"
    return (f"{reading.command_deg:+.1f}", *(f"{number}{unit}" for number in numbers))


def _said(row: Row) -> tuple[str, str, str]:
    """The numbers of a row, since when, and what there is to say; each empty where there is none."""
    words = ""
    if row.numbers:
        command, measured, residual, level = row.numbers
        words = f"command {command} deg, measured {measured} deg, residual {residual} deg, threshold {level} deg"
        if measured.endswith(" A"):
            words = f"command {command} deg, draws {measured}, {residual} from a good servo within {level}"
    return words, f"since {row.since}" * bool(row.since), row.words


def _share(reading: Reading | None) -> float:
    if reading is None or not reading.threshold_deg > 0.0:
        return math.nan
    return abs(reading.residual_deg) / reading.threshold_deg


def _since_and_to_do(alarm: Alarm | None) -> tuple[str, str]:
    if alarm is None:
        return "", ""
    kind = KINDS.get(alarm.kind, KINDS["unknown"])
    to_do = _LATER if alarm.severity == Severity.NOTICE else kind.in_flight
    return f"{alarm.since_s:.1f} s", f"{said_of(alarm)}: {to_do}"


def _bar(share: float) -> Text:
    from rich.text import Text

    full = min(round(share * _BAR), _BAR) if math.isfinite(share) else 0
    return Text("█" * full + "·" * (_BAR - full), style="red" if share >= 1.0 else "green")
