"""Structures that grow: what is worth fitting on top of a base, in which forms and places, and every fit so far."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import zip_longest

import numpy as np

from servofd.core.types import FloatArray
from servofd.discrepancy.fit import Fit, Fitter
from servofd.discrepancy.noise import COARSE_STEP_DEG
from servofd.discrepancy.record import Record, liveliest, only, simulate
from servofd.servo.catalogue import installed
from servofd.servo.effect import Effect, Slot
from servofd.servo.effects.commands import Commands, CommandSteps, Delay, PwmFrame
from servofd.servo.effects.own import SlowDynamics
from servofd.servo.effects.sensor import Quantization, SensorLag
from servofd.servo.effects.shaft import ExternalLoad, TiltedLoad
from servofd.servo.loop import AFTER, BEFORE, INSIDE
from servofd.servo.physics import Physics
from servofd.servo.registry import catalogue, everything


def common_places(effects: tuple[type[Effect], ...]) -> tuple[float, ...]:
    """Where the slow pole may lie with all of some effects; empty if it does not matter to any."""
    placed = [effect for effect in effects if effect.places]
    if not placed:
        return ()
    # Beyond the loop a slow pole before it is one inside it, unless something within tells them apart.
    same = {BEFORE} if all(effect.slot is Slot.OUTPUT for effect in placed) else set()
    if SensorLag in effects:  # that and a slow pole after the loop are one thing
        same.add(AFTER)
    first, *others = (effect.places or () for effect in placed)
    return tuple(each for each in first if each not in same and all(each in other for other in others))


def judgeable(record: Record) -> tuple[list[type[Effect]], list[type[Effect]]]:
    """Effects that this record can judge, and those that need something it does not hold."""
    held = {*record.logged, *(["servo_load"] if record.pushed is not None else [])}
    if record.side is not None:
        shown = sorted((e for e in catalogue() if e.at_rest), key=lambda effect: effect.at_rest)
        return shown, [effect for effect in catalogue() if not effect.at_rest]
    able = [effect for effect in catalogue() if set(effect.needs) <= held]
    unable = [effect for effect in catalogue() if effect not in able and effect is not ExternalLoad]
    fitted = set(record.known.covers)
    if record.runs or "airspeed_m_s" in record.logged:
        # A surface's weight is balanced about its hinge, a bench's horn hangs at zero; an arm's joint hangs anywhere.
        fitted.add(TiltedLoad)
    if record.runs:  # frames run on between separate runs: at which instants is not known
        fitted.add(PwmFrame)
    # A converter whose steps do not show in the readings has none that matter.
    fitted |= {CommandSteps} if (record.step_deg or 0.0) >= COARSE_STEP_DEG else {Quantization}
    return [effect for effect in able if effect not in fitted], unable


def excluded(known: tuple[type[Effect], ...]) -> set[str]:
    """Names that cannot come on top of known effects: they are there already, in this form or another."""
    names = {effect.name for effect in known}
    other = {name for effect in known for name in effect.instead}
    return names | other | {effect.name for effect in everything() if names.intersection(effect.instead)}


def candidates(
    record: Record, able: list[type[Effect]], known: tuple[type[Effect], ...], place: float
) -> list[tuple[type[Effect], float]]:
    """What may come on top of known effects, and where the slow pole lies: a servo has one, in one place."""
    names = excluded(known)
    found = []
    for effect in able:
        if effect.name in names or effect is PwmFrame:
            continue
        where: tuple[float, ...] = (place,)
        if effect.places and record.model.has_places and record.side is None:
            where = common_places((*known, effect))
        found += [(effect, each) for each in where]
    return [each for each in found if each[1] != AFTER or SensorLag not in (*known, each[0])]


_SHORTEST_S, _LONGEST_S = 0.01, 0.055
"""Periods of frames that are searched [s]."""
_WINDOW_S = 4.0
"""Length of the first window [s]."""
_REMEMBERED_S = 1.5
"""Longest time that a command takes to the surface, with the longest frame before it."""
_ROUGHLY_S, _NEARLY_S, _PRECISELY_S = 3e-3, 1.5e-3, 4e-4
"""Between the phases that are tried in a window, for usual periods, and for one that is known: frames
that pick other commands are far off."""
_SHARE_OF_BEAT = 0.4
"""Step of the period, as a share of the change that moves the last frame of a window by one period."""
_ZOOM, _KEPT, _LIKELY = 3.0, 27, 24
"""Factor by which the window widens, frames that are kept, and usual frames that are compared over the whole
record."""
_WORSE_AT_FIRST, _WORSE = 100.0, 10.0
"""Squared noise by which frames may be worse than what is no frame: true ones, not yet met exactly, were better by 10
and 89 in the two windows where they were hardest to see, and where there were none, worse by 1300 and 2600."""
_SHIFTS = (-0.1, -0.04, 0.0, 0.04, 0.1)
"""Phases that are tried around the best, in units of the refinement."""
_FINER = (0.5, 0.2, 0.08, 0.03, 0.01)
"""Refinements of period and phase, one after the other."""
_USUAL_S = (*(k / 1000.0 for k in range(10, 26)), 0.004, 0.005, 0.03, 0.04, 0.05, 1 / 70, 1 / 60, 1 / 45, 1 / 150)
"""Whole milliseconds, and common frame rates that are not."""


def best_frame(
    record: Record, physics: Physics, rival_deg: FloatArray | None = None, sigma_deg: float = 0.0
) -> tuple[float, float] | None:
    """Period [s] and phase of the frames that explain a record best; None where a rival's error [deg] is much smaller.

    A window of length L tells periods T apart that differ by T²/L. They are tried at that spacing in the seconds with
    most motion, and those around the best in windows that are ever longer.
    """
    centre_s, kept = _busiest_s(record, _WINDOW_S), _KEPT
    windows_s = [_WINDOW_S, _WINDOW_S * _ZOOM]
    while windows_s[-1] < record.time_s[-1] - record.time_s[0]:
        windows_s.append(windows_s[-1] * _ZOOM)
    frames = _grid(_SHORTEST_S, _LONGEST_S, _WINDOW_S, _ROUGHLY_S)
    usual = [(period_s, phase) for period_s in _USUAL_S for phase in _phases(period_s, _NEARLY_S)]
    for window_s, worse in zip_longest(windows_s, (_WORSE_AT_FIRST, _WORSE)):
        part = _window(record, centre_s, window_s)
        losses = [_loss(part, physics, frame) for frame in frames]
        if rival_deg is not None and worse is not None:
            rival = rival_deg[np.isin(record.time_s, part.time_s[part.counts])]
            if min(losses) > float(rival @ rival) + worse * sigma_deg**2:
                return None
        best = [frames[k] for k in np.argsort(losses, kind="stable")[:kept]]
        if worse == _WORSE:
            usual.sort(key=lambda frame: _loss(part, physics, frame))
        kept = max(kept // 3, 1)
        frames = [frame for one in best for frame in _around(one, centre_s, window_s * _ZOOM)]
    found: tuple[float, float] = min([best[0], *usual[:_LIKELY]], key=lambda frame: _loss(record, physics, frame))
    for finer in _FINER:
        found = min(_around(found, centre_s, window_s, finer), key=lambda frame: _loss(record, physics, frame))
    turned = [(found[0], phase) for phase in _phases(found[0], _PRECISELY_S)]
    found = min([found, *turned], key=lambda frame: _loss(record, physics, frame))
    for finer in _FINER if found in turned else ():
        found = min(_around(found, centre_s, window_s, finer), key=lambda frame: _loss(record, physics, frame))
    return found


def _grid(shortest_s: float, longest_s: float, window_s: float, apart_s: float) -> list[tuple[float, float]]:
    """Periods that a window tells apart, each with phases so far apart."""
    periods = [shortest_s]
    while periods[-1] < longest_s:
        periods.append(periods[-1] * (1.0 + _SHARE_OF_BEAT * periods[-1] / window_s))
    return [(period, phase) for period in periods for phase in _phases(period, apart_s)]


def _phases(period_s: float, step_s: float) -> list[float]:
    """Evenly over a period, as shares of it."""
    count = int(np.ceil(period_s / step_s))
    phases: list[float] = ((np.arange(count) + 0.5) / count).tolist()
    return phases


def _around(
    frame: tuple[float, float], centre_s: float, window_s: float, finer: float = 1.0
) -> list[tuple[float, float]]:
    """Frames nearby; they are counted from 0 s, so that another period turns the phase in mid-window as well.

    Half a frame later nearly the same commands are picked, where two come in a frame: that is another hill.
    """
    period, phase = frame
    halves = (0.0, 0.5) if finer == 1.0 else (0.0,)
    frames = []
    for step in (period**2 / window_s * _SHARE_OF_BEAT * finer * np.arange(-4, 5)).tolist():
        turned = phase - centre_s / period + centre_s / (period + step)
        frames += [(period + step, (turned + half + finer * shift) % 1.0) for half in halves for shift in _SHIFTS]
    return frames


def _busiest_s(record: Record, window_s: float) -> float:
    """Middle of the window in which the position moves fastest [s]."""
    speed = np.gradient(simulate(record, record.model.physics), record.time_s)
    moved = np.where(record.counts, speed, np.nan)
    number = ((record.time_s - record.time_s[0]) / window_s).astype(int)
    spread = [np.nanstd(moved[number == k]) if np.isfinite(moved[number == k]).sum() > 50 else 0.0 for k in set(number)]
    return float(record.time_s[0] + (int(np.argmax(spread)) + 0.5) * window_s)


def _window(record: Record, centre_s: float, window_s: float) -> Record:
    inside = np.abs(record.time_s - centre_s) <= window_s / 2.0
    inside &= np.isfinite(record.measured_deg)
    counts = record.counts & (record.time_s >= record.time_s[inside][0] + 0.3)
    sent_s = record.commands.effective_s
    sent = slice(*np.searchsorted(sent_s, (record.time_s[inside][0] - _REMEMBERED_S, record.time_s[inside][-1])))
    commands = Commands(*(each[sent] for each in record.commands)) if sent_s[sent].size else record.commands
    return only(replace(record, commands=commands, counts=counts), np.flatnonzero(inside))


def _loss(part: Record, physics: Physics, frame: tuple[float, float]) -> float:
    error = (part.measured_deg - simulate(part, physics._replace(frame_s=frame[0], frame_phase=frame[1])))[part.counts]
    return float(error @ error)


OCCAM = 30.0
"""By how much a further name must improve the misfit."""
_POSSIBLE = 6.0
"""Improvement on the screen below which a candidate is not fitted."""
NAMES, FITS = 8, 10
"""Names and structures that are fitted from one base."""
_CLOSE, _SHARE = 60.0, 0.3
"""How far behind the best of its name a structure may be: so much, or that share of what it improves."""
LIMITS = ("rate_limit", "voltage_rate")
"""Effects that limit the speed."""
_LATE = (Delay, SensorLag, SlowDynamics)
"""Effects that make a servo late."""


class Search:
    """Of one record: what fits it, the effects that it can show, and all structures that were fitted.

    `part` fits the liveliest part of the record, which screens candidates.
    """

    def __init__(self, fitter: Fitter, able: list[type[Effect]], progress: Callable[[str], None]) -> None:
        root = fitter.root
        self.fitter, self.able, self.progress = fitter, able, progress
        self.visited, self._began = {root.key: root}, root.key
        self.grown: set[tuple[tuple[str, ...], float]] = set()
        self.part = Fitter(liveliest(fitter.record, fitter.judged((), root.physics).error_deg))
        self._count_alike()

    @property
    def root(self) -> Fit:
        """The servo without effects as it fits best."""
        return self.visited[self._began]

    def remember(self, fit: Fit) -> None:
        """Take the correlation of what a fit leaves for that of the noise, in all misfits."""
        self.fitter.remember(fit)
        self._count_alike()
        self.visited = {key: self.fitter.reweighed(each) for key, each in self.visited.items()}

    def _count_alike(self) -> None:
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
            fit = self.without(fit, fit.idle)
        if fit.key not in self.visited or fit.misfit < self.visited[fit.key].misfit:
            self.visited[fit.key] = fit
        return self.is_physical(fit)

    def is_physical(self, fit: Fit) -> bool:
        """Whether no number is at its bound, and none so small that it is none."""
        return not fit.ran_away and not self._too_small(fit)

    def _too_small(self, fit: Fit) -> list[int]:
        """Places of the effects of a fit that are so small that they are none."""
        neutral, small = self.fitter.record.model.physics, []
        for k, effect in enumerate(fit.effects):
            judged = [p for p in effect.parameters if p.smallest and not p.aside]
            sizes = [p.away(getattr(fit.physics, p.fields[0]), neutral) >= self.fitter.smallest(p) for p in judged]
            if sizes and not any(sizes):
                small.append(k)
        return small

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
        if loose:
            self.exchange(min(loose, key=lambda fit: fit.misfit), enough, len(base.effects))
        if fits:
            best = min(fits, key=lambda fit: fit.misfit)
            if best.effects[-1].name in LIMITS:  # what limits the speed, and how, passes for one another at each place
                limited = [fit for fit in fits if fit.effects[-1].name == best.effects[-1].name]
                for place in {fit.place for fit in limited}:
                    there = [fit for fit in limited if fit.place == place]
                    self.exchange(min(there, key=lambda fit: fit.misfit), enough, len(base.effects))
        if framed and PwmFrame in self.able and PwmFrame.name not in base.names:
            fits += self._framed(base, fits)
        return fits

    def _screened(self, start: Fit, shares: int) -> list[tuple[type[Effect], Physics]]:
        """What is worth fitting on top of a start, one of so many."""
        slopes = self.part.slopes(start)
        before = self.part.given_way(start.physics, slopes[:, :0])
        screened: list[tuple[float, type[Effect], Physics]] = []
        for effect, place in candidates(self.fitter.record, self.able, start.effects, start.place):
            if self.fitter.is_own(effect):
                continue
            self.progress(effect.key())
            misfit, physics = self.part.screened(start, slopes, effect, place)
            screened.append((misfit, effect, physics))
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

    def _fitted(self, effects: tuple[type[Effect], ...], start: Physics, enough: float = np.inf) -> Fit:
        fit = self.fitter.descended(effects, start, enough=enough)
        if not self.keep(fit) and not fit.ran_away:
            self._without_small(fit, enough)
        return fit

    def _without_small(self, fit: Fit, enough: float) -> None:
        """The rest of a fit, of which an effect that stood for another became nothing beside it."""
        rest = self.without(fit, self._too_small(fit))
        if rest.effects and rest.key not in self.visited:
            self._fitted(rest.effects, rest.physics, enough)

    def without(self, fit: Fit, places: Sequence[int]) -> Fit:
        """The servo as it is without some of its effects."""
        effects = tuple(effect for k, effect in enumerate(fit.effects) if k not in places)
        start = taken_off(fit.physics, self.fitter.record.model.physics, [fit.effects[k] for k in places])
        # The slow pole lies inside the loop where its place does not matter to any effect.
        is_placed = start.slow_place in common_places(effects)
        return replace(fit, effects=effects, physics=start if is_placed else start._replace(slow_place=INSIDE), idle=())

    def exchange(self, fit: Fit, enough: float, known: int = 0) -> None:
        """Each effect of a fit, but for so many that are known, in its other forms, started from what it came to.

        What sticks, is dead or loose passes for one another until each has been fitted as well, at each place; so do
        the ways in which a speed is limited.
        """
        record = self.fitter.record
        is_placed = record.model.has_places and record.side is None
        for k, effect in list(enumerate(fit.effects))[known:]:
            size = getattr(fit.physics, effect.parameters[0].fields[0])
            rest = (*fit.effects[:k], *fit.effects[k + 1 :])
            without = fit.physics._replace(**{name: getattr(record.model.physics, name) for name in fields_of(effect)})
            is_loose = effect.family == "hysteresis"
            for other in self.able:
                if other.name in excluded(rest) or not (_is_like(effect, other) or (is_loose and other is effect)):
                    continue
                into = [size * _half(other) / _half(effect), *(p.grid[0] for p in other.parameters[1:])]
                if other.name in LIMITS:  # as fast in either direction
                    into = [size] * len(other.parameters)
                for place in (common_places((*rest, other)) or (INSIDE,)) if is_placed and is_loose else (fit.place,):
                    start = installed(without._replace(slow_place=place), [other], into)
                    self._fitted((*rest, other), start, enough)

    def _framed(self, base: Fit, fits: list[Fit]) -> list[Fit]:
        """The base with pulse frames, if its own delay is a strange one, or what makes it late helps it.

        Frames make it late by half of one: they are looked for beside a servo that is as usual.
        """
        late = min((fit.misfit for fit in fits if fit.effects[-1] in _LATE), default=np.inf)
        if base.misfit - late < OCCAM and not self.fitter.strains(Delay, base):
            return []
        self.progress(PwmFrame.key())
        record = self.fitter.record
        known = self.fitter.starts(base)[-1]._replace(delay_s=record.model.physics.delay_s)
        rival = self.fitter.judged((), min(fits, key=lambda fit: fit.misfit).physics)
        sigma = float(np.sqrt(rival.run_deg2.mean()))
        frame = best_frame(record, known, rival.error_deg, sigma)
        if frame is None:
            return []
        start = known._replace(frame_s=frame[0], frame_phase=frame[1])
        return [self._fitted((*base.effects, PwmFrame), start)]


def taken_off(physics: Physics, neutral: Physics, effects: Iterable[type[Effect]]) -> Physics:
    """A servo whose parameters of some effects are neutral."""
    fields = [name for effect in effects for p in effect.parameters for name in p.fields]
    return physics._replace(**{name: getattr(neutral, name) for name in fields})


def fields_of(effect: type[Effect]) -> tuple[str, ...]:
    """Of `Physics`, those that an effect sets."""
    return (*(name for p in effect.parameters for name in p.fields), *effect.fixed)


def _half(effect: type[Effect]) -> float:
    """Friction is given by half the width within which a servo may rest, the others by all of it."""
    return 0.5 if effect.parameters[0].fields[0] == "friction_deg" else 1.0


def _is_like(effect: type[Effect], other: type[Effect]) -> bool:
    """Whether two effects are ways of sticking, being dead or loose, or of limiting one speed, of one size."""
    if effect.family == "hysteresis" or other.family == "hysteresis":
        return effect is not other and effect.family == other.family
    return effect is not other and effect.name == other.name and effect.name in LIMITS


def load_slope(record: Record, fit: Fit) -> float:
    """Slope of a load's torque where the servo works, over the steepest one: a cosine."""
    return float(np.cos(np.radians(np.nanmean(record.measured_deg) - fit.physics.hangs_deg)))


