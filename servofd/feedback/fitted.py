"""Servos fitted to the very log that is judged: what is done where nobody has named or calibrated them."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from servofd.aircraft.segment import cut
from servofd.core.errors import CalibrationError, DesignError, NoMeasurement
from servofd.core.evidence import ModelOrigin
from servofd.core.tolerance import Tolerance
from servofd.detection.contradiction import PERSISTENCE, contradictions, excess, step_deg, width
from servofd.detection.residual import ResidualGenerator, noise_deg, prepared
from servofd.detection.threshold import interval_threshold
from servofd.detection.verdict import describe
from servofd.feedback.fit import RoughFit, fit_roughly
from servofd.servo.library import Servo

if TYPE_CHECKING:
    from collections.abc import Iterable

    from logparsers.records import FlightLog
    from servofd.aircraft.schema import Aircraft, Surface
    from servofd.aircraft.segment import Segment
    from servofd.servo.servo_model import ServoModel

SHORTEST_PERIOD_S, LONGEST_PERIOD_S = 1e-4, 0.2
_AROUND_S = 2.0
_SMALLEST_GAIN, _LARGEST_GAIN = 0.3, 1.7


class Drafted(NamedTuple):
    """Tolerances under which the log that they come from raises no alarm, but where it contradicts itself."""

    tolerance: Tolerance
    level_deg: float
    """Median of the threshold that follows from it [deg]."""
    peak_deg: float
    """Largest residual of the blocks from which it was drafted [deg]."""


def fitted_aircraft(log: FlightLog, aircraft: Aircraft, only: Iterable[str] | None = None) -> Aircraft:
    """Return the same aircraft with servos fitted to a log."""
    surfaces, servos = dict(aircraft.surfaces), {}
    for name in aircraft.surfaces if only is None else only:
        key = f"{name}-fitted"
        surfaces[name], servos[key] = _fitted(log, name, aircraft.surfaces[name], key)
    return aircraft.model_copy(update={"surfaces": surfaces, "servos": {**aircraft.servos, **servos}})


def fitted_servo(fit: RoughFit, title: str) -> Servo:
    """What was fitted, as a servo."""
    return Servo(
        title=title,
        bandwidth_hz=round(fit.bandwidth_hz, 3),
        damping=round(fit.damping, 3),
        delay_s=round(fit.delay_s, 4),
        hold="zoh",
        rate_limit_deg_s=round(fit.rate_limit_deg_s, 1) if np.isfinite(fit.rate_limit_deg_s) else None,
        source="fitted to the log that is judged",
    )


def _fitted(log: FlightLog, name: str, surface: Surface, key: str) -> tuple[Surface, Servo]:
    """One surface with the servo that was fitted to it."""
    plain = surface.model_copy(update={"servo": key, "effects": {}, "model": ModelOrigin(origin="none")})
    title = f"fitted to {name} of this log"
    unfit = fitted_servo(RoughFit(), title)
    try:
        segment = cut(log, name, surface)
    except NoMeasurement:
        return plain, unfit
    if not SHORTEST_PERIOD_S < segment.period_s < LONGEST_PERIOD_S:
        return plain, unfit
    fit = fit_roughly(segment, free_scale=True)
    if fit.origin.origin != "fitted":
        return plain.model_copy(update={"model": fit.origin}), unfit
    change: dict[str, object] = {"model": fit.origin, "suspicions": False}
    if _SMALLEST_GAIN <= fit.gain <= _LARGEST_GAIN:  # else sign or scale are wrong, and the verdict tells so
        change["command"] = surface.command.corrected(fit.gain, fit.bias_deg)
        if surface.command_saturation_deg is not None:
            ends = tuple(fit.gain * end + fit.bias_deg for end in surface.command_saturation_deg)
            change["command_saturation_deg"] = ends
        fit = fit.of_position
    fitted = plain.model_copy(update=change)
    drafted = draft_tolerance(fit.model, cut(log, name, fitted), until_s=fit.until_s)
    if drafted is None:
        return plain, unfit
    servo = fitted_servo(fit, title)
    levels = {
        "threshold": "interval",
        "tolerance": drafted.tolerance,
        "threshold_deg": drafted.level_deg,
        "persistence": PERSISTENCE,
    }
    return fitted.model_copy(update=levels), servo


def good_levels(aircraft: Aircraft, name: str, logs: Iterable[FlightLog]) -> dict[str, Any]:
    """Entries of a surface that make good runs healthy: tolerances drafted from them, and the origin of its model."""
    segments = []
    for log in logs:
        with suppress(NoMeasurement):
            segments.append(cut(log, name, aircraft.surfaces[name]))
    return levels_of(aircraft.model(name), segments)


def levels_of(model: ServoModel, segments: Iterable[Segment]) -> dict[str, Any]:
    """Entries of a surface that this servo turns, under which good runs are healthy; empty if none can be judged.

    Raises
    ------
    CalibrationError
        If a run contradicts every threshold: then the model does not explain it, or the run is not good.
    """
    drafts, error_deg, moved_deg = [], [], []
    for segment in segments:
        try:
            drafted = draft_tolerance(model, segment, all_of_it=True)
            generator = ResidualGenerator.fitting(model, segment)
        except DesignError:
            continue
        _, residuals, _ = prepared(generator, segment)
        for fault in contradictions(generator, residuals):
            raise CalibrationError(f"{segment.surface}: this model does not explain its own run: {describe(fault)}")
        if drafted is not None:
            drafts.append(drafted)
            error_deg.append(residuals.error_deg[residuals.settled])
            moved_deg.append(residuals.measured_deg[residuals.settled])
    if not drafts:
        return {}
    each = [drafted.tolerance.model_dump() for drafted in drafts]
    power = float(np.mean(np.concatenate(error_deg) ** 2))
    explained = 1.0 - power / max(float(np.var(np.concatenate(moved_deg))), 1e-300)
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


def draft_tolerance(
    model: ServoModel, segment: Segment, *, all_of_it: bool = False, until_s: float = np.inf
) -> Drafted | None:
    """Tolerances drafted from a log; None if nothing of it can be judged.

    No threshold that follows from them lies below the largest residual of the blocks that are alike, nor below one step
    of the command and one of the reading together; the fewer blocks there are, the wider they become.
    """
    try:
        generator = ResidualGenerator.fitting(model, segment)
    except DesignError:
        return None
    segment, residuals, _ = prepared(generator, segment)
    usual = residuals.settled & np.isfinite(residuals.residual_deg) & (residuals.time_s < until_s)
    for fault in contradictions(generator, residuals):
        end_s = np.inf if fault.end_s is None else fault.end_s + _AROUND_S
        usual &= (residuals.time_s < fault.start_s - _AROUND_S) | (residuals.time_s > end_s)
    if not usual.any():
        return None
    base = Tolerance(noise_deg=max(round(noise_deg(residuals.error_deg[usual]), 4), 0.02))
    level = interval_threshold(generator, segment, residuals, base)
    beyond = excess(residuals.residual_deg, level.sigma_deg, level.tolerance_deg)
    least = float(beyond[usual].max()) if all_of_it else 1.0
    found = width(residuals.time_s[usual], beyond[usual], residuals.simulated_deg[usual], least)
    steps_deg = step_deg(segment.command_deg) + step_deg(segment.measured_deg)
    scale = max(found.scale, 1.0, steps_deg / base.bias_deg)
    tolerance = _scaled(base, scale)
    inside = usual & (beyond <= found.usual)
    drafted = interval_threshold(generator, segment, residuals, tolerance)
    peak_deg = float(np.abs(residuals.residual_deg[inside]).max()) if inside.any() else 0.0
    return Drafted(tolerance, round(drafted.typical_deg, 3), peak_deg)


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
