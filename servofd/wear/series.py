"""Lines and breaks in what many flights tell of one number, neither misled by single flights that went wrong."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from servofd.estimate.statistics import MAD_TO_SIGMA, Estimate

if TYPE_CHECKING:
    from servofd.core.types import FloatArray

CHANCE = 1e-6
"""Of a change where there is none: six surfaces with nine numbers, in a hundred fleets, are 5400 chances for one."""
_CLIPPED = 3.0
"""A flight beyond three deviations of the others counts as one at three."""
_ROUNDS = 12
_FEWEST = 3
"""Flights on either side of a break: two that went wrong in a row are no other servo."""
_LINE = 2
"""Parameters of a line."""
_SMALLEST = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A line through the flights of one piece.

    Parameters
    ----------
    centre : float
        Flight number at which the line has its intercept.
    level, slope : float
        At the centre, and per flight.
    covariance : ndarray, shape (2, 2)
        Of level and slope.
    scatter : float
        Standard deviation from flight to flight, beyond what each flight's own interval explains.
    freedom : int
        Number of flights less two.
    """

    centre: float
    level: float
    slope: float
    covariance: FloatArray
    scatter: float
    freedom: int

    def at(self, number: float) -> Estimate:
        """Value of the line at a flight, with its 95 % interval."""
        away = np.array([1.0, number - self.centre])
        return self._estimate(self.level + self.slope * away[1], float(away @ self.covariance @ away))

    @property
    def slope_estimate(self) -> Estimate:
        """Change per flight, with its 95 % interval."""
        return self._estimate(self.slope, float(self.covariance[1, 1]))

    @property
    def chance(self) -> float:
        """Probability of so steep a slope if nothing changes."""
        from scipy.stats import t

        deviation = float(np.sqrt(self.covariance[1, 1]))
        return float(2.0 * t.sf(abs(self.slope) / max(deviation, 1e-300), self.freedom))

    def _estimate(self, value: float, variance: float) -> Estimate:
        half = self.student * float(np.sqrt(variance))
        return Estimate(value, value - half, value + half)

    @property
    def student(self) -> float:
        """Standard deviations in a 95 % interval, for so few flights."""
        from scipy.stats import t

        return float(t.ppf(0.975, self.freedom))


@dataclass(frozen=True, eq=False)
class Piece:
    """Flights between two breaks, of shape (k,): their numbers, values and deviations."""

    number: FloatArray
    value: FloatArray
    deviation: FloatArray

    @cached_property
    def line(self) -> Line:
        """The line through them; needs three flights."""
        return fit_line(self.number, self.value, self.deviation)

    @property
    def first(self) -> int:
        """Number of the first flight."""
        return int(self.number[0])

    @property
    def last(self) -> int:
        """Number of the last flight."""
        return int(self.number[-1])


def fit_line(number: FloatArray, value: FloatArray, deviation: FloatArray) -> Line:
    """Line through flights that scatter more than their own intervals say, a few of which may have gone wrong.

    Least squares, weighted by the variance of each flight (its own, and the scatter from flight to flight, which is
    found such that the clipped squares of the errors have their expectation); flights beyond three deviations count
    as at three (Huber). It starts from the median of all slopes (Theil and Sen).

    Parameters
    ----------
    number, value, deviation : ndarray, shape (k,), k > 2
        Flight numbers, what the flights tell, and its standard deviation.

    Examples
    --------
    >>> number = np.arange(1.0, 21.0)
    >>> value = 0.02 * number + np.where(number == 7.0, 5.0, 0.0)
    >>> round(fit_line(number, value, np.full(20, 0.01)).slope, 3)
    0.02
    """
    from scipy.stats import theilslopes

    centre = float(np.mean(number))
    x = number - centre
    slope = float(theilslopes(value, x)[0])
    level = float(np.median(value - slope * x))
    freedom = number.size - 2
    scatter, weight = 0.0, np.ones(x.size)
    covariance = np.zeros((2, 2))
    for _ in range(_ROUNDS):
        error = value - level - slope * x
        scatter = _scatter(error, deviation, freedom)
        sigma = np.sqrt(deviation**2 + scatter**2 + _SMALLEST**2)
        weight = np.minimum(1.0, _CLIPPED / np.maximum(np.abs(error) / sigma, _SMALLEST)) / sigma**2
        design = np.column_stack([np.ones(x.size), x])
        covariance = np.linalg.inv(design.T @ (weight[:, None] * design))
        level, slope = (float(v) for v in covariance @ (design.T @ (weight * value)))
    return Line(centre, level, slope, covariance, scatter, freedom)


