"""Fit of effects to one record: all parameters together, by least squares, from where a search on a part began."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from servofd.discrepancy.descent import descended
from servofd.discrepancy.frames import best_frame, frames_as_late, frames_like, usual_frame
from servofd.discrepancy.noise import floor_uncertainty, long_run_factor, noise_floor_deg
from servofd.discrepancy.record import simulate
from servofd.discrepancy.search import begin, polish, telling_part
from servofd.discrepancy.stamps import scatter_s
from servofd.discrepancy.steps import COARSE_STEP_DEG
from servofd.models.catalogue import CommandSteps, Delay, PwmFrame, Quantization, SensorLag, SlowDynamics, installed
from servofd.types import FloatArray, IntArray

if TYPE_CHECKING:
    from collections.abc import Callable

    from servofd.discrepancy.record import Record
    from servofd.models.catalogue import MissingEffect, Parameter
    from servofd.models.physics import Physics

__all__ = ["Fit", "Fitter"]

_STICKS = "hysteresis"
_STEP, _STRIDE = 3e-2, 0.3
"""Of what is common: what sticks or has edges answers to less with jumps, in which the descent loses its way. Among the
many small minima of what sticks, long strides find the largest, from where the step leads on."""
_EVALUATIONS, _THOROUGH = 20, 40
_SHARES = (1.0, 0.4)
"""Of a first step: a whole one may be too long."""
_FINER, _SIMULATORS_DIFFER = 10.0, 2.5e-3
"""The second is how far two simulators of one servo, both in steps of 0.1 ms and less, are apart in a value: 0.8 % for
friction in chirps to 25 Hz, 0.2 % for a sensor's lag, less for all others."""
_PROMISING, _FEWER = 10, 6
"""Of the candidates of a first effect, and of a further one."""
_LATE_SHARE, _LATE_CHI_SQUARED, _LATE_LEAVES, _FRAMES_EXCESS = 0.1, 30.0, 2.0, 0.02
_NOT_MUCH_MORE, _SMALL_MINIMA, _CLEARLY = 2.0, 100.0, 1.15
"""Times what the best fit leaves beside noise, and squared noises, beyond which no other goes on or passes for it; and
how far beyond it must be, for a descent may rest on the way."""
_MUCH_LESS = 0.5
"""Of what other effects left when frames were sought last: then they may be seen better."""


