"""One structure fitted to one record: effects, and the servo's own numbers within what servos of a type differ by.

The misfit is that of `servofd.core.fitting`: its groups are the runs, and its prior is that of poles, damping, gain,
delay and zero.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np

from servofd.core.fitting import Noise, Problem, Solution, inverse
from servofd.core.fitting import fit as minimum
from servofd.core.types import BoolArray, FloatArray
from servofd.discrepancy.known import A_TYPE
from servofd.discrepancy.noise import (
    COARSE_STEP_DEG,
    long_run_factor,
    mean_reading_deg,
    noise_below_deg,
    noise_floor_deg,
)
from servofd.discrepancy.record import Record, simulate, thinned
from servofd.servo.catalogue import installed
from servofd.servo.effect import Effect, Parameter
from servofd.servo.effects.linkage import Gain
from servofd.servo.effects.sensor import Bias, Quantization
from servofd.servo.loop import split
from servofd.servo.physics import Physics

SHORT, LONG, _CLOSE = 24, 60, 0.1
"""Steps of a descent that shall show what a structure is worth, and of one to the end; and the misfit, of which one
standard deviation of a number makes 1 or more, by which a step must improve."""
_NEARBY, _FROM_ALL = 8, 4.0
"""Steps of a fit to a part, which begins where all samples lead, and how many of their standard deviations off a number
may come to lie (of half the samples it is 1.4). Of 4 steps that had to improve the misfit by 1, half of the real servos
made none: what was held out was the error of the fit itself, up to 3 % below what 30 steps come to; 8 leave 1 %."""
_STEP = 0.1
"""In units of what is common, or of a prior: what sticks answers to less with jumps."""
_LOG_STEP, _DECADES = 0.2, 50.0
"""Numbers that range over decades are fitted by their logarithm, in such units."""
_STRAIN = 2.0
"""Standard deviations of one of the servo's own numbers at which it may be better to free it."""
_SAME = 1e-9
"""Curvature below which the data say nothing about a number."""
_FAR = 50.0
"""Largest exponent of a number that is fitted by its logarithm, so that none overflows."""
_SIMULATORS_DIFFER = 2.5e-3
"""Standard deviation of a number for the difference between two simulators of one servo, as a share of its distance
from neutral."""
_NOTHING_DEG = 1e-5
"""Smallest error that counts in a misfit [deg]: less is rounding."""
_USUAL_GAP_DEG = 1.0
"""Error of a servo for which the sizes of effects in the catalogue are meant."""


class _Number(NamedTuple):
    """Something that is fitted: value = neutral + unit x, or neutral exp(unit x)."""

    fields: tuple[str, ...]
    neutral: float
    unit: float
    low: float
    high: float
    is_log: bool
    prior: bool

    def value(self, x: float) -> float:
        value = (
            self.neutral * np.exp(min(max(self.unit * x, -_FAR), _FAR)) if self.is_log else self.neutral + self.unit * x
        )
        return float(min(max(value, self.low), self.high))

    def x(self, value: float) -> float:
        if self.is_log:
            return float(np.log(max(value, self.low) / self.neutral)) / self.unit
        return (value - self.neutral) / self.unit


