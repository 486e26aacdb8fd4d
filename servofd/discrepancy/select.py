"""Which effects are missing: structures are tried, each with the servo's own numbers refitted, and weighed together.

A structure is a set of effects and the place of the servo's slow pole. Those that screening makes likely are fitted;
a name must beat every structure that does without it by a wide margin (Occam's window), and structures of as many names
share the probability by their misfit and number of parameters (BIC, with samples counted over their memory). The
probability of a name is the sum over its places and forms.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from servofd.core.statistics import LEAST_DIVISOR
from servofd.core.types import FloatArray
from servofd.discrepancy.adequacy import Adequacy, adequacy, floor_of
from servofd.discrepancy.fit import LONG, OWN_FIELDS, Fit, Fitter
from servofd.discrepancy.ladder import BETTER, Step, climbed
from servofd.discrepancy.record import Record
from servofd.discrepancy.search import (
    LIMITS,
    OCCAM,
    Search,
    common_places,
    fields_of,
    judgeable,
    load_slope,
    step_size_deg,
    taken_off,
)
from servofd.servo.catalogue import by_condition, is_law, plain
from servofd.servo.effect import Effect
from servofd.servo.effects.linkage import Gain
from servofd.servo.effects.motor import MotorRate
from servofd.servo.effects.own import SlowDynamics
from servofd.servo.effects.sensor import Bias
from servofd.servo.effects.shaft import AirLoad, GravityLoad, TiltedLoad

_MOST, _MOST_ON_BENCH = 3, 4
"""Effects; one more where whole runs are held out, which no flexible combination survives for long."""
_BEAM = 3
"""Structures of a size from which larger ones are grown."""
_OCCAM_OWN, _OF_GAP, _OF_SAMPLES = 16.0, 1e-4, 0.02
"""By how much one more of the servo's own numbers, which the prior has held back, must improve the misfit; and the
share of what was there (as chi-squared) on top, at most that share of the samples."""
_POLISHED, _PAIRED, _VARIED, _LAW = 2, 1, 2, 16.0
"""Structures that are fitted to the end, that are so from a servo of two poles, too, and that are tried with a size
that goes with a condition of the runs; minus twice the logarithm of how rarely it does."""
_NO_GAIN = 40.0
"""The same of a gain in place of a load, at most."""
_USUAL_GAINS = 3.0
"""So many of these deviations a servo may be off before its gain stands for something that is missing."""
_NO_WORSE, _MOST_LEFT = 0.95, 0.5
"""Of the held-out mean square of what was found, that of a linear servo which is better; and the share of what that one
leaves beyond the noise that effects may leave and still be an answer."""
_MODEL_RATIO, _MODEL_SHARE = 1.5, 0.02
"""Where a servo leaves more than so many times the noise, its misfit is not right to that share for each effective
sample: errors that differ by 5 % tell no names apart."""
_FAR_WORSE, _OF_STEP = 0.75, 0.02
"""Share of what a slow servo leaves beyond the noise that tells a limit of the speed from it by shape, if it is that
share of a step too: real servos differ from a linear one by as much."""
_DECLARED_AT_REST = 0.99
"""The same where only rests are judged, which tell play, dead band and friction apart by their noise alone."""
_DECLARED = 0.95
"""Share of the probability that the declared names of one log hold: most logs leave no doubt, so that over all logs
they hold 99.5 % (251 logs of even seeds, where 8.0 first names should be wrong and 10 are)."""
Rivals = dict[str, dict[str, Fit]]
"""For each effect of a servo what may stand in its place, and the servos that have it."""


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """What was found in one record."""

    nominal: Fit
    steps: tuple[Step, ...]
    rivals: Rivals
    """What the data cannot tell from an effect, and the servos that have it instead; only of those of which some is."""
    unjudged: tuple[type[Effect], ...]
    """Effects that need what the log does not hold."""
    covariance: FloatArray
    fitter: Fitter
    """What fitted it."""
    final: Fit
    """The servo with all effects."""
    adequacy: Adequacy
    """What of its errors is not noise."""

    @property
    def sigma_deg(self) -> float:
        """Noise floor."""
        return self.adequacy.floor_deg

    @property
    def ties(self) -> tuple[tuple[str, ...], ...]:
        """Effects that the data cannot tell apart, the named one first."""
        return tuple((name, *others) for name, others in self.rivals.items())


def select(
    record: Record, progress: Callable[[str], None] = lambda _step: None, begun: Fitter | None = None
) -> Selection:
    """Find the effects that are missing; `begun` may have fitted linear servos to what of it is searched."""
    return concluded(searched(record, progress, begun))


def searched(
    record: Record, progress: Callable[[str], None] = lambda _step: None, begun: Fitter | None = None
) -> Search:
    """All structures that come into question, fitted."""
    fitter = begun or Fitter(record.searched)
    search = Search(fitter, judgeable(record)[0], progress)
    _widened(search)
    return search


def concluded(search: Search) -> Selection:
    """What a search comes to."""
    fitter = search.fitter
    record = fitter.record
    best = _chosen(search)
    search.remember(best)
    best = _chosen(search)
    nominal = fitter.nominal()
    names = _shares(search, best, fitter.reweighed(nominal))
    linear = _better_linear(search, names[0])
    if linear is not None:
        names = [linear]
    steps = climbed(search, names[0])
    final = steps[-1].fit if steps else fitter.halved(search.root)
    found = adequacy(record, final)
    rivals = _ties(final, [fit for fit in names if set(fit.names) != set(final.names)], steps)
    step_deg = step_size_deg(record)
    if step_deg is not None:
        _or_slow(search, final, rivals, step_deg)
    return Selection(
        nominal,
        steps,
        {name: each for name, each in rivals.items() if each},
        tuple(judgeable(record)[1]),
        fitter.covariance(final),
        fitter,
        final,
        found,
    )


def _widened(search: Search) -> None:
    """Forward with a beam, and back: what came first may stand in for what is found later."""
    record = search.fitter.record
    beam, best = [search.root], search.root
    for size in range(_MOST_ON_BENCH if record.runs else _MOST):
        for base in beam:
            least = min(f.misfit for f in search.visited.values())
            search.grow(base, least + 40.0, framed=base is beam[0])
            if base is best and _suffices(search, best, size + 1):
                break
        # The correlation of what the best leaves is that of the noise; without an effect there is more.
        search.remember(min(search.visited.values(), key=lambda fit: fit.misfit))
        best, beam = search.visited[best.key], []
        _polished(search, size + 1)
        _by_condition(search, size + 1)
        longer = _best_of_size(search, size + 1)
        for fit in longer[:1]:  # without each of its effects, and with others in their place
            for k in range(len(fit.effects) - bool(record.known.starts)):
                fewer = _without(search, fit, k)
                if size + 1 > 1 and fit.misfit < best.misfit - _window(search, best, fit):
                    search.grow(fewer, min(f.misfit for f in search.visited.values()) + 40.0)
        best = search.visited[best.key]
        longer = _best_of_size(search, size + 1)
        if not longer:
            return
        if _needed(search, best, longer):
            best = longer[0]
        elif record.runs or not record.known.starts or _beyond_noise(search, longer[0]) == 0.0:
            return
        # Without an effect the errors are correlated, so that few samples count: in a single run of an unknown
        # servo, where more than noise is left, go on.
        beam = [fit for fit in longer[:_BEAM] if fit.misfit < longer[0].misfit + 4.0 * OCCAM]


def _suffices(search: Search, best: Fit, size: int) -> bool:
    """Whether a servo that is known leaves nothing but noise, and nothing that came on top of it helps by much."""
    fitter = search.fitter
    if not best.effects or fitter.record.known.starts or fitter.record.runs:
        return False
    longer = _best_of_size(search, size)
    if longer and longer[0].misfit < best.misfit - 0.5 * OCCAM:
        return False
    return not adequacy(fitter.record, fitter.judged(best.effects, best.physics)).reasons


def _polished(search: Search, size: int) -> None:
    """Fit the likeliest structures of a size to the end, from where they are and with the best one's own numbers."""
    likely = _best_of_size(search, size)[:_POLISHED]
    for fit in likely:
        like = [fit.physics] if fit is likely[0] else [fit.physics, likely[0].physics]
        taken = {name for effect in fit.effects for name in fields_of(effect)}
        for own in like:
            changes = {name: getattr(own, name) for name in OWN_FIELDS if name not in taken}
            search.keep(search.fitter.descended(fit.effects, fit.physics._replace(**changes), LONG))
    record = search.fitter.record
    if record.known.starts and record.model.has_places:
        for fit in likely[:_PAIRED]:
            search.keep(search.fitter.descended(fit.effects, search.fitter.as_a_pair(fit.physics), LONG))


