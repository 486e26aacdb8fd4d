"""How much of a delay may be a far pole: the two trade off, and a fit shows only their sum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servofd.identification.output_error import evaluated
from servofd.identification.shape import HIGHEST_ORDER, LinearServo

if TYPE_CHECKING:
    from servofd.identification.output_error import MotionFit
    from servofd.identification.records import Run
    from servofd.types import FloatArray

_NOT_REJECTED = 3.84
"""Quantile of chi squared with one degree of freedom: twice the logarithm of the likelihood may fall by so much."""
_NEAREST, _FARTHEST, _POLES = 1.5, 300.0, 24
"""Further poles that are tried, in multiples of the largest pole found, and how many."""
_STEP = 1e-4


def lowest_delay_s(runs: Sequence[Run], fit: MotionFit) -> float:
    """Smallest delay that the data allow if a pole beyond those of the fit takes the rest of the lag.

    For each of many positions of that pole the other numbers are corrected by one Gauss-Newton step; those that raise
    the squared error by more than chance would are rejected.

    Returns
    -------
    float
        Delay [s]; that of the fit if every further pole is rejected.
    """
    linear = fit.servo.linear
    if linear.order >= HIGHEST_ORDER:
        return linear.delay_s
    largest = float(np.max(np.abs(linear.poles_rad_s)))
    count = sum(error.size for error in fit.errors_deg)
    allowed = count * fit.rms_deg**2 * (1.0 + _NOT_REJECTED / count)
    delays = [linear.delay_s]
    for far_rad_s in largest * np.geomspace(_NEAREST, _FARTHEST, _POLES):
        delay_s, squared = _with_pole(runs, fit, float(far_rad_s))
        if squared <= allowed:
            delays.append(max(0.0, delay_s))
    return min(delays)


def _with_pole(runs: Sequence[Run], fit: MotionFit, far_rad_s: float) -> tuple[float, float]:
    """Delay and squared error of the nearest servo that has one more pole, at a given place."""
    place = fit.servo.linear.order

    def errors(x: FloatArray) -> FloatArray:
        servo = fit.servo.with_vector(x)
        return np.concatenate(evaluated(runs, replace(servo, linear=_extended(servo.linear, far_rad_s)))[0])

    x = fit.servo.vector()
    x[place] = max(x[place] - 1e3 / far_rad_s, _STEP)
    here = errors(x)
    slopes = np.column_stack([(errors(x + _STEP * unit) - here) / _STEP for unit in np.eye(x.size)])
    step = np.linalg.lstsq(slopes, -here, rcond=None)[0]
    rest = here + slopes @ step
    return 1e-3 * float(x[place] + step[place]), float(rest @ rest)


def _extended(linear: LinearServo, far_rad_s: float) -> LinearServo:
    """The same servo with one more real pole."""
    if linear.order == 1:
        near_rad_s = float(np.exp(linear.shape[0]))
        shape = (float(np.log(near_rad_s * far_rad_s)), float(np.log(near_rad_s + far_rad_s)))
        return replace(linear, shape=shape)
    return replace(linear, shape=(float(np.log(far_rad_s)), *linear.shape))
