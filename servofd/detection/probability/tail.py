"""The tail of a measured residual: peaks over a threshold, and what they say about rarer ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servofd.core.errors import NoMeasurement

if TYPE_CHECKING:
    from servofd.core.types import FloatArray

HOURS_FOR_TAIL = 2.0
"""With less healthy data the fitted tail says less than the assumption of a Gaussian one."""
_LEVEL_QUANTILE = 0.999
_FEWEST_PEAKS = 200
_MOST_EXCEEDANCES = 0.05
_EXTRAPOLATION = 10.0
_SERIES = 1e-4
"""Below this the derivative by xi is taken from its limit for xi = 0, before all digits cancel."""


class Quoted(NamedTuple):
    """A number, and whether it lies beyond what the data can vouch for."""

    value: float
    extrapolated: bool


@dataclass(frozen=True, slots=True)
class TailFit:
    """Generalised Pareto distribution of the peaks of the residual's size over a level.

    Parameters
    ----------
    level_deg : float
        Level over which peaks were taken [deg].
    scale_deg : float
        Scale beta [deg].
    index : float
        Tail index xi: 0 for a Gaussian tail, far out; above 0 for heavier ones; below 0 the tail ends.
    index_error : float
        Standard error of xi.
    peaks : int
        Clusters of exceedances.
    hours : float
        Healthy data behind the fit [h].
    """

    level_deg: float
    scale_deg: float
    index: float
    index_error: float
    peaks: int
    hours: float

    @property
    def peaks_per_hour(self) -> float:
        """Clusters over the level per hour."""
        return self.peaks / self.hours

    @property
    def lowest_rate_per_hour(self) -> float:
        """Rate below which every number is an extrapolation: one in ten times the hours of data."""
        return 1.0 / (_EXTRAPOLATION * self.hours)

    def false_alarms_per_hour(self, threshold_deg: float) -> Quoted:
        r"""Rate of alarms at a threshold.

        Below the level the fit says nothing; the rate at the level is given, and the truth is higher.

        Notes
        -----
        .. math:: \nu(\tau) = \lambda \left(1 + \xi\,(\tau - u)/\beta\right)^{-1/\xi}

        Examples
        --------
        >>> TailFit(1.0, 0.1, 0.0, 0.01, 100, 10.0).false_alarms_per_hour(1.5).value.__round__(4)
        0.0674
        """
        from scipy.stats import genpareto

        excess = max(threshold_deg - self.level_deg, 0.0)
        rate = self.peaks_per_hour * float(genpareto.sf(excess, self.index, scale=self.scale_deg))
        return Quoted(rate, rate < self.lowest_rate_per_hour)

    def log_rate_error(self, threshold_deg: float) -> float:
        r"""Standard error of the logarithm of the rate at a threshold: 0.4 means a factor of 1.5 either way.

        Notes
        -----
        First-order propagation of the asymptotic covariance of the fit (R. L. Smith, 1987),

        .. math:: \frac{1+\xi}{n} \begin{pmatrix} 1+\xi & -\beta \\ -\beta & 2\beta^2 \end{pmatrix}

        and of the number of peaks. Beyond the end of a tail with xi < 0 it is infinite.

        Examples
        --------
        >>> fit = TailFit(1.0, 0.1, 0.15, 0.026, 2000, 10.0)
        >>> round(fit.log_rate_error(1.5), 2), round(fit.log_rate_error(2.5), 2)
        (0.11, 0.47)
        """
        y = max(threshold_deg - self.level_deg, 0.0) / self.scale_deg
        stretch = 1.0 + self.index * y
        if stretch <= 0.0:
            return float("inf")
        by_scale = y / (self.scale_deg * stretch)
        by_index = y**2 / 2.0
        if abs(self.index) * y > _SERIES:
            by_index = (np.log(stretch) - self.index * y / stretch) / self.index**2
        gradient = np.array([by_index, by_scale])
        one = 1.0 + self.index
        covariance = one * np.array([[one, -self.scale_deg], [-self.scale_deg, 2.0 * self.scale_deg**2]])
        return float(np.sqrt((gradient @ covariance @ gradient + 1.0) / self.peaks))

    def threshold_deg(self, rate_per_hour: float) -> Quoted:
        """Threshold for a wanted rate [deg]; the level itself if more alarms are wanted than it has.

        Examples
        --------
        >>> fit = TailFit(1.0, 0.1, 0.2, 0.01, 100, 10.0)
        >>> threshold = fit.threshold_deg(fit.false_alarms_per_hour(2.0).value)
        >>> round(threshold.value, 9), threshold.extrapolated
        (2.0, False)
        """
        from scipy.stats import genpareto

        share = min(rate_per_hour / self.peaks_per_hour, 1.0)
        excess = float(genpareto.isf(share, self.index, scale=self.scale_deg))
        return Quoted(self.level_deg + excess, rate_per_hour < self.lowest_rate_per_hour)


def fit_tail(residual_deg: FloatArray, sample_time_s: float, apart_samples: int = 15) -> TailFit:
    r"""Fit the tail of a healthy residual.

    Parameters
    ----------
    residual_deg : ndarray, shape (n,)
        Residual [deg]; NaN where it was not judged. Put at least `apart_samples` NaN between one log and the next.
    apart_samples : int
        Exceedances fewer samples apart than this belong to one peak: 15 at 100 Hz for a filter at 50 rad/s, 7.5
        time constants, after which the residual has forgotten (its correlation is below 0.01).

    Returns
    -------
    TailFit
        Maximum-likelihood fit. The level is the 99.9 % quantile of the residual's size; lower if that leaves fewer
        than 200 exceedances, but never below 95 %.

    Notes
    -----
    The standard error of xi is :math:`(1+\xi)/\sqrt{n}` for n peaks (R. L. Smith, 1987).
    """
    from scipy.stats import genpareto

    size_deg = np.abs(residual_deg)
    known = size_deg[np.isfinite(size_deg)]
    hours = known.size * sample_time_s / 3600.0
    if hours < HOURS_FOR_TAIL:
        raise NoMeasurement(f"{hours:.2g} h of healthy data; a fit of the tail needs {HOURS_FOR_TAIL:g} h")
    share = min(max(1.0 - _LEVEL_QUANTILE, _FEWEST_PEAKS / known.size), _MOST_EXCEEDANCES)
    level_deg = float(np.quantile(known, 1.0 - share))
    excess = peaks(size_deg, level_deg, apart_samples) - level_deg
    mean, variance = (float(excess.mean()), float(excess.var())) if excess.size > 1 else (0.0, 0.0)
    if not variance > 0.0:
        raise NoMeasurement("the residual has no tail to fit: its peaks are all the same")
    # Start from the moments (J. R. M. Hosking and J. R. Wallis, 1987).
    start = min(0.5 * (1.0 - mean**2 / variance), 0.4)
    with np.errstate(all="ignore"):
        # In units of the mean: the search stops at an absolute tolerance.
        index, _, scale = genpareto.fit(excess / mean, start, floc=0.0, scale=1.0 - start)
    error = (1.0 + index) / np.sqrt(excess.size)
    return TailFit(level_deg, float(scale) * mean, float(index), float(error), excess.size, hours)


def peaks(size_deg: FloatArray, level_deg: float, apart_samples: int) -> FloatArray:
    """Largest value of each cluster of exceedances [deg]."""
    over = np.flatnonzero(size_deg > level_deg)  # a missing value is never over
    if over.size == 0:
        return np.empty(0)
    first = np.flatnonzero(np.diff(over, prepend=-apart_samples - 1) >= apart_samples)
    peaks: FloatArray = np.maximum.reduceat(size_deg[over], first)
    return peaks