OWN_FIELDS = tuple(A_TYPE.spread)
"""Of `Physics`, the servo's own numbers."""
_BY_LOGARITHM = ("slow_scale", "pair_scale", "damping_scale")
_ROOTS = 6
"""Points of a grid of servos that are fitted."""
_FASTEST_SLOW, _SLOW_RAD_S, _SAMPLES = 3.0, 200.0, 3.0
"""Times 200 rad/s, or a third of a sample: what is faster than that no log shows."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A servo with some effects, as well as they fit."""

    effects: tuple[type[Effect], ...]
    physics: Physics
    """The servo with them, and with its own numbers refitted."""
    run_deg2: FloatArray
    """Mean square that is left of each run."""
    misfit: float = np.inf
    idle: tuple[int, ...] = ()
    """Which of the effects change nothing: a limit that is never reached."""
    error_deg: FloatArray = field(default_factory=lambda: np.zeros(0))
    """Measured minus simulated position, shape (n,)."""
    unstepped_deg: FloatArray = field(default_factory=lambda: np.zeros(0))
    """The error of the position before the steps of its converter, shape (n,); where there are none, `error_deg`."""
    train: float = 0.0
    """Mean square over the samples that count [deg^2]."""
    held_out: float = 0.0
    """The same, each of two folds predicted by the servo as the other one tells it."""

    @property
    def values(self) -> FloatArray:
        """Parameters of the effects in order, shape (p,)."""
        return np.array([getattr(self.physics, p.fields[0]) for p in self.parameters])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects."""
        return tuple(effect.name for effect in self.effects)

    @property
    def place(self) -> float:
        """Place of the slow pole."""
        return self.physics.slow_place

    @property
    def key(self) -> tuple[tuple[str, ...], float]:
        """Key of the structure, the same in whatever order its effects were found."""
        return tuple(sorted(effect.key() for effect in self.effects)), self.place

    @property
    def ran_away(self) -> tuple[int, ...]:
        """Which of the effects have a parameter at its bound: no answers, but failures."""
        return tuple(
            k
            for k, effect in enumerate(self.effects)
            if any(p.at_bound(getattr(self.physics, p.fields[0])) for p in effect.parameters)
        )

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of all effects in order."""
        return tuple(p for effect in self.effects for p in effect.parameters)


