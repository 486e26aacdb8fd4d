"""False alarms when the residual must stay over its threshold for several samples in a row."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from servofd.detection.probability.upcrossing import false_alarms_per_hour, root_of_rate

if TYPE_CHECKING:
    from servofd.core.types import FloatArray
    from servofd.detection.probability.noise import Noise

_POINTS_LOG2 = 13
_SHARE_SEEN = 0.95
_RUNS = 400
"""Flights to simulate; the standard error is about the delay over their square root."""
_WHITE_SHARE = 1e-12
_SMALLEST = np.finfo(float).tiny
_LARGEST_BELOW_ONE = float(np.nextafter(1.0, 0.0))


def persistent_false_alarms_per_hour(threshold_deg: float, noise: Noise, samples: int) -> float:
    r"""Rate of alarms that ask for several samples in a row over the threshold, all on one side.

    Parameters
    ----------
    threshold_deg : float
        Alarm level, on both sides [deg].
    samples : int
        Samples in a row, at least 1 and at most the number of lags that are known; 1 is `false_alarms_per_hour`.

    Notes
    -----
    One alarm for each run of at least :math:`n` samples, counted where it has lasted :math:`n`:

    .. math:: \nu_n = \frac{2}{T}\,
              \left[P(r_1 > \tau, \dots, r_n > \tau) - P(r_1 > \tau, \dots, r_{n+1} > \tau)\right]

    (a run begun is a run ended, so "not before" may be read as "not after"). They are integrals, to 1e-3,
    over the Cholesky factor of the correlation, each variable drawn from its tail given those before it (A. Genz,
    1992), on a fixed low-discrepancy net: accurate relative to their own size, and smooth in the threshold.

    Examples
    --------
    >>> from servofd.detection.probability import Noise
    >>> from servofd.detection.pulse import design_pulse_filter
    >>> from servofd.servo.library import servo_named
    >>> design = design_pulse_filter(servo_named("hs225bb-eq31").printed, 0.004, 0.01, 50.0)
    >>> noise = Noise.designed(design, noise_deg=0.1)
    >>> rate = persistent_false_alarms_per_hour(4.0 * noise.sigma_deg, noise, samples=3)
    >>> round(float(1.0 - np.exp(-rate)), 3)
    0.078
    """
    margin_deg = noise.margin_deg(threshold_deg)
    if samples == 1:
        return false_alarms_per_hour(margin_deg, noise.sigma_deg, noise.correlation, noise.sample_time_s)
    return _rate(margin_deg / noise.sigma_deg, _factor(noise, samples), noise.sample_time_s)


def persistent_threshold_deg(rate_per_hour: float, noise: Noise, samples: int) -> float:
    """Threshold at which this many samples in a row give the wanted rate of false alarms [deg]."""
    if samples == 1:
        z = root_of_rate(
            lambda level: false_alarms_per_hour(level, 1.0, noise.correlation, noise.sample_time_s), rate_per_hour
        )
    else:
        factor = _factor(noise, samples)
        z = root_of_rate(lambda level: _rate(level, factor, noise.sample_time_s), rate_per_hour)
    return z * noise.sigma_deg + abs(noise.mean_deg)


def persistent_delay_s(
    response_deg: FloatArray, threshold_deg: float, noise: Noise, samples: int, *, seed: int = 1
) -> float:
    """Expected time from a fault to this many samples in a row over the threshold, by simulation [s].

    Parameters
    ----------
    response_deg : ndarray, shape (n,)
        Mean residual that the fault causes [deg], from the sample at which it sets in.
    threshold_deg : float
        Alarm level, on both sides [deg].

    Returns
    -------
    float
        Mean delay; infinite if more than one run in twenty saw no alarm within the response.
    """
    residual = noise.sample((_RUNS, response_deg.size), seed) + response_deg + noise.mean_deg
    hit = np.zeros(residual.shape, dtype=bool)
    for side in (residual >= threshold_deg, residual <= -threshold_deg):
        held = side.copy()
        for back in range(1, samples):
            held[:, back:] &= side[:, :-back]
            held[:, :back] = False
        hit |= held
    seen = hit.any(axis=1)
    if np.count_nonzero(seen) < _SHARE_SEEN * _RUNS:
        return float("inf")
    return float(np.where(seen, hit.argmax(axis=1), response_deg.size).mean()) * noise.sample_time_s


def _factor(noise: Noise, samples: int) -> FloatArray:
    from scipy.linalg import toeplitz

    if not 1 <= samples < noise.autocorrelation.size:
        raise ValueError(f"{samples} samples in a row: the colour is known for 1 to {noise.autocorrelation.size - 1}")
    correlation = toeplitz(noise.autocorrelation[: samples + 1])
    # A trace of white noise keeps the matrix of a very smooth residual from being singular.
    return np.asarray(np.linalg.cholesky(correlation + _WHITE_SHARE * np.eye(samples + 1)), dtype=np.float64)


def _rate(z: float, factor: FloatArray, sample_time_s: float) -> float:
    """Runs of exactly the first n rows, the last row being inside again; both signs."""
    from scipy.special import ndtr, ndtri

    size = factor.shape[0]
    net = _net(size - 1)
    drawn = np.zeros((size, net.shape[0]))
    chance = np.ones(net.shape[0])
    for i in range(size):
        tail = ndtr(-(z - factor[i, :i] @ drawn[:i]) / factor[i, i])
        if i == size - 1:
            chance = chance * (1.0 - tail)
        else:
            chance = chance * tail
            drawn[i] = -ndtri(np.clip(net[:, i] * tail, _SMALLEST, _LARGEST_BELOW_ONE))
    return float(3600.0 * 2.0 / sample_time_s * chance.mean())


@cache
def _net(dimensions: int) -> FloatArray:
    """Scrambled Sobol points, shape (8192, dimensions); always the same."""
    from scipy.stats.qmc import Sobol

    points: FloatArray = Sobol(dimensions, rng=np.random.default_rng(1)).random_base2(_POINTS_LOG2)
    return points
