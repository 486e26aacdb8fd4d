"""What a healthy servo may leave in the residual, sample by sample: the compiled part of the interval threshold."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servofd.aircraft.schema import DEFAULT_SIGMAS
from servofd.core.types import BoolArray, ComplexArray, FloatArray
from servofd.servo.state import compiled, inlined, inner

_PEAK_HOLD_S = 0.15
"""Time constant with which the peaks fade: about as long as the filter remembers."""
_NOISE_SAMPLES = 200
"""Until so many positions have been seen, noise is not taken to be smaller than its tolerance."""
_FASTEST_SAMPLES, _NOISE_MEMORY = 10.0, 1000.0
"""Samples that it takes to change the noise: a few at first, then as many as fill ten seconds."""
_GLITCH = 5.0
"""Second differences count as no more than this many standard deviations."""
CURVATURE_TO_SIGMA = float(np.sqrt(np.pi / 2.0 / 6.0))
"""Mean absolute second difference of white noise to its standard deviation. The median would fail on coarse steps."""
MEMORY_S, _EVERY_S = 10.0, 0.5
"""How far back a servo's deviations are remembered, and how often they are looked at."""
_SMALLEST_NOISE_DEG = 1e-3
_RESOLUTION_TO_SIGMA = float(1.0 / np.sqrt(12.0))
_TRIFLE = 0.1
"""Unusual deviations that leave less than this share of the tolerated bias are of no interest, however sure."""
_ANYTHING = np.array([1.0, 0.1, 1.0, 10.0])
"""Deviations of gain, delay [s], bandwidth and bias [deg] that no fault exceeds by much."""


class Signals(NamedTuple):
    """Of one surface; all of shape (n,), but for the last two, which may be empty."""

    time_s: FloatArray
    immobile_deg: FloatArray
    error_deg: FloatArray
    measured_deg: FloatArray
    judged_deg: FloatArray
    """Residual; NaN where it is not judged."""
    restarted: BoolArray
    rate_error_deg: FloatArray
    """Residual that a rate limit at the edge of its tolerance would leave."""
    unseen_deg: FloatArray
    """What commands that were lost from the log add from each sample on."""


class Bounds(NamedTuple):
    """Tolerances and noise."""

    tolerated: FloatArray
    """Of gain, delay [s], bandwidth and bias [deg], of shape (4,)."""
    noise_deg: float
    noise_gain: float
    colour: float
    """Sum of the residual's autocorrelation over all lags."""


class Work(NamedTuple):
    """Room for `follow`, which allocates nothing."""

    slow: ComplexArray
    """Low passes of the immobile residual, one for each mode."""
    x: FloatArray
    """What deviations of gain, delay, bandwidth and bias by one would add."""
    peak: FloatArray
    gram: FloatArray
    moment: FloatArray
    healthy: FloatArray
    """Prior weights of healthy deviations, per power of the noise."""
    anything: FloatArray
    """Those of any deviations."""
    factor: FloatArray
    solved: FloatArray
    state: FloatArray
    """Of shape (12,): what `follow` hands on from one piece to the next, see there."""


def new_work(bounds: Bounds, modes: int) -> Work:
    """Room for a servo with so many modes."""
    noise_deg = max(bounds.noise_deg, _SMALLEST_NOISE_DEG)
    return Work(
        slow=np.zeros(modes, dtype=np.complex128),
        x=np.ones(4),
        peak=np.array([0.0, 0.0, 0.0, 1.0]),
        gram=np.zeros((4, 4)),
        moment=np.zeros(4),
        # Uniform within its bounds, a deviation has a third of their square as variance.
        healthy=3.0 / np.maximum(bounds.tolerated, 1e-9) ** 2,
        anything=1.0 / _ANYTHING**2,
        factor=np.zeros((4, 4)),
        solved=np.zeros(4),
        state=np.array([0.0, 0.0, *[np.nan] * 4, noise_deg, 0.0, 0.0, -np.inf, np.nan, np.inf]),
    )


