"""The ways in which a servo may behave for a while: well, altered, following less than asked, or not at all."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field, replace
from functools import lru_cache
from operator import itemgetter
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from logparsers.compiled import compiled
from servofd.core.numeric import least
from servofd.core.statistics import Estimate
from servofd.core.types import FloatArray
from servofd.servo.loops import play
from servofd.servo.motion import AnyServo, swung

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from servofd.core.tolerance import Tolerance
    from servofd.core.types import FloatArray
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
        noise, reached_deg = max(noise, _SMALLEST_NOISE_DEG), residuals.simulated_deg[: span.stop]
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
            reach_deg=(float(reached_deg.min()), float(reached_deg.max())),
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


_FEWEST_SAMPLES = 12


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


_NARROWEST_DEG = 0.3
_WIDE_DEG = 6.0
_GRID = 14
_REFINEMENTS = 5
_HOPELESS = 2.0
"""Times the cost of another search on its grid, that no refinement makes up for."""
_SLOWEST = 0.12
_LEAST_GAIN = 0.1
_SLOWEST_RATE = 0.1
_WELL_EXPLAINED = 1.2
_GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0


def deadband(window: Window) -> Explanation | None:
    """Increased dead band, stiction or play: the surface rests until it is half the width off.

    Before the servo, smooth or jerky, or behind it.
    """
    reach_deg = float(np.ptp(window.commands.command_deg))
    widest_deg = 2.0 * max(reach_deg, float(np.max(np.abs(window.error_deg))))
    if widest_deg <= _NARROWEST_DEG:
        return None
    grid = np.geomspace(_NARROWEST_DEG, widest_deg, _GRID)
    ways = [_before, _sticking, _behind] + ([_before_since_onset] if window.onset else [])
    searches = [_Search("deadband", window, way, grid, "width_deg") for way in ways]
    most_deg2 = _HOPELESS * min(search.best.cost_deg2 for search in searches)
    return min((s.refined() for s in searches if s.best.cost_deg2 <= most_deg2), key=window.score)


def slow(window: Window) -> Explanation:
    """The servo has lost bandwidth, or speed: the share of it that is left, or a new rate limit."""
    scales = np.geomspace(_SLOWEST, 1.0 - window.tolerance.bandwidth, _GRID)
    slower = _Search(
        "slow", window, lambda w, scale: w.simulate(w.servo.slower(scale)), scales, "bandwidth_scale"
    ).refined()
    fastest_deg_s = float(np.max(np.abs(window.rate_deg_s)))
    explained = slower.cost_deg2 <= _WELL_EXPLAINED * window.time_s.size * window.noise_deg**2
    if not fastest_deg_s > 0.0 or explained:
        return slower
    rates = fastest_deg_s * np.geomspace(_SLOWEST_RATE, 1.0 - window.tolerance.rate, _GRID // 2)
    limited = _Search("slow", window, lambda w, rate: w.simulate(w.servo.limited(rate)), rates, "rate_limit_deg_s")
    return min(slower, limited.refined(), key=window.score)


class _Search:
    """Values of one parameter: a grid, refined by golden section around its best."""

    def __init__(
        self,
        kind: str,
        window: Window,
        predict: Callable[[Window, float], FloatArray],
        grid: FloatArray,
        name: str,
    ) -> None:
        self._kind, self._window, self._predict, self._name, self._grid = kind, window, predict, name, grid
        self._tried = {value: self._fit(value) for value in grid.tolist()}

    @property
    def best(self) -> Explanation:
        """Of all that was tried."""
        return min(self._tried.values(), key=self._cost)

    def refined(self) -> Explanation:
        """The best between the neighbours of the grid's best, with its interval."""
        place = int(np.argmin([self._cost(self._tried[value]) for value in self._grid.tolist()]))
        low, high = float(self._grid[max(place - 1, 0)]), float(self._grid[min(place + 1, self._grid.size - 1)])
        left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
        for _ in range(_REFINEMENTS):
            if self._of(left) <= self._of(right):
                high, right = right, left
                left = high - _GOLDEN * (high - low)
            else:
                low, left = left, right
                right = low + _GOLDEN * (high - low)
        return _with_interval(self.best, self._tried, self._window, self._name)

    def _fit(self, value: float) -> Explanation:
        """A prediction with the nuisances of a working servo upon it; wide dead bands are rare."""
        found = _regressed(
            self._kind, self._window, lambda other: (self._predict(other, value), other.nuisances), self._window.ridge,
            1.0, lambda *_: {self._name: Estimate(value, value, value)},
        )  # fmt: skip
        return replace(found, doubt=((value / _WIDE_DEG) ** 2 if self._name == "width_deg" else 0.0) + found.doubt)

    def _of(self, value: float) -> float:
        if value not in self._tried:
            self._tried[value] = self._fit(value)
        return self._cost(self._tried[value])

    def _cost(self, fit: Explanation) -> float:
        return fit.cost_deg2 + self._window.noise_deg**2 * fit.doubt


