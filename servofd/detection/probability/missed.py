"""Probability that a known fault is seen, and how long that takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from servofd.detection.probability.upcrossing import false_alarms_per_hour

if TYPE_CHECKING:
    from servofd.core.types import FloatArray
    from servofd.detection.probability.noise import Noise
    from servofd.detection.pulse import PulseFilter

_MOST_DRAWS, _FEWEST_DRAWS, _NUMBERS = 4096, 256, 4_000_000
_ROUND_OFF = 1e-12
_RARE = 0.99
"""With more than this still missed at the end, alarms are too rare for draws: crossings of the settled mean count."""
_SMALLEST = np.finfo(float).tiny


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """Probability that an alarm has been raised by each sample after a fault; arrays of shape (n,)."""

    least: FloatArray
    """Largest marginal probability so far: the truth is never below it."""
    likely: FloatArray
    """The probability itself, with the colour of the noise; its numerical error is about 1 %."""
    most: FloatArray
    """As if the samples were independent."""
    steady_per_s: float
    """Rate of alarms at the end [1/s], once the response has settled."""
    sample_time_s: float

    @property
    def mean_delay_s(self) -> float:
        """Expected time from the fault to the alarm [s]; after the last sample alarms come at the steady rate."""
        missed = 1.0 - self.likely
        seen_s = self.sample_time_s * float(missed[:-1].sum())
        if missed[-1] == 0.0:
            return seen_s
        return seen_s + float(missed[-1]) / self.steady_per_s if self.steady_per_s > 0.0 else float("inf")

    def delay_s(self, probability: float) -> float:
        """Time by which an alarm has been raised with this probability [s]; infinite if not within the response."""
        reached = np.flatnonzero(self.likely >= probability)
        return float(reached[0]) * self.sample_time_s if reached.size else float("inf")


def detect(response_deg: FloatArray, threshold_deg: float, noise: Noise) -> Detection:
    r"""Probability that a fault has raised an alarm, sample by sample.

    Parameters
    ----------
    response_deg : ndarray, shape (n,), n at least 2
        Mean residual that the fault causes [deg], from the sample at which it sets in until it has settled.
    threshold_deg : float
        Alarm level, on both sides [deg].
    noise : Noise
        Of the healthy residual, taken to be Gaussian. Its mean is added to the response.

    Notes
    -----
    With :math:`p_i = P(|r_i| \ge \tau)` the probability of an alarm by sample k lies between
    :math:`\max_{i \le k} p_i` and, for positively correlated residuals, :math:`1 - \prod_{i \le k} (1 - p_i)`.
    The probability itself is :math:`1 - E \prod_{i \le k} P(|r_i| < \tau \mid r_{i-1}, r_{i-2}, \dots)`: each sample is
    drawn from inside the threshold, given those before it, and weighted with the chance of being there (A. Genz, 1992).

    Examples
    --------
    A fault that takes the residual to the threshold at once is seen in half of all cases by its first sample:

    >>> from servofd.detection.probability import Noise
    >>> noise = Noise(0.1, np.array([1.0, 0.6]), 0.01)
    >>> detect(np.full(3, 1.0), 1.0, noise).least
    array([0.5, 0.5, 0.5])
    """
    from scipy.special import ndtr

    # Seen from the side to which the fault pushes: small probabilities then keep their digits.
    mean_deg = response_deg + noise.mean_deg
    mean_deg = mean_deg * (1.0 if mean_deg[np.argmax(np.abs(mean_deg))] >= 0.0 else -1.0)
    lower, upper = (-threshold_deg - mean_deg) / noise.sigma_deg, (threshold_deg - mean_deg) / noise.sigma_deg
    seen = ndtr(-upper) + ndtr(lower)
    least = np.maximum.accumulate(seen)
    most = np.maximum(1.0 - np.cumprod(1.0 - seen), least)
    likely = np.maximum.accumulate(np.clip(1.0 - _never_outside(lower, upper, noise), least, most))
    steady_per_s = _steady_per_s(likely, float(mean_deg[-1]), threshold_deg, noise)
    return Detection(least, likely, most, steady_per_s, noise.sample_time_s)


def bias_response(design: PulseFilter, duration_s: float) -> FloatArray:
    """Residual after a step of 1 deg in the measured deflection, from the sample at which it sets in, shape (n,).

    Examples
    --------
    >>> from servofd.detection.pulse import design_pulse_filter
    >>> from servofd.servo.library import servo_named
    >>> design = design_pulse_filter(servo_named("hs225bb-eq31").transfer, 0.004, 0.01, 50.0)
    >>> round(float(bias_response(design, 1.0)[-1]), 6)
    1.0
    """
    from scipy.signal import lfilter

    count = int(duration_s / design.sample_time_s + 1e-9) + 1
    response: FloatArray = lfilter(design.g * design.a, design.md, np.ones(count))
    return response


def smallest_bias_deg(design: PulseFilter, threshold_deg: float, noise: Noise, within_s: float) -> float:
    """Smallest step of the measured deflection that is sure to be seen in time [deg].

    From the lower bound of the probability: the largest mean residual stands so far beyond the threshold that noise
    takes it back with the remaining probability only.
    """
    from scipy.special import ndtri

    reach = float(np.max(np.abs(bias_response(design, within_s))))
    # The mean of the noise may work against the fault.
    return (threshold_deg + abs(noise.mean_deg) + float(ndtri(0.99)) * noise.sigma_deg) / reach


def _never_outside(lower: FloatArray, upper: FloatArray, noise: Noise) -> FloatArray:
    """Probability of having stayed inside the limits [sigma] up to each sample, shape (n,)."""
    from scipy.special import ndtr, ndtri

    draws = max(_FEWEST_DRAWS, min(_MOST_DRAWS, _NUMBERS // upper.size))
    random = np.random.default_rng(1).random((upper.size, draws))
    drawn = np.empty((upper.size, draws))
    weight, stayed = np.ones(draws), np.empty(upper.size)
    forecasts = [noise.prediction(known) for known in range(min(noise.order, upper.size - 1) + 1)]
    for k in range(upper.size):
        weights, spread = forecasts[min(k, len(forecasts) - 1)]
        expected = weights @ drawn[k - weights.size : k][::-1]
        low, high = ndtr((lower[k] - expected) / spread), ndtr((upper[k] - expected) / spread)
        weight = weight * (high - low)
        stayed[k] = weight.mean()
        share = np.clip(low + random[k] * (high - low), _SMALLEST, 1.0 - np.finfo(float).epsneg)
        drawn[k] = expected + spread * ndtri(share)
    return stayed


def _steady_per_s(likely: FloatArray, mean_deg: float, threshold_deg: float, noise: Noise) -> float:
    """Rate of alarms at the end of a response [1/s]."""
    missed = 1.0 - likely
    half = min(missed.size // 2, missed.size - 2)
    if missed[-1] > _RARE:
        near, far = threshold_deg - abs(mean_deg), threshold_deg + abs(mean_deg)
        both_sides = sum(
            false_alarms_per_hour(level, noise.sigma_deg, noise.correlation, noise.sample_time_s)
            for level in (near, far)
        )
        return 0.5 * both_sides / 3600.0
    if not missed[-1] > _ROUND_OFF:
        return float("inf")
    return float(np.log(missed[half] / missed[-1])) / ((missed.size - 1 - half) * noise.sample_time_s)
