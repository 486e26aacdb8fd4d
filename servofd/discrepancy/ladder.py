"""The ladder from the nominal servo to the best, what was defeated at each step, and what cannot be told apart."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from servofd.discrepancy.evidence import EXCESS_WORTH, floor_of, matters
from servofd.discrepancy.noise import long_run_factor
from servofd.discrepancy.prune import without
from servofd.models.catalogue import Quantization

if TYPE_CHECKING:
    from servofd.discrepancy.fit import Fit, Fitter
    from servofd.models.catalogue import MissingEffect

__all__ = ["NO_MODEL_KNOWS", "Rung", "Tried", "equals_of", "keys_of", "rungs_of", "simplest", "told"]

_TIE_CHI_SQUARED, _EVEN_CHI_SQUARED = 10.0, 4.0
"""Below the second, the data do not even hint at which it is, and the simplest is named."""
NO_MODEL_KNOWS = 0.015
"""Share of what an effect moves by which two fits may differ and mean the same: what acts on a servo is no better
measured, and the laws of effects are no better known."""
_CLEAR_CHI_SQUARED = 30.0
"""In units of what stays, whatever it is: the better of a family is named, though the other is still possible."""
_TIE_OF_EXCESS = 0.15
"""Where something stays unexplained, two effects that differ by less than this share of it are not told apart, unless
that is as much of what they take away."""
_TIE_OF_KIND = 0.7
"""The same for two of one family, and for a rival of an effect with many minima, which had as many chances."""


_SMALL_MINIMA = 100.0
"""Where something sticks, fits of one servo end in minima up to 60 squared noises apart."""
_TOO_MANY = 5
"""Others in the place of an effect: no family of the catalogue is as large, so that the data say that something is
missing, and not what."""


@dataclass(frozen=True, slots=True, eq=False)
class Rung:
    """One effect added, and the ones that it defeated."""

    fit: Fit
    rivals: tuple[Fit, ...]


Tried = dict[tuple[str, ...], list["Fit"]]
"""Fits that have one effect more than the effects of the key."""


def keys_of(fit: Fit) -> tuple[str, ...]:
    """Names and forms of the effects, whatever their order."""
    return tuple(sorted(effect.key() for effect in fit.effects))


def rungs_of(
    fitter: Fitter,
    nominal: Fit,
    best: Fit,
    tried: Tried,
    able: list[type[MissingEffect]],
) -> tuple[Rung, ...]:
    """The ladder from the nominal servo to the best, refitted at each step, with what was defeated there."""
    rungs: list[Rung] = []
    base = nominal
    for k in range(1, len(best.effects) + 1):
        if k == len(best.effects):
            fit = best
        else:
            count = sum(len(effect.parameters) for effect in best.effects[:k])
            fit = fitter.refitted(best.effects[:k], best.values[:count].tolist())
        if keys_of(base) not in tried:
            tried[keys_of(base)] = fitter.with_effects(base, able, _quietly)
        others: dict[str, Fit] = {}
        for rival in sorted(tried[keys_of(base)], key=lambda r: r.held_out):
            if rival.names[-1] != fit.names[-1]:
                others.setdefault(rival.names[-1], rival)
        rungs.append(Rung(fit, tuple(others.values())))
        base = fit
    return tuple(rungs)


def equals_of(
    fitter: Fitter, best: Fit, able: list[type[MissingEffect]], tried: Tried, unknown: float = 0.0
) -> list[list[Fit]]:
    """For each effect, the fits with another one in its place that the data cannot tell from it.

    `unknown` is the share of what an effect moves to which laws and loads are not known, whatever the data say.
    """
    record, sigma = fitter.record, floor_of(fitter.record, best)
    factor = long_run_factor(best.error_deg[record.counts])
    left = max(best.total - float(record.counts.sum()) * sigma**2 * (1.0 + EXCESS_WORTH), 0.0)
    equals: list[list[Fit]] = []
    for k in range(len(best.effects)):
        if best.effects[k] is Quantization:  # seen in the readings themselves
            equals.append([])
            continue
        base = without(fitter, best, k)
        rivals = tried.get(keys_of(base)) or fitter.with_effects(base, able, _quietly)
        tried[keys_of(base)] = rivals
        taken, unsure = base.total - best.total, min(left, base.total - best.total)
        common = max(_TIE_CHI_SQUARED * sigma**2 * factor, unknown**2 * taken)
        near = _SMALL_MINIMA * sigma**2 * factor
        rivals = [_beside(fitter, best, k, r) if common < r.total - best.total < near else r for r in rivals]
        tried[keys_of(base)] = rivals
        equals.append(
            [
                rival
                for rival in rivals
                if rival.names[-1] not in best.names
                and _behind(fitter, rival, best, near) < max(common, _slack(best.effects[k], rival) * unsure)
                and not any(p.at_bound(v) for p, v in zip(rival.parameters, rival.values, strict=True))
            ]
        )
    return equals


def _behind(fitter: Fitter, rival: Fit, best: Fit, near: float) -> float:
    """What a rival leaves more than an effect [deg^2]; if that is not much, with both fitted to all samples.

    What was fitted to half of them foretells the others by luck, too: where few samples reach a limit, more of it than
    they tell one law from another.
    """
    behind = rival.total - best.total
    if fitter.record.runs or fitter.record.free_poles or abs(behind) > near:
        return behind
    return fitter.total_on_all(rival) - fitter.total_on_all(best)


def _beside(fitter: Fitter, best: Fit, index: int, rival: Fit) -> Fit:
    """The rival of an effect beside the others as they are beside it, if that is better: it begins where they ended."""
    first = sum(len(effect.parameters) for effect in best.effects[:index])
    values = np.delete(best.values, range(first, first + len(best.effects[index].parameters)))
    own = rival.values[-len(rival.effects[-1].parameters) :]
    effects = (*best.effects[:index], *best.effects[index + 1 :], rival.effects[-1])
    return min(rival, fitter.refitted(effects, [*values, *own]), key=lambda fit: fit.total)


def told(fitter: Fitter, best: Fit, able: list[type[MissingEffect]], tried: Tried) -> Fit:
    """Without what comes after the first effect and could be anything: something is there, but nothing names it.

    Whole runs that were held out vouch for what was found in others.
    """
    while not fitter.record.runs:
        offered = [{fit.names[-1] for fit in each} for each in equals_of(fitter, best, able, tried)]
        vague = [k for k, names in enumerate(offered) if k > 0 and len(names) >= _TOO_MANY]
        if not vague:
            break
        best = without(fitter, best, vague[-1])
    return best


def _slack(effect: type[MissingEffect], rival: Fit) -> float:
    """Share of what stays unexplained by which a rival may be worse than an effect and still pass for it."""
    alike = effect.family != "" and effect.family == rival.effects[-1].family
    return _TIE_OF_KIND if alike or (_is_kinked(effect) and not _is_kinked(rival.effects[-1])) else _TIE_OF_EXCESS


def simplest(fitter: Fitter, best: Fit, able: list[type[MissingEffect]], tried: Tried) -> Fit:
    """The same servo in the simplest of the words that fit equally well."""
    for k in range(len(best.effects)):
        if _is_kinked(best.effects[k]):
            smooth = [r for r in equals_of(fitter, best, able, tried)[k] if not _is_kinked(r.effects[-1])]
            best = min((r for r in smooth if matters(fitter.record, r)), key=lambda r: r.total, default=best)
    margin = _EVEN_CHI_SQUARED * floor_of(fitter.record, best) ** 2
    near = _SMALL_MINIMA / _EVEN_CHI_SQUARED * margin
    for effect, equals in zip(best.effects, equals_of(fitter, best, able, tried), strict=True):
        before = [r for r in equals if able.index(r.effects[-1]) < able.index(effect)]
        alike = [r for r in before if effect.family == r.effects[-1].family != "" and not _is_worse(fitter, r, best)]
        even = [r for r in before if r in alike or _behind(fitter, r, best, near) < margin]
        if even:
            return simplest(fitter, min(even, key=lambda r: able.index(r.effects[-1])), able, tried)
    return best


def _is_worse(fitter: Fitter, rival: Fit, best: Fit) -> bool:
    """Whether one of a family leaves more than another by what no chance in the rest itself makes of it."""
    counts = fitter.record.counts
    chance = best.total / max(int(counts.sum()), 1) * long_run_factor(best.error_deg[counts])
    return rival.total - best.total > _CLEAR_CHI_SQUARED * chance


def _is_kinked(effect: type[MissingEffect]) -> bool:
    return any(parameter.kinked for parameter in effect.parameters)


def _quietly(_step: str) -> None:
    """Tell nobody."""
