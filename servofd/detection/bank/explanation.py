"""What one hypothesis makes of a window, and the least squares that all of them share."""

from __future__ import annotations

from copy import copy
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servofd.estimate.statistics import Estimate

if TYPE_CHECKING:
    from servofd.core.types import FloatArray

COLOUR = 4.0
"""Misfits of neighbouring samples are alike: so many samples tell as much as one."""


class Regression(NamedTuple):
    """Outcome of a ridge regression with k regressors on n samples."""

    coefficients: FloatArray
    """Of shape (k,)."""
    predicted_deg: FloatArray
    """Of shape (n,)."""
    cost_deg2: float
    """Sum of squared misfits [deg^2]."""
    doubt: float
    """Sum of squared coefficients in standard deviations of their priors."""


class Ridge:
    """Least squares with a Gaussian prior of zero mean on each coefficient, for many targets.

    Parameters
    ----------
    regressors : ndarray, shape (n, k)
        By what to explain.
    spread : ndarray, shape (k,)
        Standard deviation of each coefficient's prior; infinite for none.
    noise_deg : float
        Standard deviation of the noise [deg].

    Examples
    --------
    >>> fit = Ridge(np.ones((2, 1)), np.array([np.inf]), 0.1).fit(np.array([1.0, 3.0]))
    >>> fit.coefficients.round(6), round(fit.cost_deg2, 6)
    (array([2.]), 2.0)
    """

    def __init__(self, regressors: FloatArray, spread: FloatArray, noise_deg: float) -> None:
        self.regressors, self.noise_deg = regressors, noise_deg
        self.weight = noise_deg**2 / spread**2
        self.gram = regressors.T @ regressors
        self.inverse = np.linalg.inv(self.gram + np.diag(self.weight + 1e-12 * len(regressors)))

    def respread(self, spread: FloatArray) -> Ridge:
        """Return the same regressors with other priors."""
        other = copy(self)
        other.weight = self.noise_deg**2 / spread**2
        other.inverse = np.linalg.inv(self.gram + np.diag(other.weight + 1e-12 * len(self.regressors)))
        return other

    @property
    def occam(self) -> float:
        """Twice the negative logarithm of the share of the prior that fits this well: evidence's price of freedom."""
        return float(-np.linalg.slogdet(self.inverse)[1] - np.sum(np.log(self.weight)))

    def fit(self, target_deg: FloatArray) -> Regression:
        """Explain a target of shape (n,) [deg]."""
        coefficients = self.inverse @ (self.regressors.T @ target_deg)
        predicted_deg = self.regressors @ coefficients
        misfit = target_deg - predicted_deg
        doubt = float(self.weight @ coefficients**2) / self.noise_deg**2
        return Regression(coefficients, predicted_deg, float(misfit @ misfit), doubt)

    def estimate(
        self, fit: Regression, target_deg: FloatArray, index: int, offset: float = 0.0, own: float = 0.0
    ) -> Estimate:
        """One coefficient with its interval; `own` is the deviation that the servo may have had all along."""
        doubt = _misfit_deviation(target_deg - fit.predicted_deg, self.noise_deg)
        deviation = float(np.hypot(doubt * np.sqrt(self.inverse[index, index]), own))
        return Estimate.of(offset + float(fit.coefficients[index]), deviation)


def _misfit_deviation(misfit_deg: FloatArray, noise_deg: float) -> float:
    """Deviation of the misfit, enlarged for its colour: neighbours that agree tell less than strangers."""
    deviation = max(noise_deg, float(np.sqrt(np.mean(misfit_deg**2))))
    if misfit_deg.size < 3:
        return deviation
    power = float(misfit_deg @ misfit_deg)
    likeness = min(max(float(misfit_deg[1:] @ misfit_deg[:-1]) / max(power, 1e-300), 0.0), 0.98)
    return deviation * float(np.sqrt((1.0 + likeness) / (1.0 - likeness)))
