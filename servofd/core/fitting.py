r"""The one fit: numbers within bounds that leave the least misfit, and how sure they are.

The misfit of numbers :math:`x` is

.. math:: \sum_g \frac{n_g}{\kappa_g} \ln(s_g^2 + s_0^2) + \sum_k (p_k (x_k - c_k))^2

with the mean square :math:`s_g^2` of what is left in each group of samples (a run), its samples :math:`n_g` over
their correlation factor :math:`\kappa_g`, and a prior about :math:`c` with precisions :math:`p`. Near the noise it
is chi-squared; far from it a group counts by how many times better it is predicted, whatever its size. Where the noise
is known it is chi-squared throughout. An error that is out of the ordinary counts by its size (Huber). As correlated
samples count as few, a prior keeps its weight.

The descent is that of Levenberg and Marquardt, by numpy alone (scipy's optimisers take half a second to load). Between
steps Broyden's update carries the slopes on, so that a step costs one simulation; they are taken anew where that leads
no further.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np

from servofd.core.types import FloatArray, IntArray

_DAMPING, _MOST_DAMPED, _BOLDER, _TIMIDER = 1e-4, 1e6, 6.0, 10.0
"""Share of each curvature that is added, and by how much it changes after a step that helps, or does not."""
_CLOSE: Final = 1e-4
"""Misfit by which a step must improve, far below the 1 that one standard deviation of a number makes."""
_AT_BOUND: Final = 1e-9
"""Distance from a bound below which a number is at it."""
_NO_CURVATURE: Final = 1e-12
"""Added to a curvature, so that a number without any influence divides by no zero."""
_TWO, _SOON = 2, 3.0
"""Steps that a descent has in any case, and how many steps like the last one it may still need."""
_BY_CHANCE: Final = 3.0
"""Standard deviations of chi-squared by which the pulls of parts may exceed that of noise."""
_HARDLY: Final = 1e-9
"""Share of a curvature below which a part of the samples tells nothing of a number."""
_LEAST: Final = 1e-24
"""Mean square below which a simulation is exact."""


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """What the errors of a true model are like."""

    group: IntArray | None = None
    """Number of the run that each sample belongs to, shape (n,); all belong to one if left out."""
    kappa: FloatArray = field(default_factory=lambda: np.ones(1))
    """Samples of each group that tell as much as one, shape (g,)."""
    least: float = _LEAST
    """Mean square that a true model leaves at least."""
    huber: float = np.inf
    """Standard deviations beyond which an error counts by its size."""
    sigma: FloatArray | float = 1.0
    """Standard deviation of each sample, shape (n,), up to a common factor of each group."""
    is_known: bool = False
    """Whether that factor is 1, and the first sum of the misfit is chi-squared."""

    def squares(self, error: FloatArray) -> FloatArray:
        """Mean square of each group, shape (g,), with errors (n,) out of the ordinary held back.

        Examples
        --------
        >>> Noise(huber=2.0).squares(np.array([1.0, -1.0, 10.0, 0.0]))
        array([9.5])
        """
        square = (error / self.sigma) ** 2
        if np.isfinite(self.huber):
            square = np.where(square <= self.huber**2, square, self.huber * (2.0 * np.sqrt(square) - self.huber))
        if self.group is None:
            return np.array([float(square.mean())])
        sums = np.bincount(self.group, weights=square, minlength=self.kappa.size)
        return sums / self.count(error.size)

    def count(self, samples: int) -> FloatArray:
        """Samples of each group, shape (g,), of so many in all."""
        if self.group is None:
            return np.array([float(samples)])
        return np.maximum(np.bincount(self.group, minlength=self.kappa.size), 1).astype(np.float64)

    def misfit(self, error: FloatArray) -> float:
        """First sum of the misfit."""
        with np.errstate(over="ignore", invalid="ignore"):  # a model that runs away is none, and its misfit says so
            squares = self.squares(error) + self.least
            value = float(self.count(error.size) / self.kappa @ (squares if self.is_known else np.log(squares)))
        return value if np.isfinite(value) else np.inf

    def weights(self, error: FloatArray) -> FloatArray:
        """How much the square of each error counts where the misfit is close to a sum of squares, shape (n,)."""
        per_group = 1.0 / (self.kappa * (1.0 if self.is_known else self.squares(error) + self.least))
        weight = (per_group[0] if self.group is None else per_group[self.group]) / np.square(self.sigma)
        if np.isfinite(self.huber):
            weight = weight * np.minimum(1.0, self.huber / np.maximum(np.abs(error) / self.sigma, 1e-12))
        return np.broadcast_to(weight, error.shape)


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Numbers to be fitted; arrays of shape (k,)."""

    low: FloatArray
    high: FloatArray
    """Bounds; where they are equal a number is held."""
    residual: Callable[[FloatArray], FloatArray]
    """Errors (n,) of numbers (k,)."""
    noise: Noise
    prior: FloatArray | float = 0.0
    """One over the standard deviation of what is known of each number; 0 where nothing is."""
    centre: FloatArray | float = 0.0
    """What the prior expects."""
    step: FloatArray | float = 1e-6
    """Step of the differences that give slopes, in the units of the numbers."""
    derivatives: Callable[[FloatArray], FloatArray] | None = None
    """Derivatives (n, k) of the errors at numbers (k,), if they are cheap: then they are taken anew at every step."""

    def curvature(self, weighted: FloatArray, slopes: FloatArray) -> FloatArray:
        """Half of the second derivatives of the misfit, shape (k, k), by those of the errors (n, k), also weighted."""
        return weighted.T @ slopes + np.diag(np.square(self.prior) * np.ones(self.low.size))

    def misfit(self, x: FloatArray, error: FloatArray) -> float:
        """Misfit of some numbers, which leave some errors."""
        return self.noise.misfit(error) + float(np.sum((self.prior * (x - self.centre)) ** 2))

    def slopes(self, x: FloatArray, error: FloatArray) -> FloatArray:
        """Derivatives (n, k) at numbers that leave some errors (n,); differences are to the side that has room."""
        if self.derivatives is not None:
            return self.derivatives(x)
        columns = []
        for k, step in enumerate(np.broadcast_to(self.step, x.shape).tolist()):
            there = x.copy()
            there[k] = x[k] + step if x[k] + step <= self.high[k] else max(x[k] - step, self.low[k])
            moved = there[k] - x[k]
            columns.append((self.residual(there) - error) / moved if moved else np.zeros(error.size))
        return np.column_stack(columns) if columns else np.zeros((error.size, 0))


