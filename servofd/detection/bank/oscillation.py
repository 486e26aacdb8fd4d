"""The hypothesis of a limit cycle, upon the commanded motion or instead of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from servofd.core.numeric import least
from servofd.detection.bank.explanation import Regression, Ridge
from servofd.detection.bank.window import Explanation
from servofd.estimate.statistics import Estimate

if TYPE_CHECKING:
    from servofd.core.types import FloatArray
    from servofd.detection.bank.window import Window

_SLOWEST_HZ = 0.4
_FASTEST_SHARE_OF_RATE = 0.4
_FEWEST_CYCLES = 2.0
_SPECTRUM_POINTS = 4096
_NOTICEABLE_SIGMAS = 3.0
_LARGEST_DEG = 1e3
_FREEDOM = 3.0
_SEARCH_STEPS = 12


class _Rest(NamedTuple):
    """What the surface does besides oscillating: a base, and regressors with their spread."""

    base_deg: FloatArray
    regressors: FloatArray
    spread: FloatArray


@dataclass(frozen=True, slots=True)
class Oscillation:
    """A limit cycle."""

    kind: ClassVar[str] = "oscillation"

    def explain(self, window: Window) -> Explanation | None:
        """Find frequency and amplitude, upon the motion and instead of it."""
        found = (_cycle(window, commanded=commanded) for commanded in (True, False))
        return min((fit for fit in found if fit is not None), key=window.score, default=None)


def _rest(window: Window, *, commanded: bool) -> _Rest:
    if commanded:
        return _Rest(window.healthy_deg, window.nuisances, window.spread)
    size = window.time_s.size
    return _Rest(np.zeros(size), np.ones((size, 1)), np.array([_LARGEST_DEG]))


def _cycle(window: Window, *, commanded: bool) -> Explanation | None:
    """Explain the window by one sine and the rest."""
    start_s, duration_s = float(window.time_s[0]), max(window.duration_s, 1e-9)
    rest = _rest(window, commanded=commanded)
    target_deg = window.measured_deg - rest.base_deg
    still = Ridge(rest.regressors, rest.spread, window.noise_deg).fit(target_deg)
    lowest_hz = max(_SLOWEST_HZ, _FEWEST_CYCLES / duration_s)
    start_hz = _strongest_hz(window.time_s, target_deg - still.predicted_deg, lowest_hz)
    if start_hz is None:
        return None

    def ridge(frequency_hz: float) -> Ridge:
        columns = np.column_stack([rest.regressors, _sine(window.time_s - start_s, frequency_hz)])
        return Ridge(columns, np.append(rest.spread, [_LARGEST_DEG, _LARGEST_DEG]), window.noise_deg)

    def objective(fit: Regression) -> float:
        return fit.cost_deg2 + window.noise_deg**2 * fit.doubt

    # The cost has one minimum within half a line width of the spectrum's peak.
    near_hz = (max(start_hz - 0.5 / duration_s, 0.1 * start_hz), start_hz + 0.5 / duration_s)
    frequency_hz = least(lambda f: objective(ridge(f).fit(target_deg)), *near_hz, steps=_SEARCH_STEPS)
    fitted = ridge(frequency_hz)
    fit = fitted.fit(target_deg)
    sine, cosine = (fitted.estimate(fit, target_deg, index) for index in (-2, -1))
    amplitude_deg, doubt_deg = float(np.hypot(sine.value, cosine.value)), sine.deviation
    if amplitude_deg < _NOTICEABLE_SIGMAS * window.noise_deg:
        return None
    # Cramer and Rao: for a sine of amplitude A known to s, the frequency is known to sqrt(3) s / (pi T A).
    doubt_hz = float(np.sqrt(3.0) / (np.pi * duration_s) * doubt_deg / amplitude_deg)

    def predict(other: Window) -> FloatArray:
        around = _rest(other, commanded=commanded)
        columns = np.column_stack([around.regressors, _sine(other.time_s - start_s, frequency_hz)])
        predicted_deg: FloatArray = around.base_deg + columns @ fit.coefficients
        return predicted_deg

    return Explanation(
        "oscillation",
        rest.base_deg + fit.predicted_deg,
        fit.cost_deg2,
        _FREEDOM,
        {
            "amplitude_deg": Estimate.of(amplitude_deg, doubt_deg),
            "frequency_hz": Estimate.of(frequency_hz, doubt_hz),
        },
        fit.doubt,
        predict,
    )


def _sine(time_s: FloatArray, frequency_hz: float) -> FloatArray:
    """Sine and cosine, of shape (n, 2)."""
    phase = 2.0 * np.pi * frequency_hz * time_s
    return np.column_stack([np.sin(phase), np.cos(phase)])


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