def _regressed(
    kind: str,
    window: Window,
    model: Callable[[Window], tuple[FloatArray, FloatArray]],
    ridge: Ridge,
    freedom: float,
    sizes: Callable[[Ridge, Regression, FloatArray], dict[str, Estimate]],
) -> Explanation:
    """Explain a window by a model of it: a base (n,) and regressors (n, k) upon that; `sizes` are its parameters."""
    base_deg, _ = model(window)
    target_deg = window.measured_deg - base_deg
    fit = ridge.fit(target_deg)

    def predict(other: Window) -> FloatArray:
        base_deg, regressors = model(other)
        predicted_deg: FloatArray = base_deg + regressors @ fit.coefficients
        return predicted_deg

    parameters = sizes(ridge, fit, target_deg)
    return Explanation(kind, base_deg + fit.predicted_deg, fit.cost_deg2, freedom, parameters, fit.doubt, predict)


def _with_interval(best: Explanation, tried: dict[float, Explanation], window: Window, name: str) -> Explanation:
    """Add the 95 % interval: where the cost, a parabola about the best, has risen by 1.96^2 noise variances."""
    value = best.parameters[name].value
    variance = max(window.noise_deg**2, best.cost_deg2 / window.time_s.size)
    others = sorted((abs(v - value), fit.cost_deg2 - best.cost_deg2) for v, fit in tried.items() if v != value)
    curved = [(distance, rise) for distance, rise in others if rise > variance]
    distance, rise = curved[0] if curved else (value, variance)
    random = distance * float(np.sqrt(COLOUR * variance / rise))
    # A gain that the servo may have had all along widens the zone as well.
    own = value * float(window.spread[0]) if name == "width_deg" else 0.0
    deviation = float(np.hypot(random, own))
    interval = {name: Estimate.of(value, deviation)}
    return replace(best, parameters=interval)


def _resting_commands(window: Window, width_deg: float) -> tuple[FloatArray, int, float]:
    """Commands with the lead-in replaced by what brings the surface where it was, where the window begins, and that."""
    command_deg = window.commands.command_deg.copy()
    begin = int(np.searchsorted(window.commands.effective_s, window.time_s[0], side="right"))
    asked_deg = float(command_deg[max(begin - 1, 0)])
    held_deg = min(max(window.start_deg, asked_deg - width_deg / 2.0), asked_deg + width_deg / 2.0)
    command_deg[:begin] = held_deg
    return command_deg, begin, held_deg


def _before(window: Window, width_deg: float) -> FloatArray:
    command_deg, begin, held_deg = _resting_commands(window, width_deg)
    command_deg[begin:] = play(command_deg[begin:], width_deg, held_deg)
    return window.simulate(window.servo, command_deg)


def _before_since_onset(window: Window, width_deg: float) -> FloatArray:
    command_deg = window.commands.command_deg.copy()
    onset_s = window.onset.time_s if window.onset else -np.inf
    begin = max(int(np.searchsorted(window.commands.effective_s, onset_s, side="right")), 1)
    command_deg[begin:] = play(command_deg[begin:], width_deg, float(command_deg[begin - 1]))
    return window.simulate(window.servo, command_deg)


def _sticking(window: Window, width_deg: float) -> FloatArray:
    command_deg, begin, held_deg = _resting_commands(window, width_deg)
    _stick(command_deg[begin:], width_deg / 2.0, held_deg)
    return window.simulate(window.servo, command_deg)


def _behind(window: Window, width_deg: float) -> FloatArray:
    return play(window.healthy_deg, width_deg, window.start_deg)


