"""Root of a function of one number, without the half second that importing scipy.optimize takes."""

from __future__ import annotations

from collections.abc import Callable

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
