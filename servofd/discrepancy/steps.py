"""The noise of a sensor whose steps are coarse: what lies below them, and what they make of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from servofd.core.types import FloatArray

COARSE_STEP_DEG = 0.12
"""10 bits for 120 deg; what is finer is a usual potentiometer's or encoder's converter, and missing in no model."""
_MOST, _FEWEST = 3000, 100
_EDGES = np.arange(-3.5, 4.0)
"""Edges beside a reading that noise of up to a step may cross [steps]."""
_FINEST_SHARE = 0.02
"""Nothing finer is seen through steps: it is what a simulation may be wrong by, too."""
_NODES = 24
_TEETH = 4
_OFF_COMB, _FEWEST_VALUES = 0.1, 3
_NO_CHANCE = 20.0


def noise_below_deg(measured_deg: FloatArray, simulated_deg: FloatArray, step_deg: float) -> float:
    """Standard deviation of the noise before a converter of coarse steps [deg].

    Where a position lies between two edges is known from the simulation, and with it how many edges lie between one
    reading and the next on average, for any noise: that noise is taken for which it is what is seen. A simulation that
    is off by much less than a step does no harm, because both readings are.

    Parameters
    ----------
    measured_deg, simulated_deg : ndarray, shape (n,)
        Readings, and positions without steps, of the same samples in a row; NaN where there is none [deg].

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> moved = 6.0 * np.sin(np.linspace(0.0, 60.0, 6000))
    >>> round(noise_below_deg(0.8 * np.round((moved + 0.1 * rng.standard_normal(6000)) / 0.8), moved, 0.8), 1)
    0.1
    """
    from scipy.optimize import brentq
    from scipy.special import ndtr

    crossed = np.abs(np.diff(measured_deg)) / step_deg
    told = np.flatnonzero(np.isfinite(crossed) & (np.abs(np.diff(simulated_deg)) < step_deg))
    told = told[:: max(1, told.size // _MOST)]
    if told.size < _FEWEST:
        return _FINEST_SHARE * step_deg
    first, second = simulated_deg[told] / step_deg, simulated_deg[told + 1] / step_deg
    edges = np.round(first)[:, np.newaxis] + _EDGES
    before, after = edges - first[:, np.newaxis], edges - second[:, np.newaxis]
    seen = float(crossed[told].sum())
    seen += float(np.sqrt(seen))  # one standard deviation: a floor that is too low makes effects of noise

    def more(share: float) -> float:
        below, then = ndtr(before / share), ndtr(after / share)
        return float(np.sum(below * (1.0 - then) + then * (1.0 - below))) - seen

    low, high = _FINEST_SHARE, 1.0
    if more(low) >= 0.0:
        return low * step_deg
    return step_deg if more(high) <= 0.0 else step_deg * float(brentq(more, low, high, xtol=1e-3))


def noise_within_deg(
    measured_deg: FloatArray, simulated_deg: FloatArray, step_deg: float, sigma_deg: float
) -> FloatArray:
    """What the noise before a converter may have been [deg]: of the normal distribution, if the simulation is right.

    A reading tells between which edges a position lay; where between them is drawn, always in the same way. Unlike the
    difference of two readings it does not depend on how far the position is from an edge.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> moved = 6.0 * np.sin(np.linspace(0.0, 60.0, 6000))
    >>> read = 0.8 * np.round((moved + 0.1 * rng.standard_normal(6000)) / 0.8)
    >>> round(float(np.std(noise_within_deg(read, moved, 0.8, 0.1))), 2)
    0.1
    """
    from scipy.special import log_ndtr, ndtri_exp

    low = (measured_deg - 0.5 * step_deg - simulated_deg) / sigma_deg
    high = low + step_deg / sigma_deg
    # Beyond the middle the other tail is the accurate one.
    mirrored = low + high > 0.0
    low, high = np.where(mirrored, -high, low), np.where(mirrored, -low, high)
    lower, upper = np.exp(log_ndtr(low) - log_ndtr(high)), 1.0
    drawn = np.random.default_rng(0).uniform(size=low.size)
    share = np.log(lower + drawn * (upper - lower)) + log_ndtr(high)
    noise_deg: FloatArray = sigma_deg * ndtri_exp(share)
    return np.where(mirrored, -noise_deg, noise_deg)


def mean_reading_deg(moved_deg: FloatArray, step_deg: float, sigma_deg: float) -> FloatArray:
    """What a converter with coarse steps reads on average where noise precedes it [deg]: smooth, as no reading is.

    Examples
    --------
    >>> [round(float(x), 2) for x in mean_reading_deg(np.array([0.0, 0.3, 0.5, 1.0]), 1.0, 0.1)]
    [0.0, 0.02, 0.5, 1.0]
    """
    from scipy.special import ndtr

    whole = np.round(moved_deg / step_deg)
    rest = moved_deg / step_deg - whole
    share = sigma_deg / step_deg
    mean: FloatArray = whole + sum(
        ndtr((rest - k - 0.5) / share) - ndtr(-(rest + k + 0.5) / share) for k in range(_TEETH)
    )
    return step_deg * mean


def stepped_noise_deg(sigma_deg: float, step_deg: float) -> float:
    """Root mean square of what noise changes in a reading of coarse steps [deg].

    A move by (j + r) steps, j whole, crosses j + 1 edges with probability r and else j. The noise is summed over by
    Gauss' and Hermite's nodes.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> x = rng.uniform(-9.0, 9.0, 100_000)
    >>> change = np.round(x + 0.2 * rng.standard_normal(x.size)) - np.round(x)
    >>> round(float(np.std(change)), 2), round(stepped_noise_deg(0.2, 1.0), 2)
    (0.4, 0.4)
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(_NODES)
    whole, rest = np.divmod(np.abs(nodes) * sigma_deg / step_deg, 1.0)
    squares = whole**2 + (2.0 * whole + 1.0) * rest
    return step_deg * float(np.sqrt(weights @ squares / weights.sum()))


def comb_step_deg(values_deg: FloatArray) -> float | None:
    """Step of the converter that made some values [deg], wherever its zero is; None if they lie on no comb.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> comb_step_deg(0.9 * np.round(5.0 * rng.standard_normal(1000) / 0.9)), comb_step_deg(rng.standard_normal(1000))
    (0.9, None)
    """
    known = values_deg[np.isfinite(values_deg)]
    unique = np.unique(np.round(known, 6))
    if not _FEWEST_VALUES <= unique.size <= known.size / 2:
        return None
    apart = np.diff(unique)
    # Files round each value; most of the smallest differences are one step all the same.
    step_deg = float(np.median(apart[apart < 1.5 * apart.min()]))
    # Of n values without a converter the two closest are the n-th part of the mean distance apart.
    if unique.size > known.size / 4 and step_deg < _NO_CHANCE * (unique[-1] - unique[0]) / unique.size**2:
        return None
    # Gaps are rounded by the file; numbered one after the other, all values together are not.
    tooth = np.concatenate([[0.0], np.cumsum(np.round(apart / step_deg))])
    tooth -= tooth.mean()
    step_deg = float(unique @ tooth / (tooth @ tooth))
    off = np.abs(unique - unique.mean() - tooth * step_deg).max()
    return round(step_deg, 6) if off < _OFF_COMB * step_deg else None