@dataclass(frozen=True, eq=False)
class Solution:
    """Numbers that fit, and the evidence for them."""

    problem: Problem
    x: FloatArray
    """Shape (k,)."""
    misfit: float
    error: FloatArray
    """What they leave, shape (n,)."""
    followed: FloatArray
    """Derivatives of the errors that the last step followed, shape (n, k)."""

    @cached_property
    def slopes(self) -> FloatArray:
        """Derivatives of the errors, shape (n, k)."""
        return self.problem.slopes(self.x, self.error)

    @cached_property
    def weighted(self) -> FloatArray:
        """The same, each times how much its error counts."""
        return self.slopes * self.problem.noise.weights(self.error)[:, None]

    @property
    def curvature(self) -> FloatArray:
        """Half of the second derivatives of the misfit, shape (k, k)."""
        return self.problem.curvature(self.weighted, self.slopes)

    def changes(self, parts: Sequence[IntArray]) -> FloatArray:
        """By how much the numbers change where each of some parts of the samples is left out, shape (p, k)."""
        weighted, whole, free = self.weighted, self.curvature, self.problem.high > self.problem.low
        pull = -(weighted.T @ self.error + np.square(self.problem.prior) * (self.x - self.problem.centre))
        found = np.zeros((len(parts), self.x.size))
        for change, part in zip(found, parts, strict=True):
            left = whole - weighted[part].T @ self.slopes[part]
            down = pull + weighted[part].T @ self.error[part]
            change[free] = inverse(left[np.ix_(free, free)]) @ down[free]
        return found

    def covariance(self, memory: float = 1.0, count: int = 0, lasting: float = 1.0, least: float = 0.0) -> FloatArray:
        """Of the numbers, shape (k, k): that of noise, of which so many samples tell as much as one.

        What is left may be the model's own error, which no average makes smaller. Of `count` parts of the samples in
        order each pulls the numbers its own way, and what these pulls move them by (a jackknife to first order: a part
        that alone tells of a number is not left out) comes on top. Where they do so by more than noise, it counts
        `lasting` times for what the parts have in common, which no part shows; else `least` times.

        Examples
        --------
        >>> error = np.random.default_rng(0).standard_normal(10_000)
        >>> bounds = np.full(1, -np.inf), np.full(1, np.inf)
        >>> mean = fit(Problem(*bounds, lambda x: error - x[0], Noise(), step=1e-3), np.zeros(1))
        >>> mean.covariance(count=8, lasting=5.0).round(6).tolist()
        [[0.0001]]
        >>> drifts = error + np.linspace(-1.0, 1.0, error.size)
        >>> mean = fit(Problem(*bounds, lambda x: drifts - x[0], Noise(), step=1e-3), np.zeros(1))
        >>> bool(mean.covariance(count=8)[0, 0] > 100.0 * mean.covariance()[0, 0])
        True
        """
        by_noise: FloatArray = memory * inverse(self.curvature)
        if not count:
            return by_noise
        weighted = self.weighted
        parts = np.array_split(np.arange(self.error.size), count)
        pulls = np.array([weighted[part].T @ self.error[part] for part in parts])
        pulls -= pulls.mean(axis=0)
        hardly = _HARDLY * np.diag(np.diag(self.curvature))
        curvatures = (inverse(weighted[part].T @ self.slopes[part] + hardly) for part in parts)
        surprise = sum(float(pull @ each @ pull) for pull, each in zip(pulls, curvatures, strict=True)) / memory
        usual = float(np.count_nonzero(self.slopes.any(axis=0)) * (count - 1))
        by_chance = surprise < usual + _BY_CHANCE * (2.0 * usual) ** 0.5
        moved = (least if by_chance else lasting) * pulls @ inverse(self.curvature)
        return by_noise + count / (count - 1) * moved.T @ moved


