"""Audits as one HTML page that can be sent by mail: the verdict first, in words, then what it rests on."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from servofd.detection.advice import headline, meaning, next_step
from servofd.detection.odds import SurfaceOdds, Wish
from servofd.detection.words import describe
from servofd.odds import odds_of_surface
from servofd.outputs.audit_figures import MOST_FAULTS, flight_pictures, residual_picture
from servofd.outputs.json_report import FailedLog
from servofd.outputs.odds_report import odds_rows
from servofd.outputs.page import page
from servofd.outputs.quality import quality_rows

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.aircraft import Aircraft
    from servofd.detection.audit import LogAudit, SurfaceAudit
    from servofd.detection.bank.explanation import Estimate
    from servofd.detection.bank.isolate import Fault

__all__ = ["audit_page", "quantity"]

_UNITS = {"deg_s": "deg/s", "deg": "deg", "hz": "Hz", "s": "s"}
_MISSING = "none"
_RAREST = 1e-100


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
    return page("audit.html", logs=logs, most_faults=MOST_FAULTS)


def _failed(result: FailedLog) -> dict[str, Any]:
    name = Path(result.path).name
    error = result.error.replace(result.path, name)
    return {
        "name": name,
        "verdict": "Could not be read.",
        "facts": error,
        "surfaces": [],
        "damage": [],
        "status": "unknown",
    }


def _log(audit: LogAudit, anchor: str) -> dict[str, Any]:
    log = audit.log
    facts = [log.format, f"{log.duration_s:.1f} s", log.vehicle, log.firmware]
    if log.start_utc is not None:
        facts.append(f"begun {log.start_utc:%Y-%m-%d %H:%M} UTC")
    statuses = [surface.status for surface in audit.surfaces]
    return {
        "name": log.source.name + (f", run {log.run}" if log.run else ""),
        "verdict": headline(audit.surfaces),
        "status": next((s for s in ("fault", "suspect", "healthy", "unknown") if s in statuses), "no_data"),
        "facts": ", ".join(filter(None, facts)),
        "surfaces": [
            _surface(audit.aircraft, surface, f"{anchor}-{k}") for k, surface in enumerate(audit.surfaces, start=1)
        ],
        "damage": [
            (damage.kind.replace("_", " "), damage.note, str(damage.count), _span(damage.start_s, damage.end_s))
            for damage in log.damage
        ],
    }


def _surface(aircraft: Aircraft, surface: SurfaceAudit, anchor: str) -> dict[str, Any]:
    odds = odds_of_surface(aircraft, surface, Wish()) if surface.residuals is not None else None
    known = odds if isinstance(odds, SurfaceOdds) else None
    pictures = []
    if surface.residuals is not None and surface.threshold is not None:
        pictures = flight_pictures(surface, anchor)
        spread = residual_picture(surface, known, f"{anchor}-residual")
        pictures += [spread] if spread is not None else []
    found = (*surface.faults, *surface.suspicions)
    return {
        "name": surface.surface,
        "anchor": anchor,
        "status": surface.status,
        "reason": f"{surface.reason[:1].upper()}{surface.reason[1:]}.",
        "next": next_step(surface),
        "faults": [_fault_row(fault) for fault in found],
        "meanings": [(describe(fault), meaning(fault)) for fault in found],
        "pictures": pictures,
        "statistics": _statistics(surface),
        "odds": odds_rows([known]) if known is not None else [],
        "odds_notes": known.notes if known is not None else (),
        "no_odds": getattr(odds, "reason", ""),
        "quality": quality_rows(surface),
        "method": _method(aircraft, surface),
    }


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
    about = "about " if surface.threshold_kind == "interval" else ""
    rows = [
        ("threshold [deg]", f"{about}{surface.threshold_deg:.3g} ({surface.threshold_kind})"),
        ("residual, mean [deg]", f"{statistics.mean_deg:+.3f}"),
        ("residual, standard deviation [deg]", f"{statistics.std_deg:.3f}"),
        ("residual, largest size [deg]", f"{statistics.max_abs_deg:.2f}"),
        ("simulation error, rms [deg]", f"{statistics.simulation_error_rms_deg:.3f}"),
    ]
    if surface.false_alarms_per_hour is not None:
        rate = surface.false_alarms_per_hour
        shown = f"{rate:.1e}" if rate > _RAREST else f"below {_RAREST:.0e}"
        rows.append(("false alarms per flight hour, Gaussian", shown))
    return rows


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
