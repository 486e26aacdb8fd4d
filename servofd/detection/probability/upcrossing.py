"""False alarms of a Gaussian residual: how often it crosses its threshold, and the threshold for a wanted rate."""

from __future__ import annotations

from functools import cache
from math import erfc, sqrt
from typing import TYPE_CHECKING

import numpy as np

from servofd.core.errors import DesignError
from servofd.core.numeric import root

if TYPE_CHECKING:
    from collections.abc import Callable

    from servofd.core.types import FloatArray

_NODES = 120
_REACH = 10.0
_LOWEST_Z = 1.0
"""The rate falls with the threshold from here on: for white noise it is largest at 0.67, for any other below that."""
_HIGHEST_Z = 37.0
"""Beyond it the density of a Gaussian is no longer a normal floating-point number."""


def false_alarms_per_hour(threshold_deg: float, sigma_deg: float, correlation: float, sample_time_s: float) -> float:
    r"""Rate at which a healthy, Gaussian residual crosses its threshold from inside to outside.

    Parameters
    ----------
    threshold_deg : float
        Alarm level, on both sides [deg].
    correlation : float
        Correlation of the residual with itself one sample later, between -1 and 1.

    Returns
    -------
    float
        Alarms per flight hour. For a residual with heavier tails than a Gaussian the truth is higher.

    Notes
    -----
    Discrete up-crossings, with :math:`z = \tau/\sigma` and :math:`s = \sqrt{1-\rho_1^2}`:

    .. math:: \nu = \frac{2}{T} \int_z^\infty \varphi(x)
              \left[\Phi\!\left(\frac{z-\rho_1 x}{s}\right) - \Phi\!\left(\frac{-z-\rho_1 x}{s}\right)\right] dx

    Examples
    --------
    >>> rate = false_alarms_per_hour(5.0, 1.0, 0.62066, 0.01)
    >>> round(float(1.0 - np.exp(-rate)), 3)
    0.184
    """
    if sigma_deg <= 0.0:
        return 0.0
    z = threshold_deg / sigma_deg
    rho = min(max(correlation, -1.0 + 1e-9), 1.0 - 1e-9)
    spread = np.sqrt(1.0 - rho**2)
    nodes, weights = _gauss_legendre(_NODES)
    # The density falls by a factor e within 1/z of the threshold: integrate over ten such lengths.
    reach = _REACH * min(1.0, 4.0 / max(z, 1e-3))
    x = z + 0.5 * reach * (nodes + 1.0)
    # Relative to the tail at z, so that a threshold of many sigma does not underflow before the end.
    density = np.exp(-0.5 * (x - z) * (x + z))
    inside = _below((z - rho * x) / spread) - _below((-z - rho * x) / spread)
    tail = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
    return float(3600.0 * 2.0 / sample_time_s * tail * 0.5 * reach * np.sum(weights * density * inside))


def _below(sigmas: FloatArray) -> FloatArray:
    """Probability of a standard Gaussian below each value; importing `scipy.special` for it takes 0.1 s."""
    return np.array([0.5 * erfc(-value * sqrt(0.5)) for value in sigmas.tolist()])


@cache
def _gauss_legendre(count: int) -> tuple[FloatArray, FloatArray]:
    """Nodes and weights; working them out takes a hundred times as long as using them."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return np.asarray(nodes, dtype=float), np.asarray(weights, dtype=float)


def threshold_for_rate_deg(rate_per_hour: float, sigma_deg: float, correlation: float, sample_time_s: float) -> float:
    """Threshold at which a healthy Gaussian residual gives the wanted rate of false alarms.

    Parameters
    ----------
    rate_per_hour : float
        Wanted false alarms per flight hour, of this surface alone; for a fleet, divide by the number of surfaces.
    sigma_deg : float
        Standard deviation of the residual [deg], above zero.

    Returns
    -------
    float
        Threshold [deg]; `false_alarms_per_hour` there is the wanted rate to ten digits.

    Examples
    --------
    >>> round(threshold_for_rate_deg(1e-6, 0.0418, 0.62066, 0.01), 3)
    0.292
    """
    if not sigma_deg > 0.0:
        raise DesignError("a residual without noise needs no threshold: the standard deviation must be above zero")
    z = root_of_rate(lambda level: false_alarms_per_hour(level, 1.0, correlation, sample_time_s), rate_per_hour)
    return z * sigma_deg


def root_of_rate(rate: Callable[[float], float], wanted_per_hour: float) -> float:
    """Threshold in standard deviations at which a falling rate takes the wanted value.

    Examples
    --------
    >>> round(root_of_rate(lambda z: 10.0 ** -z, 1e-3), 9)
    3.0
    """
    most, least = rate(_LOWEST_Z), rate(_HIGHEST_Z)
    if not least <= wanted_per_hour <= most:
        raise DesignError(
            f"{wanted_per_hour:g} false alarms per hour: no threshold gives this rate; choose one between "
            f"{least:.1g} and {most:.2g}"
        )
    # Rates span hundreds of powers of ten: only their logarithm is near a straight line.
    tiny = np.finfo(float).tiny
    wanted = np.log(max(wanted_per_hour, tiny))
    return root(lambda level: float(np.log(max(rate(level), tiny)) - wanted), _LOWEST_Z, _HIGHEST_Z)
