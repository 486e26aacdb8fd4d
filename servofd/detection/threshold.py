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

from servofd.aircraft import DEFAULT_SIGMAS
from servofd.detection.allowance import Bounds, Signals, follow, new_work
from servofd.models.kernel import RESTART_ALL

if TYPE_CHECKING:
    from servofd.detection.probability import CusumDesign
    from servofd.detection.residual import ResidualGenerator, Residuals
    from servofd.segment import Segment
    from servofd.tolerance import Tolerance
    from servofd.types import BoolArray, FloatArray

__all__ = ["Threshold", "ThresholdKind", "constant_threshold", "habits", "interval_threshold", "suspicion"]

ThresholdKind = Literal["constant", "interval"]

_SMALLEST_NOISE_DEG = 1e-3
_SAMPLES_FOR_STEP, _FEW_VALUES = 20_000, 0.5
_AT_LIMIT = 0.98
_RECENT_COMMANDS = 10
_TAKEN_UP = 2.0
"""Half plays to move until it is known on which side of its play a surface lies."""
_SUSPICIOUS_DRIFT = 40.0
"""In 400 flights of 120 s, healthy servos with parameters anywhere within their tolerances reached 22."""
_PEAK_OF_LAGS = 0.224
_KAPPA = 0.5
_SUSPICIONS_PER_HOUR = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Threshold:
    """Alarm level over time, and what of it is tolerance."""

    kind: ThresholdKind
    level_deg: FloatArray
    """Of shape (n,)."""
    tolerance_deg: FloatArray
    """Largest residual of a healthy servo without noise, of shape (n,)."""
    saturated_deg: FloatArray
    """What of it comes from running at the rate limit, of shape (n,)."""
    sigma_deg: FloatArray
    """Standard deviation of the residual from noise, as known at each instant, of shape (n,)."""
    cusum: CusumDesign
    """Cumulative sum of what exceeds the tolerance."""
    drift: FloatArray
    """How much better gain, delay, bandwidth and bias beyond their tolerances explain the residual of the last ten
    seconds than those within, as twice a logarithm of odds, of shape (n,)."""

    @property
    def typical_deg(self) -> float:
        """Median level [deg]; of a constant threshold the level itself."""
        if self.kind == "constant" and self.level_deg.size:
            return float(np.min(self.level_deg))
        return float(np.median(self.level_deg)) if self.level_deg.size else float("nan")


def constant_threshold(interval: Threshold, level_deg: float) -> Threshold:
    """The same level all the time, but for what a servo may leave that runs at its rate limit."""
    return replace(interval, kind="constant", level_deg=level_deg + interval.saturated_deg)


def interval_threshold(
    generator: ResidualGenerator,
    segment: Segment,
    residuals: Residuals,
    tolerance: Tolerance,
    sigmas: float = DEFAULT_SIGMAS,
) -> Threshold:
    """Largest residual that a healthy servo may have under the commands that it gets.

    Parameters
    ----------
    generator : ResidualGenerator
        Healthy model and filter.
    segment : Segment
        Commands and measurements.
    residuals : Residuals
        Of the segment.
    tolerance : Tolerance
        How far a healthy servo may differ from the model.
    sigmas : float
        Standard deviations of noise in the threshold.

    Returns
    -------
    Threshold
        Causal: no level uses a later sample, but for the median sample time.

    Examples
    --------
    At rest only bias and noise remain; in motion there is more to be wrong:

    >>> from servofd.detection.residual import ResidualGenerator
    >>> from servofd.models.servo_model import ServoModel
    >>> from servofd.segment import Segment
    >>> from servofd.servos import servo_named
    >>> from servofd.tolerance import Tolerance
    >>> model = ServoModel.of(servo_named("hs225bb-eq31"))
    >>> time_s = np.arange(0.0, 20.0, 0.01)
    >>> command_deg = np.where(time_s > 10.0, 10.0, 0.0)
    >>> measured_deg = model.simulate(time_s, command_deg, time_s) + 0.1 * np.random.default_rng(1).normal(size=2000)
    >>> segment = Segment("elevator", time_s, command_deg, time_s, measured_deg)
    >>> generator = ResidualGenerator(model, 50.0)
    >>> level_deg = interval_threshold(generator, segment, generator.run(segment), Tolerance()).level_deg
    >>> bool(0.4 < level_deg[900] < 0.7 < level_deg[1010])
    True
    """
    from servofd.detection.probability import Noise, design_cusum
    from servofd.detection.pulse import design_pulse_filter

    pulse = design_pulse_filter(generator.model.transfer, 0.0, segment.period_s, generator.pole_rad_s)
    size = residuals.time_s.size
    tolerated, saturated, sigma, drift = (np.zeros(size) for _ in range(4))
    cusum = design_cusum(_KAPPA, _SUSPICIONS_PER_HOUR, Noise.designed(pulse, 1.0))
    bounds = Bounds(
        habits(tolerance),
        tolerance.noise_deg,
        max(_step_deg(residuals.measured_deg) / np.sqrt(12.0), _SMALLEST_NOISE_DEG),
        pulse.noise_gain,
        cusum.factor,
    )
    signals = Signals(
        residuals.time_s,
        residuals.immobile_deg,
        residuals.error_deg,
        np.where(residuals.settled, residuals.residual_deg, np.nan),
        residuals.restart != 0,
        _rate_error(generator, segment, residuals, tolerance.rate),
        _unseen(segment, generator, residuals.time_s),
    )
    decay_rad_s = generator.model.parameters().decay_rad_s
    follow(signals, bounds, new_work(bounds, decay_rad_s.size), decay_rad_s, tolerated, saturated, sigma, drift)
    tolerated += _loose(generator, residuals)
    return Threshold("interval", tolerated + sigmas * sigma, tolerated, saturated, sigma, cusum, drift)


