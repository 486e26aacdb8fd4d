r"""Thresholds: a constant one, and one that follows the activity of the command.

The error of a healthy model reaches the residual as filtered commands. With :math:`r_0 = Q_y \hat y` (what the
residual would be, but for the sign, if the surface did not move at all), a servo whose gain, delay and bandwidth are
off by :math:`\delta_k, \delta_\tau, \delta_\omega` leaves to first order

.. math:: r = \delta_k r_0 - \delta_\tau \dot r_0 + \delta_\omega \sum_i \frac{s}{s + a_i} r_0

for poles :math:`-a_i`. The interval threshold bounds each term by its tolerance times the recent peak of its signal:

.. math:: \tau(t) = b + z \sigma_r
          + |\delta_k| [r_0] + |\delta_\tau| [\dot r_0] + |\delta_\omega| [\sum \dots] + [r_{sat}]

where :math:`[\cdot]` is a peak hold that decays within 0.15 s, and :math:`r_{sat}` what a servo leaves whose rate limit
is off by its tolerance, while it runs at it. A command that was lost from the log, and put back on a straight line,
adds what half the recent curvature of the command would cause if it lasted one sample: at most :math:`0.224 |p| T` of
it passes the filter's four or so lags (the peak of :math:`p\,(pt)^3 e^{-pt}/6`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from servofd.aircraft.schema import DEFAULT_SIGMAS
from servofd.core.types import ComplexArray, FloatArray
from servofd.detection.residual import CURVATURE_TO_SIGMA, RESTART_ALL, unmodelled
from servofd.servo.loops import compiled

if TYPE_CHECKING:
    from servofd.aircraft.series import Series
    from servofd.core.tolerance import Tolerance
    from servofd.detection.residual import ResidualGenerator, Residuals

_PEAK_HOLD_S = 0.15
"""Time constant with which the peaks fade: about as long as the filter remembers."""
_NOISE_SAMPLES = 200
"""Until so many positions have been seen, noise is not taken to be smaller than its tolerance."""
_FASTEST_SAMPLES, _NOISE_MEMORY = 10.0, 1000.0
"""Samples that it takes to change the noise: a few at first, then as many as fill ten seconds."""
_GLITCH = 5.0
"""Second differences count as no more than this many standard deviations."""
_SMALLEST_NOISE_DEG = 1e-3
"""Smallest noise of a position [deg]."""
_RESOLUTION_TO_SIGMA = float(1.0 / np.sqrt(12.0))


def new_state(noise_deg: float) -> tuple[FloatArray, FloatArray]:
    """Memory of `follow`: what it hands on from one piece to the next (10,), and rows of four (2, 4).

    Those are what deviations of gain, delay, bandwidth and bias by one would add, and their recent peaks.
    """
    numbers = np.array([0.0, 0.0, *[np.nan] * 4, max(noise_deg, _SMALLEST_NOISE_DEG), 0.0, np.nan, np.inf])
    return numbers, np.array([[1.0, 1.0, 1.0, 1.0], [0.0, 0.0, 0.0, 1.0]])


@compiled
def follow(
    signals: FloatArray,
    bounds: FloatArray,
    kept: FloatArray,
    rows: FloatArray,
    slow: ComplexArray,
    decay_rad_s: ComplexArray,
    out: FloatArray,
) -> None:
    """Fill the last array, of shape (3, n); call again with more samples to go on.

    It is the tolerance, the rate limit's part of it, and the noise of the residual. The smallest believable noise is
    that of the position's resolution, which is the smallest change of the position so far. `signals` (7, n) are time,
    residual of an immobile surface, simulation error, position, where the residual starts anew, what a rate limit at
    the edge of its tolerance would leave, what lost commands add; `bounds` the tolerated gain, delay [s], bandwidth and
    bias [deg], noise [deg], and its gain. `slow` are low passes of the immobile residual, one for each mode.
    """
    x, peak = rows[0], rows[1]
    noise_deg, noise_gain = bounds[4], bounds[5]
    peak_rate, unseen, last_s, last_deg, before, before_that = kept[0], kept[1], kept[2], kept[3], kept[4], kept[5]
    noise, seen, last_measured, resolution = kept[6], kept[7], kept[8], kept[9]
    tolerated = 0.0
    for i in range(4):
        tolerated += bounds[i] * peak[i]
    for k in range(signals.shape[1]):
        value = signals[1, k]
        if not np.isnan(value):
            step_s = signals[0, k] - last_s
            if np.isnan(last_deg) or signals[4, k] != 0.0:
                step_s, last_deg = 0.0, value
                for i in range(slow.size):
                    slow[i] = value
                before = before_that = np.nan
            last_speed, last_quick = x[1], x[2]
            x[0] = value
            x[1] = (value - last_deg) / step_s if step_s > 0.0 else 0.0
            x[2] = 0.0
            for i in range(slow.size):  # the sum of high passes s / (s + a), by the trapezoidal rule: a bound is enough
                half = 0.5 * decay_rad_s[i] * step_s
                slow[i] = ((1.0 - half) * slow[i] + half * (value + last_deg)) / (1.0 + half)
                share = value - slow[i]
                x[2] += share.real if decay_rad_s[i].imag == 0.0 else 2.0 * share.real
            fade = 1.0 / (1.0 + step_s / _PEAK_HOLD_S)
            peak[0] = max(abs(value), fade * peak[0])
            # A difference over a step lags by half of it, and an early servo is ahead by its advance.
            ahead = 0.5 * (1.0 + bounds[1] / step_s) if step_s > 0.0 else 0.0
            peak[1] = max(abs(x[1]) + ahead * abs(x[1] - last_speed), fade * peak[1])
            peak[2] = max(abs(x[2]) + ahead * abs(x[2] - last_quick), fade * peak[2])
            unseen *= fade
            unseen += signals[6, k]
            peak_rate = max(abs(signals[5, k]), fade * peak_rate)
            change = abs(signals[3, k] - last_measured)
            if 0.0 < change < resolution:
                resolution = change
            last_measured = signals[3, k]
            curvature = signals[2, k] - 2.0 * before + before_that
            if not np.isnan(curvature):
                seen += 1.0
                shown = min(abs(curvature) * CURVATURE_TO_SIGMA, _GLITCH * noise)
                noise += max(1.0 / (1.0 + seen / _FASTEST_SAMPLES), 1.0 / _NOISE_MEMORY) * (shown - noise)
                noise = max(noise, _SMALLEST_NOISE_DEG)
            before_that, before = before, signals[2, k]
            last_s, last_deg = signals[0, k], value
            tolerated = 0.0
            for i in range(4):
                tolerated += bounds[i] * peak[i]
        out[0, k] = tolerated + peak_rate + unseen
        out[1, k] = peak_rate + unseen
        usual = noise if seen >= _NOISE_SAMPLES else max(noise, noise_deg)
        out[2, k] = noise_gain * max(usual, _RESOLUTION_TO_SIGMA * resolution if resolution < np.inf else 0.0)
    kept[0], kept[1], kept[2], kept[3], kept[4], kept[5] = peak_rate, unseen, last_s, last_deg, before, before_that
    kept[6], kept[7], kept[8], kept[9] = noise, seen, last_measured, resolution


ThresholdKind = Literal["constant", "interval"]
Level = Literal["suspect", "fault"]

_TAKEN_UP = 2.0
"""Half plays to move until it is known on which side of its play a surface lies."""


@dataclass(frozen=True, slots=True, eq=False)
class Threshold:
    """Alarm level over time, and what of it is tolerance."""

    kind: ThresholdKind
    level_deg: FloatArray
    """Of shape (n,)."""
    tolerance_deg: FloatArray
    """Largest residual of a healthy servo without noise, of shape (n,)."""
    saturated_deg: FloatArray
    """What of it comes from running at the rate limit, and from commands that were lost, of shape (n,)."""
    sigma_deg: FloatArray
    """Standard deviation of the residual from noise, as known at each instant, of shape (n,)."""
    noise_gain: float = 1.0
    """Of the residual's noise over the position's."""

    @property
    def typical_deg(self) -> float:
        """Median level [deg]; of a constant threshold the level itself."""
        if self.kind == "constant" and self.level_deg.size:
            return float(np.min(self.level_deg))
        return float(np.median(self.level_deg)) if self.level_deg.size else float("nan")


class Evaluation:
    """The interval threshold of one surface, at the pace of its positions: for piece after piece of a flight."""

    def __init__(self, generator: ResidualGenerator, tolerance: Tolerance, period_s: float) -> None:
        from servofd.detection.pulse import design_pulse_filter

        pulse = design_pulse_filter(generator.model.transfer, 0.0, period_s, generator.pole_rad_s)
        self._generator, self._decay_rad_s = generator, generator.model.transfer.modes().decay_rad_s
        self.tolerated, self.noise_gain = tolerated_parameters(tolerance), pulse.noise_gain
        self._bounds = np.array([*self.tolerated, tolerance.noise_deg, pulse.noise_gain])
        self._memory = new_state(tolerance.noise_deg)
        self._slow = np.zeros(self._decay_rad_s.size, dtype=np.complex128)
        self._loose = new_loose_memory()

    def threshold(
        self, residuals: Residuals, rate_error_deg: FloatArray, added_deg: FloatArray, sigmas: float
    ) -> Threshold:
        """Threshold of the next samples, of shape (n,).

        `rate_error_deg` is what a rate limit lower by its tolerance would leave, `added_deg` what lost commands
        may add; both (n,), or empty where there is nothing of it.
        """
        signals = np.zeros((7, residuals.time_s.size))
        signals[:4] = residuals.time_s, residuals.immobile_deg, residuals.error_deg, residuals.measured_deg
        signals[4] = residuals.restart != 0
        for place, added in ((5, rate_error_deg), (6, added_deg)):
            if added.size:
                signals[place] = added
        out = np.zeros((3, residuals.time_s.size))
        follow(signals, self._bounds, *self._memory, self._slow, self._decay_rad_s, out)
        tolerated, saturated, sigma = out
        tolerated += loose_deg(self._generator, residuals.simulated_deg, residuals.restart, self._loose)
        return Threshold("interval", tolerated + sigmas * sigma, tolerated, saturated, sigma, self.noise_gain)


def constant_threshold(interval: Threshold, level_deg: float) -> Threshold:
    """The same level all the time, but for what a servo may leave at its rate limit, or commands that were lost."""
    return replace(interval, kind="constant", level_deg=level_deg + interval.saturated_deg)


def interval_threshold(
    generator: ResidualGenerator,
    segment: Series,
    residuals: Residuals,
    tolerance: Tolerance,
    sigmas: float = DEFAULT_SIGMAS,
) -> Threshold:
    """Largest residual that a healthy servo may have under the commands that it gets.

    Causal: no level uses a later sample, but for the usual sample time.
    """
    added = unmodelled(generator, segment, residuals, tolerance.rate)
    return Evaluation(generator, tolerance, segment.period_s).threshold(residuals, *added, sigmas)


def new_loose_memory() -> FloatArray:
    """Memory of `loose_deg` before the first sample: least and most that was simulated since the last start [deg]."""
    return np.array([np.inf, -np.inf])


def loose_deg(
    generator: ResidualGenerator, simulated_deg: FloatArray, restart: NDArray[np.int8], memory: FloatArray
) -> FloatArray:
    """What a start at an unknown point of a servo's play leaves until it has moved by more than that [deg], (n,).

    The memory is moved on, so that pieces of a flight may follow each other.
    """
    play_deg = generator.model.physics.loose_deg
    loose = np.zeros(simulated_deg.size)
    if play_deg == 0.0:
        return loose
    begins = np.union1d(np.flatnonzero(restart == RESTART_ALL), [0])
    for begin, end in zip(begins, np.append(begins[1:], loose.size), strict=True):
        if restart[begin] == RESTART_ALL:
            memory[:] = new_loose_memory()
        least_deg = np.minimum.accumulate(np.append(memory[0], simulated_deg[begin:end]))[1:]
        most_deg = np.maximum.accumulate(np.append(memory[1], simulated_deg[begin:end]))[1:]
        memory[:] = least_deg[-1], most_deg[-1]
        loose[begin:end] = play_deg * (most_deg - least_deg <= _TAKEN_UP * play_deg)
    return loose / abs(generator.model.transfer.dc_gain)


def tolerated_parameters(tolerance: Tolerance) -> FloatArray:
    """Largest relative changes of gain, delay [s], lags and bias [deg] that the tolerances allow, of shape (4,).

    A bandwidth lower by a share lengthens all lags by more than that share.
    """
    lags = tolerance.bandwidth / (1.0 - tolerance.bandwidth)
    return np.array([tolerance.gain, tolerance.delay_s, lags, tolerance.bias_deg])
