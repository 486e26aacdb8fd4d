"""Root and minimum of a function of one number, without the half second that importing scipy.optimize takes."""

from __future__ import annotations

from collections.abc import Callable
from math import sqrt

_GOLDEN = (3.0 - sqrt(5.0)) / 2.0
"""Share of an interval at which golden-section search places its next point."""
_MOST_STEPS = 200
"""Steps of a search at most."""


def root(function: Callable[[float], float], low: float, high: float, tolerance: float = 1e-12) -> float:
    """Where a function crosses zero, by Chandrupatla's method: bisection, or an inverse parabola where that is safe.

    Notes
    -----
    T. R. Chandrupatla, Advances in Engineering Software 28 (1997) 145-149.

    Examples
    --------
    >>> round(root(lambda x: x**3 - 2.0, 0.0, 2.0), 12)
    1.259921049895
    """
    new, old = low, high
    f_new, f_old = function(new), function(old)
    if f_new * f_old > 0.0:
        raise ValueError(f"the function does not change sign between {low:g} and {high:g}")
    share = 0.5
    for _ in range(_MOST_STEPS):
        least_share = tolerance / max(abs(old - new), tolerance)
        if 0.0 in (f_new, f_old) or least_share > 0.5:
            break
        x = new + min(max(share, least_share), 1.0 - least_share) * (old - new)
        f = function(x)
        if (f > 0.0) == (f_new > 0.0):
            third, f_third = new, f_new
        else:
            third, f_third, old, f_old = old, f_old, new, f_new
        new, f_new = x, f
        place, height = (new - old) / (third - old), (f_new - f_old) / (f_third - f_old)
        share = 0.5
        if height**2 < place and (1.0 - height) ** 2 < 1.0 - place:
            slope = (third - new) / (old - new)
            share = f_new / (f_old - f_new) * f_third / (f_old - f_third)
            share += slope * f_new / (f_third - f_new) * f_old / (f_third - f_old)
    return new if abs(f_new) < abs(f_old) else old


def least(
    function: Callable[[float], float], low: float, high: float, tolerance: float = 1e-5, steps: int = _MOST_STEPS
) -> float:
    """Where a function of one minimum is smallest, by Brent's method: golden section, or a parabola where that is safe.

    Notes
    -----
    R. P. Brent, Algorithms for Minimization without Derivatives, 1973, chapter 5.

    Examples
    --------
    >>> round(least(lambda x: (x - 0.7) ** 2, 0.0, 2.0), 5)
    0.7
    """
    best = second = third = low + _GOLDEN * (high - low)
    f_best = f_second = f_third = function(best)
    step = before = 0.0
    for _ in range(steps - 1):
        middle = 0.5 * (low + high)
        enough = tolerance / 3.0 + 1e-9 * abs(best)
        if abs(best - middle) <= 2.0 * enough - 0.5 * (high - low):
            break
        r, q = (best - second) * (f_best - f_third), (best - third) * (f_best - f_second)
        p, q = (best - third) * q - (best - second) * r, 2.0 * (q - r)
        p, q = (-p, q) if q > 0.0 else (p, -q)
        if abs(before) > enough and abs(p) < abs(0.5 * q * before) and q * (low - best) < p < q * (high - best):
            step, before = p / q, step
            if min(best + step - low, high - best - step) < 2.0 * enough:
                step = enough if best < middle else -enough
        else:
            before = (high if best < middle else low) - best
            step = _GOLDEN * before
        if abs(step) < enough:
            step = enough if step > 0.0 else -enough
        x = best + step
        f = function(x)
        if f <= f_best:
            low, high = (best, high) if x >= best else (low, best)
            third, f_third, second, f_second, best, f_best = second, f_second, best, f_best, x, f
        else:
            low, high = (x, high) if x < best else (low, x)
            if f <= f_second or second == best:
                third, f_third, second, f_second = second, f_second, x, f
            elif f <= f_third or third in (best, second):
                third, f_third = x, f
    return best