def _by_condition(search: Search, size: int) -> None:
    """The likeliest structures of a size with one of their effects going with a condition of the runs."""
    fitter = search.fitter
    for fit in _best_of_size(search, size)[:_VARIED]:
        if any(is_law(effect) for effect in fit.effects):
            continue
        for k, effect in enumerate(fit.effects):
            if not effect.varies:
                continue
            value = getattr(fit.physics, effect.parameters[0].fields[0])
            for number, name in enumerate(fitter.record.condition_names):
                search.progress(f"{effect.key()} by {name}")
                law = by_condition(effect, number, name)
                effects = (*fit.effects[:k], law, *fit.effects[k + 1 :])
                scale = 1.0 if effect.parameters[0].low < 0.0 else abs(value)
                tried = [
                    fit.physics._replace(**law.fixed, run_slope=share * scale) for share in law.parameters[-1].grid
                ]
                errors = [fitter.given_way(physics, np.zeros((0, 0))) for physics in tried]
                search.keep(fitter.descended(effects, tried[int(np.argmin(errors))], LONG))


def _without(search: Search, fit: Fit, k: int) -> Fit:
    """The servo without one of its effects, started from where it is with it."""
    start = search.without(fit, [k])
    known = search.visited.get(start.key)
    found = search.fitter.descended(start.effects, start.physics)
    search.keep(found)
    return found if known is None or found.misfit < known.misfit else known