STEPS_OF_TWO_SIZES = "steps of two sizes, such as 5 and 20 deg"
_HOLDS_S, _MOSTLY = 0.15, 0.8
"""How long a command stands between steps, and for how much of its time it does."""
_ALIKE, _SMALLEST_SHARE = 1.3, 0.02
"""Ratio of the largest step to the smallest; what is smaller than that share of the largest is none."""


def step_size_deg(record: Record) -> float | None:
    """Size of the steps, if all that was asked is steps, each as large as any other."""
    found = [_steps(run.commands, float(run.time_s[-1])) for run in record.runs or (record,)]
    if any(sizes is None for sizes in found):
        return None
    sizes_deg = np.concatenate([sizes for sizes in found if sizes is not None])
    sizes_deg = sizes_deg[sizes_deg > _SMALLEST_SHARE * np.max(sizes_deg, initial=0.0)]
    alike = sizes_deg.size > 0 and float(sizes_deg.max()) < _ALIKE * float(sizes_deg.min())
    return float(np.median(sizes_deg)) if alike else None


def _steps(commands: Commands, end_s: float) -> FloatArray | None:
    """Sizes of the steps between the places where a command stands [deg]; None if it mostly moves."""
    if commands.slope_deg_s.any():
        return None
    first = np.flatnonzero(np.diff(commands.command_deg, prepend=np.nan) != 0.0)
    times_s, levels_deg = commands.effective_s[first], commands.command_deg[first]
    lasts_s = np.diff(np.append(times_s, max(end_s, float(commands.effective_s[-1]))))
    stands = lasts_s > _HOLDS_S
    if float(lasts_s[stands].sum()) < _MOSTLY * float(lasts_s.sum()):
        return None
    return np.abs(np.diff(levels_deg[stands]))
