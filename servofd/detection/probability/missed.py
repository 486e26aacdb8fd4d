"""Probability that a known fault is seen, and how long that takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from servofd.detection.probability.noise import Noise
    from servofd.detection.pulse import PulseFilter
    from servofd.types import FloatArray

__all__ = ["Detection", "bias_response", "detect", "smallest_bias_deg"]

_NODES = 64
_NEVER = 1e-15


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """Probability that an alarm has been raised by each sample after a fault; arrays of shape (n,)."""

    least: FloatArray
    """Largest marginal probability so far: the truth is never below it."""
    likely: FloatArray
    """Estimate that takes the correlation of neighbouring samples into account."""
    most: FloatArray
    """As if the samples were independent."""
    sample_time_s: float

    @property
    def mean_delay_s(self) -> float:
        """Expected time from the fault to the alarm [s].

        The response is taken to have settled at the end: from there on, alarms come at the rate of the last sample.
        """
        missed = 1.0 - self.likely
        if missed[-1] <= _NEVER:
            return self.sample_time_s * float(missed.sum())
        hazard = 1.0 - missed[-1] / missed[-2] if missed[-2] > 0.0 else 1.0
        tail = missed[-1] * (1.0 - hazard) / hazard if hazard > _NEVER else np.inf
        return self.sample_time_s * float(missed.sum() + tail)

    def delay_s(self, probability: float) -> float:
        """Time by which an alarm has been raised with this probability, by the estimate [s]; infinite if never."""
        reached = np.flatnonzero(self.likely >= probability)
        return float(reached[0]) * self.sample_time_s if reached.size else float("inf")


def detect(response_deg: FloatArray, threshold_deg: float, noise: Noise) -> Detection:
    r"""Probability that a fault has raised an alarm, sample by sample.

    Parameters
    ----------
    response_deg : ndarray, shape (n,)
        Mean residual that the fault causes [deg], from the sample at which it sets in.
    threshold_deg : float
        Alarm level, on both sides [deg].
    noise : Noise
        Of the healthy residual, taken to be Gaussian. Its mean is added to the response.

    Returns
    -------
    Detection
        Bounds and an estimate.

    Notes
    -----
    With :math:`p_i = P(|r_i| \ge \tau)` the probability of an alarm by sample k lies between
    :math:`\max_{i \le k} p_i` and, for positively correlated residuals, :math:`1 - \prod_{i \le k} (1 - p_i)`.
    The estimate chains neighbours,
    :math:`1 - (1-p_0) \prod P(|r_i| < \tau \mid |r_{i-1}| < \tau)`, with the bivariate Gaussian integrated over
    Gauss-Legendre nodes, and is kept between the bounds.

    Examples
    --------
    A fault that takes the residual to the threshold at once is seen in half of all cases by its first sample:

    >>> from servofd.detection.probability import Noise
    >>> noise = Noise(0.1, np.array([1.0, 0.6]), 0.01)
    >>> detect(np.full(3, 1.0), 1.0, noise).least
    array([0.5, 0.5, 0.5])
    """
    from scipy.special import ndtr

    upper = (threshold_deg - response_deg - noise.mean_deg) / noise.sigma_deg
    lower = (-threshold_deg - response_deg - noise.mean_deg) / noise.sigma_deg
    seen = ndtr(-upper) + ndtr(lower)
    least = np.maximum.accumulate(seen)
    most = 1.0 - np.cumprod(1.0 - seen)
    both = _both_inside(lower, upper, noise.correlation)
    stay = np.where(both > 0.0, both / np.maximum(1.0 - seen[:-1], np.finfo(float).tiny), 0.0)
    chain = 1.0 - (1.0 - seen[0]) * np.cumprod(np.append(1.0, np.minimum(stay, 1.0)))
    likely = np.maximum.accumulate(np.clip(chain, least, np.maximum(most, least)))
    return Detection(least, likely, most, noise.sample_time_s)


def bias_response(design: PulseFilter, duration_s: float) -> FloatArray:
    """Residual after a step of 1 deg in the measured deflection, from the sample at which it sets in, shape (n,).

    Examples
    --------
    >>> from servofd.detection.pulse import design_pulse_filter
    >>> from servofd.servos import servo_named
    >>> design = design_pulse_filter(servo_named("hs225bb-eq31").transfer, 0.004, 0.01, 50.0)
    >>> round(float(bias_response(design, 1.0)[-1]), 6)
    1.0
    """
    from scipy.signal import lfilter

    count = int(duration_s / design.sample_time_s + 1e-9) + 1
    response: FloatArray = lfilter(design.g * design.a, design.md, np.ones(count))
    return response


def smallest_bias_deg(
    design: PulseFilter, threshold_deg: float, noise: Noise, within_s: float, probability: float = 0.99
) -> float:
    """Smallest step of the measured deflection that is sure to be seen in time [deg].

    From the lower bound of the probability: the largest mean residual stands so far beyond the threshold that noise
    takes it back with the remaining probability only.
    """
    from scipy.special import ndtri

    reach = float(np.max(np.abs(bias_response(design, within_s))))
    # The mean of the noise may work against the fault.
    return (threshold_deg + abs(noise.mean_deg) + float(ndtri(probability)) * noise.sigma_deg) / reach


def _both_inside(lower: FloatArray, upper: FloatArray, correlation: float) -> FloatArray:
    """Probability that a sample and the one before it are inside their limits [sigma], shape (n - 1,)."""
    from scipy.special import ndtr

    rho = min(max(correlation, -1.0 + 1e-9), 1.0 - 1e-9)
    spread = np.sqrt(1.0 - rho**2)
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    # Beyond nine standard deviations there is nothing left to integrate.
    low, high = np.clip(lower[:-1, None], -9.0, 9.0), np.clip(upper[:-1, None], -9.0, 9.0)
    x = low + 0.5 * (high - low) * (nodes + 1.0)
    inside = ndtr((upper[1:, None] - rho * x) / spread) - ndtr((lower[1:, None] - rho * x) / spread)
    density = np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi)
    probability: FloatArray = (0.5 * (high - low) * weights * density * inside).sum(axis=1)
    return probability
