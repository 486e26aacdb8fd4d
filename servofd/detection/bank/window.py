"""A stretch of flight as the hypotheses of the bank see it, and what one of them makes of it."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field
from operator import itemgetter
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servofd.detection.threshold import CURVATURE_TO_SIGMA
from servofd.estimate.statistics import Estimate
from servofd.servo.motion import AnyServo, swung

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from servofd.core.tolerance import Tolerance
    from servofd.core.types import FloatArray
    from servofd.detection.alarm import Level
    from servofd.detection.residual import Commands, ResidualGenerator, Residuals
    from servofd.servo.servo_model import ServoModel

COLOUR = 4.0
"""Misfits of neighbouring samples are alike: so many samples tell as much as one."""


class Regression(NamedTuple):
    """Outcome of a ridge regression with k regressors on n samples."""

    coefficients: FloatArray
    """Of shape (k,)."""
    predicted_deg: FloatArray
    """Of shape (n,)."""
    cost_deg2: float
    """Sum of squared misfits [deg^2]."""
    doubt: float
    """Sum of squared coefficients in standard deviations of their priors."""


class Ridge:
    """Least squares with a Gaussian prior of zero mean on each coefficient, for many targets.

    The regressors are of shape (n, k), the standard deviations of their priors (k,), infinite for none.

    Examples
    --------
    >>> fit = Ridge(np.ones((2, 1)), np.array([np.inf]), 0.1).fit(np.array([1.0, 3.0]))
    >>> fit.coefficients.round(6), round(fit.cost_deg2, 6)
    (array([2.]), 2.0)
    """

    def __init__(self, regressors: FloatArray, spread: FloatArray, noise_deg: float) -> None:
        self.regressors, self.noise_deg = regressors, noise_deg
        self.weight = noise_deg**2 / spread**2
        self.gram = regressors.T @ regressors
        self.inverse = np.linalg.inv(self.gram + np.diag(self.weight + 1e-12 * len(regressors)))

    def respread(self, spread: FloatArray) -> Ridge:
        """Return the same regressors with other priors."""
        other = copy(self)
        other.weight = self.noise_deg**2 / spread**2
        other.inverse = np.linalg.inv(self.gram + np.diag(other.weight + 1e-12 * len(self.regressors)))
        return other

    @property
    def occam(self) -> float:
        """Twice the negative logarithm of the share of the prior that fits this well: evidence's price of freedom."""
        return float(-np.linalg.slogdet(self.inverse)[1] - np.sum(np.log(self.weight)))

    def fit(self, target_deg: FloatArray) -> Regression:
        """Explain a target of shape (n,) [deg]."""
        coefficients = self.inverse @ (self.regressors.T @ target_deg)
        predicted_deg = self.regressors @ coefficients
        misfit = target_deg - predicted_deg
        doubt = float(self.weight @ coefficients**2) / self.noise_deg**2
        return Regression(coefficients, predicted_deg, float(misfit @ misfit), doubt)

    def estimate(
        self, fit: Regression, target_deg: FloatArray, index: int, offset: float = 0.0, own: float = 0.0
    ) -> Estimate:
        """One coefficient with its interval; `own` is the deviation that the servo may have had all along."""
        doubt = _misfit_deviation(target_deg - fit.predicted_deg, self.noise_deg)
        deviation = float(np.hypot(doubt * np.sqrt(self.inverse[index, index]), own))
        return Estimate.of(offset + float(fit.coefficients[index]), deviation)


def _misfit_deviation(misfit_deg: FloatArray, noise_deg: float) -> float:
    """Deviation of the misfit, enlarged for its colour: neighbours that agree tell less than strangers."""
    deviation = max(noise_deg, float(np.sqrt(np.mean(misfit_deg**2))))
    if misfit_deg.size < 3:
        return deviation
    power = float(misfit_deg @ misfit_deg)
    likeness = min(max(float(misfit_deg[1:] @ misfit_deg[:-1]) / max(power, 1e-300), 0.0), 0.98)
    return deviation * float(np.sqrt((1.0 + likeness) / (1.0 - likeness)))


_LEAD_S = 1.5
"""Simulations start this long before the window, so that how they start is forgotten (lags are below 0.15 s)."""
_SMALL_CHANGE = 0.02
_MOST, _GLITCH = 90.0, 3.0
"""Second differences count as no more than this many times the ninth decile, 5 standard deviations of white noise."""
_SMALLEST_NOISE_DEG = 0.01
_SMALLEST_TOLERANCE = 1e-6
_START_SAMPLES = 3
_PENALTY = 1.5
_WELL_KNOWN_S, _DELAYS = 0.02, 17
"""A tolerance of the delay that is no longer than this is as good as linear; so many are tried within a longer one."""
_FLOOR = 0.5


