"""What all fits share: estimates with intervals, robust losses, and errors that have a memory."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from servofd.core.types import FloatArray

Z_95: Final = 1.96
"""Standard deviations of a 95 % interval."""
MAD_TO_SIGMA: Final = 1.4826
"""From the median size of normal errors to their standard deviation."""
_ORDINARY = 3.0
"""Errors beyond so many typical ones count by their size: a glitch bends nothing."""
_CLOSE, _LEVEL = 1e-6, 1e-8
"""Relative changes of numbers and of the cost at which a descent ends."""
_DAMPING, _MOST_DAMPED, _BOLDER, _TIMIDER = 1e-4, 1e6, 6.0, 10.0
"""Of a descent: share of each curvature, and by how much it changes after a step."""
_AT_BOUND = 1e-9


class Estimate(NamedTuple):
    """A number with its 95 % interval.

    Examples
    --------
    >>> four = Estimate.of(4.0, 0.05)
    >>> four.low.__round__(3), four.high.__round__(3)
    (3.902, 4.098)
    """

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, value: float, deviation: float) -> Estimate:
        """Estimate with a standard deviation."""
        return cls(float(value), float(value - Z_95 * deviation), float(value + Z_95 * deviation))

    @property
    def deviation(self) -> float:
        """Standard deviation."""
        return (self.high - self.low) / (2.0 * Z_95)


def line(
    x: FloatArray, y: FloatArray, *, near: tuple[float, float] = (1e-6, 0.1), rounds: int = 8
) -> tuple[float, float]:
    """Slope and offset of y over x by small absolute deviations.

    Least squares, reweighted a few times; deviations within `near` (in the unit of y, and as a share of the mean one)
    count alike.

    Examples
    --------
    >>> x = np.arange(100.0)
    >>> slope, offset = line(x, np.where(x < 90, 2.0 * x + 1.0, 0.0))
    >>> round(slope, 1)
    2.0
    """
    weight = np.full(x.size, 1.0)
    slope, offset = 1.0, 0.0
    for _ in range(rounds):
        total = weight.sum()
        centre_x, centre_y = float(weight @ x) / total, float(weight @ y) / total
        weighted = weight * (x - centre_x)
        slope = float(weighted @ (y - centre_y)) / max(float(weighted @ (x - centre_x)), 1e-12)
        offset = centre_y - slope * centre_x
        deviation = np.abs(y - slope * x - offset)
        weight = 1.0 / (deviation + near[0] + near[1] * float(deviation.mean()))
    return slope, offset


def memory(errors: Sequence[FloatArray], lags: int) -> float:
    """Long-run variance over variance (Bartlett's window), at least 1: how many neighbours tell as much as one.

    Examples
    --------
    >>> white = np.random.default_rng(0).standard_normal(20_000)
    >>> round(memory([white], 20), 1), round(memory([np.repeat(white, 3)], 50))
    (1.0, 3)
    """
    total = sum(float(e @ e) for e in errors)
    if total == 0.0:
        return 1.0
    products = np.sum([_products(e, lags) for e in errors], axis=0) / total
    return max(1.0, 1.0 + 2.0 * float((1.0 - np.arange(1, lags + 1) / (lags + 1)) @ products))


def _products(error: FloatArray, lags: int) -> FloatArray:
    """Sums of products with itself a number of samples later, shape (lags,); a spectrum pays from 100 lags on."""
    return np.array([float(error[lag:] @ error[:-lag]) if lag < error.size else 0.0 for lag in range(1, lags + 1)])


def ordinary_deg(median_deg: float) -> float:
    """Size from which an error is out of the ordinary [deg], from the median size of the errors [deg].

    Examples
    --------
    >>> round(ordinary_deg(0.1), 3)
    0.445
    """
    return _ORDINARY * MAD_TO_SIGMA * median_deg


def mean_loss(error_deg: FloatArray, scale_deg: float) -> float:
    r"""Mean of :math:`\sqrt{1 + (e / s)^2} - 1`: half the square of small errors, the size of large ones.

    Examples
    --------
    >>> round(mean_loss(np.array([0.0, 3.0]), 1.0), 3)
    1.081
    """
    return float(np.mean(np.sqrt(1.0 + (error_deg / scale_deg) ** 2) - 1.0))


def descended(
    error: Callable[[FloatArray], FloatArray],
    slopes: Callable[[FloatArray], FloatArray],
    begin: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    *,
    evaluations: int,
    scale_deg: float | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Numbers at the foot of the slope on which a descent begins, shape (k,), and the derivatives there, (n, k).

    Levenberg and Marquardt, by numpy alone: scipy's optimisers take half a second to load. From `begin` within the
    bounds; `slopes` gives derivatives (n, k) of the errors [deg] (n,). An error beyond `scale_deg` counts by its size;
    all count by their squares if that is left out.

    Examples
    --------
    >>> x, y = np.arange(10.0), 2.0 * np.arange(10.0) + 1.0
    >>> y[4] = 500.0
    >>> rows, free = np.column_stack([x, np.ones(10)]), np.full(2, np.inf)
    >>> found, _ = descended(
    ...     lambda p: rows @ p - y, lambda _: rows, np.zeros(2), (-free, free), evaluations=50, scale_deg=1e-2)
    >>> np.round(found, 1).tolist()
    [2.0, 1.0]
    """

    def weighed(left: FloatArray) -> tuple[float, FloatArray]:
        """Cost of some errors, and how much each of them counts."""
        if scale_deg is None:
            return float(left @ left), np.ones(left.size)
        root = np.sqrt(1.0 + (left / scale_deg) ** 2)
        return float((root - 1.0).sum()), 1.0 / root

    low, high = bounds
    x = np.clip(begin, low, high)
    left, slope, damping = error(x), slopes(x), _DAMPING
    cost, weight = weighed(left)
    for _ in range(evaluations - 1):
        weighted = slope * weight[:, None]
        curvature = slope.T @ weighted
        curvature += np.diag(damping * np.diag(curvature) + 1e-300)
        there = np.clip(x + bounded_step(curvature, -(weighted.T @ left), low - x, high - x), low, high)
        left_there = error(there)
        cost_there, weight_there = weighed(left_there)
        if not cost_there < cost:
            if damping >= _MOST_DAMPED:
                break
            damping *= _TIMIDER
            continue
        is_foot = cost - cost_there < _LEVEL * cost or np.all(np.abs(there - x) < _CLOSE * (_CLOSE + np.abs(x)))
        x, left, cost, weight = there, left_there, cost_there, weight_there
        slope, damping = slopes(x), max(damping / _BOLDER, _DAMPING)
        if is_foot:
            break
    return x, slope


def bounded_step(curvature: FloatArray, down: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Newton's step, shape (k,), with so much room: what stands at its bound and is driven against it stays there."""
    free = np.ones(down.size, dtype=np.bool_)
    step: FloatArray = np.zeros(down.size)
    for _ in range(down.size):
        step = np.zeros(down.size)
        step[free] = np.linalg.solve(curvature[np.ix_(free, free)], down[free])
        stopped = free & (((low >= -_AT_BOUND) & (step < 0.0)) | ((high <= _AT_BOUND) & (step > 0.0)))
        if not stopped.any():
            break
        free &= ~stopped
    return step


def deviations(jacobian: FloatArray, error_deg: FloatArray, memory: float) -> FloatArray:
    """Standard deviations of fitted numbers (inverse of the Fisher information), larger by the memory of the errors.

    Examples
    --------
    The mean of 10 000 errors of 1 deg is known to 0.01 deg:

    >>> error_deg = np.random.default_rng(0).standard_normal(10_000)
    >>> deviations(np.ones((10_000, 1)), error_deg, 1.0).round(3).tolist()
    [0.01]
    """
    sigma_deg = MAD_TO_SIGMA * float(np.median(np.abs(error_deg)))
    variance = max(sigma_deg**2, float(np.mean(np.clip(error_deg, -_ORDINARY * sigma_deg, _ORDINARY * sigma_deg) ** 2)))
    scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-12)
    _, sizes, right = np.linalg.svd(jacobian / scale, full_matrices=False)
    inverse = (right.T / np.maximum(sizes, 1e-9) ** 2) @ right
    deviation: FloatArray = np.sqrt(np.maximum(np.diag(inverse), 0.0) * variance * memory) / scale
    return deviation