class Fitter:
    """Fits structures to a record; counts its simulations.

    `part`: samples that are fitted, all of them or of a long record enough. `kappa` (shape (r,)): correlation factor
    of the errors, for each run.
    """

    def __init__(self, record: Record) -> None:
        self.record, self.simulations = record, 0
        self._samples = max(float(record.counts.sum()), 1.0)
        self.part = thinned(record)
        self._where = np.flatnonzero(self.part.counts)
        self._run = self.part.run[self._where]
        self._count = np.maximum(np.bincount(self._run, minlength=max(len(self.part.runs), 1)).astype(float), 1.0)
        self.kappa = np.ones(self._count.size)
        floor_deg = noise_floor_deg(self.part, self.part.measured_deg)
        self._least = max(0.2 * floor_deg, 0.29 * (self.part.step_deg or 0.0), _NOTHING_DEG) ** 2
        self._size, self._below_deg = 1.0, 0.0
        self._fastest = max(_FASTEST_SLOW, _SAMPLES / (_SLOW_RAD_S * record.period_s))
        self._halves: dict[tuple[Hashable, ...], list[tuple[BoolArray, Fit]]] = {}

    @property
    def effective(self) -> float:
        """Number of samples, over their memory."""
        return float((self._count / self.kappa).sum())

    def remember(self, fit: Fit) -> None:
        """Take the correlation of what a fit leaves for that of the noise."""
        errors = self._seen_deg(fit.physics)
        kappa = [long_run_factor(errors[self._run == r]) for r in range(self._count.size)]
        self.kappa = np.array(kappa)

    def reweighed(self, fit: Fit) -> Fit:
        """The same servo with the misfit that the correlation of the noise gives it now."""
        own = [n for n in self._numbers(fit.effects, fit.physics) if n.prior]
        misfit = float((self._count / self.kappa) @ np.log(fit.run_deg2 + self._least))
        return replace(fit, misfit=misfit + float(np.sum(self._x(own, fit.physics) ** 2)))

    def nominal(self) -> Fit:
        """The servo as it is known; of an unknown one, the best linear one."""
        return self.halved(self.root) if self.record.known.starts else self.judged((), self.record.model.physics)

    @cached_property
    def linear(self) -> list[Fit]:
        """Linear servos with their own numbers refitted as if errors were uncorrelated, the best first."""
        neutral, known, kappa = self.record.model.physics, self.record.known, self.kappa
        self.kappa = np.ones(kappa.size)
        coarse = [neutral._replace(**point) for point in known.grid]
        coarse.sort(key=lambda physics: self._noise.misfit(self._seen_deg(physics)))
        starts = [neutral, *coarse[:_ROOTS], *(neutral._replace(**start) for start in known.starts)]
        found = sorted((self.descended((), start, LONG) for start in starts), key=lambda fit: fit.misfit)
        self.kappa = kappa
        return found

    @cached_property
    def root(self) -> Fit:
        """The linear servo with its own numbers refitted; the correlation of what it leaves counts as the noise's."""
        fits = self.linear
        self.remember(fits[0])
        found = min((self.descended((), fit.physics, LONG) for fit in fits[:_ROOTS]), key=lambda fit: fit.misfit)
        if self.record.known.starts:
            self._size = min(1.0, float(np.sqrt(found.run_deg2.max())) / _USUAL_GAP_DEG)
        return found

    def judged(self, effects: tuple[type[Effect], ...], physics: Physics) -> Fit:
        """A servo with given numbers on the whole record."""
        self.simulations += 1
        record = self.record
        error = record.measured_deg - simulate(record, physics)
        unstepped = error
        if Quantization in effects:
            unstepped = record.measured_deg - simulate(record, physics._replace(output_step_deg=0.0))
        square = float(error[record.counts] @ error[record.counts]) / self._samples
        runs = record.run[record.counts]
        squares = np.bincount(runs, weights=error[record.counts] ** 2, minlength=max(len(record.runs), 1))
        left = squares / np.maximum(np.bincount(runs, minlength=squares.size), 1)
        return Fit(effects, physics, left, error_deg=error, unstepped_deg=unstepped, train=square, held_out=square)

    def is_own(self, effect: type[Effect]) -> bool:
        """Whether an effect is one of the servo's own numbers, beyond what servos of a type differ by."""
        return all(set(p.fields) <= set(OWN_FIELDS) for p in effect.parameters)

    def strains(self, effect: type[Effect], base: Fit) -> bool:
        """Whether it is, and a base has moved it so far that to free it may be better."""
        if not self.is_own(effect):
            return False
        if self.record.known.starts and not self.record.runs and effect in (Bias, Gain):
            return True  # the correlation of the errors may hide them
        names = {name for p in effect.parameters for name in p.fields}
        numbers = [n for n in self._numbers(base.effects, base.physics) if n.prior and n.fields[0] in names]
        return any(abs(x) > _STRAIN for x in self._x(numbers, base.physics))

    def smallest(self, parameter: Parameter) -> float:
        """A size in degrees as this record is to be judged: of a drive that is off by micrometres, micrometres."""
        usual = parameter.smallest * self._scale(parameter)
        return self.record.known.smallest.get(parameter.fields[0], usual)

    def starts(self, base: Fit) -> list[Physics]:
        """Where a further effect may start: from what its own numbers came to, and from what is usual.

        Without the effect they may have gone far to stand in for it; of an unknown servo all are.
        """
        numbers = [n for n in self._numbers(base.effects, base.physics) if n.prior]
        known = self.record.known
        if known.starts and not base.effects:
            return [base.physics, *(base.physics._replace(**start) for start in known.starts)]
        strained = any(abs(x) > known.strained for x in self._x(numbers, base.physics))
        usual = base.physics._replace(**{n.fields[0]: n.neutral for n in numbers})
        return [base.physics, usual] if strained else [base.physics]

    def as_a_pair(self, physics: Physics) -> Physics:
        """A servo as late at low frequencies, all of it by its pair of poles: the slow one is as fast as may be."""
        slow_rad_s, (total, product) = split(np.array(self.record.model.transfer.denominator))
        fast = self._fastest
        by_slow_s = (1.0 / physics.slow_scale - 1.0 / fast) / slow_rad_s
        by_pair_s = physics.damping_scale / physics.pair_scale * total / product
        return physics._replace(
            slow_scale=fast, pair_scale=total / product / max(by_pair_s + by_slow_s, 0.5 * by_pair_s), damping_scale=1.0
        )

    def screened(self, base: Fit, slopes: FloatArray, effect: type[Effect], place: float) -> tuple[float, Physics]:
        """Best misfit that a coarse grid of one more effect reaches, and the servo there.

        What is fitted already gives way as far as its slopes tell.
        """
        grids = [[self._scale(p) * value for value in (p.grid[:1] if p.aside else p.grid)] for p in effect.parameters]
        if effect is Quantization:
            grids = [[self.record.step_deg or 0.0]]
        tried: dict[tuple[float, ...], tuple[float, Physics]] = {}

        def misfit(point: tuple[float, ...]) -> float:
            if point not in tried:
                physics = installed(base.physics._replace(slow_place=place), [effect], list(point))
                tried[point] = self.given_way(physics, slopes), physics
            return tried[point][0]

        best = min(product(*grids), key=misfit)
        for k, grid in enumerate(grids):  # between the neighbours on the grid
            near = [0.5 * (best[k] + other) for other in _beside(grid, best[k])]
            best = min((best, *((*best[:k], value, *best[k + 1 :]) for value in near)), key=misfit)
        return tried[best]

    def given_way(self, physics: Physics, slopes: FloatArray) -> float:
        """Misfit of a servo after its numbers gave way as far as their slopes tell."""
        error, penalty = self._seen_deg(physics), 0.0
        if slopes.shape[1]:
            rows, prior = slopes[:-1], slopes[-1]
            weighted = rows * self._noise.weights(error)[:, None]
            curvature = rows.T @ weighted + np.diag(prior + 1e-9)
            step = -np.linalg.solve(curvature, weighted.T @ error)
            error = error + rows @ step
            penalty = float(prior @ step**2)
        return self._noise.misfit(error) + penalty

    def slopes(self, fit: Fit) -> FloatArray:
        """Slope of the errors over each number that is fitted, and its prior in the last row, shape (m + 1, q)."""
        numbers = self._numbers(fit.effects, fit.physics)
        return np.vstack([self._at(numbers, fit.physics).slopes, [float(n.prior) for n in numbers]])

    def descended(
        self, effects: tuple[type[Effect], ...], start: Physics, steps: int = SHORT, enough: float = np.inf
    ) -> Fit:
        """All numbers fitted together from where a servo is; given up where it does not come below `enough` soon."""
        numbers = self._numbers(effects, start)
        problem = self._problem(numbers, start)
        found = minimum(problem, self._x(numbers, start), steps=steps, close=_CLOSE, enough=enough)
        physics = self._servo(numbers, found.x, start)
        idle = _idle(effects, found.followed[:, sum(n.prior for n in numbers) :])
        return Fit(effects, physics, self._noise.squares(found.error), found.misfit, idle)

    def _problem(self, numbers: list[_Number], start: Physics) -> Problem:
        x = self._x(numbers, start)
        steps = _STEP * np.where([n.is_log or n.prior for n in numbers], 1.0, np.maximum(1.0, 0.2 * np.abs(x)))
        low, high = np.array([n.x(n.low) for n in numbers]), np.array([n.x(n.high) for n in numbers])
        prior = np.array([float(n.prior) for n in numbers])

        def residual(there: FloatArray) -> FloatArray:
            return self._seen_deg(self._servo(numbers, there, start))

        return Problem(low, high, residual, self._noise, prior, step=steps)

    @property
    def _noise(self) -> Noise:
        return Noise(self._run, self.kappa, self._least)

    def halved(self, fit: Fit) -> Fit:
        """A fit with the errors that each of two folds has, predicted by the servo as the other one tells it."""
        whole, counts = self.judged(fit.effects, fit.physics), self.record.counts
        error = self._beside_mean_reading(whole)[counts]
        key = fit.effects, fit.physics, self.kappa.tobytes()
        if key not in self._halves:
            folds = [counts & (self.record.fold % 2 == fold) for fold in (1, 0)]
            self._halves[key] = list(zip(folds, self.without(fit, folds), strict=True))
        others = [self._beside_mean_reading(judged)[fold] for fold, judged in self._halves[key]]
        train, held_out = float(error @ error), float(sum(each @ each for each in others))
        return replace(whole, train=train / self._samples, held_out=held_out / self._samples, misfit=fit.misfit)

    def without(self, fit: Fit, left_out: Sequence[BoolArray]) -> list[Fit]:
        """The servo fitted without some of the samples (n,), each time to all others, on the whole record.

        Samples count for as much more as there are fewer, or the prior would have more of a say than in the fit.
        """
        record, physics = self.record, fit.physics
        others = [record.counts & ~each for each in left_out]
        if (
            record.side is not None
            or not (fit.effects or physics != record.model.physics)
            or not all(map(np.any, others))
        ):
            return [self.judged(fit.effects, physics)] * len(others)
        numbers = self._numbers(fit.effects, physics)
        x, prior = self._x(numbers, physics), np.array([float(n.prior) for n in numbers])
        there = self._at(numbers, physics)
        # What a part does not tell stays as all samples tell it.
        near = 1.0 / (_FROM_ALL * np.sqrt(np.diag(inverse(there.curvature))))
        prior, centre = np.where(prior > 0.0, prior, near), np.where(prior > 0.0, 0.0, x)
        found = []
        for counts in others:
            part = Fitter(replace(record, counts=counts))
            part.kappa = self.kappa * float(counts.sum() / record.counts.sum())
            part._size = self._size
            problem = replace(part._problem(numbers, physics), prior=prior, centre=centre)
            rows = part.part.counts[self._where]
            best = minimum(problem, x, steps=_NEARBY, close=_CLOSE, slopes=there.slopes[rows])
            self.simulations += part.simulations
            found.append(self.judged(fit.effects, self._servo(numbers, best.x, physics)))
        return found

    def covariance(self, fit: Fit) -> FloatArray:
        """Covariance of the values of a fit, shape (p, p); infinite where nothing shows."""
        numbers = self._numbers(fit.effects, fit.physics)
        count = len(fit.values)
        if not count:
            return np.zeros((0, 0))
        curvature = self._at(numbers, fit.physics).curvature
        seen = np.diag(curvature) > _SAME
        spread = np.zeros(curvature.shape)
        spread[np.ix_(seen, seen)] = np.linalg.pinv(curvature[np.ix_(seen, seen)], rcond=1e-12)
        own = len(numbers) - count
        units = np.array(
            [n.unit * (abs(v) if n.is_log else 1.0) for n, v in zip(numbers[own:], fit.values, strict=True)]
        )
        result = spread[own:, own:] * np.outer(units, units)
        known = np.array([n.low == n.high for n in numbers[own:]])
        unseen = ~seen[own:] & ~known
        result[unseen, unseen] = np.inf
        neutral = self.record.model.physics
        sizes = [min(p.away(float(v), neutral), abs(v)) for p, v in zip(fit.parameters, fit.values, strict=True)]
        return result + np.diag((_SIMULATORS_DIFFER * np.array(sizes)) ** 2)

    def _numbers(self, effects: tuple[type[Effect], ...], start: Physics) -> list[_Number]:
        """The servo's own numbers first, but for those that an effect fits; then those of the effects."""
        neutral, record = self.record.model.physics, self.record
        taken = {name for effect in effects for p in effect.parameters for name in p.fields}
        numbers = []
        for name, deviation in record.known.spread.items():
            if name in taken or (name == "slow_scale" and not record.model.has_places):
                continue
            if record.side is not None and name not in ("gain", "bias_deg"):
                continue
            is_log, size = name in _BY_LOGARITHM, self._size if name == "bias_deg" else 1.0
            low, high = (
                (0.02, self._fastest if name == "slow_scale" else 50.0)
                if is_log
                else (0.0 if name == "delay_s" else -np.inf, np.inf)
            )
            numbers.append(_Number((name,), getattr(neutral, name), deviation * size, low, high, is_log, prior=True))
        for effect in effects:
            for p in effect.parameters:
                is_log = p.low > 0.0 and p.high / p.low > _DECADES
                unit = _LOG_STEP if is_log else p.typical * self._scale(p)
                value = getattr(start, p.fields[0])
                at = value if is_log else 0.0
                # The comb of the readings tells their step, and nothing else does.
                low, high = (value, value) if effect is Quantization else (p.low, p.high)
                numbers.append(_Number(p.fields, at, unit, low, high, is_log, prior=False))
        return numbers

    def _x(self, numbers: list[_Number], physics: Physics) -> FloatArray:
        return np.array([n.x(getattr(physics, n.fields[0])) for n in numbers])

    def _servo(self, numbers: list[_Number], x: FloatArray, start: Physics) -> Physics:
        changes: dict[str, float] = {}
        for number, each in zip(numbers, x.tolist(), strict=True):
            changes |= dict.fromkeys(number.fields, number.value(each))
        return start._replace(**changes)

    def _seen_deg(self, physics: Physics) -> FloatArray:
        """Errors of the samples that count."""
        self.simulations += 1
        return (self.part.measured_deg - self._simulated_deg(physics))[self._where]

    def _simulated_deg(self, physics: Physics) -> FloatArray:
        """Simulated positions of the fitted part [deg]; of a converter with coarse steps its mean reading."""
        step_deg = physics.output_step_deg
        if step_deg < COARSE_STEP_DEG or step_deg != self.part.step_deg:
            return simulate(self.part, physics)
        moved_deg = simulate(self.part, physics._replace(output_step_deg=0.0))
        if self._below_deg == 0.0:
            read_deg = np.where(self.part.counts, self.part.measured_deg, np.nan)
            self._below_deg = noise_below_deg(read_deg, moved_deg, step_deg)
        return mean_reading_deg(moved_deg, step_deg, self._below_deg)

    def _beside_mean_reading(self, judged: Fit) -> FloatArray:
        """Error of a judged servo; of coarse steps beside what they read on average, as it was fitted."""
        step_deg = judged.physics.output_step_deg
        if step_deg < COARSE_STEP_DEG or step_deg != self.part.step_deg or self._below_deg == 0.0:
            return judged.error_deg
        measured_deg = self.record.measured_deg
        return measured_deg - mean_reading_deg(measured_deg - judged.unstepped_deg, step_deg, self._below_deg)

    def _at(self, numbers: list[_Number], physics: Physics) -> Solution:
        """A servo as if its numbers had been found: the slopes of its errors, and the curvature of its misfit."""
        error, x = self._seen_deg(physics), self._x(numbers, physics)
        return Solution(self._problem(numbers, physics), x, np.inf, error, np.zeros((0, 0)))

    def _scale(self, parameter: Parameter) -> float:
        """Scale of a number: degrees as the record is off, a load as it was logged."""
        if parameter.fields[0] == "load_deg" and self.record.pushed is not None:
            return 1.0 / float(np.sqrt(np.mean(self.record.pushed.load**2)))
        return self._size if (parameter.neutral == 0.0 and parameter.name.endswith("_deg")) else 1.0


def _idle(effects: tuple[type[Effect], ...], slopes: FloatArray) -> tuple[int, ...]:
    """Which effects have no slope at all."""
    if not slopes.shape[1]:
        return ()
    first, found = 0, []
    for k, effect in enumerate(effects):
        last = first + len(effect.parameters)
        if effect is not Quantization and not slopes[:, first:last].any():  # the comb tells its step
            found.append(k)
        first = last
    return tuple(found)


def _beside(grid: list[float], value: float) -> list[float]:
    """The next values on a grid."""
    below, above = [x for x in grid if x < value], [x for x in grid if x > value]
    return [*([max(below)] if below else []), *([min(above)] if above else [])]
