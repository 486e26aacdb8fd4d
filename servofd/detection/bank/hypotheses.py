"""The ways in which a servo may behave: well, altered, following less than asked, or not at all."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np

from logparsers.compiled import compiled
from servofd.core.numeric import least
from servofd.core.types import FloatArray
from servofd.detection.bank.window import COLOUR, Explanation, Regression, Ridge
from servofd.estimate.statistics import Estimate
from servofd.servo.kernel import play
from servofd.servo.motion import ExtendedServo

if TYPE_CHECKING:
    from collections.abc import Callable

    from servofd.detection.bank.window import Window

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
        self._window, self._name, self._grid = window, name, grid
        self._fit = partial(_fit, kind, window, predict, name)
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

    def _of(self, value: float) -> float:
        if value not in self._tried:
            self._tried[value] = self._fit(value)
        return self._cost(self._tried[value])

    def _cost(self, fit: Explanation) -> float:
        return fit.cost_deg2 + self._window.noise_deg**2 * fit.doubt


def _fit(
    kind: str, window: Window, predict: Callable[[Window, float], FloatArray], name: str, value: float
) -> Explanation:
    """A prediction with the nuisances of a working servo upon it; dead bands of more than a few degrees are rare."""
    found = _regressed(
        kind, window, lambda other: (predict(other, value), other.nuisances), window.ridge, 1.0,
        lambda *_: {name: Estimate(value, value, value)},
    )  # fmt: skip
    return replace(found, doubt=((value / _WIDE_DEG) ** 2 if name == "width_deg" else 0.0) + found.doubt)


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
    if isinstance(window.servo, ExtendedServo):
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
