"""Thresholds under which good runs of a servo that was identified or explained are healthy."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from servofd.aircraft.series import cut
from servofd.core.errors import DesignError, NoMeasurement
from servofd.core.statistics import LEAST_DIVISOR
from servofd.core.tolerance import Tolerance
from servofd.detection.residual import ResidualGenerator, noise_deg, prepared
from servofd.detection.threshold import interval_threshold

if TYPE_CHECKING:
    from collections.abc import Iterable

    from logparsers.records import FlightLog
    from servofd.aircraft.schema import Aircraft
    from servofd.aircraft.series import Series
    from servofd.servo.servo_model import ServoModel

PERSISTENCE = 3
"""Judged samples in a row that make an alarm: a reading may be as old as the interval since the one before it, and so
may a command, and for as many samples a step of the command contradicts no servo."""
_ALIKE_S = 2.0
"""Samples within so long tell one thing."""
_MARGIN, _UNSURE = 1.25, 2.0
"""A threshold is so many times the largest residual, and more where few blocks were seen."""
_NOISE_SIGMAS = 3.0
"""Standard deviations of its noise that a residual may reach by chance."""


class Drafted(NamedTuple):
    """Tolerances under which the runs that they come from raise no alarm."""

    tolerance: Tolerance
    level_deg: float
    """Median of the threshold that follows from it [deg]."""


def good_levels(aircraft: Aircraft, name: str, logs: Iterable[FlightLog]) -> dict[str, Any]:
    """Entries of a surface that make good runs healthy: tolerances drafted from them, and the origin of its model."""
    segments = []
    for log in logs:
        with suppress(NoMeasurement):
            segments.append(cut(log, name, aircraft))
    return levels_of(aircraft.model(name), segments)


def levels_of(model: ServoModel, segments: Iterable[Series]) -> dict[str, Any]:
    """Entries of a surface that this servo turns, under which good runs are healthy; empty if none can be judged."""
    drafts, error_deg, moved_deg = [], [], []
    for segment in segments:
        try:
            drafted = draft_tolerance(model, segment)
            generator = ResidualGenerator.fitting(model, segment)
        except DesignError:
            continue
        _, residuals, _ = prepared(generator, segment)
        if drafted is not None:
            drafts.append(drafted)
            error_deg.append(residuals.error_deg[residuals.settled])
            moved_deg.append(residuals.measured_deg[residuals.settled])
    if not drafts:
        return {}
    each = [drafted.tolerance.model_dump() for drafted in drafts]
    power = float(np.mean(np.concatenate(error_deg) ** 2))
    explained = 1.0 - power / max(float(np.var(np.concatenate(moved_deg))), LEAST_DIVISOR)
    return {
        "threshold": "interval",
        "threshold_deg": max(drafted.level_deg for drafted in drafts),
        "tolerance": {key: max(one[key] for one in each) for key in each[0]},
        "persistence": PERSISTENCE,
        "suspicions": False,
        "model": {
            "origin": "fitted",
            "held_out_rms_deg": round(float(np.sqrt(power)), 4),
            "explained_share": round(min(explained, 1.0), 4),
            "good_runs": len(drafts),
        },
    }


def draft_tolerance(model: ServoModel, segment: Series) -> Drafted | None:
    """Tolerances drafted from a good run; None if nothing of it can be judged.

    No threshold that follows from them lies below the largest residual of the run; the fewer blocks there are, the
    wider they become.
    """
    try:
        generator = ResidualGenerator.fitting(model, segment)
    except DesignError:
        return None
    segment, residuals, _ = prepared(generator, segment)
    usual = residuals.settled & np.isfinite(residuals.residual_deg)
    if not usual.any():
        return None
    base = Tolerance(noise_deg=max(round(noise_deg(residuals.error_deg[usual]), 4), 0.02))
    level = interval_threshold(generator, segment, residuals, base)
    no_noise_deg = np.maximum(np.abs(residuals.residual_deg) - _NOISE_SIGMAS * level.sigma_deg, 0.0)
    beyond = no_noise_deg / np.maximum(level.tolerance_deg, 1e-9)
    blocks = np.count_nonzero(np.diff(np.floor(residuals.time_s[usual] / _ALIKE_S), prepend=-np.inf))
    unsure = _MARGIN + _UNSURE / float(np.sqrt(blocks))
    tolerance = _scaled(base, max(unsure * float(beyond[usual].max()), 1.0))
    return Drafted(tolerance, round(interval_threshold(generator, segment, residuals, tolerance).typical_deg, 3))


def _scaled(base: Tolerance, scale: float) -> Tolerance:
    """Every tolerance so many times as wide; lags, not bandwidths, grow with the scale."""
    lags = scale * base.bandwidth / (1.0 - base.bandwidth)
    return Tolerance(
        gain=round(min(scale * base.gain, 0.9), 4),
        delay_s=round(scale * base.delay_s, 5),
        bandwidth=round(lags / (1.0 + lags), 4),
        rate=round(min(scale * base.rate, 0.9), 4),
        bias_deg=round(scale * base.bias_deg, 4),
        noise_deg=base.noise_deg,
    )
