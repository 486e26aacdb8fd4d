"""Which model the data ask for: how many poles, unity gain or not, rate limits, dead band."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from servofd.core.errors import IdentificationError
from servofd.identification.fit import fit_response
from servofd.identification.output_error import MotionFit, ServoCandidate, fit_motion
from servofd.identification.rate import step_slopes
from servofd.identification.shape import HIGHEST_ORDER, LinearServo
from servofd.servo.library import second_order

if TYPE_CHECKING:
    from servofd.identification.frequency_response import FrequencyResponse
    from servofd.identification.records import Run

_WORTH = 0.98
"""An effect must take so much off the root mean square error, beside winning by BIC."""
_EQUAL_RMS = 1.001
_CHANCE = 6.63
"""Quantile of chi squared at 1 %: by so much chance alone improves twice the logarithm of the likelihood."""
_BANDWIDTHS_HZ, _DAMPINGS, _DELAYS_S = (2.0, 4.0, 8.0, 16.0), (0.7, 1.6), (0.0, 0.02, 0.05)
_STARTS = 2
_FEW, _MANY = 8, 60
"""Simulations of a descent that shall only show whether the start was a good one, and of the last one."""
_DEAD_BAND_SHARES = (0.02, 0.04)
"""Of the range of motion, where the search for a dead band begins."""


@dataclass(frozen=True, slots=True)
class Choice:
    """The model that won, and the one with one more pole if it fits just as well."""

    fit: MotionFit
    further: MotionFit | None = None


def choose_linear(runs: Sequence[Run], response: FrequencyResponse | None, order: int | None) -> Choice:
    """Fit 1 to 3 poles, or as many as asked for; each must pay for itself.

    A pole too few shifts the bandwidth (2 % for an S9256), one too many hardly matters: so the price is the smaller of
    BIC's and that of a test at 1 %.

    Parameters
    ----------
    response : FrequencyResponse or None
        Their response within the band; None if they have none, then starts come from a grid.
    order : int or None
        Number of poles; None to let the data choose.
    """
    orders = range(1, HIGHEST_ORDER + 1) if order is None else (order,)
    fits: dict[int, MotionFit] = {}
    for n in orders:
        if response is not None:
            fits[n] = fit_motion(runs, ServoCandidate(fit_response(response, n)))
        else:
            fits[n] = _best_of(runs, [ServoCandidate(start) for start in _grid(n)])
    best = min(fits, key=lambda n: _criterion(runs, fits[n]))
    if not np.isfinite(fits[best].rms_deg):
        raise IdentificationError("no servo model comes near this motion")
    more = fits.get(best + 1)
    as_good = more is not None and more.rms_deg > fits[best].rms_deg / _EQUAL_RMS
    return Choice(fits[best], more if as_good else None)


def _criterion(runs: Sequence[Run], fit: MotionFit) -> float:
    """BIC with a lower price for the poles; with a dc gain of 1 if that is better, for a free gain hides a pole."""
    unity = with_unity_gain(runs, fit) if fit.is_white and fit.servo.linear.gain > 0.0 else None
    count = int(np.concatenate(fit.errors_deg).size)
    rebate = max(0.0, float(np.log(count)) - _CHANCE) * fit.servo.linear.order
    return (unity or fit).bic - rebate


def with_unity_gain(runs: Sequence[Run], fit: MotionFit) -> MotionFit | None:
    """The same servo with a dc gain of exactly 1, if the data do not object (smaller BIC); else None.

    Thesis Appendix A does the same ("a0 = b0"): a chirp hardly shows the gain at zero frequency, and its error
    would spread to bandwidth and poles.
    """
    linear = replace(fit.servo.linear, gain=1.0)
    fixed = fit_motion(runs, replace(fit.servo, linear=linear, fixed_gain=True))
    return fixed if fixed.bic < fit.bic else None


def choose_nonlinear(runs: Sequence[Run], linear: MotionFit, order: int | None, *, swept: bool) -> MotionFit:
    """Add rate limits and a dead band as far as they explain what the linear servo does not.

    Parameters
    ----------
    order : int or None
        Number of poles; None to let the data choose.
    swept : bool
        True if `linear` comes from a frequency response: it is a good start then, and few others are tried.

    Returns
    -------
    MotionFit
        `linear` itself if nothing is worth adding.
    """
    best = linear
    rate_deg_s = _typical_rate(runs)
    grid = _grid(order or 2)
    shapes = [linear.servo.linear, *(grid[:: len(_DELAYS_S) * len(_DAMPINGS)] if swept else grid)]
    # Steps in one direction alone cannot show a limit in the other.
    down_deg_s = None if len({np.sign(slope.travel_deg) for slope in step_slopes(runs)}) == 1 else rate_deg_s
    limited = [ServoCandidate(replace(s, gain=float(np.sign(s.gain))), rate_deg_s, down_deg_s) for s in shapes]
    best = _better(best, _best_of(runs, limited))
    if best.is_white and swept:
        return _without_needless(runs, best)
    span_deg = max(run.span_deg for run in runs)
    wide = [replace(best.servo, dead_band_deg=share * span_deg) for share in _DEAD_BAND_SHARES]
    best = _better(best, _best_of(runs, wide))
    if best is linear:
        return best
    for n in () if order else (1, 3):
        start = replace(best.servo, linear=_reordered(best.servo.linear, n))
        if best.is_white:
            other = _best_of(runs, [start, *(replace(start, linear=shape) for shape in _grid(n))])
        else:
            other = fit_motion(runs, start, evaluations=_FEW)
        if other.bic < best.bic and (best.is_white or other.rms_deg < _WORTH * best.rms_deg):
            best = other
    return _without_needless(runs, fit_motion(runs, best.servo, evaluations=_MANY))


def _without_needless(runs: Sequence[Run], fit: MotionFit) -> MotionFit:
    """The servo from here without an effect, if it does as well after all: it may have begun in the wrong place."""
    servo = fit.servo
    simpler = [
        replace(servo, rate_up_deg_s=None, rate_down_deg_s=None),
        replace(servo, dead_band_deg=None),
        replace(servo, rate_up_deg_s=None, rate_down_deg_s=None, dead_band_deg=None),
    ]
    # The largest number of effects first: of equals, `min` takes the last and simplest of the reversed list.
    fits = [fit, *(fit_motion(runs, one) for one in simpler if one != servo)]
    return min(reversed(fits), key=lambda one: one.bic)


def _better(old: MotionFit, new: MotionFit) -> MotionFit:
    return new if new.bic < old.bic and new.rms_deg < _WORTH * old.rms_deg else old


def _best_of(runs: Sequence[Run], starts: Sequence[ServoCandidate]) -> MotionFit:
    """Fit from the few most promising of many starts."""
    scored = sorted(starts, key=lambda start: _score(runs, start))
    rough = [fit_motion(runs, start, evaluations=_FEW) for start in scored[:_STARTS]]
    return fit_motion(runs, min(rough, key=lambda fit: fit.rms_deg).servo)


def _score(runs: Sequence[Run], start: ServoCandidate) -> float:
    errors = [run.measured_deg - start.simulate(run) for run in runs]
    return float(sum(error @ error for error in errors))


def _grid(order: int) -> list[LinearServo]:
    """Servos all over the range of hobby servos."""
    combinations = itertools.product(_BANDWIDTHS_HZ, _DAMPINGS, _DELAYS_S)
    if order < 3:
        second = (LinearServo.of(second_order(2.0 * np.pi * hz, damping), delay) for hz, damping, delay in combinations)
        return [_reordered(servo, order) for servo in second]
    shapes = []
    for hz, damping, delay_s in combinations:
        # Thesis Eq. 3.1: a real pole at the bandwidth, and a pair 2.5 times as fast.
        pole, pair = 2.0 * np.pi * hz, 2.5 * 2.0 * np.pi * hz
        shapes.append(LinearServo((np.log(pole), 2.0 * np.log(pair), np.log(1.4 * damping * pair)), delay_s))
    return shapes


def _reordered(servo: LinearServo, order: int) -> LinearServo:
    """A servo of another order with about the same bandwidth."""
    if servo.order == order:
        return servo
    bandwidth = servo.transfer.bandwidth_rad_s
    shapes = {
        1: (np.log(bandwidth),),
        2: (np.log(4.0 * bandwidth**2), np.log(4.0 * bandwidth)),
        3: (np.log(3.0 * bandwidth), np.log(4.0 * bandwidth**2), np.log(4.0 * bandwidth)),
    }
    return LinearServo(tuple(float(v) for v in shapes[order]), servo.delay_s, servo.gain)


def _typical_rate(runs: Sequence[Run]) -> float:
    """Speed of the steps, or else the speed that is hardly ever passed [deg/s]."""
    slopes = [abs(slope.slope_deg_s) for slope in step_slopes(runs)]
    if slopes:
        return float(np.quantile(slopes, 0.75))
    speeds = [np.abs(np.gradient(run.measured_deg, run.measured_s)) for run in runs]
    return float(np.quantile(np.concatenate(speeds), 0.95)) or 1.0
