"""How often noise alone would raise an alarm."""

from __future__ import annotations

import numpy as np

__all__ = ["false_alarms_per_hour"]

_NODES = 120
_REACH = 10.0


def false_alarms_per_hour(threshold_deg: float, sigma_deg: float, correlation: float, sample_time_s: float) -> float:
    r"""Rate at which a healthy, Gaussian residual crosses its threshold from inside to outside.

    Parameters
    ----------
    threshold_deg : float
        Alarm level, on both sides [deg].
    sigma_deg : float
        Standard deviation of the residual [deg].
    correlation : float
        Correlation of the residual with itself one sample later, between -1 and 1.
    sample_time_s : float
        Sample time [s].

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
    from scipy.special import log_ndtr, ndtr

    if sigma_deg <= 0.0:
        return 0.0
    z = threshold_deg / sigma_deg
    rho = min(max(correlation, -1.0 + 1e-9), 1.0 - 1e-9)
    spread = np.sqrt(1.0 - rho**2)
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    # The density falls by a factor e within 1/z of the threshold: integrate over ten such lengths.
    reach = _REACH * min(1.0, 4.0 / max(z, 1e-3))
    x = z + 0.5 * reach * (nodes + 1.0)
    # Relative to the tail at z, so that a threshold of many sigma does not underflow before the end.
    density = np.exp(-0.5 * (x - z) * (x + z))
    inside = ndtr((z - rho * x) / spread) - np.exp(log_ndtr((-z - rho * x) / spread))
    tail = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
    return float(3600.0 * 2.0 / sample_time_s * tail * 0.5 * reach * np.sum(weights * density * inside))