def _scatter(error: FloatArray, deviation: FloatArray, freedom: int) -> float:
    """Scatter with which the clipped squared errors, in deviations, have a mean of one; 0 if they have less anyway."""
    from scipy.optimize import brentq

    def excess(scatter: float) -> float:
        squares = error**2 / (deviation**2 + scatter**2 + _SMALLEST**2)
        return float(np.sum(np.minimum(squares, _CLIPPED**2))) / freedom - 1.0

    most = float(np.max(np.abs(error))) * np.sqrt(error.size) + _SMALLEST
    if excess(0.0) <= 0.0 or excess(most) >= 0.0:
        return 0.0
    return float(brentq(excess, 0.0, most, xtol=1e-3 * most))


def pieces(number: FloatArray, value: FloatArray, deviation: FloatArray) -> tuple[Piece, ...]:
    """Cut flights where one line does not do, and two lines do: a jump, or another slope.

    A cut must be less likely by chance than `CHANCE`, by the F test of two lines against one with clipped squares,
    times the number of places where it could be; then both parts are looked at again.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> number = np.arange(1.0, 41.0)
    >>> value = 0.02 * number - 0.5 * (number > 20) + 0.01 * rng.standard_normal(40)
    >>> [(piece.first, piece.last) for piece in pieces(number, value, np.full(40, 0.01))]
    [(1, 20), (21, 40)]
    """
    whole = Piece(number, value, deviation)
    cut = _best_cut(whole)
    if cut is None:
        return (whole,)
    sides = slice(0, cut), slice(cut, None)
    return tuple(piece for side in sides for piece in pieces(number[side], value[side], deviation[side]))


def _best_cut(whole: Piece) -> int | None:
    """Where to cut, as a number of flights before it; None if one line does."""
    from scipy.stats import f

    size = whole.number.size
    places = np.arange(_FEWEST, size - _FEWEST + 1)
    if places.size == 0 or size <= 2 * _LINE:
        return None
    value = _without_outliers(whole.value, whole.deviation)
    weight = 1.0 / (whole.deviation**2 + _local_scatter(value, whole.deviation) ** 2 + _SMALLEST**2)
    before, after = _costs(whole.number, value, weight), _costs(whole.number[::-1], value[::-1], weight[::-1])[::-1]
    two = before[places - 1] + after[places]
    freedom = size - 2 * _LINE
    gain = (before[-1] - two) / _LINE / np.maximum(two / freedom, 1.0)
    chance = f.sf(np.maximum(gain, 0.0), _LINE, freedom) * places.size
    best = int(np.argmax(gain))
    return int(places[best]) if chance[best] < CHANCE else None


def _without_outliers(value: FloatArray, deviation: FloatArray) -> FloatArray:
    """Values no further than three deviations from the median of their neighbours (Hampel)."""
    from scipy.ndimage import median_filter

    middle: FloatArray = median_filter(value, size=5, mode="nearest")
    away = value - middle
    sigma = np.sqrt(deviation**2 + (MAD_TO_SIGMA * float(np.median(np.abs(away)))) ** 2)
    clipped: FloatArray = middle + np.clip(away, -_CLIPPED * sigma, _CLIPPED * sigma)
    return clipped


def _local_scatter(value: FloatArray, deviation: FloatArray) -> float:
    """Scatter from flight to flight, from second differences: neither a trend nor a jump enters."""
    total = MAD_TO_SIGMA * float(np.median(np.abs(np.diff(value, 2)))) / np.sqrt(6.0)
    return float(np.sqrt(max(total**2 - float(np.median(deviation)) ** 2, 0.0)))


def _costs(number: FloatArray, value: FloatArray, weight: FloatArray) -> FloatArray:
    """Weighted squared error of a line through the first k flights, for all k; shape (n,)."""
    x, y = number - number.mean(), value - value.mean()
    w, wx, wy, wxx, wxy, wyy = (np.cumsum(weight * terms) for terms in (np.ones(x.size), x, y, x * x, x * y, y * y))
    spread = np.maximum(wxx - wx**2 / w, _SMALLEST)
    costs: FloatArray = np.maximum(wyy - wy**2 / w - (wxy - wx * wy / w) ** 2 / spread, 0.0)
    return costs
