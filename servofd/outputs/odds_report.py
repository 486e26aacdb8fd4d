"""The odds of an alarm: false ones, missed ones, late ones (schema servofd.odds/1)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.detection.probability import WITHIN_S, SurfaceOdds, bias_response, detect, false_alarms_per_hour
from servofd.outputs.chart import Chart, Curve, Mark, Panel
from servofd.outputs.document import Bullets, Document, Table

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servofd.detection.probability import Operating, Quoted

_SHORTEST_S, _LONGEST_S = 1e-4, 3600.0
"""Delays below the first are shown as that, and above the second as over an hour [s]."""
_SIZES_SIGMAS, _ROLES = (3.0, 4.0, 5.0, 6.0, 8.0), ("simulated", "measured", "residual", "suspect", "fault")
"""Sizes of the bias faults of the chart, in standard deviations of the residual, and the roles of their curves."""
_LOWEST_RATE, _HIGHEST_RATE, _THRESHOLDS = 1e-6, 1e3, 60
"""Ends of the axis of false alarms [1/h], and points of a curve."""


def odds_chart(odds: SurfaceOdds) -> Chart:
    """Probability of detection within 0.2 s against false alarms per hour, one curve for each size of a bias fault.

    By the measured tail, where there is one, sizes grow with the threshold of the wanted rate.
    """
    noise, tail = odds.noise, odds.tail
    if tail is None:
        scale_deg = noise.sigma_deg
        thresholds = abs(noise.mean_deg) + scale_deg * np.linspace(_SIZES_SIGMAS[0], _SIZES_SIGMAS[-1], _THRESHOLDS)
        rates = np.array(
            [
                false_alarms_per_hour(noise.margin_deg(t), noise.sigma_deg, noise.correlation, noise.sample_time_s)
                for t in thresholds
            ]
        )
    else:
        scale_deg = max(noise.sigma_deg, 1.2 * odds.wished.threshold_deg / _SIZES_SIGMAS[-1])
        rates = np.geomspace(tail.peaks_per_hour, _LOWEST_RATE, _THRESHOLDS)
        thresholds = np.array([tail.threshold_deg(rate).value for rate in rates])
    response = bias_response(odds.design, WITHIN_S[0])
    curves = []
    for sigmas, role in zip(_SIZES_SIGMAS, _ROLES, strict=True):
        seen = np.array([float(detect(sigmas * scale_deg * response, t, noise).likely[-1]) for t in thresholds])
        curves.append(Curve(f"{sigmas * scale_deg:.2g} deg", role, rates[::-1], seen[::-1]))
    panel = Panel(f"bias seen within {WITHIN_S[0]:g} s", "probability", tuple(curves), -0.02, 1.02)
    marks = [Mark("command", odds.wish.false_alarms_per_hour, "wanted rate")]
    if tail is not None:
        marks.append(Mark("threshold", tail.lowest_rate_per_hour, "extrapolation to the left"))
    text = "Each curve is a bias fault of one size: lower thresholds, to the right, see it surely and alarm falsely."
    title = f"{odds.surface}: detection against false alarms"
    ends = _LOWEST_RATE, _HIGHEST_RATE
    return Chart(title, text, *ends, (panel,), marks=tuple(marks), axis="false alarms per flight hour", log=True)


def odds_report(odds: Sequence[SurfaceOdds], left_out: Mapping[str, str], failed: Mapping[str, str]) -> Document:
    """One column per surface; why surfaces were left out and logs failed, by their names."""
    columns = [_column(one) for one in odds]
    rows = [[name, *(column[name] for column in columns)] for name in columns[0]] if columns else []
    notes = [f"{one.surface}: {note}" for one in odds for note in one.notes]
    notes += [f"{name}: nothing healthy to learn from: {reason}" for name, reason in left_out.items()]
    return Document(
        "Odds",
        "no_data",
        "",
        parts=[Table("", ["", *(one.surface for one in odds)], rows), Bullets(notes)],
        data={
            "schema": "servofd.odds/1",
            "surfaces": {one.surface: _surface(one) for one in odds},
            "missing": {**failed, **left_out},
        },
    )


def _surface(odds: SurfaceOdds) -> dict[str, Any]:
    noise, tail = odds.noise, odds.tail
    return {
        "servo": odds.servo,
        "sample_rate_hz": 1.0 / noise.sample_time_s,
        "filter_pole_rad_s": odds.design.pole_rad_s,
        "healthy_hours": odds.hours,
        "notes": list(odds.notes),
        "residual": {
            "mean_deg": noise.mean_deg,
            "std_deg": noise.sigma_deg,
            "correlation": noise.correlation,
            "long_run_factor": noise.long_run_factor,
        },
        "tail": None
        if tail is None
        else {
            "index": tail.index,
            "index_error": tail.index_error,
            "level_deg": tail.level_deg,
            "scale_deg": tail.scale_deg,
            "peaks": tail.peaks,
            "log_rate_error_in_force": tail.log_rate_error(odds.in_force.threshold_deg),
            "log_rate_error_wished": tail.log_rate_error(odds.wished.threshold_deg),
        },
        "wished": {
            "false_alarms_per_hour": odds.wish.false_alarms_per_hour,
            "threshold_deg": {
                "gaussian": odds.gaussian_threshold_deg,
                "tail": _quoted(odds.tail_threshold_deg),
                "in_a_row": {str(n): value for n, value in odds.in_a_row_threshold_deg.items()},
            },
        },
        "fault_deg": odds.wish.fault_deg,
        "at_threshold_in_force": _operating(odds.in_force),
        "at_wished_threshold": _operating(odds.wished),
    }


def _operating(operating: Operating) -> dict[str, Any]:
    return {
        "threshold_deg": operating.threshold_deg,
        "false_alarms_per_hour": {
            "gaussian": operating.gaussian_per_hour,
            "tail": _quoted(operating.tail_per_hour),
            "in_a_row": {str(n): rate for n, rate in operating.in_a_row_per_hour.items()},
        },
        "smallest_bias_deg": {f"within_{s:g}_s": size for s, size in operating.smallest_bias_deg.items()},
        "delay_s": operating.delay_s,
    }


def _quoted(quoted: Quoted | None) -> dict[str, Any] | None:
    return None if quoted is None else {"value": quoted.value, "extrapolation": quoted.extrapolated}


def _column(odds: SurfaceOdds) -> dict[str, str]:
    noise, tail, wish = odds.noise, odds.tail, odds.wish
    now, then = odds.in_force, odds.wished
    rate = f"{wish.false_alarms_per_hour:g}/h"
    column = {
        "servo": odds.servo,
        "sample rate [Hz], filter pole [rad/s]": f"{1.0 / noise.sample_time_s:.4g}, {odds.design.pole_rad_s:g}",
        "healthy data [h]": f"{odds.hours:.3g}" if odds.hours else "none (design)",
        "residual sigma [deg], rho1": f"{noise.sigma_deg:.4f}, {noise.correlation:.3f}",
        "tail index xi": "-" if tail is None else f"{tail.index:.2f} ± {tail.index_error:.2f}",
        "threshold in force [deg]": f"{now.threshold_deg:g}",
        "  false alarms/h, Gaussian": _rate(now.gaussian_per_hour),
        "  false alarms/h, measured tail": "-" if now.tail_per_hour is None else _marked(now.tail_per_hour, ".1e"),
    }
    for n in now.in_a_row_per_hour:
        column[f"  false alarms/h, {n} in a row"] = _rate(now.in_a_row_per_hour[n])
    column |= _seen(now, wish.fault_deg)
    column[f"threshold for {rate} [deg], Gaussian"] = f"{odds.gaussian_threshold_deg:.3f}"
    quoted = odds.tail_threshold_deg
    column[f"threshold for {rate} [deg], measured tail"] = "-" if quoted is None else _marked(quoted, ".3f")
    for n, value in odds.in_a_row_threshold_deg.items():
        column[f"threshold for {rate} [deg], {n} in a row"] = f"{value:.3f}"
    column |= {f"{name}, then": text for name, text in _seen(then, wish.fault_deg).items()}
    return column


def _seen(operating: Operating, fault_deg: float) -> dict[str, str]:
    rows = {
        f"  bias seen within {within_s:g} s, 99% [deg]": f"{size:.2f}"
        for within_s, size in operating.smallest_bias_deg.items()
    }
    return rows | {f"  delay for {fault_deg:g} deg [s]": _seconds(operating.delay_s)}


def _rate(per_hour: float) -> str:
    return f"{per_hour:.1e}" if per_hour > 1e-100 else "below 1e-100"


def _marked(quoted: Quoted, style: str) -> str:
    return f"{quoted.value:{style}}" + (" (extrapolation)" if quoted.extrapolated else "")


def _seconds(delay_s: float) -> str:
    if delay_s < _SHORTEST_S:
        return "at once"
    return f"{delay_s:.3g}" if delay_s < _LONGEST_S else "over an hour"