def _best_of_size(search: Search, size: int) -> list[Fit]:
    """The best fit of each set of names of a size, best first."""
    fits = [fit for fit in search.visited.values() if len(fit.effects) == size and search.is_physical(fit)]
    best: dict[tuple[str, ...], Fit] = {}
    for fit in sorted(fits, key=lambda fit: _cost(search, fit)):
        best.setdefault(tuple(sorted(fit.names)), fit)
    return list(best.values())


def _cost(search: Search, fit: Fit) -> float:
    """BIC, and how surprising its names are."""
    count = sum(len(effect.parameters) for effect in fit.effects)
    surprise = sum(effect.surprise for effect in fit.effects)
    record = search.fitter.record
    surprise += min((_static_loss(record, fit) / record.known.gain_share) ** 2, _NO_GAIN)
    laws = _LAW * sum(is_law(effect) for effect in fit.effects)
    return fit.misfit + count * float(np.log(max(search.fitter.effective, 2.0))) + surprise + laws


def _static_loss(record: Record, fit: Fit) -> float:
    """By what share a servo at rest misses what it was sent to: by its gain, or by what loads it.

    A surface gives way to the air by some percent (hinge moments of 0.02 deg per deg at 300 Pa), and its weight is
    balanced; the horn of a bench, with its runs, carries any load.
    """
    loss = fit.physics.gain - 1.0 if Gain in fit.effects else 0.0
    if record.runs:
        return loss
    if AirLoad in fit.effects and "airspeed_m_s" in record.logged:
        # What is kept under the name of the airspeed is its dynamic pressure.
        loss += fit.physics.airload_per_pa * float(np.median(record.logged["airspeed_m_s"]))
    if GravityLoad in fit.effects or TiltedLoad in fit.effects:
        loss += float(np.radians(fit.physics.droop_deg)) * load_slope(record, fit)
    return loss