Values = Sequence[float] | FloatArray
Frame = tuple[float, float]
"""Period [s] and phase of pulse frames."""


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
    unstepped_deg: FloatArray
    """The error of the position before the steps of its converter, shape (n,); where there are none, `error_deg`."""

    @property
    def total(self) -> float:
        """Over all samples that count."""
        return self.train + self.held_out

    @property
    def names(self) -> tuple[str, ...]:
        """Of the effects."""
        return tuple(effect.name for effect in self.effects)

    @property
    def ran_away(self) -> tuple[int, ...]:
        """Which of the effects have a parameter at its bound: no answers, but failures."""
        values = iter(self.values.tolist())
        at_bound = [[p.at_bound(next(values)) for p in effect.parameters] for effect in self.effects]
        return tuple(k for k, each in enumerate(at_bound) if any(each))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Of all effects in order."""
        return tuple(p for effect in self.effects for p in effect.parameters)


@dataclass(slots=True, eq=False)
class Fitter:
    """Fits effects to a record; counts its simulations."""

    record: Record
    simulations: int = field(default=0, init=False)
    fewer: dict[tuple[Fit, int], Fit] = field(default_factory=dict, init=False)
    """Fits without one of their effects, by its number; they are asked for again and again."""
    _frames: dict[float, Frame | None] = field(default_factory=dict, init=False)
    """Pulse frames that were sought, by the sum of squares over the noise that the other effects left."""
    _first: dict[int, Fit] = field(default_factory=dict, init=False)
    """Best fit of each number of effects."""
    _on_all: dict[Fit, float] = field(default_factory=dict, init=False)
    """Sums of squares of fits to all samples."""
    _trained: IntArray = field(init=False)
    _held_out: IntArray = field(init=False)

    def __post_init__(self) -> None:
        self._trained, self._held_out = np.flatnonzero(self.record.trained), np.flatnonzero(self.record.held_out)

    def on(self, record: Record) -> Fitter:
        """The same for other samples."""
        return Fitter(record)

    def adopt(self, other: Fitter) -> None:
        """Take over what another one learnt beside the values of effects: nothing here."""

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
        train, held_out = error[self._trained], error[self._held_out]
        unstepped = error
        if Quantization in effects:
            k = effects.index(Quantization)
            first = sum(len(effect.parameters) for effect in effects[:k])
            unstepped = self.error_deg(effects[:k] + effects[k + 1 :], np.delete(values, first))
        squares = float(train @ train), float(held_out @ held_out)
        return Fit(effects, _in_force(effects, values), error, *squares, unstepped)

    def nominal(self) -> Fit:
        """The servo as it is known."""
        return self.judged((), ())

    def with_effects(self, base: Fit, able: Sequence[type[MissingEffect]], tried: Callable[[str], None]) -> list[Fit]:
        """The best fits that have one effect more; of the most promising, all parameters are refitted.

        Pulse frames, a search of thousands of simulations, are looked for only if a delay helps (it is what they do on
        average); if nothing else leaves more than noise, only those of usual periods that are as late as that.
        """
        part = telling_part(self.record, base.error_deg)
        others = [effect for effect in able if self._possible(effect, base)]
        fits = self._refitted_best([self._begun(part, base, effect, tried) for effect in others])
        if PwmFrame in able and PwmFrame not in base.effects and self._is_late(base, fits):
            tried(PwmFrame.key())
            fits += self._framed(base, fits)
        return fits

    def _possible(self, effect: type[MissingEffect], base: Fit) -> bool:
        """Whether an effect is tried with the others: its name is new, and it is not found in a way of its own."""
        own_way = {PwmFrame, Quantization}
        if (self.record.step_deg or 0.0) >= COARSE_STEP_DEG:
            own_way.add(CommandSteps)  # at rest, steps of the position look like those of the command
        return effect.name not in base.names and effect not in own_way

    def _begun(self, part: Record, base: Fit, effect: type[MissingEffect], tried: Callable[[str], None]) -> Fit:
        tried(effect.key())
        effects = (*base.effects, effect)
        values, count = begin(part, effects, base.values.tolist(), self.record)
        self.simulations += count
        return self._eased(part, self.judged(effects, values)) if base.effects else self.judged(effects, values)

    def _eased(self, part: Record, fit: Fit) -> Fit:
        """After a first step of all parameters together: what was known before had stood in for what is new."""
        partly = self.on(part)
        there = partly.judged(fit.effects, fit.values)
        slopes = partly.slopes(there)
        self.simulations += partly.simulations
        step = np.linalg.lstsq(slopes, -there.error_deg[partly.record.trained], rcond=1e-6)[0]
        scale, low, high = np.array([(p.typical, p.low, p.high) for p in fit.parameters]).T
        eased = [fit.values + share * step * scale for share in _SHARES]
        return min(
            (fit, *(self.judged(fit.effects, np.clip(each, low, high)) for each in eased)), key=lambda f: f.train
        )

    def _refitted_best(self, fits: list[Fit]) -> list[Fit]:
        fits = sorted(fits, key=lambda fit: fit.train)
        count = _FEWER if len(fits[0].effects) > 1 else _PROMISING
        settled: list[Fit] = []
        for fit in fits[:count]:
            settled.append(self._settled(fit, self._enough(len(fit.effects))))
            self._leads(settled[-1])
        return settled + fits[count:]

    def _leads(self, fit: Fit) -> None:
        """Remember the best fit of its length."""
        length = len(fit.effects)
        if length not in self._first or fit.train < self._first[length].train:
            self._first[length] = fit

    def _enough(self, length: int) -> float:
        """Sum of squares at which a fit neither goes on beside the best of its length, nor passes for it [deg^2]."""
        if length not in self._first:
            return np.inf
        first = self._first[length]
        noise = self._noise([first])
        chance = (
            _SMALL_MINIMA * noise / max(self._trained.size, 1) * long_run_factor(first.error_deg[self.record.counts])
        )
        return _CLEARLY * (noise + _NOT_MUCH_MORE * max(first.train - noise, 0.0) + chance)

    def _settled(self, fit: Fit, enough: float) -> Fit:
        """All parameters refitted; what cannot be descended is searched on the whole record."""
        values, newest = fit.values.tolist(), fit.effects[-1].parameters
        if all(p.kinked for p in newest):
            values, count = polish(self.record, fit.effects, values, len(values) - len(newest))
            self.simulations += count
        return self._descended(fit.effects, values, _EVALUATIONS, enough)

    def _is_late(self, base: Fit, fits: list[Fit]) -> bool:
        """Whether a delay, or what passes for one, takes away some of what is left."""
        late = [fit for fit in fits if fit.effects[-1] in (Delay, SensorLag, SlowDynamics)]
        noise = self._noise(fits)
        least = max(_LATE_SHARE * (base.train - noise), _LATE_CHI_SQUARED * noise / max(self._trained.size, 1))
        return any(base.train - fit.train > least for fit in late)

    def _noise(self, fits: list[Fit]) -> float:
        """Of the fitted samples, as the best fit shows it [deg^2]."""
        return self._trained.size * noise_floor_deg(self.record, min(fits, key=lambda fit: fit.train).error_deg) ** 2

    def _framed(self, base: Fit, fits: list[Fit]) -> list[Fit]:
        """The best fit with pulse frames, if there is any."""
        best, effects = min(fits, key=lambda fit: fit.train), (*base.effects, PwmFrame)
        known, noise, frame = self.physics(base.effects, base.values), self._noise(fits), None
        late = [fit for fit in fits if fit.effects[-1] in (Delay, SensorLag, SlowDynamics)]
        like = [fit for fit in late if fit.effects[-1] is Delay] or late
        more = best.train > (1.0 + max(_FRAMES_EXCESS, floor_uncertainty(self.record))) * noise
        # To wait for the next frame is to be late by chance: where that shows, no rival speaks against frames.
        scattered = scatter_s(self.record, best.error_deg, _FRAMES_EXCESS) > 0.0
        if not (more or scattered):
            later_s = [
                float(fit.values[-1]) - self.record.plant.neutral.delay_s for fit in late if fit.effects[-1] is Delay
            ]
            late_s = max(later_s, default=0.0)
            frame = self._sought(known, base.train - noise, best, noise, late_s)
            frame = frame or usual_frame(self.record, known, late_s)
        elif self._lacks_most(min(fit.train for fit in like), len(effects), noise):
            frame = self._sought(known, base.train - noise, None if scattered else best, noise)
        if frame is None:
            return []
        values, count = polish(self.record, effects, [*base.values.tolist(), *frame], base.values.size)
        self.simulations += count
        return [self.refitted(effects, values)]

    def _lacks_most(self, train: float, length: int, noise: float) -> bool:
        """Whether no fit of a length, whatever its effects, is far better than what frames are on average."""
        return train - noise < _LATE_LEAVES * max(self._first[length].train - noise, _FRAMES_EXCESS * noise)

    def _sought(
        self, known: Physics, left: float, rival: Fit | None, noise: float, late_s: float | None = None
    ) -> Frame | None:
        """Frames that a search of the whole log finds, unless a rival is clearly better; or those that it found before.

        Beside other effects that leave as much, it would find them again, or again none.
        """
        alike = [before for before in self._frames if left > _MUCH_LESS * before]
        if not alike:
            sigma_deg = float(np.sqrt(noise / self._trained.size))
            error_deg = None if rival is None else rival.error_deg
            if late_s is None or error_deg is None:
                likely = frames_like(self.record, known, error_deg, sigma_deg)
            else:
                likely = frames_as_late(self.record, known, late_s, error_deg, sigma_deg)
            self._frames[left] = best_frame(self.record, known, likely) if likely else None
        return self._frames[min(alike, default=left)]

    def refitted(
        self, effects: tuple[type[MissingEffect], ...], values: Values, evaluations: int = _EVALUATIONS
    ) -> Fit:
        """All parameters fitted together, from given values: least squares within the bounds."""
        return self._descended(effects, values, evaluations, np.inf)

    def _descended(
        self, effects: tuple[type[MissingEffect], ...], values: Values, evaluations: int, enough: float
    ) -> Fit:
        """The same; what cannot leave less than `enough` [deg^2] ends early."""
        best = self.judged(effects, values)
        rough = np.array([effect.family == _STICKS and not p.aside for effect in effects for p in effect.parameters])

        def errors_deg(values: FloatArray) -> FloatArray:
            return self.error_deg(effects, values)[self._trained]

        for stride in (_STRIDE, _STEP) if rough.any() else (_STEP,):
            steps, fine = np.where(rough, stride, _STEP), evaluations > _EVALUATIONS
            found = self.judged(
                effects,
                descended(errors_deg, best.values, best.parameters, steps, evaluations, fine=fine, enough=enough),
            )
            best = found if found.train <= best.train else best
        return best

    def on_all(self, fit: Fit) -> tuple[Fit, FloatArray]:
        """A fit with its values refitted to all samples, and their covariance, shape (p, p).

        The sums of squares stay those of the fit to the fitted blocks alone: they judge, the values are used.
        """
        if not fit.effects:
            return fit, np.zeros((0, 0))
        whole = self.on(replace(self.record, block=np.zeros_like(self.record.block)))
        best = whole.refitted(fit.effects, fit.values, _THOROUGH)
        error = best.error_deg[self.record.counts]
        sigma_deg = float(np.sqrt(np.mean(error**2)))
        covariance = whole.covariance(best, sigma_deg, long_run_factor(error)) + whole.discretization(best)
        self.adopt(whole)
        return replace(fit, values=best.values, error_deg=best.error_deg, unstepped_deg=best.unstepped_deg), covariance

    def total_on_all(self, fit: Fit) -> float:
        """What an extended servo leaves of all samples if its values are fitted to all of them [deg^2]."""
        if fit not in self._on_all:
            whole = self.on(replace(self.record, block=np.zeros_like(self.record.block)))
            self._on_all[fit] = whole.refitted(fit.effects, fit.values).total
            self.simulations += whole.simulations
        return self._on_all[fit]

    def covariance(self, fit: Fit, sigma_deg: float, factor: float) -> FloatArray:
        """Of the values of a fit, shape (p, p), from the curvature on both sides; infinite where nothing shows."""
        if not fit.effects:
            return np.zeros((0, 0))
        jacobian = self.slopes(fit)
        seen = np.linalg.norm(jacobian, axis=0) > 1e-9
        result = np.diag(np.where(seen, 0.0, np.inf))
        inside = np.ix_(seen, seen)
        result[inside] = np.linalg.pinv(jacobian[:, seen].T @ jacobian[:, seen], rcond=1e-12) * sigma_deg**2 * factor
        scale = np.array([p.typical for p in fit.parameters])
        covariance: FloatArray = result * np.where(np.isinf(result), 1.0, np.outer(scale, scale))
        return covariance

    def discretization(self, fit: Fit) -> FloatArray:
        """Square of how far a simulation in steps ten times as fine would move the values of a fit, shape (p, p).

        No noise, but the same in every record: what sticks and slips within a step of the kernel is not exact. Nor is
        any other simulator, to a small share of each value.
        """
        finer = simulate(self.record, self.physics(fit.effects, fit.values), _FINER)
        change = (self.record.measured_deg - finer - fit.error_deg)[self._trained]
        moved = np.linalg.lstsq(self.slopes(fit), -change, rcond=1e-6)[0] * [p.typical for p in fit.parameters]
        sizes = [
            min(p.away(float(v), self.record.plant.neutral), abs(v))
            for p, v in zip(fit.parameters, fit.values, strict=True)
        ]
        return np.outer(moved, moved) + np.diag((_SIMULATORS_DIFFER * np.array(sizes)) ** 2)

    def slopes(self, fit: Fit) -> FloatArray:
        """Slope of the errors over each parameter in units of what is common, shape (m, p)."""
        columns = []
        for k, parameter in enumerate(fit.parameters):
            # Of a knee at 3 deg, 300 of which are common, a hundredth is a hundredth of 3.
            value = abs(float(fit.values[k]))
            step = 1e-2 * (min(parameter.typical, value) if value > 1e-3 * parameter.typical else parameter.typical)
            up, down = fit.values.copy(), fit.values.copy()
            up[k], down[k] = min(up[k] + step, parameter.high), max(down[k] - step, parameter.low)
            change = self.error_deg(fit.effects, up) - self.error_deg(fit.effects, down)
            columns.append(change[self._trained] / (up[k] - down[k]) * parameter.typical)
        return np.column_stack(columns)


def _in_force(effects: Sequence[type[MissingEffect]], values: Values) -> FloatArray:
    """Values that mean the same in any order of the effects: of what several of them set, the last one's counts."""
    parameters = [p for effect in effects for p in effect.parameters]
    last = {p.fields: float(value) for p, value in zip(parameters, values, strict=True)}
    return np.array([last[p.fields] for p in parameters])