def fit(
    problem: Problem,
    begin: FloatArray,
    *,
    steps: int = 60,
    close: float = _CLOSE,
    enough: float = np.inf,
    slopes: FloatArray | None = None,
) -> Solution:
    """Numbers at the foot of the slope on which a descent begins.

    It ends after so many `steps`, or where one with fresh slopes improves the misfit, or promises to, by no more than
    `close`; or where it is still worse than `enough`, and improves too slowly to become better.
    `slopes` (n, k) are those at the beginning, if they are known.

    Examples
    --------
    >>> x, y = np.arange(10.0), 2.0 * np.arange(10.0) + 1.0
    >>> y[4] = 500.0
    >>> anything = np.full(2, -np.inf), np.full(2, np.inf)
    >>> line = Problem(*anything, lambda p: p[0] * x + p[1] - y, Noise(huber=2.0, sigma=1e-3))
    >>> fit(line, np.zeros(2)).x.round(2)
    array([2., 1.])
    """
    x = np.clip(begin, problem.low, problem.high)
    error = problem.residual(x)
    slopes = problem.slopes(x, error) if slopes is None else slopes
    best, damping, is_fresh, is_behind = problem.misfit(x, error), _DAMPING, True, False
    for taken in range(steps):
        if is_behind:
            slopes, is_behind = problem.slopes(x, error), False
        weighted = slopes * problem.noise.weights(error)[:, None]
        whole = problem.curvature(weighted, slopes)
        curvature = whole + np.diag(damping * np.diag(whole) + _NO_CURVATURE)
        down = -(weighted.T @ error + np.square(problem.prior) * (x - problem.centre))
        step = bounded_step(curvature, down, problem.low - x, problem.high - x)
        if is_fresh and float(step @ (2.0 * down - whole @ step)) <= close:
            break
        there = np.clip(x + step, problem.low, problem.high)
        moved = there - x
        size = float(moved @ moved)
        left = problem.residual(there) if size else error
        misfit = problem.misfit(there, left)
        gained = best - misfit
        if gained > 0.0:
            if problem.derivatives is None:
                slopes = slopes + np.outer((left - error - slopes @ moved) / size, moved)
            is_behind = problem.derivatives is not None
            x, error, best, damping = there, left, misfit, max(damping / _BOLDER, _DAMPING)
            if taken >= _TWO and best - _SOON * gained > enough:
                break
        if gained > close:
            is_fresh = problem.derivatives is not None
        elif not is_fresh:
            slopes, is_fresh, damping = problem.slopes(x, error), True, _DAMPING
        elif gained > 0.0 or damping >= _MOST_DAMPED:
            break
        else:
            damping *= _TIMIDER
    return Solution(problem, x, best, error, slopes)


def bounded_step(curvature: FloatArray, down: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Newton's step, shape (k,), with so much room: what stands at its bound and is driven against it stays there."""
    free = low < high
    step: FloatArray = np.zeros(down.size)
    for _ in range(down.size):
        step = np.zeros(down.size)
        step[free] = np.linalg.solve(curvature[np.ix_(free, free)], down[free])
        stopped = free & (((low >= -_AT_BOUND) & (step < 0.0)) | ((high <= _AT_BOUND) & (step > 0.0)))
        if not stopped.any():
            break
        free &= ~stopped
    return step


def inverse(curvature: FloatArray) -> FloatArray:
    """Inverse of a curvature, shape (k, k); wide, and not infinite, where there is none."""
    scale = np.sqrt(np.maximum(np.diag(curvature), 1e-200))
    sizes, directions = np.linalg.eigh(curvature / np.outer(scale, scale))
    found: FloatArray = (directions / np.maximum(sizes, _NO_CURVATURE)) @ directions.T / np.outer(scale, scale)
    return found
