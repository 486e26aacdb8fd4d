"""What a sweep shows of a servo, in numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servofd.detection.bank.explanation import Estimate, Ridge
from servofd.detection.bank.window import Window, noise_deg
from servofd.detection.residual import commands_at_servo
from servofd.models.play import play

if TYPE_CHECKING:
    from servofd.detection.residual import ResidualGenerator, Residuals
    from servofd.detection.threshold import Threshold
    from servofd.segment import Segment
    from servofd.tolerance import Tolerance
    from servofd.types import FloatArray

_WIDE = np.array([1.0, 0.1, 1.0, 30.0, 30.0])
"""Prior standard deviations of gain, delay [s], bandwidth, bias [deg] and play [deg]: wide, a sweep is all motion."""
_PLAY_NOISES, _SMALLEST_PLAY_DEG = 6.0, 0.5


class SweepNumbers(NamedTuple):
    """Travel, and how the servo differs from its model."""

    asked_deg: tuple[float, float]
    """Lowest and highest command [deg]."""
    expected_deg: tuple[float, float]
    """Lowest and highest deflection of a healthy servo [deg]."""
    reached_deg: tuple[float, float]
    """Lowest and highest measured deflection [deg]."""
    gain: Estimate
    """Deflection per degree of command."""
    extra_delay_s: Estimate
    """Beyond that of the model [s]."""
    bandwidth: Estimate
    """Over that of the model."""
    bias_deg: Estimate
    play_deg: Estimate
    """Full width of dead band or backlash, seen when the motion turns round [deg]."""
    fastest_deg_s: float
    """Speed of the surface, single samples left out [deg/s]."""
    residual_peak_deg: float
    threshold_deg: float
    """Median level [deg]."""


def measure(
    generator: ResidualGenerator, segment: Segment, residuals: Residuals, threshold: Threshold, tolerance: Tolerance
) -> SweepNumbers:
    """Fit gain, delay, bandwidth, bias and play to a sweep.

    Notes
    -----
    Play enters as the difference between the healthy motion and what is left of it after a zone of small width,
    per degree of that width: linear in the true width as long as that is small against the motion.
    """
    judged = np.flatnonzero(residuals.settled)
    noise = noise_deg(residuals.error_deg[judged])
    commands = commands_at_servo(segment, generator.model.plan.delay_s, generator.longest_gap_s(segment))
    span = slice(int(judged[0]), int(judged[-1]) + 1)
    window = Window.of(generator.model, tolerance, noise, residuals, commands, span)
    healthy_deg = window.healthy_deg
    width_deg = max(_PLAY_NOISES * noise, _SMALLEST_PLAY_DEG)
    lost_deg = (play(healthy_deg, width_deg, float(healthy_deg[0])) - healthy_deg) / width_deg
    ridge = Ridge(np.column_stack([window.nuisances, lost_deg]), _WIDE, window.noise_deg)
    fit = ridge.fit(window.error_deg)
    gain, delay, bandwidth, bias, width = (
        ridge.estimate(fit, window.error_deg, k, offset) for k, offset in enumerate((1.0, 0.0, 1.0, 0.0, 0.0))
    )
    asked = segment.command_deg[
        (segment.command_s >= residuals.time_s[0]) & (segment.command_s <= residuals.time_s[-1])
    ]
    return SweepNumbers(
        _ends(asked if asked.size else segment.command_deg),
        _ends(healthy_deg),
        _ends(window.measured_deg),
        gain,
        delay,
        bandwidth,
        bias,
        width,
        _fastest_deg_s(window.time_s, window.measured_deg),
        float(np.max(np.abs(residuals.residual_deg[judged]))),
        threshold.typical_deg,
    )


def _ends(values_deg: FloatArray) -> tuple[float, float]:
    return float(np.min(values_deg)), float(np.max(values_deg))


def _fastest_deg_s(time_s: FloatArray, measured_deg: FloatArray) -> float:
    """Largest speed over 50 ms [deg/s]: over single samples it would be that of the noise."""
    ahead = np.minimum(np.searchsorted(time_s, time_s + 0.05), time_s.size - 1)
    step_s = time_s[ahead] - time_s
    speed = np.abs(measured_deg[ahead] - measured_deg)[step_s > 0.0] / step_s[step_s > 0.0]
    return float(np.max(speed, initial=0.0))
