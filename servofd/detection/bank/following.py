"""Hypotheses of a servo that still follows its command: healthy, bias, loss of effectiveness, oscillation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from servofd.detection.bank.explanation import Estimate, Explanation, Regression, Ridge

if TYPE_CHECKING:
    from servofd.detection.bank.window import Window
    from servofd.types import FloatArray

__all__ = ["Bias", "Healthy", "LossOfEffectiveness", "Oscillation"]

_GAIN, _BIAS = 0, 3
"""Columns of `Window.nuisances`."""
_LARGEST_BIAS_DEG = 30.0
_LARGEST_TRIM_DEG = 5.0
_STUCK_GAIN = 0.1
"""A servo that moves less is called stuck."""
_SLOWEST_HZ = 0.4
_FASTEST_SHARE_OF_RATE = 0.4
_FEWEST_CYCLES = 2.0
_SPECTRUM_POINTS = 4096
_NOTICEABLE_SIGMAS = 3.0


@dataclass(frozen=True, slots=True)
class Healthy:
    """The model, within the tolerances of a working servo."""

    kind: ClassVar[str] = "healthy"

    def explain(self, window: Window) -> Explanation:
        """Fit the nuisances."""
        fit = window.ridge.fit(window.error_deg)
        return Explanation(self.kind, window.healthy_deg + fit.predicted_deg, fit.cost_deg2, 0.0, doubt=fit.doubt)


@dataclass(frozen=True, slots=True)
class Bias:
    """The surface is off by a constant angle: a slipped arm, a bent rod, a shifted potentiometer."""

    kind: ClassVar[str] = "bias"

    def explain(self, window: Window) -> Explanation | None:
        """Fit an offset larger than a healthy servo may have."""
        ridge = _widened(window, {_BIAS: _LARGEST_BIAS_DEG})
        fit = ridge.fit(window.error_deg)
        bias = ridge.estimate(fit, window.error_deg, _BIAS, habit=window.spread[_BIAS])
        if abs(bias.value) <= window.tolerance.bias_deg:
            return None
        predicted_deg = window.healthy_deg + fit.predicted_deg
        return Explanation(
            self.kind,
            predicted_deg,
            fit.cost_deg2,
            1.0,
            {"bias_deg": bias},
            fit.doubt,
            predict=partial(_with, fit.coefficients),
        )


@dataclass(frozen=True, slots=True)
class LossOfEffectiveness:
    """The surface moves by a share of what was asked: a slipping horn, a loose linkage, a weak servo."""

    kind: ClassVar[str] = "loss_of_effectiveness"

    def explain(self, window: Window) -> Explanation | None:
        """Fit a gain below that of a healthy servo, about zero or about another trim."""
        fits = []
        for spread, freedom in (({_GAIN: 1.0}, 1.0), ({_GAIN: 1.0, _BIAS: _LARGEST_TRIM_DEG}, 2.0)):
            ridge = _widened(window, spread)
            fit = ridge.fit(window.error_deg)
            gain = ridge.estimate(fit, window.error_deg, _GAIN, offset=1.0, habit=window.spread[_GAIN])
            if _STUCK_GAIN < gain.value < 1.0 - window.tolerance.gain:
                predicted_deg = window.healthy_deg + fit.predicted_deg
                fits.append(
                    Explanation(
                        self.kind,
                        predicted_deg,
                        fit.cost_deg2,
                        freedom,
                        {"gain": gain},
                        fit.doubt,
                        partial(_with, fit.coefficients),
                    )
                )
        return min(fits, key=window.score, default=None)


@dataclass(frozen=True, slots=True)
class Oscillation:
    """A limit cycle, upon the commanded motion or instead of it."""

    kind: ClassVar[str] = "oscillation"

    def explain(self, window: Window) -> Explanation | None:
        """Find the frequency, upon the motion first, then instead of it."""
        upon = _cycle(window, window.error_deg, window.ridge)
        if upon is not None:
            upon = replace(upon, predicted_deg=window.healthy_deg + upon.predicted_deg)
        still = Ridge(np.ones((window.time_s.size, 1)), np.array([np.inf]), window.noise_deg)
        instead = _cycle(window, window.measured_deg, still)
        return min((fit for fit in (upon, instead) if fit is not None), key=window.score, default=None)


def _with(coefficients: FloatArray, window: Window) -> FloatArray:
    """Healthy deflection with these nuisances."""
    return window.healthy_deg + window.nuisances @ coefficients


def _widened(window: Window, spread: dict[int, float]) -> Ridge:
    """Nuisances of a working servo, some of them beyond what is healthy."""
    wide = window.spread.copy()
    wide[list(spread)] = list(spread.values())
    return Ridge(window.nuisances, wide, window.noise_deg)


def _cycle(window: Window, target_deg: FloatArray, others: Ridge) -> Explanation | None:
    """Explain the target by one sine and other regressors."""
    from scipy.optimize import minimize_scalar

    time_s, duration_s = window.time_s - window.time_s[0], max(window.duration_s, 1e-9)
    rest_deg = target_deg - others.fit(target_deg).predicted_deg
    start_hz = _strongest_hz(time_s, rest_deg, max(_SLOWEST_HZ, _FEWEST_CYCLES / duration_s))
    if start_hz is None:
        return None
    spread = np.append(others.noise_deg / np.sqrt(np.maximum(others.weight, 1e-300)), [1e3, 1e3])

    def ridge(frequency_hz: float) -> Ridge:
        phase = 2.0 * np.pi * frequency_hz * time_s
        return Ridge(np.column_stack([others.regressors, np.sin(phase), np.cos(phase)]), spread, window.noise_deg)

    # The cost has one minimum within half a line width of the spectrum's peak.
    near_hz = (max(start_hz - 0.5 / duration_s, 0.1 * start_hz), start_hz + 0.5 / duration_s)
    best = minimize_scalar(
        lambda f: _objective(ridge(f).fit(target_deg), window),
        bounds=near_hz,
        method="bounded",
        options={"maxiter": 12},
    )
    fitted = ridge(float(best.x))
    fit = fitted.fit(target_deg)
    sine, cosine = (fitted.estimate(fit, target_deg, index) for index in (-2, -1))
    size_deg, doubt_deg = float(np.hypot(sine.value, cosine.value)), (sine.high - sine.low) / (2.0 * 1.96)
    if size_deg < _NOTICEABLE_SIGMAS * window.noise_deg:
        return None
    # Cramer and Rao: for a sine of amplitude A known to s, the frequency is known to sqrt(3) s / (pi T A).
    doubt_hz = np.sqrt(3.0) / (np.pi * duration_s) * doubt_deg / size_deg
    parameters = {
        "amplitude_deg": Estimate.of(size_deg, doubt_deg),
        "frequency_hz": Estimate.of(float(best.x), float(doubt_hz)),
    }
    return Explanation("oscillation", fit.predicted_deg, fit.cost_deg2, 3.0, parameters, fit.doubt)


def _objective(fit: Regression, window: Window) -> float:
    return fit.cost_deg2 + window.noise_deg**2 * fit.doubt


def _strongest_hz(time_s: FloatArray, values_deg: FloatArray, lowest_hz: float) -> float | None:
    """Peak of the spectrum, from evenly spaced values."""
    period_s = float(np.median(np.diff(time_s)))
    highest_hz = _FASTEST_SHARE_OF_RATE / period_s
    if not lowest_hz < highest_hz:
        return None
    even_deg = np.interp(np.arange(0.0, time_s[-1], period_s), time_s, values_deg)
    points = max(_SPECTRUM_POINTS, even_deg.size)
    frequency_hz = np.fft.rfftfreq(points, period_s)
    power = np.abs(np.fft.rfft(even_deg, points)) * ((frequency_hz >= lowest_hz) & (frequency_hz <= highest_hz))
    return float(frequency_hz[np.argmax(power)])