@compiled
def _stick(command_deg: FloatArray, half_width_deg: float, held_deg: float) -> None:
    """Hold until the command is half a width away, then go all the way."""
    for k in range(command_deg.size):
        if abs(command_deg[k] - held_deg) > half_width_deg:
            held_deg = command_deg[k]
        command_deg[k] = held_deg


_GAIN, _BIAS = 0, 3
"""Columns of `Window.nuisances`."""
_LARGEST_BIAS_DEG = 30.0
_FASTEST_GROWTH_DEG_S = 1.0
_LARGEST_TRIM_DEG = 5.0
_STUCK_GAIN = 0.1
"""A servo that moves less is called stuck."""


def healthy(window: Window) -> Explanation:
    """The model, within the tolerances of a working servo."""
    fit = window.ridge.fit(window.error_deg)
    return Explanation("healthy", window.healthy_deg + fit.predicted_deg, fit.cost_deg2, 0.0, doubt=fit.doubt)


def bias(window: Window) -> Explanation | None:
    """The surface is off by a constant angle: a slipped arm, a bent rod, a shifted potentiometer.

    An offset larger than a healthy servo may have, that stays or grows; it is given at the window's end.
    """
    fits = (_offset(window, growing=growing) for growing in (False, True))
    large = (fit for fit in fits if abs(fit.parameters["bias_deg"].value) > window.tolerance.bias_deg)
    return min(large, key=window.score, default=None)


def _offset(window: Window, *, growing: bool) -> Explanation:
    wide = window.spread.copy()
    wide[_BIAS] = _LARGEST_BIAS_DEG
    end_s = float(window.time_s[-1])

    def model(other: Window) -> tuple[FloatArray, FloatArray]:
        drift = [other.time_s - end_s] if growing else []
        return other.healthy_deg, np.column_stack([other.nuisances, *drift])

    ridge = Ridge(model(window)[1], np.append(wide, [_FASTEST_GROWTH_DEG_S] * growing), window.noise_deg)
    own_deg = window.spread[_BIAS]
    return _regressed(
        "bias", window, model, ridge, 2.0 if growing else 1.0,
        lambda ridge, fit, target: {"bias_deg": ridge.estimate(fit, target, _BIAS, own=own_deg)},
    )  # fmt: skip


def loss_of_effectiveness(window: Window) -> Explanation | None:
    """The surface moves by a share of what was asked: a slipping horn, a loose linkage, a weak servo.

    A gain below that of a healthy servo, about zero or about another trim. Of a servo with effects, less than what was
    asked may reach it, and its play and friction do not shrink along with that.
    """
    kind, most, own = "loss_of_effectiveness", 1.0 - window.tolerance.gain, window.spread[_GAIN]
    fits = []
    for trim_deg, freedom in ((window.spread[_BIAS], 1.0), (_LARGEST_TRIM_DEG, 2.0)):
        wide = window.spread.copy()
        wide[[_GAIN, _BIAS]] = 1.0, trim_deg
        found = _regressed(
            kind, window, lambda w: (w.healthy_deg, w.nuisances), Ridge(window.nuisances, wide, window.noise_deg),
            freedom, lambda ridge, fit, target: {"gain": ridge.estimate(fit, target, _GAIN, offset=1.0, own=own)},
        )  # fmt: skip
        fits += [found] if found.parameters["gain"].value > _STUCK_GAIN else []
    if not window.servo.is_linear:
        gains = np.linspace(_LEAST_GAIN, most, _GRID)
        heard = _Search(kind, window, lambda w, gain: w.simulate(w.servo, gain * w.commands.command_deg), gains, "gain")
        fits.append(heard.refined())
    return min((fit for fit in fits if fit.parameters["gain"].value < most), key=window.score, default=None)


_OUT_OF_REACH_DEG = 2.0
_UNCOMMANDED_RUN_DEG = 3.0
_STOP_SHARE = 0.9
_WIND_HZ = 1.0
_FASTEST_WIND_HZ = 8.0
_MOST_COSINES = 96
_SWINGS_DEG = (3.0, 10.0)
_UNHEARD_OF = 6.0
"""Where nothing was commanded, loose and wandering surfaces look alike: then it is called floating, 20 to 1."""


def stuck(window: Window) -> Explanation | None:
    """The shaft jams where the servo has brought it, within reach of the commands."""
    rest = _resting("stuck", window)
    return None if _ran_away(window, rest.parameters["position_deg"].value) else rest


