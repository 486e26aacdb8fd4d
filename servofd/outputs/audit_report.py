"""Audits in words, tables and charts: the verdict first, then what it rests on."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from logparsers.modes import modes_of
from logparsers.records import FlightLog
from logparsers.units import MS_PER_S
from servofd.aircraft.outputs import WITHOUT_SURFACES
from servofd.aircraft.schema import Aircraft
from servofd.axes.verdict import AxisAudit, named, shown
from servofd.core.statistics import Estimate
from servofd.core.types import FloatArray
from servofd.detection.verdict import Fault, LogAudit, SurfaceAudit, meaning, next_step
from servofd.jobs.workflow import FailedLog
from servofd.outputs.chart import MOST_FAULTS, alone_chart, axis_chart, kind_of, lanes_of, surface_charts
from servofd.outputs.document import Cell, Document, Figures, Item, Items, Lanes, Part, Section, Table, Words
from servofd.outputs.json_report import audit_document
from servofd.outputs.sentence import (
    LEAST_CLEARED,
    clock,
    other_way_round,
    plain_rate,
    seen,
    spoken,
    whole_sentence,
    with_interval,
    worst,
    worst_first,
)

if TYPE_CHECKING:
    from servofd.flight.judge import FlightAlone

_UNITS = {"deg_s": "deg/s", "deg": "deg", "hz": "Hz", "s": "s"}
_MISSING = "none"
_ORIGINS = {
    "calibrated": "calibrated on good flights",
    "named": "the servo that was named",
    "fitted": "fitted to this very log",
    "none": "none that predicts",
}
_RATES = dict.fromkeys(("calibrated", "fitted"), "as measured on simulated aircraft")
"""What a rate of false alarms rests on, by the origin of the model."""
_BY_POSITION = """Each servo is simulated with the commands that were logged, on their true time stamps: poles,
transport delay, hold and rate limit of its model. Where a bank of fault models explains an alarm, it says which fault
it is, since when, how large and how sure. With command and position alone a bad servo and a bad position sensor look
the same. After Model-based Fault Detection for Low-cost UAV Actuators, University of Minnesota, 2016."""
_BY_NULLSPACE = """Of a servo that was named, measured minus simulated deflection passes a nullspace filter, which
leaves a residual that no command can move as long as the servo is healthy; the alarm is raised when its size reaches
the threshold."""
_BY_PREDICTION = """Of a servo that was calibrated, or fitted to the log itself, the residual is measured minus
predicted deflection; the alarm is raised when windows of it, from single samples to half a minute, are further from
zero than its noise and what good servos differ by allow."""
_BY_MOTION = """An axis without measured deflections is judged by the motion of the aircraft: a model fitted to
healthy flights says which part of the motion the command should cause. What the motion shows instead is a share of
the command that was lost, and an offset; the alarm is raised when both together are further from those of healthy
flights than any of these ever was from the others."""
_BY_ITSELF = """Without positions and other flights the reference is the flight's own past. Every second the motion of
roll and pitch is fitted to all that was flown before, and what the last 5, 10 and 20 s leave is compared with what
healthy flights of other aircraft leave, and with what this one left so far."""
_BY_CURRENT = """A current is judged beside what a good servo draws for the motion that was asked for: what its
electronics take, holding against the air, friction either way, and acceleration. A servo that pushes with all it has
wherever it is asked to be elsewhere is blocked; one that draws nothing for its motion has no power; one that draws more
than good flights differ by binds."""


def audit_report(results: Sequence[LogAudit | FailedLog]) -> Document:
    """Verdicts of one or more logs, those with a fault first.

    It names files without their folders, and tells nothing else of the machine, its user, or where the aircraft flew.
    """
    logs = [_failed(result) if isinstance(result, FailedLog) else _log(result) for result in results]
    data = audit_document(results)
    method = _how_found(results)
    if len(logs) == 1:
        return replace(logs[0], evidence=[method], data=data)
    logs.sort(key=lambda log: ("fault", "suspect", log.status).index(log.status))
    faulty, known = sum(log.status == "fault" for log in logs), {log.status for log in logs}
    suspect = sum(log.status == "suspect" for log in logs)
    others = f"; {suspect} {'is' if suspect == 1 else 'are'} suspect" if suspect else ""
    dark = sum(log.status in ("unknown", "no_data") for log in logs)
    others += f"; no verdict on {dark}" if dark else ""
    runs = len({one.path if isinstance(one, FailedLog) else str(one.log.source) for one in results}) == 1
    count = f"{len(logs)} {'runs' if runs else 'logs'}"
    said = f"{faulty or 'None'} of {count} show{'s' * (faulty <= 1)} a fault{others}."
    index, sections = [], []
    for k, log in enumerate(logs, 1):
        index.append((Cell(log.title, link=f"#log-{k}"), Cell(status=log.status), log.sentence))
        said_of_it = Words(log.sentence, style="verdict"), Words(log.facts, style="soft")
        sections.append(Section(log.title, [*said_of_it, *log.parts], anchor=f"log-{k}"))
    return Document(
        title=f"{logs[0].log}, {count}" if runs else ", ".join(log.title for log in logs),
        status=next((status for status in LEAST_CLEARED if status in known), "no_data"),
        sentence=f"No verdict on any of {count}." if dark == len(logs) else said,
        parts=[
            Table("All runs" if runs else "All logs", ("run" if runs else "log", "worst", "verdict"), index),
            *sections,
        ],
        evidence=[method],
        data=data,
    )


def _how_found(results: Sequence[LogAudit | FailedLog]) -> Section:
    """Methods that some verdict rests on; that of positions where none does."""
    audits = [one for one in results if not isinstance(one, FailedLog)]
    moved = any(one.axes for one in audits)
    alone = any(isinstance(one, FailedLog) and one.flight is not None for one in results)
    measured = any(one.surfaces for one in audits) or not (moved or alone)
    drawn = any(s.current is not None for one in audits for s in one.surfaces)
    origins = {s.model.origin for one in audits for s in one.surfaces}
    methods = (
        (_BY_POSITION, measured), (_BY_NULLSPACE, "named" in origins),
        (_BY_PREDICTION, not origins.isdisjoint(("calibrated", "fitted"))), (_BY_MOTION, moved), (_BY_ITSELF, alone),
        (_BY_CURRENT, drawn),
    )  # fmt: skip
    return Section("How this was found", [Words(text) for text, is_used in methods if is_used], folded=True)


def _failed(result: FailedLog) -> Document:
    name = Path(result.path).name
    if result.flight is not None:
        return _alone(name, result.flight, result.error.replace(result.path, name))
    said = "Could not be read." if result.log is None else "Could not be judged."
    if result.log is not None and result.log.vehicle in WITHOUT_SURFACES:
        said = f"No control surfaces: a {result.log.vehicle}."
    return Document(name, "unknown", said, result.error.replace(result.path, name), log=name)


def _alone(name: str, flight: FlightAlone, facts: str) -> Document:
    """What one flight says by itself."""
    rows = [
        (spoken(one.name), _LOOKS[one.status], one.text, "" if one.since_s is None else clock(one.since_s))
        for one in flight.checks
    ]
    parts: list[Part] = [Table("What this flight says by itself", ("check", "answer", "what was seen", "from"), rows)]
    if flight.motion is not None:
        motion, axes = flight.motion, flight.axes
        parts.append(Figures(lambda: [alone_chart(motion, axes)]))
    sentence, rest = flight.sentence, ""
    if any(check.status == "look" for check in flight.checks):  # what to look at heads the page; the rest follows
        sentence, _, rest = flight.sentence.partition("; ")
    facts = facts.replace(f"{flight.sentence}; ", f"{rest}; " if rest else "").replace(flight.sentence, rest)
    return Document(name, "unknown", f"{sentence[:1].upper()}{sentence[1:]}.", facts, parts, log=name)


_LOOKS = {"ok": "nothing wrong", "look": "look", "unknown": "cannot tell"}


def _log(audit: LogAudit) -> Document:
    log = audit.log
    facts = [log.source.name, log.format, f"{log.duration_s:.1f} s", log.vehicle, log.firmware]
    if log.start_utc is not None:
        facts.append(f"begun {log.start_utc:%Y-%m-%d %H:%M} UTC")
    ordered = worst_first(audit.surfaces)
    damage = []
    for one in log.damage_summary:
        when = " to ".join(f"{time_s:.2f}" for time_s in (one.start_s, one.end_s) if time_s is not None)
        damage.append((spoken(one.kind), one.note, str(one.count), when or "-"))
    said, modes = _said(log), modes_of(log)
    entries = [(clock(at_s), words) for at_s, words in sorted([*((t, f"mode: {one}") for t, one in modes), *said])]
    diary = Table("Its flight modes and messages", ("at", "what"), entries)
    is_drawn = audit.axes or any(s.residuals is not None or s.current is not None for s in audit.surfaces)
    return Document(
        title=log.source.name + (f", run {log.run}" if log.run else ""),
        status=worst((*audit.surfaces, *audit.axes)),
        sentence=whole_sentence(audit),
        facts=", ".join(filter(None, facts)),
        parts=[
            Items(
                "Surfaces",
                ("surface", "status", "model", "why"),
                [_surface(audit.aircraft, one, len(ordered)) for one in ordered],
            ),
            Items("Axes", ("axis", "status", "what the motion shows"), [_axis(axis) for axis in audit.axes]),
            Table("Damage of the log", ("kind", "what", "count", "time [s]"), damage),
            *[Section("What the autopilot did and said", [diary], folded=True)] * bool(entries),
            *[Lanes(lambda: {"lanes": lanes_of(log), "modes": modes, "said": said})] * bool(is_drawn),
        ],
        log=log.source.name,
    )


def _surface(aircraft: Aircraft, surface: SurfaceAudit, of: int) -> Item:
    found = (*surface.faults, *surface.suspicions)
    is_drawn = surface.residuals is not None or surface.current is not None
    parts: list[Part] = [Figures(lambda: surface_charts(surface, of))] if is_drawn else []
    numbers: list[Part] = [
        _faults(found),
        Table("Residual and threshold", ("quantity", "value"), _statistics(surface)),
        Table("Quality of the data", ("quantity", "value"), quality_rows(surface)),
        Table("Current", ("quantity", "value"), _current(surface)),
    ]
    if len(found) > MOST_FAULTS:
        numbers.insert(1, Words(f"{MOST_FAULTS} of {len(found)} are shown in a close-up.", style="soft"))
    if surface.residuals is not None:
        model = aircraft.model(surface.surface)
        poles = ", ".join(f"{p:.4g}".replace("+0j", "").strip("()") for p in model.transfer.poles_rad_s)
        limit = min(model.physics.follow_up_deg_s, model.physics.follow_down_deg_s)
        rate = f", rate limit {limit:.4g} deg/s" if limit < float("inf") else ""
        delay = f"delay {MS_PER_S * model.delay_s:.3g} ms{rate}"
        numbers.append(Words(f"Model: servo {surface.servo}: poles {poles} rad/s, {delay}.", style="soft"))
    if surface.status in ("fault", "suspect"):
        several = len(found) > 1
        lead = [f"{kind_of(fault).capitalize()} at {clock(fault.start_s)}:" if several else "" for fault in found]
        meanings = [Words(meaning(fault), name, style="soft") for name, fault in zip(lead, found, strict=True)]
        parts = [*meanings, *parts, Section("Details: numbers, quality of the data", numbers, folded=True)]
    elif surface.segment is not None or surface.current is not None:
        parts += numbers
    sizes = seen(surface.detectable) if surface.status == "healthy" else ""
    reason, step = _and_step(surface)
    said = "; ".join(filter(None, (reason, other_way_round(surface), sizes)))
    return Item(surface.surface, surface.status, said, step, surface.model.origin, parts)


def _faults(found: Sequence[Fault]) -> Table:
    """What is known of each fault."""
    rows = []
    for fault in found:
        values = (f"{quantity(name)} {with_interval(*one)}" for name, one in fault.parameters.items())
        rows.append(
            (
                *(kind_of(fault), f"{fault.start_s:.2f}", f"{fault.alarm_s:.2f}"),
                "lasts" if fault.end_s is None else f"{fault.end_s:.2f}",
                "; ".join(values) or _MISSING,
                f"{100.0 * fault.probability:.3g}%",
                spoken(", ".join(fault.alternatives)) or _MISSING,
                " and ".join(one.witness for one in (fault, fault.confirmed_by) if one is not None),
            )
        )
    times = ("onset [s]", "alarm [s]", "end [s]")
    head = ("kind", *times, "parameters (95% intervals)", "probability", "alternatives", "by its")
    return Table("Faults and suspicions", head, rows)


def _and_step(surface: SurfaceAudit) -> tuple[str, str]:
    """Why it has its verdict, and what to do; how to name the unit of a current is something to do."""
    reason, step, current = surface.reason, next_step(surface), surface.current
    if surface.status in ("no_data", "unknown") and current is not None and current.time_s is None:
        what, colon, unit = current.reason.partition(": ")
        return reason.replace(current.reason, what), unit if colon else step
    return reason, step


def _current(surface: SurfaceAudit) -> list[tuple[str, str]]:
    if surface.current is None:
        return []
    share, ratio = surface.current.explained_share, surface.current.ratio_to_good
    rows = [("what it shows", surface.current.reason)]
    rows += [("explained by the motion that was asked for", f"{share:.0%}")] if share is not None else []
    return rows + ([("in motion, over that of a good servo", f"{ratio:.2f}")] if ratio is not None else [])


def _axis(axis: AxisAudit) -> Item:
    events = []
    for event in axis.events:
        end, own = "lasts" if event.end_s is None else f"{event.end_s:.1f}", axis.model.own_command
        sizes = (_estimated(event.lost_share if own else None, 2), _estimated(event.offset_us if own else None, 0))
        events.append((f"{event.start_s:.1f}", f"{event.alarm_s:.1f}", end, *sizes, event.cause or "its own"))
    numbers = [
        ("lost share", _estimated(axis.lost_share, 2)),
        ("offset [us]", _estimated(axis.offset_us, 0)),
        ("judged", f"{axis.judged_share:.0%} of the flight"),
        ("would have been seen", shown(axis.detectable) or "nothing"),
        ("a surface that stood still", f"would have been seen in {axis.identifiable:.0%} of the flight"),
        ("model", f"{axis.model.form.replace('_', ' ')}, explains {axis.model.explained:.0%} on days not seen"),
        ("false alarms", f"about {axis.false_alarms_per_hour:.2g} an hour"),
    ]
    head = ("onset [s]", "alarm [s]", "end [s]", "lost share (95%)", "offset [us] (95%)", "cause")
    parts = (
        Figures(lambda: [axis_chart(axis)]),
        Table("When it did not answer", head, events),
        Table("Numbers", ("quantity", "value"), numbers),
    )
    return Item(f"{axis.axis} ({named(axis.members, axis.axis)})", axis.status, axis.reason, parts=parts)


def _estimated(estimate: Estimate | None, digits: int) -> str:
    if estimate is None:
        return "not known"
    return f"{estimate.value:+.{digits}f} ({estimate.low:+.{digits}f} to {estimate.high:+.{digits}f})"


def quantity(name: str) -> str:
    """Name of a parameter in words, with its unit."""
    for suffix, unit in _UNITS.items():
        if name.endswith(f"_{suffix}"):
            return f"{spoken(name.removesuffix(f'_{suffix}'))} [{unit}]"
    return spoken(name)


def _statistics(surface: SurfaceAudit) -> list[tuple[str, str]]:
    statistics = surface.statistics
    if statistics is None:
        return []
    model = surface.model
    about = "about " if surface.threshold_kind == "interval" else ""
    share = model.explained_share
    explained = "" if share is None else f", predicts {share:.1%} of the motion held out"
    rows = [
        ("threshold [deg]", f"{about}{surface.threshold_deg:.3g} ({surface.threshold_kind})"),
        ("residual, mean [deg]", f"{statistics.mean_deg:+.3f}"),
        ("residual, standard deviation [deg]", f"{statistics.std_deg:.3f}"),
        ("residual, largest size [deg]", f"{statistics.max_abs_deg:.2f}"),
        ("simulation error, rms [deg]", f"{statistics.simulation_error_rms_deg:.3f}"),
        ("model", f"{_ORIGINS[model.origin]}{explained}"),
        ("judged", f"{surface.judged_share:.0%} of the log"),
        ("smallest faults", seen(surface.detectable) or "none would have been seen"),
    ]
    if surface.false_alarms_per_hour is not None:
        basis = _RATES.get(model.origin, "were the residual Gaussian")
        rows.append((f"false alarms, {basis}", plain_rate(surface.false_alarms_per_hour)))
    return rows


_JITTER_QUANTILE = 0.95
"""Quantile of the intervals between samples that stands for their jitter."""


def quality_rows(surface: SurfaceAudit) -> list[tuple[str, str]]:
    """Rows of a table: quantity with unit, and its value.

    Examples
    --------
    >>> from servofd.detection.verdict import SurfaceAudit
    >>> from servofd.aircraft.series import Series
    >>> t = np.arange(0.0, 10.0, 0.02)
    >>> segment = Series("rudder", t, 0.0 * t, t, np.where(t < 5.0, 0.0, np.nan))
    >>> rows = dict(quality_rows(SurfaceAudit("rudder", "unknown", "", "x", "constant", 1.5, True, segment=segment)))
    >>> rows["position rate [Hz]"], rows["positions missing [%]"]
    ('50 (95% of steps within 1.00 times the median)', '50')
    """
    segment = surface.segment
    if segment is None:
        return []
    measured = np.isfinite(segment.measured_deg)
    rows = [
        ("command rate [Hz]", _rate(segment.command_s)),
        ("longest time without a command [s]", _gap(segment.command_s)),
        ("position rate [Hz]", _rate(segment.measured_s[measured])),
        ("longest time without a position [s]", _gap(segment.measured_s[measured])),
        ("positions missing [%]", f"{100.0 * (1.0 - measured.mean()):.2g}" if measured.size else "100"),
    ]
    if segment.command_period_s is not None:
        rows.append(("commands thinned by the log", f"one every {MS_PER_S * segment.command_period_s:.3g} ms was sent"))
    if segment.frozen_s > 0.0:
        rows.append(("frozen telemetry [s]", f"{segment.frozen_s:.1f}"))
    if surface.residuals is not None:
        settled = surface.residuals.settled
        rows.append(("positions judged [%]", f"{100.0 * settled.mean():.3g}"))
        rows.append(("starts of the filter", str(int(np.count_nonzero(surface.residuals.restart)))))
    return rows


def _rate(time_s: FloatArray) -> str:
    step_s = np.diff(time_s)
    if not step_s.size:
        return "none"
    median_s = float(np.median(step_s))
    jitter = float(np.quantile(step_s, _JITTER_QUANTILE)) / median_s
    return f"{1.0 / median_s:.4g} (95% of steps within {jitter:.2f} times the median)"


def _gap(time_s: FloatArray) -> str:
    step_s = np.diff(time_s)
    if not step_s.size:
        return "-"
    longest = int(np.argmax(step_s))
    return f"{step_s[longest]:.3g} (at {time_s[longest]:.2f} s)"


_MOST_SAID = 80
"""Messages of a page: the gravest of a log that has more."""
_OF_ITS_PLACE = re.compile(r"\d\.\d{4,}|[0-9A-Fa-f]{8}")
"""Coordinates, and the numbers of boards and builds: a page shows neither the place nor the hardware of a flight."""
_LEAST_GRAVE = 8
"""Severity of a message without one: below the least grave of MAVLink, 7."""


def _said(log: FlightLog) -> list[tuple[float, str]]:
    """Time [s] and text of the autopilot's messages in a log."""
    messages = [one for one in log.texts if np.isfinite(one.time_s) and one.text and not _OF_ITS_PLACE.search(one.text)]
    gravest = sorted(messages, key=lambda one: _LEAST_GRAVE if one.severity is None else one.severity)[:_MOST_SAID]
    return sorted({(one.time_s, one.text) for one in gravest})