class Onset(NamedTuple):
    """How a fault came."""

    time_s: float
    position_deg: float
    """Where the surface was."""
    low_deg: float
    high_deg: float
    """Range of the healthy deflection from then to the beginning of the window."""


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """The best that a hypothesis can do for a window."""

    kind: str
    predicted_deg: FloatArray
    """Of shape (n,)."""
    cost_deg2: float
    """Sum of squared misfits, and what the priors of the nuisances add [deg^2]."""
    freedom: float
    """Number of free parameters."""
    parameters: Mapping[str, Estimate] = field(default_factory=dict)
    doubt: float = 0.0
    """Twice the negative logarithm of how plausible the parameters are in themselves."""
    predict: Callable[[Window], FloatArray] | None = None
    """Deflection that this fault would cause in another window [deg], shape (n,)."""


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """What was asked, what a healthy servo would have done, and what happened; arrays of shape (n,).

    Only samples with a position are in it.
    """

    servo: AnyServo
    """The healthy servo."""
    tolerance: Tolerance
    noise_deg: float
    """Standard deviation of the position measurement [deg]."""
    time_s: FloatArray
    measured_deg: FloatArray
    healthy_deg: FloatArray
    rate_deg_s: FloatArray
    """Speed of the healthy servo [deg/s]."""
    nuisances: FloatArray
    """What gain, delay, bandwidth and bias would add to the healthy deflection, of shape (n, 4)."""
    ridge: Ridge
    """Explains by these nuisances, within the tolerances of a working servo."""
    commands: Commands
    """As they reach the servo, from before the window on."""
    reach_deg: tuple[float, float]
    """Range of the healthy deflection in the flight so far [deg]."""
    onset: Onset | None
    """None if the fault is older than the record, which then tells nothing about how it came."""

    @classmethod
    def of(
        cls,
        model: ServoModel,
        tolerance: Tolerance,
        noise: float,
        residuals: Residuals,
        commands: Commands,
        span: slice,
        onset: Onset | None = None,
    ) -> Window:
        """Cut samples `span` out of the residuals of a whole flight."""
        usable = np.flatnonzero(np.isfinite(residuals.measured_deg[span])) + span.start
        time_s, healthy_deg = residuals.time_s[usable], residuals.simulated_deg[usable]
        first = int(np.searchsorted(commands.effective_s, time_s[0] - _LEAD_S, side="right")) - 1
        last = int(np.searchsorted(commands.effective_s, time_s[-1], side="right"))
        cut = slice(max(first, 0), max(last, 1))  # one at least, even if it takes effect after the window
        near = type(commands)(commands.effective_s[cut], commands.command_deg[cut], commands.slope_deg_s[cut])
        servo = model.servo(residuals.context)
        if tolerance.delay_s > _WELL_KNOWN_S:
            near, healthy_deg = _delayed(servo, tolerance, near, time_s, residuals.measured_deg[usable])
        quick, slow = (simulate(servo.slower(1.0 + change), near, time_s) for change in (_SMALL_CHANGE, -_SMALL_CHANGE))
        rate_deg_s = np.gradient(healthy_deg, time_s)
        quickness_deg = (quick - slow) / (2.0 * _SMALL_CHANGE)
        nuisances = np.column_stack([healthy_deg, -rate_deg_s, quickness_deg, np.ones(time_s.size)])
        noise = max(noise, _SMALLEST_NOISE_DEG)
        return cls(
            servo=servo,
            tolerance=tolerance,
            noise_deg=noise,
            time_s=time_s,
            measured_deg=residuals.measured_deg[usable],
            healthy_deg=healthy_deg,
            rate_deg_s=rate_deg_s,
            nuisances=nuisances,
            ridge=Ridge(nuisances, _spread(tolerance), noise),
            commands=near,
            reach_deg=_range(residuals.simulated_deg[: span.stop]),
            onset=onset,
        )

    @property
    def error_deg(self) -> FloatArray:
        """Simulation error of the healthy model [deg]."""
        return self.measured_deg - self.healthy_deg

    @property
    def spread(self) -> FloatArray:
        """Prior standard deviation of each nuisance, of shape (4,)."""
        return _spread(self.tolerance)

    def score(self, explanation: Explanation) -> float:
        """Information criterion (after Schwarz) of an explanation: twice the negative logarithm of its weight."""
        samples = max(self.time_s.size / COLOUR, 2.0)
        power = max(explanation.cost_deg2 / self.time_s.size, _FLOOR * self.noise_deg**2)
        return float(samples * np.log(power) + _PENALTY * explanation.freedom * np.log(samples) + explanation.doubt)

    @property
    def duration_s(self) -> float:
        """From the first to the last sample [s]."""
        return float(self.time_s[-1] - self.time_s[0])

    @property
    def start_deg(self) -> float:
        """Where the surface was at the start [deg]."""
        return float(median(self.measured_deg[:_START_SAMPLES].tolist()))

    @property
    def motion_deg(self) -> float:
        """How far a healthy servo would have moved, from end to end [deg]."""
        return float(np.ptp(self.healthy_deg))

    def simulate(self, servo: AnyServo, command_deg: FloatArray | None = None) -> FloatArray:
        """Deflection of another servo, or under other commands, at the times of the window [deg]."""
        commands = self.commands
        if command_deg is not None:
            slope_deg_s = commands.slope_deg_s
            if slope_deg_s.any():
                steps_s = np.diff(commands.effective_s, append=np.inf)
                slope_deg_s = np.where(slope_deg_s != 0.0, np.diff(command_deg, append=command_deg[-1]) / steps_s, 0.0)
            commands = type(commands)(commands.effective_s, command_deg, slope_deg_s)
        return simulate(servo, commands, self.time_s)


