"""Hypotheses that need a simulation each: dead band or stiction, and a slow servo."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from logparsers.compiled import compiled
from servofd.core.types import FloatArray
from servofd.detection.bank.explanation import COLOUR
from servofd.detection.bank.window import Explanation
from servofd.estimate.statistics import Estimate
from servofd.servo.motion import ExtendedServo
from servofd.servo.play import play

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


@dataclass(frozen=True, slots=True)
class DeadBand:
    """Increased dead band, stiction or play: the surface rests until it is half the width off."""

    kind: ClassVar[str] = "deadband"

    def explain(self, window: Window) -> Explanation | None:
        """Fit the width: before the servo, smooth or jerky, or behind it."""
        reach_deg = float(np.ptp(window.commands.command_deg))
        widest_deg = 2.0 * max(reach_deg, float(np.max(np.abs(window.error_deg))))
        if widest_deg <= _NARROWEST_DEG:
            return None
        grid = np.geomspace(_NARROWEST_DEG, widest_deg, _GRID)
        ways = [_before, _sticking, _behind] + ([_before_since_onset] if window.onset else [])
        searches = [_Search(self.kind, window, way, grid, "width_deg") for way in ways]
        most_deg2 = _HOPELESS * min(search.best.cost_deg2 for search in searches)
        return min((s.refined() for s in searches if s.best.cost_deg2 <= most_deg2), key=window.score)


@dataclass(frozen=True, slots=True)
class Slow:
    """The servo has lost bandwidth, or speed."""

    kind: ClassVar[str] = "slow"

    def explain(self, window: Window) -> Explanation | None:
        """Fit the share of the bandwidth that is left, or a new rate limit."""
        scales = np.geomspace(_SLOWEST, 1.0 - window.tolerance.bandwidth, _GRID)
        slower = _Search(self.kind, window, _slower, scales, "bandwidth_scale").refined()
        fastest_deg_s = float(np.max(np.abs(window.rate_deg_s)))
        explained = slower.cost_deg2 <= _WELL_EXPLAINED * window.time_s.size * window.noise_deg**2
        if not fastest_deg_s > 0.0 or explained:
            return slower
        rates = fastest_deg_s * np.geomspace(_SLOWEST_RATE, 1.0 - window.tolerance.rate, _GRID // 2)
        return min(slower, _Search(self.kind, window, _limited, rates, "rate_limit_deg_s").refined(), key=window.score)


def reduced_command(window: Window) -> Explanation | None:
    """Less than what was asked reaches a servo with effects, whose play and friction do not shrink along with it."""
    if not isinstance(window.servo, ExtendedServo):
        return None
    gains = np.linspace(_LEAST_GAIN, 1.0 - window.tolerance.gain, _GRID)
    return _Search("loss_of_effectiveness", window, _heard, gains, "gain").refined()


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
    """A prediction with the nuisances of a working servo upon it."""
    predicted_deg = predict(window, value)
    fit = window.ridge.fit(window.measured_deg - predicted_deg)
    parameters = {name: Estimate(value, value, value)}
    return Explanation(
        kind,
        predicted_deg + fit.predicted_deg,
        fit.cost_deg2,
        1.0,
        parameters,
        _doubt(name, value) + fit.doubt,
        lambda other: predict(other, value) + other.nuisances @ fit.coefficients,
    )


def _doubt(name: str, value: float) -> float:
    """Dead bands of more than a few degrees are rare."""
    return (value / _WIDE_DEG) ** 2 if name == "width_deg" else 0.0


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


def _heard(window: Window, gain: float) -> FloatArray:
    return window.simulate(window.servo, gain * window.commands.command_deg)


def _slower(window: Window, bandwidth_scale: float) -> FloatArray:
    return window.simulate(window.servo.slower(bandwidth_scale))


def _limited(window: Window, rate_deg_s: float) -> FloatArray:
    return window.simulate(window.servo.limited(rate_deg_s))


@compiled
def _stick(command_deg: FloatArray, half_width_deg: float, held_deg: float) -> None:
    """Hold until the command is half a width away, then go all the way."""
    for k in range(command_deg.size):
        if abs(command_deg[k] - held_deg) > half_width_deg:
            held_deg = command_deg[k]
        command_deg[k] = held_deg
