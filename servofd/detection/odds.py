"""What the watch over one surface is worth: false alarms, missed faults, delays, and what other thresholds would do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from servofd.detection.probability import (
    CusumDesign,
    Noise,
    bias_response,
    design_cusum,
    detect,
    false_alarms_per_hour,
    persistent_false_alarms_per_hour,
    persistent_threshold_deg,
    smallest_bias_deg,
    threshold_for_rate_deg,
)

if TYPE_CHECKING:
    from servofd.core.types import FloatArray
    from servofd.detection.probability import Quoted, TailFit
    from servofd.detection.pulse import PulseFilter

IN_A_ROW = (2, 3, 5)
"""Persistences that are shown beside the single sample."""
KAPPA_SIGMA = 0.5
"""Reference value of the cumulative sum: best for shifts of one standard deviation."""
WITHIN_S = (0.2, 1.0)
"""Times within which a fault is to be seen [s]."""
_SETTLED_TIME_CONSTANTS = 40.0


@dataclass(frozen=True, slots=True)
class Wish:
    """What is asked of the watch."""

    false_alarms_per_hour: float = 1e-3
    """Of one surface, per flight hour."""
    fault_deg: float = 2.0
    """Step of the measured deflection whose delay is told [deg]."""


@dataclass(frozen=True, slots=True)
class Operating:
    """What one threshold does."""

    threshold_deg: float
    gaussian_per_hour: float
    """False alarms per hour if the residual is Gaussian."""
    tail_per_hour: Quoted | None
    """False alarms per hour by the measured tail; None if there is too little data to fit one."""
    in_a_row_per_hour: dict[int, float]
    """False alarms per hour if that many samples in a row are asked for (Gaussian)."""
    smallest_bias_deg: dict[float, float]
    """Step of the measured deflection seen within that time [s] with 99 % probability [deg]."""
    delay_s: float
    """Expected delay for the fault of the wish [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceOdds:
    """Odds of one surface."""

    surface: str
    servo: str
    design: PulseFilter
    noise: Noise
    hours: float
    """Healthy data behind the noise [h]; 0 if it comes from the design."""
    tail: TailFit | None
    notes: tuple[str, ...]
    wish: Wish
    in_force: Operating
    gaussian_threshold_deg: float
    """For the wished rate, if the residual is Gaussian [deg]."""
    tail_threshold_deg: Quoted | None
    """For the wished rate, by the measured tail [deg]."""
    wished: Operating
    """At the tail's threshold if there is one, else at the Gaussian."""
    in_a_row_threshold_deg: dict[int, float]
    cusum: CusumDesign
    cusum_delay_s: float


def surface_odds(
    surface: str,
    servo: str,
    design: PulseFilter,
    noise: Noise,
    threshold_deg: float,
    wish: Wish,
    *,
    tail: TailFit | None = None,
    hours: float = 0.0,
    notes: tuple[str, ...] = (),
) -> SurfaceOdds:
    """Work out the odds of one surface.

    The noise is that of its healthy residual, measured or designed; `hours` of healthy data stand behind it and the
    tail, and `notes` are what the reader must know.

    Examples
    --------
    >>> from servofd.detection.pulse import design_pulse_filter
    >>> from servofd.servo.library import servo_named
    >>> design = design_pulse_filter(servo_named("hs225bb-eq31").transfer, 0.004, 0.01, 50.0)
    >>> odds = surface_odds("elevator", "hs225bb-eq31", design, Noise.designed(design, 0.1), 1.5, Wish(1e-6))
    >>> round(odds.gaussian_threshold_deg, 3)
    0.292
    """
    wanted = wish.false_alarms_per_hour
    gaussian_deg = abs(noise.mean_deg) + threshold_for_rate_deg(
        wanted, noise.sigma_deg, noise.correlation, noise.sample_time_s
    )
    tail_deg = tail.threshold_deg(wanted) if tail else None
    cusum = design_cusum(KAPPA_SIGMA, wanted, noise)
    response_deg = wish.fault_deg * settled_bias(design)
    rows = [n for n in IN_A_ROW if n <= noise.order]
    return SurfaceOdds(
        surface=surface,
        servo=servo,
        design=design,
        noise=noise,
        hours=hours,
        tail=tail,
        notes=notes,
        wish=wish,
        in_force=_operating(threshold_deg, design, noise, tail, response_deg),
        gaussian_threshold_deg=gaussian_deg,
        tail_threshold_deg=tail_deg,
        wished=_operating(tail_deg.value if tail_deg else gaussian_deg, design, noise, tail, response_deg),
        in_a_row_threshold_deg={n: persistent_threshold_deg(wanted, noise, n) for n in rows},
        cusum=cusum,
        cusum_delay_s=cusum.mean_delay_s(response_deg / noise.sigma_deg),
    )


def settled_bias(design: PulseFilter) -> FloatArray:
    """Residual after a step of 1 deg in the measured deflection, until it has settled, shape (n,)."""
    return bias_response(design, max(WITHIN_S[-1], _SETTLED_TIME_CONSTANTS / design.pole_rad_s))


def _operating(
    threshold_deg: float, design: PulseFilter, noise: Noise, tail: TailFit | None, response_deg: FloatArray
) -> Operating:
    margin_deg = noise.margin_deg(threshold_deg)
    detection = detect(response_deg, threshold_deg, noise)
    return Operating(
        threshold_deg=threshold_deg,
        gaussian_per_hour=false_alarms_per_hour(margin_deg, noise.sigma_deg, noise.correlation, noise.sample_time_s),
        tail_per_hour=tail.false_alarms_per_hour(threshold_deg) if tail else None,
        in_a_row_per_hour={
            n: persistent_false_alarms_per_hour(threshold_deg, noise, n) for n in IN_A_ROW if n <= noise.order
        },
        smallest_bias_deg={s: smallest_bias_deg(design, threshold_deg, noise, s) for s in WITHIN_S},
        delay_s=detection.mean_delay_s,
    )
