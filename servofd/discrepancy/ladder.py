"""The ladder of steps to what was found: one effect more each time, and less error on data that it did not see."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

from servofd.discrepancy.fit import Fit
from servofd.discrepancy.search import Search, common_places, taken_off
from servofd.servo.effect import Effect

_FALLS, BETTER, _SWAPS, _RIVALS = 0.999, 0.97**2, 4, 4
"""Of the mean square on two folds, each predicted from the other: what a step must fall below, of the one before it, or
what a rival must, of the step in whose place it stands, to be taken instead; so often, and of so many likely rivals."""


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A servo with one effect more than the one before."""

    fit: Fit
    rivals: tuple[Fit, ...]
    """Servos with another effect in its place, best first."""


def climbed(search: Search, best: Fit) -> tuple[Step, ...]:
    """The ladder to the best, or to what has as few or fewer names and is predicted better.

    A rival in the place of a step that leaves less on data that neither was fitted to is the better step.
    """
    for _ in range(_SWAPS):
        steps = _steps(search, best)
        better = [
            rival
            for step in steps
            for rival in step.rivals
            if rival.held_out < BETTER * step.fit.held_out and rival.held_out < BETTER * steps[-1].fit.held_out
        ]
        if not better:
            break
        best = min(better, key=lambda fit: fit.held_out)
    return steps


def _steps(search: Search, best: Fit) -> tuple[Step, ...]:
    """From the servo as it is known to the best, the effect that helps most first; each step must lower the error.

    That is the one of two folds, each predicted from the other. Of the orders in which it falls at every step that is
    taken which comes to most effects; an effect that lowers it in no order is not named.
    """
    halves: dict[frozenset[type[Effect]], Fit] = {}

    def held_out(effects: tuple[type[Effect], ...]) -> Fit:
        key = frozenset(effects)
        if key not in halves:
            halves[key] = search.fitter.halved(replace(prefix(search, best, effects), effects=effects))
        return halves[key]

    def climb(known: tuple[type[Effect], ...], before: float) -> tuple[type[Effect], ...]:
        longest = known
        left = [effect for effect in best.effects if effect not in known]
        for effect in sorted(left, key=lambda effect: held_out((*known, effect)).held_out):
            there = held_out((*known, effect)).held_out
            if there >= _FALLS * before:
                break
            way = climb((*known, effect), there)
            longest = max(longest, way, key=len)
            if len(longest) == len(best.effects):
                break
        return longest

    order = climb((), search.fitter.nominal().held_out)
    steps = []
    for count in range(1, len(order) + 1):
        fit = replace(held_out(order[:count]), effects=order[:count])
        steps.append(Step(fit, _rivals(search, fit)))
    return tuple(steps)


def _rivals(search: Search, fit: Fit) -> tuple[Fit, ...]:
    """Servos with another effect in the place of the last one, best first."""
    known, last = Counter(fit.names[:-1]), fit.names[-1]
    rivals: dict[str, Fit] = {}
    for other in sorted(search.visited.values(), key=lambda each: each.misfit):
        rest = list((Counter(other.names) - known).elements())
        if len(other.effects) == len(fit.effects) and len(rest) == 1 and rest[0] != last and search.is_physical(other):
            effect = next(each for each in other.effects if each.name == rest[0])
            others = (each for each in other.effects if each is not effect)
            rivals.setdefault(rest[0], replace(other, effects=(*others, effect)))
    shown = [search.fitter.halved(each) for each in list(rivals.values())[:_RIVALS]]
    return tuple(sorted(shown, key=lambda each: each.held_out))


def prefix(search: Search, best: Fit, effects: tuple[type[Effect], ...]) -> Fit:
    """The servo with some of its effects."""
    if len(effects) == len(best.effects):
        return best
    keys, is_anywhere = tuple(sorted(effect.key() for effect in effects)), best.place not in common_places(effects)
    known = [fit for (of, place), fit in search.visited.items() if of == keys and (place == best.place or is_anywhere)]
    if known:
        return min(known, key=lambda fit: fit.misfit)
    gone = [effect for effect in best.effects if effect not in effects]
    fit = search.fitter.descended(effects, taken_off(best.physics, search.fitter.record.model.physics, gone))
    search.keep(fit)
    return fit
