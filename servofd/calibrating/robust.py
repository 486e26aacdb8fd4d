"""Least squares for records of flights: errors beyond the ordinary count by their size, no longer by their square."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from servofd.types import FloatArray

__all__ = ["descended", "deviations", "mean_loss", "ordinary_deg"]

_ORDINARY = 3.0
"""Errors beyond so many typical ones count by their size: a glitch bends nothing."""
_MAD_TO_SIGMA = 1.4826
_TOLERANCE = 1e-6
"""Relative change of numbers and cost at which a descent ends."""


def ordinary_deg(median_deg: float) -> float:
    """Size from which an error is out of the ordinary [deg], from the median size of the errors [deg].

    Examples
    --------
    >>> round(ordinary_deg(0.1), 3)
    0.445
    """
    return _ORDINARY * _MAD_TO_SIGMA * median_deg


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
    scale_deg: float,
    *,
    delay_at: int | None,
    evaluations: int,
) -> FloatArray:
    """Numbers at the foot of the slope on which a descent begins.

    Parameters
    ----------
    error : callable
        From numbers of shape (k,) to errors [deg], shape (n,).
    slopes : callable
        From the same to their derivatives, shape (n, k).
    begin : FloatArray
        First numbers, shape (k,).
    scale_deg : float
        Size from which an error is out of the ordinary [deg].
    delay_at : int, optional
        Which of the numbers is a delay: it cannot be negative.
    evaluations : int
        Of the errors, at most.

    Examples
    --------
    >>> x, y = np.arange(10.0), 2.0 * np.arange(10.0) + 1.0
    >>> y[4] = 500.0
    >>> rows = np.column_stack([x, np.ones(10)])
    >>> found = descended(lambda p: rows @ p - y, lambda _: rows, np.zeros(2), 1e-2, delay_at=None, evaluations=50)
    >>> np.round(found, 1).tolist()
    [2.0, 1.0]
    """
    from scipy.optimize import least_squares

    lower = np.full(begin.size, -np.inf)
    if delay_at is not None:
        lower[delay_at] = -1e-9  # a start at zero must lie within
    found: FloatArray = least_squares(
        error,
        begin,
        jac=slopes,
        bounds=(lower, np.inf),
        x_scale="jac",
        loss="soft_l1",
        f_scale=scale_deg,
        max_nfev=evaluations,
        xtol=_TOLERANCE,
        ftol=_TOLERANCE,
    ).x
    return found


def deviations(jacobian: FloatArray, error_deg: FloatArray, memory: float) -> FloatArray:
    """Standard deviations of fitted numbers (inverse of the Fisher information), larger by the memory of the errors.

    Parameters
    ----------
    jacobian : FloatArray
        Derivatives of the errors, shape (n, k).
    error_deg : FloatArray
        Errors [deg], shape (n,).
    memory : float
        How many neighbouring errors tell as much as one.

    Examples
    --------
    The mean of 10 000 errors of 1 deg is known to 0.01 deg:

    >>> error_deg = np.random.default_rng(0).standard_normal(10_000)
    >>> deviations(np.ones((10_000, 1)), error_deg, 1.0).round(3).tolist()
    [0.01]
    """
    sigma_deg = _MAD_TO_SIGMA * float(np.median(np.abs(error_deg)))
    variance = max(sigma_deg**2, float(np.mean(np.clip(error_deg, -_ORDINARY * sigma_deg, _ORDINARY * sigma_deg) ** 2)))
    scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-12)
    _, sizes, right = np.linalg.svd(jacobian / scale, full_matrices=False)
    inverse = (right.T / np.maximum(sizes, 1e-9) ** 2) @ right
    deviation: FloatArray = np.sqrt(np.maximum(np.diag(inverse), 0.0) * variance * memory) / scale
    return deviation
