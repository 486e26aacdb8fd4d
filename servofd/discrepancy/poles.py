"""Fit of effects to a servo whose poles nobody knows: they are fitted along with every effect, from several starts."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servofd.discrepancy.fit import Fit, Fitter

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from servofd.discrepancy.fit import Values
    from servofd.discrepancy.record import Record
    from servofd.models.catalogue import MissingEffect, Parameter
    from servofd.models.physics import Physics
    from servofd.types import FloatArray

__all__ = ["PoleFitter", "Poles"]


class Poles(NamedTuple):
    """Scales of the natural frequency and of the damping ratio of the servo that the search starts with."""

    bandwidth_scale: float = 1.0
    damping_scale: float = 1.0


_STARTS = (Poles(0.8, 1.0), Poles(2.0, 1.0), Poles(4.0, 1.5))
"""Of a servo of 5 Hz: one that is weak, one as small servos are, and one so fast that other effects hide its poles."""
_LOWEST, _HIGHEST = Poles(0.05, 0.05), Poles(40.0, 20.0)
_STEP = 2e-3
_TIE_TO_START = 1e-4
_EVALUATIONS, _FIRST_EVALUATIONS = 20, 12
_USUAL_GAP_DEG = 1.0
"""Error of a linear servo for which the sizes of effects in the catalogue are meant."""
_KEPT, _SETTLED = 2, 1
"""Starts that are descended from; effects after which the poles are known well enough to be the only start."""
_REFITTED = 4


class _Known(NamedTuple):
    """The best fit of a set of effects, in whatever order."""

    loss: float
    poles: Poles
    values: dict[str, FloatArray]

    def joined(self, effects: Sequence[type[MissingEffect]]) -> FloatArray:
        """Values in the order of the effects, shape (p,)."""
        return np.concatenate([self.values[effect.key()] for effect in effects] or [np.zeros(0)])


def _key(effects: Sequence[type[MissingEffect]]) -> tuple[str, ...]:
    return tuple(sorted(effect.key() for effect in effects))


@dataclass(slots=True, eq=False)
class PoleFitter(Fitter):
    """Fits effects and poles together, and remembers the poles that went with each set of effects."""

    known: dict[tuple[str, ...], _Known] = field(default_factory=dict, init=False)
    settled: dict[tuple[str, ...], list[_Known]] = field(default_factory=dict, init=False)
    """All that were ever the best of a set: a fit made then goes on with its own poles."""
    _is_nominal: bool = field(default=False, init=False)

    def on(self, record: Record) -> PoleFitter:
        """The same for other samples, from what is known."""
        other = PoleFitter(record)
        other.known = {key: each._replace(loss=np.inf) for key, each in self.known.items()}
        return other

    def adopt(self, other: Fitter) -> None:
        """Take over the poles that another one found."""
        if isinstance(other, PoleFitter):
            self.known.update(other.known)
            for key, known in other.settled.items():
                self.settled.setdefault(key, []).extend(known)

    def poles(self, effects: Sequence[type[MissingEffect]]) -> Poles:
        """Those fitted with these effects, or with as many of them as were ever fitted."""
        for size in range(len(effects), -1, -1):
            known = self.known.get(_key(effects[:size]))
            if known is not None:
                return known.poles
        return Poles()

    def physics(self, effects: Sequence[type[MissingEffect]], values: Values) -> Physics:
        """The servo with these effects, and the last poles that were fitted with most of these values."""
        settled = self.settled.get(_key(effects))
        if not settled:
            return self._with_poles(effects, values, self.poles(effects))
        common = [int(np.count_nonzero(known.joined(effects) == np.asarray(values))) for known in settled]
        return self._with_poles(effects, values, settled[max(range(len(settled)), key=lambda k: (common[k], k))].poles)

    def nominal(self) -> Fit:
        """The best servo of second order."""
        if not self._is_nominal:
            self._multi_start((), [(poles, []) for poles in (self.poles(()), *_STARTS)], _EVALUATIONS)
            self._is_nominal = True
        return self.judged((), ())

    def refitted(
        self, effects: tuple[type[MissingEffect], ...], values: Values, evaluations: int = _EVALUATIONS
    ) -> Fit:
        """All parameters and the poles fitted together: least squares within the bounds."""
        return self._multi_start(effects, [(self.poles(effects), list(values))], evaluations)

    def with_effects(self, base: Fit, able: Sequence[type[MissingEffect]], tried: Callable[[str], None]) -> list[Fit]:
        """The best fits that have one effect more, each from several starts of the poles."""
        fits = []
        for effect in able:
            if effect.name in base.names:
                continue
            tried(effect.key())
            fits.append(self._with_one(base, effect))
        fits.sort(key=lambda fit: fit.train)
        return [self.refitted(fit.effects, fit.values) if k < _REFITTED else fit for k, fit in enumerate(fits)]

    def _with_one(self, base: Fit, effect: type[MissingEffect]) -> Fit:
        effects = (*base.effects, effect)
        # Where in the motor a load acts is the same question for a servo without a state for its torque.
        grids = [self._sized(p, p.grid[:1] if p.aside else p.grid) for p in effect.parameters]
        grid = [list(point) for point in product(*grids)]
        starts = []
        kinked = any(p.kinked for p in effect.parameters)
        for poles in (self.poles(base.effects), *(() if kinked or len(base.effects) >= _SETTLED else _STARTS)):
            losses = [self._loss(effects, [*base.values, *point], poles) for point in grid]
            starts.append((min(losses), poles, [*base.values, *grid[int(np.argmin(losses))]]))
        starts.sort(key=lambda start: start[0])
        return self._multi_start(effects, [(poles, values) for _, poles, values in starts[:_KEPT]], _FIRST_EVALUATIONS)

    def _scale(self, parameter: Parameter) -> float:
        """Of an error that an effect leaves, if it is given in degrees: no more than there is, on a fine drive little.

        Sizes in the catalogue are those of servos that leave a degree or so; of one that leaves a micrometre nobody
        knows what is common.
        """
        if parameter.neutral != 0.0 or not parameter.name.endswith("_deg"):
            return 1.0
        nominal = self.nominal()
        rms_deg = float(np.sqrt(nominal.total / max(int(self.record.counts.sum()), 1)))
        return min(1.0, rms_deg / _USUAL_GAP_DEG)

    def _sized(self, parameter: Parameter, grid: tuple[float, ...]) -> list[float]:
        return [self._scale(parameter) * value for value in grid]

    def _with_poles(self, effects: Sequence[type[MissingEffect]], values: Values, poles: Poles) -> Physics:
        return Fitter.physics(self, effects, values)._replace(**poles._asdict())

    def _error_deg(self, effects: Sequence[type[MissingEffect]], values: Values, poles: Poles) -> FloatArray:
        from servofd.discrepancy.record import simulate

        self.simulations += 1
        return self.record.measured_deg - simulate(self.record, self._with_poles(effects, values, poles))

    def _loss(self, effects: Sequence[type[MissingEffect]], values: Values, poles: Poles) -> float:
        error = self._error_deg(effects, values, poles)[self.record.trained]
        return float(error @ error)

    def _multi_start(
        self, effects: tuple[type[MissingEffect], ...], starts: Sequence[tuple[Poles, Values]], evaluations: int
    ) -> Fit:
        """The best of the fits from several starts, and of those that are known; its poles are remembered."""
        key = _key(effects)
        for poles, start in starts:
            values, fitted, loss = self._fitted(effects, start, poles, evaluations)
            if key not in self.known or loss < self.known[key].loss:
                rest = iter(values)
                named = {effect.key(): np.array([next(rest) for _ in effect.parameters]) for effect in effects}
                self.known[key] = _Known(loss, fitted, named)
                self.settled.setdefault(key, []).append(self.known[key])
        return self.judged(effects, self.known[key].joined(effects))

    def _fitted(
        self, effects: tuple[type[MissingEffect], ...], values: Values, poles: Poles, evaluations: int
    ) -> tuple[list[float], Poles, float]:
        """Values and poles, and the sum of squares over the fitted samples that they leave [deg^2]."""
        from scipy.optimize import least_squares

        parameters = [p for effect in effects for p in effect.parameters]
        scale = np.array([self._scale(p) * p.typical for p in parameters])
        start = np.concatenate([np.asarray(values, dtype=float) / scale, np.log(poles)])
        low = np.concatenate([np.array([p.low for p in parameters]) / scale, np.log(_LOWEST)])
        high = np.concatenate([np.array([p.high for p in parameters]) / scale, np.log(_HIGHEST)])
        start = np.clip(start, low + 1e-6 * (high - low), high - 1e-6 * (high - low))
        count = scale.size

        def split(x: FloatArray) -> tuple[FloatArray, Poles]:
            return x[:count] * scale, Poles(*np.exp(x[count:]).tolist())

        def errors(x: FloatArray) -> FloatArray:
            error = self._error_deg(effects, *split(x))[self.record.trained]
            return np.concatenate([error, _TIE_TO_START * (x - start)])

        at_once: list[tuple[FloatArray, FloatArray]] = []

        def remembered(x: FloatArray) -> FloatArray:
            at_once[:] = [(x.copy(), errors(x))]
            return at_once[0][1]

        def slopes(x: FloatArray) -> FloatArray:
            same = np.array_equal(at_once[0][0], x)
            here = at_once[0][1] if same else errors(x)
            # A kink seen from afar is smooth: one per cent of a size that is not small.
            sizes = _STEP * np.maximum(np.abs(x), 1.0)
            steps = np.where(x + sizes > high, -sizes, sizes)
            units = np.eye(x.size)
            return np.column_stack(
                [(errors(x + step * unit) - here) / step for step, unit in zip(steps, units, strict=True)]
            )

        found = least_squares(
            remembered, start, jac=slopes, bounds=(low, high), max_nfev=evaluations, xtol=1e-4, ftol=1e-5, gtol=None
        )
        best, known = split(found.x)
        error = found.fun[: -start.size]
        return best.tolist(), known, float(error @ error)
