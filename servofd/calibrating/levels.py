"""Thresholds for a wanted rate of false alarms, and the tolerances widened until they hold what was seen."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from servofd.detection.probability import Noise, fit_tail, threshold_for_rate_deg
from servofd.detection.probability.tail import HOURS_FOR_TAIL, peaks
from servofd.detection.pulse import design_pulse_filter
from servofd.detection.threshold import habits, interval_threshold
from servofd.tolerance import Tolerance

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.calibrating.stretches import Flown
    from servofd.detection.residual import ResidualGenerator, Residuals
    from servofd.segment import Segment
    from servofd.types import FloatArray

__all__ = ["MARGIN", "Levels", "Terms", "levels_for", "sigmas_for", "terms_of", "widened", "with_tail"]

MARGIN = 1.25
"""Levels stay this much above the largest residual of the good flights: the next flight is not the same."""
_TRIED = ("gain", "delay_s", "bandwidth", "bias_deg")
_UNIT = 0.5
_MOST_ROWS = 3_000
_LARGEST = Tolerance(gain=0.5, delay_s=0.1, bandwidth=0.6, bias_deg=999.0)
"""Of what a linear programme may choose: wider ones no longer describe a servo."""
_APART_S = 0.15
_TAIL, _MOST_TAIL_SAMPLES, _FEWEST_PEAKS, _MOST_WIDENING = 0.01, 2_000, 8, 3.0


class Terms(NamedTuple):
    """What the interval threshold is made of, at all judged samples of all flights; arrays of shape (n,)."""

    residual_deg: FloatArray
    base_deg: FloatArray
    """What no tolerance below changes: rate limit, lost commands."""
    sigma_deg: FloatArray
    by_tolerance: FloatArray
    """Degrees of threshold per unit of each of `servofd.detection.threshold.habits`, shape (n, 4)."""
    flight: FloatArray
    """Which flight."""
    time_s: FloatArray

    def tolerated_deg(self, tolerance: Tolerance) -> FloatArray:
        """Largest residual without noise [deg]."""
        tolerated: FloatArray = self.base_deg + self.by_tolerance @ habits(tolerance)
        return tolerated

    def ratio(self, tolerance: Tolerance, sigmas: float) -> FloatArray:
        """|residual| over its threshold."""
        ratio: FloatArray = np.abs(self.residual_deg) / (self.tolerated_deg(tolerance) + sigmas * self.sigma_deg)
        return ratio


@dataclass(frozen=True, slots=True)
class Levels:
    """Thresholds of one surface."""

    tolerance: Tolerance
    sigmas: float
    """Standard deviations of noise in the interval threshold."""
    constant_deg: float
    interval_deg: float
    """Median level of the interval threshold in these flights [deg]."""
    residual_std_deg: float
    residual_peak_deg: float
    peak_ratio: float
    """Largest \\|residual\\| over the interval threshold."""
    hours: float
    extrapolated: bool
    """True if the wanted rate is rarer than the flights can vouch for."""


def terms_of(flights: Sequence[Flown], tolerance: Tolerance) -> Terms:
    """Take the threshold apart; it is linear in the tolerances."""
    none = Tolerance(
        gain=0.0, delay_s=0.0, bandwidth=0.0, rate=tolerance.rate, bias_deg=0.0, noise_deg=tolerance.noise_deg
    )
    parts = []
    for k, (flight, generator, residuals) in enumerate(flights):
        judged = residuals.settled
        tolerated = partial(_tolerated, generator, flight.segment, residuals)
        base_deg, sigma_deg = tolerated(none)
        units = [none.model_copy(update={name: _UNIT}) for name in _TRIED]
        by = [(tolerated(unit)[0] - base_deg) / habits(unit)[index] for index, unit in enumerate(units)]
        parts.append(
            Terms(
                residuals.residual_deg[judged],
                base_deg,
                sigma_deg,
                np.column_stack(by),
                np.full(base_deg.size, float(k)),
                residuals.time_s[judged],
            )
        )
    return Terms(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _tolerated(
    generator: ResidualGenerator, segment: Segment, residuals: Residuals, tolerance: Tolerance
) -> tuple[FloatArray, FloatArray]:
    """Tolerated residual and deviation of the noise at all judged samples [deg]."""
    threshold = interval_threshold(generator, segment, residuals, tolerance)
    return threshold.tolerance_deg[residuals.settled], threshold.sigma_deg[residuals.settled]


def sigmas_for(rate_per_hour: float, flown: Flown) -> float:
    """Standard deviations of noise that a residual of this filter's colour exceeds at the wanted rate."""
    period_s = flown.flight.segment.period_s
    pulse = design_pulse_filter(flown.generator.model.transfer, 0.0, period_s, flown.generator.pole_rad_s)
    return threshold_for_rate_deg(rate_per_hour, 1.0, Noise.designed(pulse, 1.0).correlation, period_s)