def _window(search: Search, fewer: Fit, more: Fit) -> float:
    """By how much the misfit must fall for a further name."""
    if all(search.fitter.is_own(effect) for effect in more.effects if effect.name not in fewer.names):
        return _OCCAM_OWN
    return OCCAM + _tolerance(search, more)


def _tolerance(search: Search, fit: Fit, before: Fit | None = None) -> float:
    """Misfit that no model of a real servo, and no other simulator, is right to: a share of what was there before."""
    count = search.fitter._count / search.fitter.kappa
    root = search.root if before is None else before
    gap = float(count @ np.maximum(root.run_deg2 / (fit.run_deg2 + search.fitter._least) - 1.0, 0.0))
    return min(_OF_GAP * gap, _OF_SAMPLES * float(count.sum()))


def _needed(search: Search, best: Fit, longer: list[Fit]) -> bool:
    """Whether longer structures, or what nearly equals the best of them, beat one with fewer names by the window."""
    return any(
        fit.misfit < best.misfit - _window(search, best, fit) * (len(fit.effects) - len(best.effects))
        for fit in longer
        if _cost(search, fit) < _cost(search, longer[0]) + OCCAM
    )


def _chosen(search: Search) -> Fit:
    """The best structure of as many names as are needed."""
    best = search.root
    for size in range(1, _MOST_ON_BENCH + 1):
        longer = _best_of_size(search, size)
        if _needed(search, best, longer):
            best = longer[0]
    return best


def _better_linear(search: Search, best: Fit) -> Fit | None:
    """Of an unknown servo, the linear one with any gain and zero, if it predicts more than what was found.

    So too where that one leaves no more than noise with a gain that servos have, and where what was found leaves most
    of what it leaves: names are no answer then.
    """
    fitter, record = search.fitter, search.fitter.record
    if not record.known.starts:
        return None
    root = search.root
    is_usual = abs(root.physics.gain - 1.0) <= _USUAL_GAINS * record.known.gain_share
    if is_usual and not adequacy(record, fitter.halved(root)).reasons:
        return root
    fits = [fitter.descended(effects, root.physics, LONG) for effects in ((Bias,), (Gain,), (Bias, Gain))]
    found = [root, *(fit for fit in fits if search.is_physical(fit))]
    halves = [fitter.halved(fit) for fit in found]
    least = min(half.held_out for half in halves)
    k = next(k for k, half in enumerate(halves) if _NO_WORSE * half.held_out <= least)
    linear, halved = found[k], fitter.halved(best)
    worse = halves[k].held_out < _NO_WORSE * halved.held_out
    if best.effects and not worse and adequacy(record, halved).reasons:
        worse = _share_of_excess(search, linear, best) < 1.0 - _MOST_LEFT
    if not worse:
        return None
    search.keep(linear)
    return linear


def _share_of_excess(search: Search, fewer: Fit, best: Fit) -> float:
    """Of what a servo without an effect leaves beyond the noise, how much the effect takes away."""
    fitter = search.fitter
    before, after = (fitter.halved(fit).held_out for fit in (fewer, best))
    excess = before - floor_of(fitter.record, fitter.judged(best.effects, best.physics)) ** 2
    return (before - after) / excess if excess > 0.0 else 0.0


