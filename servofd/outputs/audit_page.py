"""Audits as one HTML page that can be sent by mail: the verdict first, in words, then what it rests on."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.axes.model import FORMS
from servofd.axes.motion import LIFT_MOTORS
from servofd.axes.verdict import named, shown
from servofd.detection.verdict import meaning, next_step
from servofd.jobs.workflow import FailedLog
from servofd.outputs.chart import MOST_FAULTS, Chart, Curve, Mark, Panel, Span, fault_charts, flight_chart, kind_of
from servofd.outputs.page import page
from servofd.outputs.sentence import clock, plain_rate, seen, spoken, whole_sentence, worst

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from logparsers.records import FlightLog
    from servofd.aircraft.schema import Aircraft
    from servofd.axes.verdict import AxisAudit
    from servofd.core.evidence import ModelOrigin
    from servofd.core.statistics import Estimate
    from servofd.core.types import FloatArray
    from servofd.detection.verdict import Fault, LogAudit, SurfaceAudit

_UNITS = {"deg_s": "deg/s", "deg": "deg", "hz": "Hz", "s": "s"}
_MISSING = "none"
_ORIGINS = {
    "calibrated": "calibrated on good flights",
    "named": "the servo that was named",
    "fitted": "fitted to this very log",
    "none": "none that predicts",
}
_RANK = {"fault": 0, "suspect": 1}


def audit_page(results: Sequence[LogAudit | FailedLog]) -> str:
    """Text of the page, for one or more logs, those with a fault first.

    It names files without their folders, and tells nothing else of the machine, its user, or where the aircraft flew.
    """
    logs = [
        _failed(result) if isinstance(result, FailedLog) else _log(result, f"log-{k}")
        for k, result in enumerate(results, start=1)
    ]
    logs.sort(key=lambda log: _RANK.get(log["status"], len(_RANK)))
    first = logs[0] if len(logs) == 1 else _all_of(logs)
    return page(
        "audit.html",
        logs=logs,
        most_faults=MOST_FAULTS,
        status=first["status"],
        sentence=first["sentence"],
        facts=first["facts"],
    )


def _all_of(logs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What several logs come to."""
    faulty = sum(log["status"] == "fault" for log in logs)
    known = {log["status"] for log in logs}
    status = next((s for s in ("fault", "suspect", "unknown", "no_data", "healthy") if s in known), "no_data")
    return {
        "status": status,
        "sentence": f"{faulty or 'None'} of {len(logs)} logs show{'s' * (faulty <= 1)} a fault.",
        "facts": "",
    }


def _failed(result: FailedLog) -> dict[str, Any]:
    name = Path(result.path).name
    error = result.error.replace(result.path, name)
    motors = None if result.log is None else motors_of(result.log)
    read = "Could not be read." if result.log is None else "Could not be judged."
    return {
        "name": name,
        "file": name,
        "sentence": read if motors is None else f"No control surfaces: a {motors['kind']}.",
        "facts": error,
        "motors": motors,
        "surfaces": [],
        "axes": [],
        "damage": [],
        "status": "unknown",
    }


def _log(audit: LogAudit, anchor: str) -> dict[str, Any]:
    log = audit.log
    facts = [log.format, f"{log.duration_s:.1f} s", log.vehicle, log.firmware]
    if log.start_utc is not None:
        facts.append(f"begun {log.start_utc:%Y-%m-%d %H:%M} UTC")
    ordered = sorted(audit.surfaces, key=lambda surface: _RANK.get(surface.status, len(_RANK)))
    return {
        "name": log.source.name + (f", run {log.run}" if log.run else ""),
        "file": log.source.name,
        "sentence": whole_sentence(audit),
        "status": worst((*audit.surfaces, *audit.axes)),
        "facts": ", ".join(filter(None, [log.source.name, *facts])),
        "surfaces": [_surface(audit.aircraft, surface, f"{anchor}-{k}") for k, surface in enumerate(ordered, start=1)],
        "axes": [_axis(axis, f"{anchor}-{axis.axis}") for axis in audit.axes],
        "motors": None,
        "damage": [
            (damage.kind.replace("_", " "), damage.note, str(damage.count), _span(damage.start_s, damage.end_s))
            for damage in log.damage_summary
        ],
    }


