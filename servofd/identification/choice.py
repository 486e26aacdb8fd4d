"""Which model the data ask for: how many poles, unity gain or not, rate limits, dead band."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from servofd.core.errors import IdentificationError
from servofd.identification.motion import LinearServo, MotionFit, ServoCandidate, evaluated, fit_motion
from servofd.identification.records import Run
from servofd.servo.library import second_order
from servofd.servo.loop import MOST_POLES

_STEP_SHARE = 0.2
"""Share of the commanded range from which on a change is a step."""


class Step(NamedTuple):
    """A command that is new by a jump, and holds until another."""

    start_s: float
    end_s: float
    jump_deg: float


def steps_of(run: Run) -> list[Step]:
    """All steps of a run.

    Examples
    --------
    >>> from servofd.identification.records import prepared
    >>> from servofd.aircraft.series import Series
    >>> t = np.arange(100) / 100.0
    >>> run = prepared(Series("x", t, np.where(t < 0.1, 0.0, 60.0), t, np.zeros(100)))
    >>> [(round(step.start_s, 2), step.jump_deg) for step in steps_of(run)]
    [(0.1, 60.0)]
    """
    threshold_deg = _STEP_SHARE * run.span_deg
    changed = np.flatnonzero(np.diff(run.command_deg) != 0.0) + 1
    ends = np.append(run.command_s[changed[1:]], max(run.command_s[-1], run.measured_s[-1]) + 1e-9)
    jumps_deg = run.command_deg[changed] - run.command_deg[changed - 1]
    return [
        Step(float(run.command_s[k]), float(end_s), float(jump_deg))
        for k, end_s, jump_deg in zip(changed, ends, jumps_deg, strict=True)
        if abs(jump_deg) > threshold_deg
    ]


_WORTH = 0.98
"""An effect must take so much off the root mean square error, beside winning by BIC."""
_EQUAL_RMS = 1.001
"""Ratio of two errors below which they are equal."""
_CHANCE = 6.63
"""Quantile of chi squared at 1 %: by so much chance alone improves twice the logarithm of the likelihood."""
_BANDWIDTHS_HZ, _DAMPINGS, _DELAYS_S = (2.0, 4.0, 8.0, 16.0), (0.7, 1.6), (0.0, 0.02, 0.05)
"""Grid of bandwidths [Hz], dampings and delays [s] at which fits begin."""
_STARTS = 2
_FEW, _MANY = 16, 120
"""Steps of a descent that shall only show whether the start was a good one, and of the last one."""
_FASTEST, _FAST = 0.99, 0.5
"""Quantile of the speeds, and the share of it beyond which a servo may be at its limit."""
_DEAD_BAND_SHARES = (0.02, 0.04)
"""Of the range of motion, where the search for a dead band begins."""


@dataclass(frozen=True, slots=True)
class Choice:
    """The model that won, and the one with one more pole if it fits just as well."""

    fit: MotionFit
    further: MotionFit | None = None


def choose_linear(runs: Sequence[Run], order: int | None) -> Choice:
    """Fit 1 to 3 poles, or as many as asked for; each must pay for itself.

    A pole too few shifts the bandwidth (2 % for an S9256), one too many hardly matters: so the price is the smaller of
    BIC's and that of a test at 1 %.
    """
    fits: dict[int, MotionFit] = {}
    for n in range(1, MOST_POLES + 1) if order is None else (order,):
        fits[n] = _best_of(
            runs, [ServoCandidate(replace(each, gain=sign)) for each in _grid(n) for sign in (1.0, -1.0)]
        )
        if n == 2 and 1 in fits:
            # A far pole hardly differs from a delay: one that is three times as fast as the first is asked for, too.
            one, pole = fits[1].servo.linear, float(np.exp(fits[1].servo.linear.shape[0]))
            beside = LinearServo((np.log(3.0 * pole**2), np.log(4.0 * pole)), one.delay_s, one.gain)
            near = fit_motion(runs, ServoCandidate(beside))
            fits[n] = min(fits[n], near, key=lambda fit: fit.rms_deg)
    best = min(fits, key=lambda n: _criterion(runs, fits[n]))
    if not np.isfinite(fits[best].rms_deg):
        raise IdentificationError("no servo model comes near this motion")
    more = fits.get(best + 1)
    as_good = more is not None and more.rms_deg > fits[best].rms_deg / _EQUAL_RMS
    return Choice(fits[best], more if as_good else None)


def _criterion(runs: Sequence[Run], fit: MotionFit) -> float:
    """BIC with a lower price for the poles; with a dc gain of 1 if that is better, for a free gain hides a pole."""
    rebate = max(0.0, float(np.log(fit.count)) - _CHANCE) * fit.servo.linear.order
    return (with_unity_gain(runs, fit) or fit).bic - rebate


def with_unity_gain(runs: Sequence[Run], fit: MotionFit) -> MotionFit | None:
    """The same servo with a dc gain of exactly 1, if that fits (smaller BIC) and leaves noise alone; else None.

    Thesis Appendix A does the same ("a0 = b0"): a chirp hardly shows the gain at zero frequency, and its error
    would spread to bandwidth and poles.
    """
    if not fit.is_white or fit.servo.linear.gain <= 0.0:
        return None
    linear = replace(fit.servo.linear, gain=1.0)
    fixed = fit_motion(runs, replace(fit.servo, linear=linear, fixed_gain=True))
    return fixed if fixed.bic < fit.bic else None


def choose_nonlinear(runs: Sequence[Run], linear: MotionFit, swept: LinearServo | None, order: int | None) -> MotionFit:
    """Add rate limits and a dead band as far as they explain what the linear servo, or that of the sweeps, does not."""
    best = linear
    rate_deg_s = _typical_rate(runs)
    grid = _grid(order or 2)
    shapes = [linear.servo.linear, *([swept, *grid[:: len(_DELAYS_S) * len(_DAMPINGS)]] if swept else grid)]
    # Steps in one direction alone cannot show a limit in the other.
    down_deg_s = None if len({np.sign(step.jump_deg) for run in runs for step in steps_of(run)}) == 1 else rate_deg_s
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
            other = fit_motion(runs, start, steps=_FEW)
        if other.bic < best.bic and (best.is_white or other.rms_deg < _WORTH * best.rms_deg):
            best = other
    return _without_needless(runs, fit_motion(runs, best.servo, steps=_MANY))


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
    scored = sorted(starts, key=lambda start: sum(float(error @ error) for error in evaluated(runs, start)[0]))
    rough = [fit_motion(runs, start, steps=_FEW) for start in scored[:_STARTS]]
    return fit_motion(runs, min(rough, key=lambda fit: fit.rms_deg).servo)


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
    """Speed of what moves fast in the run that moves fastest [deg/s], single samples left out."""
    rates = []
    for run in runs:
        speed = np.abs(np.gradient(run.measured_deg, run.measured_s))
        rates.append(float(np.median(speed[speed >= _FAST * np.quantile(speed, _FASTEST)])))
    return max(rates) or 1.0