def _shares(search: Search, best: Fit, nominal: Fit) -> list[Fit]:
    """Fits of each set of names that belongs to those that share 95 % of the probability, likeliest first."""
    size = len(best.effects)
    weight: dict[tuple[str, ...], float] = {}
    first: dict[tuple[str, ...], Fit] = {}
    least = _cost(search, best)
    # Of the servo as it is known: a gain that is refitted stands in for much of a load, against its prior.
    tempered = 1.0 + max(_tolerance(search, best), _tolerance(search, best, nominal)) / OCCAM
    tempered += _MODEL_SHARE * _beyond_noise(search, best) * search.fitter.effective
    for fit in search.visited.values():
        if fit is not best and (len(fit.effects) != size or not search.is_physical(fit)):
            continue
        key = tuple(sorted(fit.names))
        share = float(np.exp(-0.5 * (_cost(search, fit) - least) / tempered))
        weight[key] = weight.get(key, 0.0) + share / _forms(search, fit)
        if key not in first or _cost(search, fit) < _cost(search, first[key]):
            first[key] = fit
    total, reached = sum(weight.values()), 0.0
    names: list[Fit] = []
    most = max(weight.values())
    declared = _DECLARED if search.fitter.record.side is None else _DECLARED_AT_REST

    def rank(key: tuple[str, ...]) -> tuple[float, int]:  # what is equal goes by the catalogue's order
        late = sum(search.able.index(plain(effect)) for effect in first[key].effects)
        return -round(float(np.log(max(weight[key] / most, LEAST_DIVISOR))), 1), late

    for key in sorted(weight, key=rank):
        if reached >= declared * total:
            break
        names.append(first[key])
        reached += weight[key]
    return names


def _beyond_noise(search: Search, best: Fit) -> float:
    """Share of what the best leaves that is no noise but its own error."""
    record = search.fitter.record
    whole = search.fitter.judged(best.effects, best.physics)
    return max(0.0, 1.0 - (_MODEL_RATIO * floor_of(record, whole)) ** 2 / max(whole.train, 1e-30))


def _forms(search: Search, fit: Fit) -> float:
    """How many structures the names of a fit may have, by which their probability is divided."""
    has_places = search.fitter.record.model.has_places and search.fitter.record.side is None
    most = 1
    for name in fit.names:
        forms = [effect for effect in search.able if effect.name == name]
        most = max(most, sum(max(len(common_places((form,))), 1) if has_places else 1 for form in forms))
    return float(most)


def _ties(best: Fit, others: list[Fit], steps: tuple[Step, ...]) -> Rivals:
    """What the data cannot tell from the effects of the best.

    Those of structures as likely; and what would have been the better step by itself but is not with those that follow.
    """
    rivals: Rivals = {name: {} for name in best.names}
    families = {effect.name: effect.family for effect in best.effects}
    for other in others:
        mine = [name for name in best.names if name not in other.names]
        for effect in [effect for effect in other.effects if effect.name not in best.names][: len(mine)]:
            like = next((name for name in mine if effect.family and families[name] == effect.family), mine[0])
            mine.remove(like)
            rivals[like].setdefault(effect.name, other)
    for step in steps:
        for rival in step.rivals:
            if rival.held_out < BETTER * step.fit.held_out:
                rivals[step.fit.names[-1]].setdefault(rival.names[-1], rival)
    return rivals


def _or_slow(search: Search, best: Fit, rivals: Rivals, step_deg: float) -> None:
    """Add what steps of one size do not tell: a slow servo and one whose speed is limited, unless one is far worse."""
    slow = SlowDynamics.name
    mine = next((effect for effect in best.effects if effect.name in (*LIMITS, slow)), None)
    if mine is None or {slow, *LIMITS} & set(rivals[mine.name]):
        return
    rest = tuple(effect for effect in best.effects if effect is not mine)
    if mine.name == slow:
        theirs, effects = MotorRate.name, (*rest, MotorRate)
        visited = [fit for fit in search.visited.values() if set(fit.effects) == set(effects)]
        rival = min(visited, key=lambda fit: fit.misfit, default=None)
    else:
        theirs = slow
        effects = rest if SlowDynamics in search.fitter.record.known.covers else (*rest, SlowDynamics)
        starts = (taken_off(best.physics, search.fitter.record.model.physics, [mine]), search.root.physics)
        rival = min((search.fitter.descended(effects, s, LONG) for s in starts), key=lambda fit: fit.misfit)
    if rival is None:
        return
    there, here = (search.fitter.halved(fit).held_out for fit in (rival, best))
    by_shape_deg = float(np.sqrt(max(there - here, 0.0)))
    if by_shape_deg <= _OF_STEP * step_deg or _share_of_excess(search, rival, best) <= _FAR_WORSE:
        rivals[mine.name][theirs] = rival