def _surface(aircraft: Aircraft, surface: SurfaceAudit, anchor: str) -> dict[str, Any]:
    charts = []
    if surface.residuals is not None and surface.threshold is not None and surface.residuals.time_s.size > 1:
        charts = [*fault_charts(surface), flight_chart(surface)]
    found = (*surface.faults, *surface.suspicions)
    return {
        "name": spoken(surface.surface),
        "anchor": anchor,
        "status": surface.status,
        "found": surface.status in _RANK,
        "not_judged": not surface.is_judged,
        "reason": f"{surface.reason[:1].upper()}{surface.reason[1:]}.",
        "line": _line(surface),
        "next": next_step(surface),
        "faults": [_fault_row(fault) for fault in found],
        "meanings": [(f"{kind_of(fault).capitalize()} at {clock(fault.start_s)}", meaning(fault)) for fault in found],
        "charts": charts,
        "statistics": _statistics(surface),
        "quality": quality_rows(surface),
        "method": _method(aircraft, surface),
    }


def _axis(axis: AxisAudit, anchor: str) -> dict[str, Any]:
    return {
        "name": f"{axis.axis.capitalize()} ({named(axis.members, axis.axis)})",
        "anchor": anchor,
        "status": axis.status,
        "found": axis.status in _RANK,
        "reason": f"{axis.reason[:1].upper()}{axis.reason[1:]}.",
        "chart": axis_chart(axis),
        "events": [
            (
                f"{event.start_s:.1f}",
                f"{event.alarm_s:.1f}",
                "lasts" if event.end_s is None else f"{event.end_s:.1f}",
                _estimated(event.lost_share if axis.model.own_command else None, 2),
                _estimated(event.offset_us if axis.model.own_command else None, 0),
                event.cause or "its own",
            )
            for event in axis.events
        ],
        "numbers": [
            ("lost share", _estimated(axis.lost_share, 2)),
            ("offset [us]", _estimated(axis.offset_us, 0)),
            ("judged", f"{axis.judged_share:.0%} of the flight"),
            ("would have been seen", shown(axis.detectable) or "nothing"),
            ("a surface that stood still", f"would have been seen in {axis.identifiable:.0%} of the flight"),
            ("model", f"{axis.model.form.replace('_', ' ')}, explains {axis.model.explained:.0%} on days not seen"),
            ("false alarms", f"about {axis.false_alarms_per_hour:.2g} an hour"),
        ],
    }


def _estimated(estimate: Estimate | None, digits: int) -> str:
    if estimate is None:
        return "not known"
    return f"{estimate.value:+.{digits}f} ({estimate.low:+.{digits}f} to {estimate.high:+.{digits}f})"


def _line(surface: SurfaceAudit) -> str:
    """A healthy surface in a line."""
    within = "" if surface.statistics is None else f" within {surface.statistics.max_abs_deg:.1f} deg"
    sizes = seen(surface.detectable)
    return f"followed its command{within}{'; ' + sizes if sizes else ''}."


def _fault_row(fault: Fault) -> tuple[str, ...]:
    return (
        kind_of(fault),
        f"{fault.start_s:.2f}",
        f"{fault.alarm_s:.2f}",
        "lasts" if fault.end_s is None else f"{fault.end_s:.2f}",
        "; ".join(f"{quantity(name)} {_interval(estimate)}" for name, estimate in fault.parameters.items()) or _MISSING,
        f"{100.0 * fault.probability:.3g}%",
        ", ".join(fault.alternatives).replace("_", " ") or _MISSING,
    )


def quantity(name: str) -> str:
    """Name of a parameter in words, with its unit."""
    for suffix, unit in _UNITS.items():
        if name.endswith(f"_{suffix}"):
            return f"{name.removesuffix(f'_{suffix}').replace('_', ' ')} [{unit}]"
    return name.replace("_", " ")


def _interval(estimate: Estimate) -> str:
    return f"{estimate.value:.3g} ({estimate.low:.3g} to {estimate.high:.3g})"