def simulate(servo: AnyServo, commands: Commands, at_s: FloatArray) -> FloatArray:
    """Deflection at given times, from rest at the first command [deg]."""
    return swung(servo, (commands.effective_s, commands.command_deg, commands.slope_deg_s), at_s)


def _delayed(
    servo: AnyServo, tolerance: Tolerance, commands: Commands, time_s: FloatArray, measured_deg: FloatArray
) -> tuple[Commands, FloatArray]:
    """Commands as late as fits best within the tolerance, and the healthy deflection under them.

    What a long delay changes is not linear in it.
    """
    tried = []
    for late_s in np.linspace(-tolerance.delay_s, tolerance.delay_s, _DELAYS):
        later = type(commands)(commands.effective_s + late_s, commands.command_deg, commands.slope_deg_s)
        healthy_deg = simulate(servo, later, time_s)
        tried.append((float(np.abs(measured_deg - healthy_deg).sum()), later, healthy_deg))
    _, later, healthy_deg = min(tried, key=itemgetter(0))
    return later, healthy_deg


def _spread(tolerance: Tolerance) -> FloatArray:
    """Standard deviations of uniform spreads within the tolerances."""
    bounds: FloatArray = np.array([tolerance.gain, tolerance.delay_s, tolerance.bandwidth, tolerance.bias_deg])
    return np.maximum(bounds, _SMALLEST_TOLERANCE) / float(np.sqrt(3.0))


def _range(values_deg: FloatArray) -> tuple[float, float]:
    return float(np.min(values_deg)), float(np.max(values_deg))


def noise_deg(error_deg: FloatArray) -> float:
    """Standard deviation of white measurement noise in a simulation error, whatever moves slowly in it [deg].

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> round(noise_deg(0.1 * rng.standard_normal(100_000) + np.sin(np.arange(1e5) / 100.0)), 2)
    0.1
    """
    curvature = np.diff(error_deg[np.isfinite(error_deg)], 2)
    if curvature.size == 0:
        return 0.0
    size_deg = np.abs(curvature)
    glitch_deg = _GLITCH * float(np.percentile(size_deg, _MOST))
    return CURVATURE_TO_SIGMA * float(np.mean(np.minimum(size_deg, glitch_deg)))


_FEWEST_SAMPLES = 12


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault of one surface."""

    kind: str
    """`unknown` if no hypothesis explains it, or several do alike."""
    start_s: float
    """Best estimate of the onset [s]."""
    alarm_s: float
    """When the alarm would have been raised in flight [s]."""
    end_s: float | None
    """When it was last seen [s]; None if it lasts to the end of the log."""
    parameters: Mapping[str, Estimate]
    probability: float
    """Of that kind; of the likeliest alternative if several do alike."""
    alternatives: tuple[str, ...]
    level: Level = "fault"
    named_s: float | None = None
    """When there were data enough for this name [s]."""
    first_signs: tuple[str, ...] = ()
    """What it could have been for all that was known within its first second."""


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """All that the bank needs to know of one surface's flight."""

    generator: ResidualGenerator
    tolerance: Tolerance
    noise_deg: float
    """Of the position."""
    sigma_deg: float
    """Of the healthy residual."""
    residuals: Residuals
    commands: Commands
    is_report: bool = True
    """Whether what only reports tell is wanted: the first signs of each fault."""

    def window(self, from_s: float, to_s: float, onset: Onset | None) -> Window | None:
        """Cut out a stretch; None if it holds too few samples."""
        time_s = self.residuals.time_s
        first, last = (int(i) for i in np.searchsorted(time_s, (from_s, to_s + 1e-9)))
        span = slice(first, last)
        if np.count_nonzero(self.residuals.settled[span]) < _FEWEST_SAMPLES:
            return None
        return Window.of(
            self.generator.model, self.tolerance, self.noise_deg, self.residuals, self.commands, span, onset
        )

    @property
    def end_s(self) -> float:
        """Last sample [s]."""
        return float(self.residuals.time_s[-1])
