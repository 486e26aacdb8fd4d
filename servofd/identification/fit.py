"""Fit of a servo to a frequency response: Sanathanan and Koerner's iteration to start, then the exact model."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.identification.shape import LARGEST_LOG_GAIN, LONGEST_DELAY_S, LinearServo, shape_bounds
from servofd.servo.transfer import TransferFunction

if TYPE_CHECKING:
    from servofd.core.types import ComplexArray, FloatArray
    from servofd.identification.frequency_response import FrequencyResponse

_DELAY_STEP_S, _LONGEST_DELAY_S = 1e-3, 0.08
_ITERATIONS = 8
_LARGEST_WEIGHT = 10.0
FAR_POLES = (3.0, 8.0, 20.0)
"""Starts for a second pole, in multiples of the first: far poles and delay trade off, one start is not enough."""


def start_value(response: FrequencyResponse, order: int) -> LinearServo:
    """All-pole servo near a response.

    The hold is divided out, then for delays of 0, 1, 2 ... ms the linear least-squares problem of Sanathanan and
    Koerner is iterated; the delay with the smallest error wins. Free zeros would eat the delay, so there are none.

    Parameters
    ----------
    order : int
        Number of poles, 1 to 3.

    Returns
    -------
    LinearServo
        A start for `fit_response`.
    """
    w, half = response.frequency_rad_s, 0.5 * response.sample_time_s
    plain = response.response / (np.sinc(w * half / np.pi) * np.exp(-1j * w * half))
    scale = float(np.sqrt(w[0] * w[-1]))
    s, weight = np.asarray(1j * w / scale, dtype=complex), _weights(response)
    best, smallest = None, np.inf
    for delay_s in np.arange(0.0, _LONGEST_DELAY_S, _DELAY_STEP_S):
        denominator, gain, error = _all_pole(s, plain * np.exp(1j * w * delay_s), weight, order)
        if error < smallest:
            best, smallest = (float(delay_s), denominator, gain), error
    if best is None:
        return LinearServo(tuple([np.log(scale)] * order), 0.0)
    delay_s, denominator, gain = best
    return _stable(denominator * scale ** np.arange(order + 1), gain, delay_s)


def fit_response(response: FrequencyResponse, order: int) -> LinearServo:
    """Fit an all-pole servo, with the hold and the fractional delay exact.

    Least squares on the logarithm of the ratio of response and model, which weighs magnitude and phase alike at all
    frequencies, with weights sqrt(c / (1 - c)) from the coherence c.

    Parameters
    ----------
    order : int
        Number of poles, 1 to 3.

    Examples
    --------
    >>> from servofd.identification.frequency_response import FrequencyResponse
    >>> truth = LinearServo((np.log(30.0),), 0.004, 1.01)
    >>> w = np.geomspace(6.0, 120.0, 50)
    >>> ones = np.ones(50)
    >>> found = fit_response(FrequencyResponse(w, truth.sampled_response(w, 0.01), 0.99 * ones, ones, 0.01), 1)
    >>> round(1e3 * found.delay_s, 3), round(float(np.exp(found.shape[0])), 3), round(found.gain, 4)
    (4.0, 30.0, 1.01)
    """
    fits = [_refine(response, start) for start in _starts(response, order)]
    return min(fits, key=lambda pair: pair[1])[0]


def _starts(response: FrequencyResponse, order: int) -> list[LinearServo]:
    starts = [start_value(response, order)]
    if order == 2:
        one = start_value(response, 1)
        pole = float(np.exp(one.shape[0]))
        starts += [
            LinearServo((np.log(far * pole**2), np.log((1.0 + far) * pole)), one.delay_s, one.gain) for far in FAR_POLES
        ]
    return starts


def _refine(response: FrequencyResponse, start: LinearServo) -> tuple[LinearServo, float]:
    from scipy.optimize import least_squares

    sign = np.sign(start.gain) or 1.0
    weight = _weights(response)

    def servo(x: FloatArray) -> LinearServo:
        return LinearServo(tuple(x[:-2]), float(x[-2]) * 1e-3, float(sign * np.exp(x[-1])))

    def residual(x: FloatArray) -> FloatArray:
        model = servo(x).sampled_response(response.frequency_rad_s, response.sample_time_s)
        ratio = np.log(response.response / model) * weight
        return np.concatenate([ratio.real, ratio.imag])

    x0 = np.array([*start.shape, 1e3 * start.delay_s, np.log(abs(start.gain))])
    slowest, fastest = shape_bounds(start.order, response.sample_time_s)
    lower = np.array([*slowest, 0.0, -LARGEST_LOG_GAIN])
    upper = np.array([*fastest, 1e3 * LONGEST_DELAY_S, LARGEST_LOG_GAIN])
    x0 = np.clip(x0, lower + 1e-3, upper - 1e-3)
    with np.errstate(all="ignore"):
        if not np.all(np.isfinite(residual(x0))):
            return start, np.inf
        try:
            found = least_squares(
                residual, x0, bounds=(lower, upper), loss="soft_l1", ftol=1e-6, xtol=1e-5, max_nfev=50
            )
        except ValueError:  # a step ran out of the numbers' range
            return start, np.inf
    return servo(found.x), float(found.cost)


def _weights(response: FrequencyResponse) -> FloatArray:
    coherence = np.clip(response.coherence, 0.0, 1.0 - 1e-9)
    weights: FloatArray = np.minimum(np.sqrt(coherence / (1.0 - coherence)), _LARGEST_WEIGHT)
    return weights


def _all_pole(
    s: ComplexArray, response: ComplexArray, weight: FloatArray, order: int
) -> tuple[FloatArray, float, float]:
    """Denominator, dc gain and error of one iteration sequence, on scaled frequencies."""
    powers = s[:, np.newaxis] ** np.arange(order - 1, -1, -1)
    size, denominator, error = np.ones(s.size), np.zeros(order + 1), np.inf
    for _ in range(_ITERATIONS):
        factor = (weight / size / np.abs(response))[:, np.newaxis]
        matrix = np.hstack([response[:, np.newaxis] * powers, -np.ones((s.size, 1))]) * factor
        target = -(response * s**order) * factor[:, 0]
        solution = np.linalg.lstsq(
            np.vstack([matrix.real, matrix.imag]), np.concatenate([target.real, target.imag]), rcond=None
        )[0]
        denominator = np.concatenate([[1.0], solution[:-1]])
        values = np.polyval(denominator, s)
        size = np.maximum(np.abs(values), 1e-12)
        error = float(np.sum(np.abs(weight * (solution[-1] / values / response - 1.0)) ** 2))
    stable = bool(np.all(np.roots(denominator).real < 0.0))
    gain = float(solution[-1] / denominator[-1]) if denominator[-1] else 1.0
    return denominator, gain, error if stable else np.inf


def _stable(denominator: FloatArray, gain: float, delay_s: float) -> LinearServo:
    return LinearServo.of(TransferFunction((gain * denominator[-1],), tuple(denominator.tolist())), delay_s)