def _statistics(surface: SurfaceAudit) -> list[tuple[str, str]]:
    statistics = surface.statistics
    if statistics is None:
        return []
    model = surface.model
    about = "about " if surface.threshold_kind == "interval" else ""
    rows = [
        ("threshold [deg]", f"{about}{surface.threshold_deg:.3g} ({surface.threshold_kind})"),
        ("residual, mean [deg]", f"{statistics.mean_deg:+.3f}"),
        ("residual, standard deviation [deg]", f"{statistics.std_deg:.3f}"),
        ("residual, largest size [deg]", f"{statistics.max_abs_deg:.2f}"),
        ("simulation error, rms [deg]", f"{statistics.simulation_error_rms_deg:.3f}"),
        ("model", f"{_ORIGINS[model.origin]}{_explained(model)}"),
        ("judged", f"{surface.judged_share:.0%} of the log"),
        ("smallest faults", seen(surface.detectable) or "none would have been seen"),
    ]
    if surface.false_alarms_per_hour is not None:
        told = "as measured on simulated aircraft" if model.origin == "calibrated" else "were the residual Gaussian"
        rows.append((f"false alarms, {told}", plain_rate(surface.false_alarms_per_hour)))
    return rows


def _explained(model: ModelOrigin) -> str:
    return "" if model.explained_share is None else f", predicts {model.explained_share:.1%} of the motion held out"


def _method(aircraft: Aircraft, surface: SurfaceAudit) -> str:
    if surface.residuals is None:
        return ""
    model = aircraft.model(surface.surface)
    poles = ", ".join(f"{p:.4g}".replace("+0j", "").strip("()") for p in model.transfer.poles_rad_s)
    limit = min(model.plan.rate_up_deg_s, model.plan.rate_down_deg_s)
    rate = f", rate limit {limit:.4g} deg/s" if limit < float("inf") else ""
    return f"servo {surface.servo}: poles {poles} rad/s, delay {1e3 * model.plan.delay_s:.3g} ms{rate}"


def _span(start_s: float | None, end_s: float | None) -> str:
    if start_s is None:
        return "-"
    return f"{start_s:.2f}" if end_s is None else f"{start_s:.2f} to {end_s:.2f}"


_MOST_OF_IT = 0.998
_HEADROOM = 1.1
_HIGHEST = 20.0


def axis_chart(axis: AxisAudit) -> Chart:
    """The whole flight of one axis."""
    time_s, usable = axis.time_s, axis.inputs.usable
    asked, shown = (np.where(usable, values, np.nan) for values in (axis.asked, axis.shown))
    both = np.concatenate([asked[usable], shown[usable], [0.0]])
    low, high = (float(x) for x in np.quantile(both, (1.0 - _MOST_OF_IT, _MOST_OF_IT)))
    margin = 0.1 * (high - low) + 1e-9
    unit = FORMS[axis.model.form].unit
    effect = Panel(
        "effect of the command",
        unit,
        (Curve("expected", "simulated", time_s, asked), Curve("as the motion shows", "measured", time_s, shown)),
        low - margin,
        high + margin,
    )
    score = np.sqrt(np.clip(axis.score, 0.0, _HIGHEST**2))
    top = _HEADROOM * max(1.2, float(score.max()))
    distance = Panel(
        "distance from healthy over its threshold",
        "1",
        (
            Curve("distance", "residual", time_s, np.where(usable, score, np.nan)),
            Curve("threshold", "threshold", time_s[[0, -1]], np.ones(2)),
        ),
        0.0,
        top,
    )
    text = (
        "Above, the part of the motion that the command should cause, and the part that nothing else explains; a lost "
        "surface keeps the second from following the first. Below, how far lost share and offset are from those of "
        "healthy flights. Where nothing is drawn, nothing was judged."
    )
    last_s = float(time_s[-1])
    spans = tuple(Span("fault", e.start_s, e.end_s or last_s, "lost") for e in axis.events if not e.cause)
    marks = tuple(Mark("alarm", e.alarm_s, "alarm") for e in axis.events if not e.cause)
    return Chart("Whole flight", text, float(time_s[0]), last_s, (effect, distance), spans, marks)


_JITTER_QUANTILE = 0.95


