"""What a better model is worth to an audit: residual, threshold, and the smallest fault that is sure to be seen.

The residual before is noise and the gap between the two models, r = Qy (y - y_better) + Qy (y_better - y_known). The
gap is no noise: a healthy servo leaves it whenever it is flown like this. A threshold that is to be quiet lies above
its largest value, and above that of the noise on top of it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.core.errors import DesignError, NoMeasurement
from servofd.detection.probability import Noise, smallest_bias_deg, threshold_for_rate_deg
from servofd.detection.pulse import design_pulse_filter
from servofd.detection.residual import ResidualGenerator

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.aircraft.series import Series
    from servofd.core.types import FloatArray
    from servofd.servo.servo_model import ServoModel

_FALSE_ALARMS_PER_HOUR = 1e-3
"""Rate of false alarms at which both models are compared [1/h]."""
_WITHIN_S = 1.0


@dataclass(frozen=True, slots=True)
class Watch:
    """What an audit with one model makes of the flight."""

    residual_std_deg: float
    residual_max_abs_deg: float
    threshold_deg: float
    """Constant level that this flight's gap and Gaussian noise pass once in 1000 h."""
    smallest_step_deg: float
    """Step of the deflection that is seen within a second with 99 % probability."""


@dataclass(frozen=True, slots=True)
class AuditGain:
    """The audit before and after."""

    before: Watch
    after: Watch

    @property
    def factor(self) -> float:
        """How many times smaller a fault can be found."""
        return self.before.smallest_step_deg / self.after.smallest_step_deg

    def document(self) -> dict[str, Any]:
        """Plain dictionary."""
        return {
            "false_alarms_per_hour": _FALSE_ALARMS_PER_HOUR,
            "within_s": _WITHIN_S,
            "before": asdict(self.before),
            "after": asdict(self.after),
            "times_smaller_fault": self.factor,
        }


def audit_gain(
    segments: Sequence[Series], known: ServoModel, better: ServoModel, until_s: float = float("inf")
) -> AuditGain | None:
    """Compare two models on the same flights; None if these are too short to tell the noise, or no filter suits one."""
    try:
        before, after = (_watch(segments, model, better, until_s) for model in (known, better))
    except (NoMeasurement, DesignError):
        return None
    return AuditGain(before, after)


def _watch(segments: Sequence[Series], model: ServoModel, better: ServoModel, until_s: float) -> Watch:
    pole_rad_s = min(ResidualGenerator.fitting(model, segment).pole_rad_s for segment in segments)
    generator = ResidualGenerator(model, pole_rad_s)
    period_s = segments[0].period_s
    design = design_pulse_filter(model.transfer, model.delay_s, period_s, pole_rad_s)
    lags = design.impulse_response().size // 2
    parts = [_parts(generator, segment, better, until_s, lags) for segment in segments]
    residual_deg, noise_deg = (np.concatenate(pieces) for pieces in zip(*parts, strict=True))
    noise = Noise.measured(noise_deg, period_s, lags)
    gap_deg = float(np.nanmax(np.abs(residual_deg - noise_deg)))
    level_deg = threshold_for_rate_deg(_FALSE_ALARMS_PER_HOUR, noise.sigma_deg, noise.correlation, period_s)
    threshold_deg = gap_deg + abs(noise.mean_deg) + level_deg
    return Watch(
        float(np.nanstd(residual_deg)),
        float(np.nanmax(np.abs(residual_deg))),
        threshold_deg,
        smallest_bias_deg(design, threshold_deg, noise, _WITHIN_S),
    )


def _parts(
    generator: ResidualGenerator, segment: Series, better: ServoModel, until_s: float, lags: int
) -> tuple[FloatArray, FloatArray]:
    """Residual, and what of it the better model leaves [deg]; NaN where it is not judged, and after the end."""
    residuals = generator.run(segment)
    moved_deg = ResidualGenerator(better, generator.pole_rad_s).run(segment).simulated_deg
    left_deg = generator.filtered(residuals.time_s, residuals.measured_deg - moved_deg, residuals.restart)
    judged = residuals.settled & (residuals.time_s < until_s)
    # What lies between two logs is longer than any memory of the filter.
    pause = np.full(2 * lags, np.nan)
    return (
        np.append(np.where(judged, residuals.residual_deg, np.nan), pause),
        np.append(np.where(judged, left_deg, np.nan), pause),
    )
