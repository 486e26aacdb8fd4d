"""How often noise crosses a threshold, which threshold keeps a wished rate, and the smallest offset seen in time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import erfc, sqrt
from typing import TYPE_CHECKING

import numpy as np

from logparsers.units import S_PER_HOUR
from servofd.core.errors import DesignError

if TYPE_CHECKING:
    from servofd.core.types import FloatArray
    from servofd.detection.pulse import PulseFilter

_NODES = 120
"""Nodes of the Gauss and Legendre sum."""
_REACH = 10.0
"""Standard deviations over which the integral reaches."""
_LOWEST_Z = 1.0
"""The rate falls with the threshold from here on: for white noise it is largest at 0.67, for any other below that."""
_HIGHEST_Z = 37.0
"""Beyond it the density of a Gaussian is no longer a normal floating-point number."""
_HALVINGS = 45
"""Of the range between both, after which a threshold is right to 1e-12."""
_SURE_Z = 2.3263478740408408
"""Standard deviations that a Gaussian stays above with a probability of 99 %."""


def _below(sigmas: FloatArray) -> FloatArray:
    """Probability of a standard Gaussian below each value; importing `scipy.special` for it takes 0.1 s."""
    return np.array([0.5 * erfc(-value * sqrt(0.5)) for value in sigmas.tolist()])


@cache
def _gauss_legendre(count: int) -> tuple[FloatArray, FloatArray]:
    """Nodes and weights; working them out takes a hundred times as long as using them."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return np.asarray(nodes, dtype=float), np.asarray(weights, dtype=float)


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise of a healthy residual."""

    sigma_deg: float
    """Standard deviation [deg]."""
    correlation: float
    """Of the residual with itself one sample later."""
    sample_time_s: float
    """Sample time [s]."""
    mean_deg: float = 0.0
    """Mean [deg]; it takes its size off the margin to a threshold."""

    @classmethod
    def designed(cls, design: PulseFilter, noise_deg: float) -> Noise:
        """Noise of a residual whose measured deflection carries white noise of this standard deviation [deg]."""
        return cls(design.noise_gain * noise_deg, float(design.autocorrelation(2)[1]), design.sample_time_s)

    @classmethod
    def measured(cls, residual_deg: FloatArray, sample_time_s: float) -> Noise:
        """Noise of a healthy residual (n,) as it was measured; NaN where it was not judged, and between two logs."""
        centred = residual_deg - np.nanmean(residual_deg)
        power = float(np.nanmean(centred**2))
        correlation = float(np.nanmean(centred[1:] * centred[:-1])) / power if power > 0.0 else 0.0
        return cls(float(np.sqrt(power)), correlation, sample_time_s, float(np.nanmean(residual_deg)))

    def false_alarms_per_hour(self, threshold_deg: float) -> float:
        """Rate at which this noise crosses a threshold from inside to outside, if it is Gaussian.

        With heavier tails than a Gaussian the truth is higher.

        Examples
        --------
        >>> rate = Noise(1.0, 0.62066, 0.01).false_alarms_per_hour(5.0)
        >>> round(float(1.0 - np.exp(-rate)), 3)
        0.184
        """
        if self.sigma_deg <= 0.0:
            return 0.0
        z = max(threshold_deg - abs(self.mean_deg), 0.0) / self.sigma_deg
        rho = min(max(self.correlation, -1.0 + 1e-9), 1.0 - 1e-9)
        spread = np.sqrt(1.0 - rho**2)
        nodes, weights = _gauss_legendre(_NODES)
        # The density falls by a factor e within 1/z of the threshold: integrate over ten such lengths.
        reach = _REACH * min(1.0, 4.0 / max(z, 1e-3))
        x = z + 0.5 * reach * (nodes + 1.0)
        # Relative to the tail at z, so that a threshold of many sigma does not underflow before the end.
        density = np.exp(-0.5 * (x - z) * (x + z))
        inside = _below((z - rho * x) / spread) - _below((-z - rho * x) / spread)
        tail = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
        return float(S_PER_HOUR * 2.0 / self.sample_time_s * tail * 0.5 * reach * np.sum(weights * density * inside))

    def threshold_deg(self, rate_per_hour: float) -> float:
        """Threshold that this noise, if it is Gaussian, crosses at the wanted rate [deg]; right to ten digits of it.

        Of this surface alone: for a fleet, divide the rate by the number of surfaces.
        """
        if not self.sigma_deg > 0.0:
            raise DesignError("a residual without noise needs no threshold: the standard deviation must be above zero")
        unit = Noise(1.0, self.correlation, self.sample_time_s)
        most, least = (unit.false_alarms_per_hour(level) for level in (_LOWEST_Z, _HIGHEST_Z))
        if not least <= rate_per_hour <= most:
            raise DesignError(
                f"{rate_per_hour:g} false alarms per hour: no threshold gives this rate; choose one between "
                f"{least:.1g} and {most:.2g}"
            )
        low, high = _LOWEST_Z, _HIGHEST_Z
        for _ in range(_HALVINGS):
            level = 0.5 * (low + high)
            low, high = (level, high) if unit.false_alarms_per_hour(level) > rate_per_hour else (low, level)
        return abs(self.mean_deg) + self.sigma_deg * high


def crossings(residual_deg: FloatArray, threshold_deg: float) -> int:
    """Times that a residual (n,), NaN where it was not judged, went from inside its threshold to outside."""
    size_deg = np.abs(residual_deg)
    return int(np.count_nonzero((size_deg[:-1] < threshold_deg) & (size_deg[1:] >= threshold_deg)))


def smallest_offset_deg(design: PulseFilter, threshold_deg: float, noise: Noise, within_s: float) -> float:
    """Smallest sudden offset of the position that is over the threshold at one sample in time, with 99 % [deg].

    The largest mean residual stands so far over the threshold that noise takes it back with 1 % only.
    """
    from scipy.signal import lfilter

    count = int(within_s / design.sample_time_s + 1e-9) + 1
    response: FloatArray = lfilter(design.g * design.a, design.md, np.ones(count))
    # The mean of the noise may work against the fault.
    return (threshold_deg + abs(noise.mean_deg) + _SURE_Z * noise.sigma_deg) / float(np.max(np.abs(response)))
