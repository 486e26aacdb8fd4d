"""Tests that cannot be used, and why, a sentence each."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servofd.core.errors import IdentificationError
from servofd.core.series import latest

if TYPE_CHECKING:
    from servofd.aircraft.segment import Segment
    from servofd.core.types import FloatArray
    from servofd.identification.output_error import ServoCandidate
    from servofd.identification.records import Run, Uniform

_SLOWEST_HZ, _FASTEST_HZ = 8.0, 20_000.0
_FEWEST_SAMPLES = 30
_CLIPPED_SAMPLES, _CLIPPED_COMMAND = 0.05, 0.15
_AT_LIMIT, _SATURATED_TIME, _DENSE_S = 0.97, 0.8, 2e-3
_LEAD_S = 0.01
_DRIFT_SHARE, _DRIFT_OF_ERROR = 0.2, 0.9
"""Of the range of the command, over the test; and of the squared error of the best linear servo."""


def check_segment(segment: Segment, label: str) -> None:
    """Refuse a record that is too short, sampled wrongly, or without excitation."""
    known = np.isfinite(segment.measured_deg)
    count = int(np.count_nonzero(known))
    if count < _FEWEST_SAMPLES:
        raise IdentificationError(
            f"{label}: only {count} measured positions; a chirp or steps with at least {_FEWEST_SAMPLES} are needed"
        )
    rate_hz = 1.0 / segment.period_s
    if not _SLOWEST_HZ <= rate_hz <= _FASTEST_HZ:
        unit = "milliseconds" if rate_hz < _SLOWEST_HZ else "seconds"
        raise IdentificationError(
            f"{label}: sampled at {rate_hz:.4g} Hz: too {'slow' if rate_hz < _SLOWEST_HZ else 'fast'} to see a servo; "
            f"{_SLOWEST_HZ:g} Hz to {_FASTEST_HZ:g} Hz work. Are the time stamps in {unit}?"
        )
    measured = segment.measured_deg[known]
    at_start = float(np.median(measured[:3]))
    if np.ptp(segment.command_deg) == 0.0 and abs(segment.command_deg[0] - at_start) < 0.5 * float(np.ptp(measured)):
        raise IdentificationError(
            f"{label}: no excitation: the command is {segment.command_deg[0]:g} deg throughout; "
            "command a chirp (1 to 25 Hz, 4 deg, 120 s) or steps"
        )


def check_clipping(run: Run, label: str) -> None:
    """Refuse a position that stays at its extreme while the command moves on."""
    command_deg = latest(run.command_s, run.command_deg, run.measured_s)
    for extreme in (run.measured_deg.max(), run.measured_deg.min()):
        held = run.measured_deg == extreme
        if np.mean(held) < _CLIPPED_SAMPLES:
            continue
        low, high = np.quantile(command_deg[held], (0.1, 0.9))
        if high - low > _CLIPPED_COMMAND * np.ptp(command_deg):
            raise IdentificationError(
                f"{label}: position is clipped: {np.mean(held):.0%} of the samples are exactly {extreme:g} deg while "
                f"the command moves by {high - low:.3g} deg; use a smaller amplitude or a sensor with more range"
            )


def check_drift(run: Run, error_deg: FloatArray, label: str) -> None:
    """Refuse a position that wanders off while the command does not: it would pass for rate limits."""
    since = (run.measured_s - run.measured_s.mean()) / np.ptp(run.measured_s)
    drift_deg = float(since @ error_deg / (since @ since))
    explained = drift_deg**2 * float(since @ since) / max(float(error_deg @ error_deg), 1e-300)
    if explained > _DRIFT_OF_ERROR and abs(drift_deg) > _DRIFT_SHARE * np.ptp(run.command_deg):
        raise IdentificationError(
            f"{label}: the position drifts by {drift_deg:.3g} deg over the test while the command does not: a sensor "
            "that wanders or slips; repeat the test, or take the trend out"
        )


def check_saturation(run: Run, servo: ServoCandidate, label: str) -> None:
    """Refuse a servo that runs at its rate limit all the time: a triangle shows no dynamics."""
    if servo.rate_up_deg_s is None:
        return
    slowest_deg_s = min(servo.rate_up_deg_s, servo.rate_down_deg_s or servo.rate_up_deg_s)
    dense_s = np.arange(run.measured_s[0], run.measured_s[-1], _DENSE_S)
    speed_deg_s = np.abs(np.diff(servo.simulate(replace(run, measured_s=dense_s, measured_deg=dense_s)))) / _DENSE_S
    share = float(np.mean(speed_deg_s > _AT_LIMIT * slowest_deg_s))
    if share > _SATURATED_TIME:
        raise IdentificationError(
            f"{label}: the servo moves at its rate limit of about {slowest_deg_s:.0f} deg/s for {share:.0%} of the "
            "time, which hides its dynamics; use a smaller amplitude"
        )


def check_order_of_columns(uniform: Uniform, label: str) -> None:
    """Refuse a position that moves before its command."""
    from scipy.signal import correlate, correlation_lags

    command_deg, measured_deg, sample_time_s = uniform.command_deg, uniform.measured_deg, uniform.sample_time_s
    lag = correlation_lags(command_deg.size, command_deg.size)
    near = np.abs(lag) * sample_time_s <= 1.0
    product = correlate(np.diff(measured_deg, prepend=measured_deg[0]), np.diff(command_deg, prepend=command_deg[0]))
    lead_s = -float(lag[near][np.argmax(np.abs(product[near]))]) * sample_time_s
    if lead_s >= max(_LEAD_S, 1.5 * sample_time_s):
        raise IdentificationError(
            f"{label}: the position moves {1e3 * lead_s:.0f} ms before the command: are the two columns swapped?"
        )