def hardover(window: Window) -> Explanation | None:
    """The servo runs to one end, uncommanded, and stays there."""
    rest = _resting("hardover", window)
    return rest if _ran_away(window, rest.parameters["position_deg"].value) else None


def floating(window: Window) -> Explanation | None:
    """The surface is loose, and the air moves it: random smooth motion that has nothing to do with the command."""
    found = _smooth("floating", window, np.zeros(window.time_s.size))
    if found is None:
        return None
    swing = Estimate.of(float(np.ptp(found.predicted_deg)) / 2.0, window.noise_deg)
    return replace(found, parameters={"amplitude_deg": swing})


def wandering(window: Window) -> Explanation | None:
    """The surface follows its command, but for a smooth error that no fault of the bank explains.

    Without it, everything that is smooth would be called floating.
    """
    found = _smooth("unknown", window, window.healthy_deg)
    return None if found is None else replace(found, doubt=found.doubt + _UNHEARD_OF)


def _smooth(kind: str, window: Window, base_deg: FloatArray) -> Explanation | None:
    """Explain what is beyond the base by cosines, the faster the smaller; their size is chosen by the evidence."""
    target_deg, found = window.measured_deg - base_deg, []
    for sized in _cosines(window):
        fit = sized.fit(target_deg)
        doubt = (sized.occam + fit.doubt) / COLOUR
        found.append(Explanation(kind, base_deg + fit.predicted_deg, fit.cost_deg2, 0.0, {}, doubt))
    return min(found, key=window.score, default=None)


