"""Audits as one HTML page that can be sent by mail: the verdict first, in words, then what it rests on."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from servofd.axes.words import named
from servofd.detection.advice import meaning, next_step
from servofd.detection.words import describe
from servofd.outputs.audit_charts import MOST_FAULTS, fault_charts, flight_chart
from servofd.outputs.axis_chart import axis_chart
from servofd.outputs.json_report import FailedLog
from servofd.outputs.motors import motors_of
from servofd.outputs.page import page
from servofd.outputs.quality import quality_rows
from servofd.outputs.sentence import plain_rate, seen, spoken, whole_sentence, worst

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.aircraft import Aircraft
    from servofd.axes.verdict import AxisAudit, Between
    from servofd.detection.bank.explanation import Estimate
    from servofd.detection.bank.flight import Fault
    from servofd.detection.verdict import LogAudit, SurfaceAudit
    from servofd.evidence import ModelOrigin

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
    """Text of the page, for one or more logs.

    It names files without their folders, and tells nothing else of the machine, its user, or where the aircraft flew.

    Parameters
    ----------
    results : sequence of LogAudit or FailedLog
        What was audited, and what could not be read.

    Examples
    --------
    >>> text = audit_page([FailedLog("/home/me/a.csv", "/home/me/a.csv: no such file")])
    >>> "a.csv: no such file" in text, "/home/me" in text
    (True, False)
    """
    logs = [
        _failed(result) if isinstance(result, FailedLog) else _log(result, f"log-{k}")
        for k, result in enumerate(results, start=1)
    ]
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
    return {"status": status, "sentence": f"{faulty or 'None'} of {len(logs)} logs show a fault.", "facts": ""}


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
        "untold": not surface.is_judged,
        "reason": f"{surface.reason[:1].upper()}{surface.reason[1:]}.",
        "line": _line(surface),
        "next": next_step(surface),
        "faults": [_fault_row(fault) for fault in found],
        "meanings": [(describe(fault), meaning(fault)) for fault in found],
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
                f"{event.lost_share.value:.2f} ({event.lost_share.low:.2f} to {event.lost_share.high:.2f})",
                f"{event.offset_us.value:+.0f} ({event.offset_us.low:+.0f} to {event.offset_us.high:+.0f})",
                event.cause or "its own",
            )
            for event in axis.events
        ],
        "numbers": [
            ("lost share", _estimated(axis.lost_share, 2)),
            ("offset [us]", _estimated(axis.offset_us, 0)),
            ("judged", f"{axis.judged_share:.0%} of the flight"),
            ("lost share known to +-0.3", f"in {axis.identifiable:.0%} of the flight"),
            ("model", f"{axis.model.form.replace('_', ' ')}, explains {axis.model.explained:.0%} on days not seen"),
            ("false alarms", f"about {axis.false_alarms_per_hour:.2g} an hour"),
        ],
    }


def _estimated(estimate: Between | None, digits: int) -> str:
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
        "within tolerance" if fault.kind == "healthy" else fault.kind.replace("_", " "),
        f"{fault.start_s:.2f}",
        f"{fault.alarm_s:.2f}",
        "lasts" if fault.end_s is None else f"{fault.end_s:.2f}",
        "; ".join(f"{quantity(name)} {_interval(estimate)}" for name, estimate in fault.parameters.items()) or _MISSING,
        f"{100.0 * fault.probability:.3g} %",
        ", ".join(fault.alternatives).replace("_", " ") or _MISSING,
    )


def quantity(name: str) -> str:
    """Name of a parameter in words, with its unit.

    Examples
    --------
    >>> quantity("rate_limit_deg_s"), quantity("gain")
    ('rate limit [deg/s]', 'gain')
    """
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
        rows.append(("false alarms, were the residual Gaussian", plain_rate(surface.false_alarms_per_hour)))
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