def quality_rows(surface: SurfaceAudit) -> list[tuple[str, str]]:
    """Rows of a table: quantity with unit, and its value.

    Examples
    --------
    >>> from servofd.detection.verdict import SurfaceAudit
    >>> from servofd.aircraft.segment import Segment
    >>> t = np.arange(0.0, 10.0, 0.02)
    >>> segment = Segment("rudder", t, 0.0 * t, t, np.where(t < 5.0, 0.0, np.nan))
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
        rows.append(("commands thinned by the log", f"one every {1e3 * segment.command_period_s:.3g} ms was sent"))
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


_NO_SURFACES = frozenset(
    {
        *("multirotor", "quadrotor", "hexarotor", "octorotor", "tricopter", "decarotor", "dodecarotor", "coaxial"),
        "helicopter",
    }
)
_OUTPUT = re.compile(r"(?:RCOU|RCO2|SERVO_OUTPUT_RAW)\.(?:C|Ch|servo)(\d+)(?:_raw)?")
_LEAST_US, _MOST_US = 900.0, 2200.0
_LOWEST_US, _HIGHEST_US = 1000.0, 2000.0
_AT_LIMIT_US = 5.0
"""Nearer to its end an output is saturated: nothing is left for control."""
_RUNS_SHARE = 0.05


def motors_of(log: FlightLog) -> dict[str, Any] | None:
    """Commands and saturation of the motors, for a page; None if the aircraft is none without surfaces."""
    if log.vehicle not in _NO_SURFACES:
        return None
    names = {int(found[1]): name for name in log.channels if (found := _OUTPUT.fullmatch(name))}
    functions = {number: log.parameters.get(f"SERVO{number}_FUNCTION") for number in names}
    motors = [number for number in sorted(names) if functions[number] is None or functions[number] in LIFT_MOTORS]
    pulses = {}
    for number in motors:
        channel = log[names[number]]
        good = (channel.values > _LEAST_US) & (channel.values < _MOST_US)
        if np.count_nonzero(good) > 1 and np.ptp(channel.values[good]) > 0.0:
            pulses[number] = (channel.time_s[good], channel.values[good])
    if not pulses:
        return {"kind": log.vehicle, "rows": [], "chart": None}
    low, high = _range_us(log.parameters)
    rows, running = [], []
    for number, (_, values) in pulses.items():
        runs = values > low + _RUNS_SHARE * (high - low)
        flown = values[runs] if runs.any() else values
        running.append(float(np.mean(flown)))
        top, bottom = np.mean(flown > high - _AT_LIMIT_US), np.mean(flown < low + _AT_LIMIT_US)
        rows.append((f"output {number}", f"{np.mean(flown):.0f}", f"{flown.max():.0f}", f"{top:.1%}", f"{bottom:.1%}"))
    return {
        "kind": log.vehicle,
        "rows": rows,
        "chart": _chart(pulses, low, high),
        "uneven_us": f"{np.ptp(running):.0f}",
    }


def _range_us(parameters: Mapping[str, float]) -> tuple[float, float]:
    low, high = parameters.get("MOT_PWM_MIN", 0.0), parameters.get("MOT_PWM_MAX", 0.0)
    return (low, high) if 0.0 < low < high else (_LOWEST_US, _HIGHEST_US)


def _chart(pulses: Mapping[int, tuple[Any, Any]], low: float, high: float) -> Chart:
    time_s = next(iter(pulses.values()))[0]
    every = np.array([np.interp(time_s, *one) for one in pulses.values()])
    panel = Panel(
        "motor commands",
        "us",
        (
            Curve("the most of any motor", "measured", time_s, every.max(axis=0)),
            Curve("mean", "simulated", time_s, every.mean(axis=0)),
            Curve("the least of any motor", "command", time_s, every.min(axis=0)),
            Curve("full", "threshold", time_s[[0, -1]], np.full(2, high)),
        ),
        low - 50.0,
        high + 50.0,
    )
    text = "Where the upper line reaches its end, a motor has nothing left to hold the attitude with."
    return Chart("What was asked of the motors", text, float(time_s[0]), float(time_s[-1]), (panel,))
