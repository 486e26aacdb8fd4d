"""Hypotheses of a servo that still follows its command: healthy, bias, loss of effectiveness."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from servofd.detection.bank.altered import reduced_command
from servofd.detection.bank.explanation import Ridge
from servofd.detection.bank.window import Explanation

if TYPE_CHECKING:
    from servofd.core.types import FloatArray
    from servofd.detection.bank.window import Window

_GAIN, _BIAS = 0, 3
"""Columns of `Window.nuisances`."""
_LARGEST_BIAS_DEG = 30.0
_FASTEST_GROWTH_DEG_S = 1.0
_LARGEST_TRIM_DEG = 5.0
_STUCK_GAIN = 0.1
"""A servo that moves less is called stuck."""


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
        """Fit an offset larger than a healthy servo may have, that stays or grows; it is given at the window's end."""
        fits = (self._fit(window, growing=growing) for growing in (False, True))
        return min((fit for fit in fits if fit is not None), key=window.score, default=None)

    def _fit(self, window: Window, *, growing: bool) -> Explanation | None:
        wide = window.spread.copy()
        wide[_BIAS] = _LARGEST_BIAS_DEG
        end_s = float(window.time_s[-1])
        spread = np.append(wide, _FASTEST_GROWTH_DEG_S) if growing else wide

        def columns(other: Window) -> FloatArray:
            return np.column_stack([other.nuisances, other.time_s - end_s]) if growing else other.nuisances

        ridge = Ridge(columns(window), spread, window.noise_deg)
        fit = ridge.fit(window.error_deg)
        bias = ridge.estimate(fit, window.error_deg, _BIAS, own=window.spread[_BIAS])
        if abs(bias.value) <= window.tolerance.bias_deg:
            return None
        return Explanation(
            self.kind,
            window.healthy_deg + fit.predicted_deg,
            fit.cost_deg2,
            2.0 if growing else 1.0,
            {"bias_deg": bias},
            fit.doubt,
            predict=lambda other: other.healthy_deg + columns(other) @ fit.coefficients,
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
            gain = ridge.estimate(fit, window.error_deg, _GAIN, offset=1.0, own=window.spread[_GAIN])
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
        heard = reduced_command(window)
        if heard is not None and heard.parameters["gain"].value < 1.0 - window.tolerance.gain:
            fits.append(heard)
        return min(fits, key=window.score, default=None)


def _with(coefficients: FloatArray, window: Window) -> FloatArray:
    """Healthy deflection with these nuisances."""
    return window.healthy_deg + window.nuisances @ coefficients


def _widened(window: Window, spread: dict[int, float]) -> Ridge:
    """Nuisances of a working servo, some of them beyond what is healthy."""
    wide = window.spread.copy()
    wide[list(spread)] = list(spread.values())
    return Ridge(window.nuisances, wide, window.noise_deg)
