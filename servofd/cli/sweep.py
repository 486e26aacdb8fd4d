"""``servofd audit --sweep``: pre-flight check of each surface from a commanded sweep on the ground.

Go is what an audit calls healthy, of a surface that was moved to both sides far enough to show a jam, and whose gain
and zero are within its tolerances; no-go, what it calls suspect or at fault, or what is certainly beyond them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from servofd.aircraft.schema import Surface
from servofd.cli.options import Options
from servofd.cli.terminal import complain, give_json, print_table
from servofd.core.statistics import Estimate, correlation_factor
from servofd.core.types import FloatArray
from servofd.detection.audit import audit_log
from servofd.detection.residual import Residuals
from servofd.detection.verdict import SurfaceAudit
from servofd.feedback.flown import flown_aircraft, known_aircraft, one_log
from servofd.outputs.sentence import seen

_LEAST_DEG = 3.0
"""Smallest travel to either side that a sweep needs [deg]."""
_THRESHOLDS = 2.0
"""A stuck servo must show twice the threshold, on both sides."""
_WORDS = {"go": "go", "no_go": "NO-GO", "unknown": "cannot tell"}
_HEAD = ("surface", "verdict", "asked", "reached", "gain", "bias", "residual", "why")
_MEMORY_S = 1.0
"""Errors further apart than that are independent [s]."""


def run(options: Options) -> int:
    """Check, then write or print."""
    known = known_aircraft(options.config)
    logs, documents = one_log(options.log, known).by_boots(), list[dict[str, Any]]()
    for log in logs:
        aircraft = flown_aircraft(log, known)
        aircraft.check_names(options.surface, log.label)
        audit = audit_log(log, aircraft, surfaces=tuple(options.surface))
        surfaces = {one.surface: _checked(one, aircraft.surfaces[one.surface]) for one in audit.surfaces}
        about: dict[str, Any] = {"path": str(log.source), "duration_s": log.duration_s}
        documents.append({"schema": "servofd.sweep/1", **about, "surfaces": surfaces})
    *earlier, last = documents
    if not give_json(options.json, last | {"earlier_boots": earlier} if earlier else last):
        for log, document in zip(logs, documents, strict=True):
            rows = [_row(name, one) for name, one in document["surfaces"].items()]
            print_table(_HEAD, rows, f"{log.label}   {log.format}, {log.duration_s:.1f} s")
    checked = [(name, one) for document in documents for name, one in document["surfaces"].items() if one["expected"]]
    if any(one["status"] == "no_go" for _, one in checked):
        return 1
    dark = [f"{name}: {one['reasons'][0]}" for name, one in checked if one["status"] == "unknown"]
    if not checked:
        dark = ["no position of a surface is in it"]
    for reason in dark[:1]:
        complain(reason, options.log)
    return 2 if dark else 0


def _checked(surface: SurfaceAudit, known: Surface) -> dict[str, Any]:
    segment, residuals, statistics = surface.segment, surface.residuals, surface.statistics
    fitted = {} if segment is None or residuals is None else _fitted(residuals, segment.period_s)
    missing = "" if segment is None else _missing(segment.command_deg, surface.threshold_deg)
    wrong = _out_of_tolerance(fitted, known)
    status, reasons = "unknown", [surface.reason]
    if surface.status == "fault":
        status = "no_go"
    elif missing and surface.tried:
        reasons = [missing]
    elif surface.status == "suspect" or (surface.status == "healthy" and wrong):
        status, reasons = "no_go", wrong or reasons
    elif surface.status == "healthy":
        status, reasons = "go", [seen(surface.detectable) or surface.reason]
    return {
        "status": status,
        "reasons": reasons,
        "expected": surface.expected,
        "numbers": {name: estimate._asdict() for name, estimate in fitted.items()},
        "asked_deg": None if segment is None else _ends(segment.command_deg),
        "reached_deg": None if segment is None else _ends(segment.measured_deg),
        "residual_peak_deg": None if statistics is None else statistics.max_abs_deg,
        "threshold_deg": surface.threshold_deg,
        "detectable": surface.detectable.document(),
    }


def _fitted(residuals: Residuals, period_s: float) -> dict[str, Estimate]:
    """Gain over that of the healthy servo, and bias [deg], by least squares; intervals allow for correlated errors."""
    rows = residuals.settled & np.isfinite(residuals.measured_deg) & np.isfinite(residuals.simulated_deg)
    healthy_deg, measured_deg = residuals.simulated_deg[rows], residuals.measured_deg[rows]
    if healthy_deg.size < 2 or np.ptp(healthy_deg) == 0.0:
        return {}
    terms = np.column_stack([healthy_deg, np.ones(healthy_deg.size)])
    inverse = np.linalg.inv(terms.T @ terms)
    values = inverse @ terms.T @ measured_deg
    error_deg = measured_deg - terms @ values
    alike = correlation_factor([error_deg], max(1, round(_MEMORY_S / period_s)))
    deviations = np.sqrt(np.diag(inverse) * alike * np.mean(error_deg**2))
    return dict(zip(("gain", "bias_deg"), map(Estimate.of, values, deviations), strict=True))


def _out_of_tolerance(fitted: dict[str, Estimate], known: Surface) -> list[str]:
    """What is certainly beyond the tolerances: the whole interval of an estimate."""
    found = []
    for name, healthy, tolerance, words in (
        ("gain", 1.0, known.tolerances.gain, "moves by {:.0%} of its command (tolerance ±{:.1%})"),
        ("bias_deg", 0.0, known.tolerances.bias_deg, "is off by {:+.2f} deg (tolerance ±{:.2g} deg)"),
    ):
        one = fitted.get(name)
        if one is not None and not (one.low <= healthy + tolerance and one.high >= healthy - tolerance):
            found.append(words.format(one.value, tolerance))
    return found


def _ends(values_deg: FloatArray) -> list[float] | None:
    known = values_deg[np.isfinite(values_deg)]
    return [float(known.min()), float(known.max())] if known.size else None


def _missing(command_deg: FloatArray, threshold_deg: float) -> str:
    """Which motion is missing; nothing if a stuck servo would have shown on both sides."""
    needed_deg = max(_LEAST_DEG, _THRESHOLDS * threshold_deg)
    low, high = (float(end(command_deg)) - float(command_deg[0]) for end in (np.min, np.max))
    if low <= -needed_deg and high >= needed_deg:
        return ""
    return f"not moved enough ({low:+.1f} to {high:+.1f} deg): move it at least ±{np.ceil(needed_deg):.0f} deg"


def _row(name: str, one: dict[str, Any]) -> tuple[str, ...]:
    ends = (one["asked_deg"], one["reached_deg"])
    peak_deg, numbers = one["residual_peak_deg"], one["numbers"]
    return (
        name,
        _WORDS[one["status"]],
        *("" if each is None else f"{each[0]:+.1f} to {each[1]:+.1f} deg" for each in ends),
        f"{numbers['gain']['value']:.3f}" if numbers else "",
        f"{numbers['bias_deg']['value']:+.2f} deg" if numbers else "",
        "" if peak_deg is None else f"{peak_deg:.2f} of {one['threshold_deg']:.2f} deg",
        "; ".join(one["reasons"]),
    )
