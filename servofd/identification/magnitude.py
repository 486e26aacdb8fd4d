"""The thesis' own fit: log-Chebyshev magnitude, minimum phase, and a delay to match the phase (3.3, Appendix A)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.core.errors import IdentificationError
from servofd.identification.shape import LinearServo
from servofd.servo.transfer import TransferFunction

if TYPE_CHECKING:
    from servofd.core.types import FloatArray
    from servofd.identification.frequency_response import FrequencyResponse

_LARGEST_RIPPLE = 3.0
"""Of the logarithm of the magnitude: a factor of 20 is no fit."""
_BISECTIONS = 30
_FAR = 1e3
"""The squared magnitude must stay positive up to so many times the highest frequency of the fit."""


def fit_magnitude(response: FrequencyResponse, order: int) -> LinearServo:
    r"""Fit the magnitude as MATLAB's ``fitmagfrd`` does, then the delay to the phase.

    With :math:`x = (w/w_g)^2` an all-pole servo has :math:`|G|^2 = 1 / A(x)`. The smallest g for which a polynomial
    with :math:`e^{-2g} \le |G_{sm}|^2 A \le e^{2g}` exists is found by bisection, each trial a linear programme
    (HiGHS); the roots of A give the poles, :math:`s = -\sqrt{-x}`. Unlike the thesis, the hold is divided out
    first, so that neither the magnitude nor the delay contains it. Fragile where poles lie far beyond the band.

    Parameters
    ----------
    order : int
        Number of poles, 1 to 3.

    Returns
    -------
    LinearServo
        Minimum phase and a delay; the delay is not held to zero or above.

    Examples
    --------
    >>> from servofd.identification.frequency_response import FrequencyResponse
    >>> truth = LinearServo((np.log(4900.0), np.log(70.0)), 0.004)
    >>> w = np.geomspace(6.0, 120.0, 50)
    >>> ones = np.ones(50)
    >>> s = 1j * w
    >>> exact = truth.transfer.at(s) * np.exp(-0.009 * s) * np.sinc(0.005 * w / np.pi)  # hold: 5 ms and a sinc
    >>> found = fit_magnitude(FrequencyResponse(w, exact, 0.99 * ones, ones, 0.01), 2)
    >>> round(1e3 * found.delay_s, 2), found.poles_rad_s.real.round(2)
    (4.0, array([-35., -35.]))
    """
    w, half = response.frequency_rad_s, 0.5 * response.sample_time_s
    plain = response.response / (np.sinc(w * half / np.pi) * np.exp(-1j * w * half))
    scale = float(np.sqrt(w[0] * w[-1]))
    polynomial = _smallest_ripple((w / scale) ** 2, np.abs(plain) ** 2, order)
    poles = -np.sqrt(-np.roots(polynomial).astype(complex)) * scale
    if poles.size < order or not np.all(poles.real < 0.0):
        raise IdentificationError(
            f"no stable servo of order {order} has this magnitude; try a lower --order, or --method response"
        )
    denominator = np.poly(poles).real
    gain = float(1.0 / np.sqrt(polynomial[-1]))
    transfer = TransferFunction((gain * float(denominator[-1]),), tuple(denominator.tolist()))
    phase_rad = np.unwrap(np.angle(plain / transfer.at(np.asarray(1j * w, dtype=complex))))
    phase_rad -= 2.0 * np.pi * np.round(phase_rad[0] / (2.0 * np.pi))
    return LinearServo.of(transfer, float(-(phase_rad @ w) / (w @ w)))


def _smallest_ripple(x: FloatArray, power: FloatArray, order: int) -> FloatArray:
    """Coefficients of A, highest power first, with the smallest largest deviation."""
    low, high, best = 0.0, _LARGEST_RIPPLE, None
    for _ in range(_BISECTIONS):
        ripple = 0.5 * (low + high)
        found = _polynomial_within(x, power, order, ripple)
        if found is None:
            low = ripple
        else:
            high, best = ripple, found
    if best is None:
        raise IdentificationError(f"no servo of order {order} comes near this magnitude")
    return best


def _polynomial_within(x: FloatArray, power: FloatArray, order: int, ripple: float) -> FloatArray | None:
    """A polynomial A with exp(-2 ripple) <= power A <= exp(2 ripple) and A > 0 at higher frequencies, or None."""
    from scipy.optimize import linprog

    rows = power[:, np.newaxis] * np.vander(x, order + 1)
    far = np.vander(np.geomspace(x[-1], x[-1] * _FAR, 30), order + 1)
    far /= far.max(axis=1, keepdims=True)
    lowest = 1e-9
    result = linprog(
        np.zeros(order + 1),
        A_ub=np.vstack([rows, -rows, -far]),
        b_ub=np.concatenate(
            [np.full(x.size, np.exp(2.0 * ripple)), np.full(x.size, -np.exp(-2.0 * ripple)), np.full(len(far), -lowest)]
        ),
        bounds=[(None, None)] * order + [(lowest, None)],
        method="highs",
    )
    return np.asarray(result.x) if result.status == 0 else None