def suspicion(residuals: Residuals, threshold: Threshold) -> BoolArray:
    """Samples, of shape (n,), at which something too small for the threshold has lasted too long for chance.

    Either the cumulative sum of what exceeds the tolerance is beyond its limit, or the servo's habits of the last ten
    seconds are not those of a healthy one.
    """
    from servofd.detection.probability import cusum

    excess_deg = np.abs(residuals.residual_deg) - threshold.tolerance_deg
    drifted = threshold.drift >= _SUSPICIOUS_DRIFT
    if not np.any(excess_deg > 0.0):
        return drifted
    # Of either sign, so that oscillations add up; less one sigma, so that the sum of noise alone falls.
    beyond = np.maximum(excess_deg - threshold.sigma_deg, 0.0) / threshold.sigma_deg
    judged = np.where(residuals.settled, beyond, np.nan)
    sums = cusum(judged, threshold.cusum.kappa, residuals.restart != 0)
    return ((sums >= threshold.cusum.limit) & (excess_deg > 0.0)) | drifted


def _rate_error(generator: ResidualGenerator, segment: Segment, residuals: Residuals, share: float) -> FloatArray:
    """Residual of a servo whose rate limit is off by its tolerance [deg], shape (n,); empty if it never runs at it."""
    slower = replace(generator, model=generator.model.weaker(share))
    if slower.model is generator.model:
        return np.zeros(0)
    plan = generator.model.plan
    limit_deg_s = min(plan.rate_up_deg_s, plan.rate_down_deg_s)
    step_s, step_deg = np.diff(residuals.time_s), np.abs(np.diff(residuals.simulated_deg))
    # The slower servo runs at its limit before the model does.
    if plan.physics is None and not np.any(step_deg >= _AT_LIMIT * (1.0 - share) * limit_deg_s * step_s):
        return np.zeros(0)
    error_deg = slower.run(segment).simulated_deg - residuals.simulated_deg
    known = np.where(np.isfinite(residuals.measured_deg), error_deg, np.nan)
    return generator.filtered(residuals.time_s, known, residuals.restart)


def _loose(generator: ResidualGenerator, residuals: Residuals) -> FloatArray:
    """What a start at an unknown point of a servo's play leaves until it has moved by more than that [deg], (n,)."""
    servo = generator.model.extended()
    loose_deg = np.zeros(residuals.time_s.size)
    if servo is None or servo.play_deg == 0.0:
        return loose_deg
    begins = np.union1d(np.flatnonzero(residuals.restart == RESTART_ALL), [0])
    for begin, end in zip(begins, np.append(begins[1:], loose_deg.size), strict=True):
        moved_deg = residuals.simulated_deg[begin:end]
        travel_deg = np.maximum.accumulate(moved_deg) - np.minimum.accumulate(moved_deg)
        loose_deg[begin:end] = servo.play_deg * (travel_deg <= _TAKEN_UP * servo.play_deg)
    return loose_deg / abs(generator.model.transfer.dc_gain)


def habits(tolerance: Tolerance) -> FloatArray:
    """Largest relative changes of gain, delay [s], lags and bias [deg] that the tolerances allow, of shape (4,).

    A bandwidth lower by a share lengthens all lags by more than that share.

    Examples
    --------
    >>> from servofd.tolerance import Tolerance
    >>> habits(Tolerance(bandwidth=0.5)).tolist()
    [0.03, 0.003, 1.0, 0.3]
    """
    lags = tolerance.bandwidth / (1.0 - tolerance.bandwidth)
    return np.array([tolerance.gain, tolerance.delay_s, lags, tolerance.bias_deg])


def _step_deg(measured_deg: FloatArray) -> float:
    """Resolution of the position: the smallest difference between its values, if they are few [deg]."""
    some_deg = measured_deg[np.isfinite(measured_deg)][:_SAMPLES_FOR_STEP]
    values_deg = np.unique(some_deg)
    if values_deg.size < 2 or values_deg.size > _FEW_VALUES * some_deg.size:
        return 0.0
    return float(np.median(np.diff(values_deg)))


def _unseen(segment: Segment, generator: ResidualGenerator, time_s: FloatArray) -> FloatArray:
    """What lost commands may add to the residual from each sample on [deg], shape (n,); empty if none was lost."""
    from servofd.detection.residual import lost_commands

    lost = lost_commands(segment.command_s, generator.longest_gap_s(segment))
    if segment.command_period_s is not None or not lost.any():
        return np.zeros(0)
    before = np.flatnonzero(lost)
    curvature_deg = np.abs(
        np.diff(segment.command_deg, 2, prepend=segment.command_deg[:1], append=segment.command_deg[-1:])
    )
    recent_deg = np.lib.stride_tricks.sliding_window_view(
        np.pad(curvature_deg, (_RECENT_COMMANDS, 0)), _RECENT_COMMANDS
    )
    # A chord over n + 1 intervals is off by ((n + 1) / 2)^2 times as much as one over two, for n commands.
    size_deg = 0.5 * recent_deg[before].max(axis=1) * lost[before] * (0.5 * (lost[before] + 1)) ** 2
    passed = _PEAK_OF_LAGS * generator.pole_rad_s * segment.period_s
    unseen_deg = np.zeros(time_s.size)
    # It reaches the servo before the next command does, and the log with the first position after that.
    at = np.searchsorted(time_s, segment.command_s[before] + generator.model.plan.delay_s)
    np.add.at(unseen_deg, np.minimum(at, time_s.size - 1), passed * size_deg)
    return unseen_deg