@compiled
def follow(
    signals: Signals,
    bounds: Bounds,
    work: Work,
    decay_rad_s: ComplexArray,
    tolerated_deg: FloatArray,
    saturated_deg: FloatArray,
    sigma_deg: FloatArray,
    drift: FloatArray,
) -> None:
    """Fill the last four arrays, each of shape (n,).

    They are the tolerance, the rate limit's part of it, the noise of the residual, and evidence of unusual deviations.
    Call again with more samples to go on. The smallest believable noise is that of the position's resolution, which is
    the smallest change of the position so far.
    """
    slow, x, peak, kept = work.slow, work.x, work.peak, work.state
    peak_rate, unseen, last_s, last_deg, before, before_that = kept[0], kept[1], kept[2], kept[3], kept[4], kept[5]
    noise, seen, odds, next_s, last_measured, resolution = kept[6], kept[7], kept[8], kept[9], kept[10], kept[11]
    for k in range(signals.time_s.size):
        value = signals.immobile_deg[k]
        if not np.isnan(value):
            step_s = signals.time_s[k] - last_s
            if np.isnan(last_deg) or signals.restarted[k]:
                step_s, last_deg = 0.0, value
                for i in range(slow.size):
                    slow[i] = value
                before = before_that = np.nan
            last_speed, last_quick = x[1], x[2]
            x[0] = value
            x[1] = (value - last_deg) / step_s if step_s > 0.0 else 0.0
            x[2] = _quick(slow, decay_rad_s, value, last_deg, step_s)
            fade = 1.0 / (1.0 + step_s / _PEAK_HOLD_S)
            peak[0] = max(abs(value), fade * peak[0])
            # A difference over a step lags by half of it, and an early servo is ahead by its advance.
            ahead = 0.5 * (1.0 + bounds.tolerated[1] / step_s) if step_s > 0.0 else 0.0
            peak[1] = max(abs(x[1]) + ahead * abs(x[1] - last_speed), fade * peak[1])
            peak[2] = max(abs(x[2]) + ahead * abs(x[2] - last_quick), fade * peak[2])
            unseen *= fade
            if signals.unseen_deg.size > 0:
                unseen += signals.unseen_deg[k]
            if signals.rate_error_deg.size > 0:
                peak_rate = max(abs(signals.rate_error_deg[k]), fade * peak_rate)
            resolution = _finer(resolution, abs(signals.measured_deg[k] - last_measured))
            last_measured = signals.measured_deg[k]
            curvature = signals.error_deg[k] - 2.0 * before + before_that
            if not np.isnan(curvature):
                seen += 1.0
                noise = max(_nearer(noise, abs(curvature), seen), _SMALLEST_NOISE_DEG)
            believed = max(noise, _RESOLUTION_TO_SIGMA * resolution) if resolution < np.inf else noise
            before_that, before = before, signals.error_deg[k]
            last_s, last_deg = signals.time_s[k], value
            residual = signals.judged_deg[k]
            # Neither made-up commands nor a saturated servo show deviations; what is beyond all tolerance is none.
            allowed = _total(bounds.tolerated, peak) + peak_rate + DEFAULT_SIGMAS * bounds.noise_gain * believed
            if abs(residual) <= allowed and unseen + peak_rate < bounds.noise_gain * believed:
                _learn(work.gram, work.moment, x, residual, 1.0 / (1.0 + step_s / MEMORY_S))
                if last_s >= next_s:
                    power = bounds.colour * max(bounds.noise_gain * believed, _TRIFLE * bounds.tolerated[3]) ** 2
                    odds = _explained(work, work.anything, power) - _explained(work, work.healthy, power)
                    next_s = last_s + _EVERY_S
        drift[k] = odds
        tolerated_deg[k] = _total(bounds.tolerated, peak) + peak_rate + unseen
        saturated_deg[k] = peak_rate + unseen
        usual = noise if seen >= _NOISE_SAMPLES else max(noise, bounds.noise_deg)
        sigma_deg[k] = bounds.noise_gain * max(usual, _RESOLUTION_TO_SIGMA * resolution if resolution < np.inf else 0.0)
    kept[0], kept[1], kept[2], kept[3], kept[4], kept[5] = peak_rate, unseen, last_s, last_deg, before, before_that
    kept[6], kept[7], kept[8], kept[9], kept[10], kept[11] = noise, seen, odds, next_s, last_measured, resolution


@inlined
def _quick(slow: ComplexArray, decay_rad_s: ComplexArray, value: float, last: float, step_s: float) -> float:
    """Sum of the high passes s / (s + a), by the trapezoidal rule: a bound needs no exponential."""
    quick = 0.0
    for i in range(decay_rad_s.size):
        half = 0.5 * decay_rad_s[i] * step_s
        slow[i] = ((1.0 - half) * slow[i] + half * (value + last)) / (1.0 + half)
        share = value - slow[i]
        quick += share.real if decay_rad_s[i].imag == 0.0 else 2.0 * share.real
    return quick


@inlined
def _finer(resolution: float, change: float) -> float:
    """Smallest change of the position so far."""
    return change if 0.0 < change < resolution else resolution


@inlined
def _nearer(noise: float, curvature: float, seen: float) -> float:
    """Move the noise towards the mean that second differences of the simulation error speak for."""
    change = max(1.0 / (1.0 + seen / _FASTEST_SAMPLES), 1.0 / _NOISE_MEMORY)
    return noise + change * (min(curvature * CURVATURE_TO_SIGMA, _GLITCH * noise) - noise)


@inlined
def _learn(gram: FloatArray, moment: FloatArray, x: FloatArray, residual: float, keep: float) -> None:
    """Normal equations of the residual on what deviations would add, the past fading away."""
    for i in range(4):
        moment[i] = keep * moment[i] + x[i] * residual
        for j in range(i + 1):
            gram[i, j] = keep * gram[i, j] + x[i] * x[j]


@inlined
def _total(bounds: FloatArray, peak: FloatArray) -> float:
    total = 0.0
    for i in range(4):
        total += bounds[i] * peak[i]
    return total


@inner
def _explained(work: Work, weight: FloatArray, power: float) -> float:
    """How much of the residual they explain, m' (G + p W)^-1 m / p of the normal equations, by Cholesky's factors."""
    gram, factor, solved = work.gram, work.factor, work.solved
    total = 0.0
    for i in range(4):
        for j in range(i + 1):
            rest = gram[i, j]
            if i == j:
                rest += power * weight[i]
            for m in range(j):
                rest -= factor[i, m] * factor[j, m]
            factor[i, j] = np.sqrt(max(rest, 1e-300)) if i == j else rest / factor[j, j]
        rest = work.moment[i]
        for m in range(i):
            rest -= factor[i, m] * solved[m]
        solved[i] = rest / factor[i, i]
        total += solved[i] ** 2
    return total / power
