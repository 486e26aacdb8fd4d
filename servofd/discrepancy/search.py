"""Structures that grow: what is worth fitting on top of a base, in which forms and places, and every fit so far."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from servofd.discrepancy.candidates import SMALLEST, candidates, common_places, excluded
from servofd.discrepancy.fit import OWN_FIELDS, Fit, Fitter
from servofd.discrepancy.frames import best_frame, frames_like
from servofd.discrepancy.record import liveliest
from servofd.servo.catalogue import ClockOffset, Delay, PwmFrame, SensorLag, SlowDynamics, TiltedLoad, installed
from servofd.servo.physics import INSIDE, RATE_FIELDS

if TYPE_CHECKING:
    from collections.abc import Callable

    from servofd.discrepancy.record import Record
    from servofd.servo.missing_effect import MissingEffect
    from servofd.servo.physics import Physics

OCCAM = 30.0
"""By how much a further name must improve the misfit."""
_POSSIBLE = 6.0
"""Improvement on the screen below which a candidate is not fitted."""
NAMES, FITS = 8, 16
"""Names and structures that are fitted from one base."""
_CLOSE, _SHARE = 60.0, 0.3
"""How far behind the best of its name a structure may be: so much, or that share of what it improves."""
_STEEP = 0.9
"""A load that pulls back more steeply where the servo works is a lost gain and an offset."""
LIMITS = ("rate_limit", "voltage_rate")
"""Effects that limit the speed."""
_PER_V, _SLOWEST = ("deg_s_per_v", "speed_deg_s_per_v"), 0.2
_LATE, _LATE_S = (Delay, SensorLag, SlowDynamics), 0.02
"""Effects that make a servo late, and a delay in the middle of what servos and links add [s]."""


@dataclass(slots=True, eq=False)
class Search:
    """Of one record: what fits it, the effects that it can show, and all structures that were fitted."""

    fitter: Fitter
    able: list[type[MissingEffect]]
    progress: Callable[[str], None]
    visited: dict[tuple[tuple[str, ...], float], Fit] = field(default_factory=dict)
    grown: set[tuple[tuple[str, ...], float]] = field(default_factory=set)
    part: Fitter = field(init=False)

    def begin(self, root: Fit) -> None:
        """From the servo as it is known; the liveliest part of the record screens candidates."""
        record = self.fitter.record
        self.part = Fitter(liveliest(record, self.fitter.judged((), root.physics).error_deg))
        self.look_again()
        self.keep(root)

    def look_again(self) -> None:
        """Count the part's samples as the whole's."""
        self.part._size = self.fitter._size
        if self.part.kappa.size == self.fitter.kappa.size:
            self.part.kappa = self.fitter.kappa
        else:
            self.part.kappa = np.full(self.part.kappa.size, float(np.median(self.fitter.kappa)))

    def keep(self, fit: Fit) -> bool:
        """Remember a fit if it is the best of its structure; whether it is a servo at all.

        What changes nothing is no part of it: the rest has been fitted from another start.
        """
        if fit.idle:
            fit = without_idle(fit, self.fitter.record.plant.neutral)
        if fit.key not in self.visited or fit.misfit < self.visited[fit.key].misfit:
            self.visited[fit.key] = fit
        return self.is_physical(fit)

    def is_physical(self, fit: Fit) -> bool:
        """Whether no number is at its bound, and none so small that it is none."""
        if fit.ran_away or (TiltedLoad in fit.effects and hanging(self.fitter.record, fit) > _STEEP):
            return False
        neutral, first = self.fitter.record.plant.neutral, 0
        for effect in fit.effects:
            sizes = []
            for p, value in zip(effect.parameters, fit.values[first:].tolist(), strict=False):
                least = SMALLEST.get(p.fields[0])
                if least is not None and not p.aside:
                    sizes.append(p.away(value, neutral) >= self.fitter.smallest(p, least))
            first += len(effect.parameters)
            if sizes and not any(sizes):
                return False
        return True

    def grow(self, base: Fit, enough: float, *, framed: bool = True) -> list[Fit]:
        """Fits with one effect more than a base; with pulse frames, which take long, only if asked for."""
        if base.key in self.grown:
            return []
        self.grown.add(base.key)
        physical = self.fitter.starts(base)
        chosen = [each for start in physical for each in self._screened(replace(base, physics=start), len(physical))]
        fits = [self._fitted((*base.effects, effect), physics, enough) for effect, physics in chosen]
        fits += [
            self._fitted((*base.effects, effect), base.physics, enough)
            for effect in self.able
            if effect.name not in excluded(base.effects) and self.fitter.strains(effect, base)
        ]
        loose = [fit for fit in fits if fit.effects[-1].family == "hysteresis"]
        if loose and self.fitter.record.free_poles:
            self.exchange(min(loose, key=lambda fit: fit.misfit), enough, len(base.effects))
        fits += self._twins(base, fits, enough)
        if framed and PwmFrame in self.able and PwmFrame.name not in base.names:
            fits += self._framed(base, fits)
        return fits

    def _screened(self, start: Fit, shares: int) -> list[tuple[type[MissingEffect], Physics]]:
        """What is worth fitting on top of a start, one of so many."""
        slopes = self.part.slopes(start)
        before = self.part.given_way(start.physics, slopes[:, :0])
        screened: list[tuple[float, type[MissingEffect], Physics]] = []
        for candidate in candidates(self.fitter.record, self.able, start.effects, start.place):
            if self.fitter.is_own(candidate.effect):
                continue
            self.progress(candidate.effect.key())
            misfit, physics = self.part.screened(start, slopes, candidate)
            screened.append((misfit, candidate.effect, physics))
        screened.sort(key=lambda each: each[0])
        best_of: dict[str, float] = {}
        for misfit, effect, _ in screened:
            best_of.setdefault(effect.name, misfit)
        most = -(-NAMES // shares)
        names = [name for name, misfit in best_of.items() if misfit < before - _POSSIBLE][:most]
        near = {name: max(_CLOSE, _SHARE * (before - best_of[name])) for name in names}
        return [
            (effect, physics)
            for misfit, effect, physics in screened
            if effect.name in near and misfit < best_of[effect.name] + near[effect.name]
        ][: -(-FITS // shares)]

    def _fitted(self, effects: tuple[type[MissingEffect], ...], start: Physics, enough: float = np.inf) -> Fit:
        fit = self.fitter.descended(effects, start, enough=enough)
        self.keep(fit)
        return fit

    def exchange(self, fit: Fit, enough: float, known: int = 0) -> None:
        """Each effect of a fit, but for so many that are known, in its other forms, started from what it came to.

        What sticks, is dead or loose passes for one another until each has been fitted as well, at each place; so do
        the ways in which a speed is limited.
        """
        record, first = self.fitter.record, 0
        is_placed = record.plant.has_places and record.side is None
        for k, effect in enumerate(fit.effects):
            size, first = float(fit.values[first]), first + len(effect.parameters)
            if k < known:
                continue
            rest = (*fit.effects[:k], *fit.effects[k + 1 :])
            without = fit.physics._replace(**{f: getattr(record.plant.neutral, f) for f in fields_of(effect)})
            is_loose = effect.family == "hysteresis"
            for other in self.able:
                if other.name in excluded(rest) or not (_is_like(effect, other) or (is_loose and other is effect)):
                    continue
                into = [size * _half(other) / _half(effect), *(p.grid[0] for p in other.parameters[1:])]
                for place in (common_places((*rest, other)) or (INSIDE,)) if is_placed and is_loose else (fit.place,):
                    start = installed(without._replace(slow_place=place), [other], into)
                    self._fitted((*rest, other), self._as_fast(start, fit.physics), enough)

    def delayed(self, base: Fit, enough: float) -> None:
        """A servo whose speed is limited with a longer delay, the limit in each form and at each place.

        What a slow pole elsewhere does to a limited speed looks much like a delay: the place that came first without
        one is no better than the others, and its own numbers have given way.
        """
        record = self.fitter.record
        limit = next((effect for effect in base.effects if effect.name in LIMITS), None)
        if limit is None or Delay in base.effects or ClockOffset in base.effects:
            return
        rest = tuple(effect for effect in base.effects if effect is not limit)
        usual = base.physics._replace(**{name: getattr(record.plant.neutral, name) for name in OWN_FIELDS})
        without = usual._replace(**{name: getattr(record.plant.neutral, name) for name in fields_of(limit)})
        value = float(base.values[sum(len(e.parameters) for e in base.effects[: base.effects.index(limit)])])
        late_s = record.plant.neutral.delay_s + _LATE_S
        for form in self.able:
            if form.name == limit.name and len(form.parameters) == 1:
                effects = (*rest, form, Delay)
                for place in common_places(effects) or (base.place,):
                    start = installed(without._replace(slow_place=place), [form, Delay], [value, late_s])
                    self._fitted(effects, start, enough)

    def _as_fast(self, start: Physics, fitted: Physics) -> Physics:
        """A start that is as fast as what was fitted: a motor at its limit loses what friction takes."""
        record = self.fitter.record
        more_deg_s = _lost_deg_s(record, start) - _lost_deg_s(record, fitted)
        supply_v = 1.0 if record.voltage_v is None else float(np.nanmean(record.voltage_v))
        limits = {name: getattr(start, name) for name in RATE_FIELDS}
        more = {name: more_deg_s / (supply_v if name in _PER_V else 1.0) for name in limits}
        return start._replace(**{n: max(v + more[n], _SLOWEST * v) for n, v in limits.items() if v < np.inf})

    def _twins(self, base: Fit, fits: list[Fit], enough: float) -> list[Fit]:
        """What moves nearly alike, started from what the other came to: late commands and late readings."""
        best = {
            twin: min((fit for fit in fits if fit.effects[-1] is twin), key=lambda fit: fit.misfit, default=None)
            for twin in (Delay, ClockOffset)
        }
        found, neutral = [], self.fitter.record.plant.neutral
        for twin, other in ((Delay, best[ClockOffset]), (ClockOffset, best[Delay])):
            if twin not in self.able or other is None or ((own := best[twin]) and own.misfit < other.misfit):
                continue
            at = other.physics
            late_s = at.delay_s + at.offset_s - neutral.delay_s
            if twin is Delay:
                start = at._replace(delay_s=max(neutral.delay_s + late_s, 0.0), offset_s=neutral.offset_s)
            else:
                start = at._replace(delay_s=neutral.delay_s, offset_s=late_s)
            found.append(self._fitted((*base.effects, twin), start, enough))
        return found

    def _framed(self, base: Fit, fits: list[Fit]) -> list[Fit]:
        """The base with pulse frames, if a delay or what passes for one helps it."""
        late = [fit for fit in fits if fit.effects[-1] in _LATE]
        if not late or base.misfit - min(fit.misfit for fit in late) < OCCAM:
            return []
        self.progress(PwmFrame.key())
        record = self.fitter.record
        known = base.physics
        rival = self.fitter.judged((), min(fits, key=lambda fit: fit.misfit).physics)
        sigma = float(np.sqrt(rival.run_deg2.mean()))
        likely = frames_like(record, known, rival.error_deg, sigma)
        if not likely:
            return []
        period_s, phase = best_frame(record, known, likely)
        start = known._replace(frame_s=period_s, frame_phase=phase)
        return [self._fitted((*base.effects, PwmFrame), start)]


def without_idle(fit: Fit, neutral: Physics) -> Fit:
    """A fit without the effects that change nothing."""
    effects = tuple(effect for k, effect in enumerate(fit.effects) if k not in fit.idle)
    values = [getattr(fit.physics, p.fields[0]) for effect in effects for p in effect.parameters]
    gone = {name: getattr(neutral, name) for k in fit.idle for p in fit.effects[k].parameters for name in p.fields}
    physics = fit.physics._replace(**gone)
    if physics.slow_place not in common_places(effects):
        physics = physics._replace(slow_place=INSIDE)
    return replace(fit, effects=effects, values=np.array(values), physics=physics, idle=())


def fields_of(effect: type[MissingEffect]) -> tuple[str, ...]:
    """Of `Physics`, those that an effect sets."""
    return (*(name for p in effect.parameters for name in p.fields), *effect.fixed)


def _lost_deg_s(record: Record, physics: Physics) -> float:
    """Speed that friction takes from a motor at its limit."""
    limits = (physics.rate_up_deg_s, physics.rate_down_deg_s, physics.deg_s_per_v)
    is_limited = physics.friction_deg > 0.0 and min(limits) < np.inf
    return physics.friction_deg / record.plant.loop(physics).error_per_rate_s if is_limited else 0.0


def _half(effect: type[MissingEffect]) -> float:
    """Friction is given by half the width within which a servo may rest, the others by all of it."""
    return 0.5 if effect.parameters[0].fields[0] == "friction_deg" else 1.0


def _is_like(effect: type[MissingEffect], other: type[MissingEffect]) -> bool:
    """Whether two effects are ways of sticking, being dead or loose, or of limiting one speed, of one size."""
    if effect.family == "hysteresis" or other.family == "hysteresis":
        return effect is not other and effect.family == other.family
    same = effect.parameters[0].name == other.parameters[0].name
    return effect is not other and same and effect.name == other.name and effect.name in LIMITS


def hanging(record: Record, fit: Fit) -> float:
    """Cosine of how far from where its load hangs a servo works: how steeply the load changes there."""
    return float(np.cos(np.radians(np.nanmean(record.measured_deg) - fit.physics.hangs_deg)))