def widened(terms: Terms, tolerance: Tolerance, sigmas: float) -> Tolerance:
    """Widen tolerances, as little as possible on average over time, until every residual fits with a margin.

    A linear programme: the mean level is smallest subject to level >= 1.25 |residual| at each sample. On flights that
    the model explains nothing is widened.
    """
    from scipy.optimize import linprog

    lowest, largest = habits(tolerance), habits(_LARGEST)
    short_deg = MARGIN * np.abs(terms.residual_deg) - sigmas * terms.sigma_deg - terms.base_deg
    missing_deg = short_deg - terms.by_tolerance @ lowest
    rows = np.flatnonzero(missing_deg > 0.0)
    if rows.size == 0:
        return tolerance
    rows = rows[np.argsort(missing_deg[rows])[-_MOST_ROWS:]]
    bounds = list(zip(lowest.tolist(), np.maximum(lowest, largest).tolist(), strict=True))
    found: Any = linprog(
        terms.by_tolerance.mean(axis=0), A_ub=-terms.by_tolerance[rows], b_ub=-short_deg[rows], bounds=bounds
    )
    if not found.success:
        return tolerance.model_copy(update={"bias_deg": tolerance.bias_deg + float(missing_deg.max())})
    gain, delay_s, lags, bias_deg = (1.0001 * found.x).tolist()
    changed = {"gain": gain, "delay_s": delay_s, "bandwidth": lags / (1.0 + lags), "bias_deg": bias_deg}
    return tolerance.model_copy(update=changed)


def with_tail(terms: Terms, tolerance: Tolerance, sigmas: float, rate_per_hour: float, period_s: float) -> Tolerance:
    r"""Widen tolerances for what these flights were too short to show.

    Peaks of \|residual\| over its threshold are taken to fall off exponentially (a generalised Pareto tail of index 0,
    heavier than a Gaussian one), and the threshold to be where they reach the wanted rate.

    Parameters
    ----------
    terms : Terms
        Of the good flights.
    tolerance : Tolerance
        Wide enough for the flights themselves.
    sigmas : float
        Standard deviations of noise in the threshold.
    rate_per_hour : float
        Wanted false alarms of this surface.
    period_s : float
        Sample time [s].

    Returns
    -------
    Tolerance
        At most three times as wide; the same if the tail ends below the threshold.
    """
    ratio = terms.ratio(tolerance, sigmas)
    apart = max(1, round(_APART_S / period_s))
    level = float(np.quantile(ratio, max(1.0 - _TAIL, 1.0 - _MOST_TAIL_SAMPLES / ratio.size)))
    excess = peaks(_apart(ratio, terms.flight, apart), level, apart) - level
    if excess.size < _FEWEST_PEAKS:
        return tolerance
    per_hour = excess.size / (ratio.size * period_s / 3600.0)
    factor = level + float(excess.mean()) * float(np.log(max(per_hour / rate_per_hour, 1.0)))
    wider = tolerance.scaled(float(np.clip(factor, 1.0, _MOST_WIDENING)))
    return wider.model_copy(update={"rate": tolerance.rate, "noise_deg": tolerance.noise_deg})


def levels_for(terms: Terms, tolerance: Tolerance, rate_per_hour: float, sigmas: float, period_s: float) -> Levels:
    """Levels at which healthy flights of this aircraft raise the wanted number of false alarms per hour.

    Parameters
    ----------
    terms : Terms
        Of the good flights.
    tolerance : Tolerance
        Already widened.
    rate_per_hour : float
        Wanted false alarms of this surface.
    sigmas : float
        From Gaussian up-crossings.
    period_s : float
        Sample time [s].

    Returns
    -------
    Levels
        With 2 h of flights or more the fitted tail of the residual may raise them; constant levels allow for the
        tolerances at the largest activity that was flown.
    """
    size_deg = np.abs(terms.residual_deg)
    hours = size_deg.size * period_s / 3600.0
    tolerated_deg = terms.tolerated_deg(tolerance)
    constant_deg = max(
        float(tolerated_deg.max()) + sigmas * float(np.median(terms.sigma_deg)), MARGIN * float(size_deg.max())
    )
    extrapolated = hours < HOURS_FOR_TAIL
    if not extrapolated:
        apart = max(1, round(_APART_S / period_s))
        beyond = (size_deg - tolerated_deg) / terms.sigma_deg
        tail = fit_tail(_apart(np.maximum(beyond, 0.0), terms.flight, apart), period_s, apart).threshold_deg(
            rate_per_hour
        )
        sigmas, extrapolated = max(sigmas, tail.value), tail.extrapolated
        tail = fit_tail(_apart(size_deg, terms.flight, apart), period_s, apart).threshold_deg(rate_per_hour)
        constant_deg = max(constant_deg, tail.value)
    level_deg = tolerated_deg + sigmas * terms.sigma_deg
    return Levels(
        tolerance,
        sigmas,
        constant_deg,
        float(np.median(level_deg)),
        float(np.std(terms.residual_deg)),
        float(size_deg.max()),
        float(np.max(size_deg / level_deg)),
        hours,
        extrapolated,
    )


def _apart(values: FloatArray, flight: FloatArray, gap: int) -> FloatArray:
    """Same values with missing ones between flights, so that no peak spans two of them."""
    edges = np.flatnonzero(np.diff(flight)) + 1
    return np.concatenate([np.append(part, np.full(gap, np.nan)) for part in np.split(values, edges)])