@lru_cache(maxsize=4)
def _cosines(window: Window) -> tuple[Ridge, ...]:
    """Smooth motions of each size within a window, kept for the next hypothesis; none if the window is too short."""
    count = 1 + int(np.ceil(2.0 * _FASTEST_WIND_HZ * window.duration_s))
    count = min(count, _MOST_COSINES, window.time_s.size // 2)
    if count < 1:
        return ()
    place = (window.time_s - window.time_s[0]) / max(window.duration_s, 1e-9)
    columns = np.cos(np.pi * place[:, None] * np.arange(count))
    frequency_hz = 0.5 * np.arange(count) / max(window.duration_s, 1e-9)
    shape = np.asarray(1.0 / (1.0 + (frequency_hz / _WIND_HZ) ** 2), dtype=np.float64)
    ridge = Ridge(columns, _SWINGS_DEG[0] * shape, window.noise_deg)
    return ridge, *(ridge.respread(swing_deg * shape) for swing_deg in _SWINGS_DEG[1:])


def _resting(kind: str, window: Window) -> Explanation:
    """Explain the window by a surface at rest."""
    position_deg = float(np.mean(window.measured_deg))
    misfit = window.measured_deg - position_deg
    parameters = {"position_deg": Estimate.of(position_deg, window.noise_deg / float(np.sqrt(misfit.size)))}
    return Explanation(
        kind,
        np.full(misfit.size, position_deg),
        float(misfit @ misfit),
        1.0,
        parameters,
        predict=lambda other: np.full(other.time_s.size, position_deg),
    )


def _ran_away(window: Window, position_deg: float) -> bool:
    """Whether no command has led to where the surface rests."""
    stops_deg = (window.servo.lower_deg, window.servo.upper_deg)
    if any(np.isfinite(stop) and stop != 0.0 and position_deg / stop >= _STOP_SHARE for stop in stops_deg):
        return True
    low_deg, high_deg = window.reach_deg
    if not low_deg - _OUT_OF_REACH_DEG <= position_deg <= high_deg + _OUT_OF_REACH_DEG:
        return True
    if window.onset is None:
        return False
    run_deg = position_deg - window.onset.position_deg
    towards_deg = window.onset.low_deg if run_deg < 0.0 else window.onset.high_deg
    asked_deg = (towards_deg - window.onset.position_deg) * float(np.sign(run_deg))
    return abs(run_deg) - max(asked_deg, 0.0) > _UNCOMMANDED_RUN_DEG


_SLOWEST_HZ = 0.4
_FASTEST_SHARE_OF_RATE = 0.4
_FEWEST_CYCLES = 2.0
_SPECTRUM_POINTS = 4096
_NOTICEABLE_SIGMAS = 3.0
_LARGEST_DEG = 1e3
_FREEDOM = 3.0
_SEARCH_STEPS = 12


def oscillation(window: Window) -> Explanation | None:
    """A limit cycle, upon the motion or instead of it."""
    found = (_cycle(window, commanded=commanded) for commanded in (True, False))
    return min((fit for fit in found if fit is not None), key=window.score, default=None)


def _cycle(window: Window, *, commanded: bool) -> Explanation | None:
    """Explain the window by one sine and the rest."""
    start_s, duration_s = float(window.time_s[0]), max(window.duration_s, 1e-9)
    spread = window.spread if commanded else np.array([_LARGEST_DEG])

    def rest(other: Window) -> tuple[FloatArray, FloatArray]:
        size = other.time_s.size
        return (other.healthy_deg, other.nuisances) if commanded else (np.zeros(size), np.ones((size, 1)))

    def model(other: Window, frequency_hz: float) -> tuple[FloatArray, FloatArray]:
        base_deg, regressors = rest(other)
        phase = 2.0 * np.pi * frequency_hz * (other.time_s - start_s)
        return base_deg, np.column_stack([regressors, np.sin(phase), np.cos(phase)])

    base_deg, regressors = rest(window)
    target_deg = window.measured_deg - base_deg
    still = Ridge(regressors, spread, window.noise_deg).fit(target_deg)
    lowest_hz = max(_SLOWEST_HZ, _FEWEST_CYCLES / duration_s)
    start_hz = _strongest_hz(window.time_s, target_deg - still.predicted_deg, lowest_hz)
    if start_hz is None:
        return None

    def ridge(frequency_hz: float) -> Ridge:
        return Ridge(model(window, frequency_hz)[1], np.append(spread, [_LARGEST_DEG] * 2), window.noise_deg)

    def objective(frequency_hz: float) -> float:
        fit = ridge(frequency_hz).fit(target_deg)
        return fit.cost_deg2 + window.noise_deg**2 * fit.doubt

    # The cost has one minimum within half a line width of the spectrum's peak.
    near_hz = (max(start_hz - 0.5 / duration_s, 0.1 * start_hz), start_hz + 0.5 / duration_s)
    frequency_hz = least(objective, *near_hz, steps=_SEARCH_STEPS)

    def sizes(ridge: Ridge, fit: Regression, target_deg: FloatArray) -> dict[str, Estimate]:
        sine, cosine = (ridge.estimate(fit, target_deg, index) for index in (-2, -1))
        amplitude_deg, doubt_deg = float(np.hypot(sine.value, cosine.value)), sine.deviation
        # Cramer and Rao: for a sine of amplitude A known to s, the frequency is known to sqrt(3) s / (pi T A).
        doubt_hz = float(np.sqrt(3.0) / (np.pi * duration_s) * doubt_deg / max(amplitude_deg, 1e-300))
        return {
            "amplitude_deg": Estimate.of(amplitude_deg, doubt_deg),
            "frequency_hz": Estimate.of(frequency_hz, doubt_hz),
        }

    found = _regressed(
        "oscillation", window, lambda other: model(other, frequency_hz), ridge(frequency_hz), _FREEDOM, sizes
    )
    return found if found.parameters["amplitude_deg"].value >= _NOTICEABLE_SIGMAS * window.noise_deg else None


def _strongest_hz(time_s: FloatArray, values_deg: FloatArray, lowest_hz: float) -> float | None:
    """Peak of the spectrum, from evenly spaced values."""
    period_s = float(np.median(np.diff(time_s)))
    highest_hz = _FASTEST_SHARE_OF_RATE / period_s
    if not lowest_hz < highest_hz:
        return None
    even_s = np.arange(time_s[0], time_s[-1], period_s)
    points = max(_SPECTRUM_POINTS, even_s.size)
    frequency_hz = np.fft.rfftfreq(points, period_s)
    power = np.abs(np.fft.rfft(np.interp(even_s, time_s, values_deg), points))
    power *= (frequency_hz >= lowest_hz) & (frequency_hz <= highest_hz)
    return float(frequency_hz[np.argmax(power)])


BANK: dict[str, Callable[[Window], Explanation | None]] = {
    "healthy": healthy,
    "bias": bias,
    "stuck": stuck,
    "hardover": hardover,
    "floating": floating,
    "oscillation": oscillation,
    "deadband": deadband,
    "slow": slow,
    "loss_of_effectiveness": loss_of_effectiveness,
}
"""Each fits a window, or gives None if this cannot be it; adding one is adding a function and an entry here."""
