r"""The best that any causal detector can do: it knows the fault, when it sets in, and the servo's tolerances.

The log-likelihood ratio of "this fault, since then" against "healthy", sample by sample. The residual is the
simulation error :math:`e` through a filter that can be inverted, so the ratio of both is the same; and that of the
error is simple: its noise is white, and a working servo adds :math:`N\theta` with :math:`\theta` normal of the
tolerances' spread. With the signature :math:`d` of the fault (faulty minus healthy deflection of that very flight,
without noise),

.. math:: \Lambda_k = d^T \Sigma_k^{-1} (e - d/2), \qquad \Sigma_k = \sigma^2 I + N P N^T \quad \text{(up to sample } k)

which by Woodbury's identity needs running sums and one 4 by 4 system a sample. What came before the onset is in it:
this detector has learnt what its servo is like. Two limits:

- :math:`\ln(1/\alpha)`: exceeded in at most a share :math:`\alpha` of healthy flights (Wald), by a detector that is
  switched on at the onset. Nobody can know the onset: this is a bound that cannot be reached.
- :math:`\ln \gamma`: a cumulative sum of the same ratio has a mean time of at least :math:`\gamma` samples between
  false alarms, and no detector with that many is faster in its worst case (G. Lorden, Procedures for reacting to a
  change in distribution, 1971). This is the bound at an equal rate of false alarms.

The model of health is not quite right (converters, lost commands): no limit is below the largest ratio that healthy
flights give.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from servofd.core.types import FloatArray

__all__ = ["KNOWN_ONSET", "UNKNOWN_ONSET", "Health", "log_likelihood_ratio"]

_FLIGHTS_PER_FALSE_ALARM, _SAMPLES_PER_FLIGHT = 1000, 12_000
KNOWN_ONSET = float(np.log(_FLIGHTS_PER_FALSE_ALARM))
UNKNOWN_ONSET = float(np.log(_FLIGHTS_PER_FALSE_ALARM * _SAMPLES_PER_FLIGHT))


class Health(NamedTuple):
    """What a working servo may add to the error of its simulation, and the noise."""

    noise_deg: float
    spread: FloatArray
    """Standard deviation of each nuisance, shape (k,)."""
    nuisances: FloatArray
    """What one unit of each adds, shape (n, k)."""


def log_likelihood_ratio(health: Health, error_deg: FloatArray, signature_deg: FloatArray) -> FloatArray:
    """Evidence for a fault of known signature, up to and including each sample of a flight, shape (n,).

    Parameters
    ----------
    health : Health
        Of the whole flight.
    error_deg : ndarray, shape (n,)
        Measured minus simulated deflection [deg].
    signature_deg : ndarray, shape (n,)
        What the fault adds to it, zero before the onset [deg].

    Examples
    --------
    Without nuisances that resemble it, a step of one sigma brings half a unit a sample:

    >>> health = Health(noise_deg=1.0, spread=np.array([1e-9]), nuisances=np.ones((3, 1)))
    >>> log_likelihood_ratio(health, np.ones(3), np.ones(3)).round(6).tolist()
    [0.5, 1.0, 1.5]
    """
    variance, regressors = health.noise_deg**2, health.nuisances / health.noise_deg * health.spread
    gram = np.cumsum(regressors[:, :, None] * regressors[:, None, :], axis=0) + np.eye(regressors.shape[1])
    against = np.cumsum(regressors * signature_deg[:, None], axis=0)
    target_deg = error_deg - 0.5 * signature_deg
    along = np.cumsum(regressors * target_deg[:, None], axis=0)
    explained = np.einsum("ki,ki->k", against, np.linalg.solve(gram, along[:, :, None])[:, :, 0])
    ratio: FloatArray = (np.cumsum(signature_deg * target_deg) - explained) / variance
    return ratio
