"""Cumulative sums: slow for large faults, but sure for small ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from servofd.core.numeric import root
from servofd.core.types import BoolArray, FloatArray
from servofd.servo.state import compiled, fixed

if TYPE_CHECKING:
    from servofd.detection.probability.noise import Noise

_OVERSHOOT = 1.166
"""Mean overshoot of a Gaussian random walk, twice 0.583 (D. Siegmund, Sequential Analysis, 1985)."""


@dataclass(frozen=True, slots=True)
class CusumDesign:
    """A two-sided cumulative sum with its alarm limit.

    Parameters
    ----------
    kappa : float
        Reference value [sigma]: what is taken off each sample. Shifts below it are never seen.
    limit : float
        Alarm limit h [sigma].
    factor : float
        Long-run factor S of the noise, 1 if it is white.
    sample_time_s : float
        Sample time [s].
    """

    kappa: float
    limit: float
    factor: float
    sample_time_s: float

    def mean_delay_s(self, shift_sigma: FloatArray) -> float:
        r"""Expected time from the fault to the alarm [s].

        Parameters
        ----------
        shift_sigma : ndarray, shape (n,)
            Mean residual that the fault causes, in standard deviations, until it has settled.

        Returns
        -------
        float
            Delay; infinite if the settled shift does not exceed the reference value.

        Notes
        -----
        Siegmund's formula for a drift :math:`\Delta = \delta - \kappa`, with the variance of the walk multiplied by S,

        .. math:: N = S\,\frac{e^{-2\Delta b/S} + 2\Delta b/S - 1}{2\Delta^2}, \qquad b = h + 1.166\,\sqrt{S}

        and the delay is the time by which the response has gathered as much as N samples of the settled shift would.
        Within a fifth of simulated delays, or two samples.
        """
        drift = abs(float(shift_sigma[-1])) - self.kappa
        if drift <= 0.0:
            return float("inf")
        barrier = self.limit + _OVERSHOOT * np.sqrt(self.factor)
        x = 2.0 * drift * barrier / self.factor
        needed = self.factor * (np.expm1(-x) + x) / (2.0 * drift)
        gathered = np.cumsum(np.sign(shift_sigma[-1]) * shift_sigma - self.kappa)
        reached = np.flatnonzero(gathered >= needed)
        samples = float(reached[0]) if reached.size else shift_sigma.size - 1 + (needed - gathered[-1]) / drift
        return float(samples * self.sample_time_s)


def design_cusum(kappa: float, rate_per_hour: float, noise: Noise) -> CusumDesign:
    r"""Alarm limit for a wanted rate of false alarms.

    Returns
    -------
    CusumDesign
        With :math:`h = S\,h_\mathrm{iid}`; on coloured residuals its rate is at most the wanted one.

    Notes
    -----
    For white noise, Siegmund's run length of one side is
    :math:`(e^{2\kappa b} - 2\kappa b - 1)/(2\kappa^2)`, :math:`b = h + 1.166`; two sides alarm twice as often.

    Examples
    --------
    >>> from servofd.detection.probability import Noise
    >>> white = Noise(1.0, np.array([1.0, 0.0]), 0.01)
    >>> round(design_cusum(0.5, 3600.0 / (9556.0 * 0.01), white).limit, 3)
    8.0
    """
    samples = 2.0 * 3600.0 / (rate_per_hour * noise.sample_time_s)
    wanted = 2.0 * kappa**2 * samples
    # exp(x) - x - 1 = wanted; it lies below exp(x), and above it by no more than twice near the root.
    top = float(np.log(wanted + 1.0)) * 2.0 + 4.0
    x = root(lambda value: np.expm1(value) - value - wanted, 0.0, top)
    white = max(float(x) / (2.0 * kappa) - _OVERSHOOT, 0.0)
    return CusumDesign(kappa, noise.long_run_factor * white, noise.long_run_factor, noise.sample_time_s)


def cusum(
    normalised_residual: FloatArray,
    kappa: float,
    restart: BoolArray | None = None,
    memory: FloatArray | None = None,
) -> FloatArray:
    """Two-sided cumulative sum of a residual.

    Parameters
    ----------
    normalised_residual : ndarray, shape (n,)
        Residual less its healthy mean, in standard deviations. Over a NaN the sum holds.
    kappa : float
        Reference value [sigma].
    restart : ndarray of bool, shape (n,), optional
        True where the sum starts anew from zero, before this sample is added.
    memory : ndarray, shape (2,), optional
        Both sums [sigma]: where they stand before the first sample, and after the last one.

    Returns
    -------
    ndarray, shape (n,)
        The larger of both sums [sigma], never below zero.

    Examples
    --------
    >>> cusum(np.array([1.0, 2.0, np.nan, -4.0]), 0.5)
    array([0.5, 2. , 2. , 3.5])
    >>> cusum(np.ones(4), 0.5, np.array([False, False, True, False]))
    array([0.5, 1. , 0.5, 1. ])
    """
    values = np.asarray(normalised_residual, dtype=float)
    restarts = np.zeros(values.size, dtype=bool) if restart is None else np.asarray(restart, dtype=bool)
    if restarts.shape != values.shape:
        raise ValueError(f"restart has shape {restarts.shape}, the residual {values.shape}")
    result = np.empty(values.size)
    _sums(fixed(values), kappa, fixed(restarts), np.zeros(2) if memory is None else memory, result)
    return result


@compiled
def _sums(values: FloatArray, kappa: float, restart: BoolArray, memory: FloatArray, result: FloatArray) -> None:
    high, low = memory[0], memory[1]
    for k in range(values.size):
        if restart[k]:
            high = low = 0.0
        if not np.isnan(values[k]):
            high = max(0.0, high + values[k] - kappa)
            low = max(0.0, low - values[k] - kappa)
        result[k] = max(high, low)
    memory[0], memory[1] = high, low
