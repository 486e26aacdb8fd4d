"""Fit of effects to one record: a coarse grid, a search along each coordinate, then all parameters together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from servofd.discrepancy.frames import best_frame
from servofd.discrepancy.record import simulate
from servofd.models.catalogue import PwmFrame, installed
from servofd.types import FloatArray

if TYPE_CHECKING:
    from collections.abc import Callable

    from servofd.discrepancy.record import Record
    from servofd.models.catalogue import MissingEffect, Parameter
    from servofd.models.physics import Physics

__all__ = ["Fit", "Fitter"]

_STEP = 2e-3
_TIE_TO_START = 1e-4
_EVALUATIONS = 12
_SEARCHES = 9
_PROMISING = 10
_KINKED_ROUNDS = 2
_SURE = 1.959963984540054
"""Standard deviations of a 95 % interval."""


Values = Sequence[float] | FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A servo with some effects, as well as they fit."""

    effects: tuple[type[MissingEffect], ...]
    values: FloatArray
    """Parameters of the effects in order, shape (p,)."""
    error_deg: FloatArray
    """Measured minus simulated position, shape (n,)."""
    train: float
    """Sum of squares over the fitted samples [deg^2]."""
    held_out: float
    """The same over the samples that only judge."""

    @property
    def total(self) -> float:
        """Over all samples that count."""
        return self.train + self.held_out

    @property
    def names(self) -> tuple[str, ...]:
        """Of the effects."""
        return tuple(effect.name for effect in self.effects)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Of all effects in order."""
        return tuple(p for effect in self.effects for p in effect.parameters)


@dataclass(slots=True, eq=False)
class Fitter:
    """Fits effects to a record; counts its simulations."""

    record: Record
    simulations: int = field(default=0, init=False)

    def physics(self, effects: Sequence[type[MissingEffect]], values: Values) -> Physics:
        """The servo with these effects."""
        return installed(self.record.plant.neutral, effects, [float(v) for v in values])

    def error_deg(self, effects: Sequence[type[MissingEffect]], values: Values) -> FloatArray:
        """Measured minus simulated position [deg], shape (n,)."""
        self.simulations += 1
        return self.record.measured_deg - simulate(self.record, self.physics(effects, values))

    def judged(self, effects: tuple[type[MissingEffect], ...], values: Values) -> Fit:
        """Fit with given values."""
        error = self.error_deg(effects, values)
        train, held_out = error[self.record.trained], error[self.record.held_out]
        return Fit(effects, np.array(values, dtype=float), error, float(train @ train), float(held_out @ held_out))

    def nominal(self) -> Fit:
        """The servo as it is known."""
        return self.judged((), ())

    def loss(self, effects: Sequence[type[MissingEffect]], values: Values) -> float:
        """Sum of squares over the fitted samples [deg^2]."""
        error = self.error_deg(effects, values)[self.record.trained]
        return float(error @ error)

    def with_effects(self, base: Fit, able: Sequence[type[MissingEffect]], tried: Callable[[str], None]) -> list[Fit]:
        """The best fits that have one effect more; of the most promising, all parameters are refitted."""
        fits = []
        for effect in able:
            if effect.name in base.names:
                continue
            tried(effect.key())
            effects = (*base.effects, effect)
            start = self._start(base, effect)
            fits.append(self.judged(effects, self._searched(effects, [*base.values, *start], len(base.values))))
        fits.sort(key=lambda fit: fit.train)
        return [
            self.refitted(fit.effects, fit.values.tolist()) if k < _PROMISING else fit for k, fit in enumerate(fits)
        ]

    def refitted(self, effects: tuple[type[MissingEffect], ...], values: Values) -> Fit:
        """All parameters fitted together, from given values: least squares within the bounds."""
        from scipy.optimize import least_squares

        start = np.array(values, dtype=float)
        parameters = [p for effect in effects for p in effect.parameters]
        free = [k for k, p in enumerate(parameters) if not p.kinked]
        if not free:
            return self.judged(effects, start)
        scale = np.array([parameters[k].typical for k in free])
        low = np.array([parameters[k].low for k in free]) / scale
        high = np.array([parameters[k].high for k in free]) / scale

        def at(x: FloatArray) -> FloatArray:
            whole = start.copy()
            whole[free] = x * scale
            return whole

        x0 = np.asarray(np.clip(start[free] / scale, low + 1e-6 * (high - low), high - 1e-6 * (high - low)))

        def errors(x: FloatArray) -> FloatArray:
            # What the data do not show stays where it is.
            return np.concatenate([self.error_deg(effects, at(x))[self.record.trained], _TIE_TO_START * (x - x0)])

        def slopes(x: FloatArray) -> FloatArray:
            here = errors(x)
            steps = np.where(x + _STEP > high, -_STEP, _STEP)
            return np.column_stack(
                [(errors(x + step * unit) - here) / step for step, unit in zip(steps, np.eye(x.size), strict=True)]
            )

        found = least_squares(
            errors, x0, jac=slopes, bounds=(low, high), max_nfev=_EVALUATIONS, xtol=1e-4, ftol=1e-5, gtol=None
        )
        best = self.judged(effects, at(found.x))
        given = self.judged(effects, start)
        return best if best.train <= given.train else given

    def _start(self, base: Fit, effect: type[MissingEffect]) -> list[float]:
        """The best point of the effect's grid."""
        if effect is PwmFrame:
            return list(best_frame(self.record, self.physics(base.effects, base.values)))
        grid = product(*(p.grid for p in effect.parameters))
        return list(min(grid, key=lambda point: self.loss((*base.effects, effect), [*base.values, *point])))

    def _searched(self, effects: tuple[type[MissingEffect], ...], values: list[float], first: int) -> list[float]:
        """Search along each new coordinate, between the neighbours on its grid."""
        from scipy.optimize import minimize_scalar

        parameters = [p for effect in effects for p in effect.parameters]
        kinked = any(p.kinked for p in parameters[first:])
        for _ in range(_KINKED_ROUNDS if kinked else 1):
            for k in range(first, len(values)):
                low, high = _neighbours(parameters[k], values[k])

                def loss(value: float, k: int = k) -> float:
                    return self.loss(effects, [*values[:k], value, *values[k + 1 :]])

                found = minimize_scalar(loss, bounds=(low, high), method="bounded", options={"maxiter": _SEARCHES})
                if found.fun < self.loss(effects, values):
                    values[k] = float(found.x)
        return values

    def covariance(self, fit: Fit, sigma_deg: float, factor: float) -> FloatArray:
        """Of the values of a fit, shape (p, p), from the curvature on both sides; infinite where nothing shows."""
        columns = []
        for k, parameter in enumerate(fit.parameters):
            step = 1e-2 * parameter.typical
            up, down = fit.values.copy(), fit.values.copy()
            up[k], down[k] = min(up[k] + step, parameter.high), max(down[k] - step, parameter.low)
            change = self.error_deg(fit.effects, up) - self.error_deg(fit.effects, down)
            columns.append(change[self.record.trained] / (up[k] - down[k]) * parameter.typical)
        if not columns:
            return np.zeros((0, 0))
        jacobian = np.column_stack(columns)
        seen = np.linalg.norm(jacobian, axis=0) > 1e-9
        result = np.diag(np.where(seen, 0.0, np.inf))
        inside = np.ix_(seen, seen)
        result[inside] = np.linalg.pinv(jacobian[:, seen].T @ jacobian[:, seen], rcond=1e-12) * sigma_deg**2 * factor
        scale = np.array([p.typical for p in fit.parameters])
        covariance: FloatArray = result * np.where(np.isinf(result), 1.0, np.outer(scale, scale))
        return covariance


def _neighbours(parameter: Parameter, value: float) -> tuple[float, float]:
    """Bracket around a grid point."""
    grid = sorted({*parameter.grid, parameter.neutral})
    if parameter.width > 0.0:
        return max(parameter.low, value - parameter.width), min(parameter.high, value + parameter.width)
    if value not in grid:
        width = 0.25 * abs(value - parameter.neutral) + 1e-9
        return max(parameter.low, value - width), min(parameter.high, value + width)
    k = grid.index(value)
    reach = 1.0 if k in (0, len(grid) - 1) else 0.0
    low = grid[k - 1] if k > 0 else value - reach * abs(grid[1] - grid[0])
    high = grid[k + 1] if k + 1 < len(grid) else value + reach * abs(grid[-1] - grid[-2])
    return max(low, parameter.low), min(high, parameter.high)
