"""Which effects are missing: forward with a beam, backward by significance, judged on blocks that were not fitted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from servofd.discrepancy.candidates import first_of_each, judgeable
from servofd.discrepancy.evidence import (
    accepted,
    cost,
    floor_of,
    least_scatter,
    rest_matters,
    stays_above_noise,
    worth_trying,
)
from servofd.discrepancy.fit import Fit, Fitter
from servofd.discrepancy.ladder import NO_MODEL_KNOWS, Rung, Tried, equals_of, keys_of, rungs_of, simplest, told
from servofd.discrepancy.poles import PoleFitter
from servofd.discrepancy.prune import convincing, ordered, pruned, with_steps, without
from servofd.discrepancy.run_by_run import vouched
from servofd.discrepancy.stamps import scatter_s
from servofd.models.catalogue import Quantization

if TYPE_CHECKING:
    from collections.abc import Callable

    from servofd.discrepancy.record import Record
    from servofd.models.catalogue import MissingEffect
    from servofd.types import FloatArray

__all__ = ["Rung", "Selection", "select", "unexplained"]

_BEAM, _WIDE_BEAM, _FEW = 2, 4, 2
"""The wide one where something stays, or a few effects are not enough: two simple ones may do as well."""
_NOT_MUCH_MORE = 2.0
_SAME_LOSS = 1e-3
"""Relative: the same servo in other words."""
_MOST_EFFECTS, _MOST_ON_BENCH = 4, 5
"""More where whole runs are held out, which no flexible combination survives for long."""


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """What was found in one record."""

    nominal: Fit
    rungs: tuple[Rung, ...]
    ties: tuple[tuple[str, ...], ...]
    """Effects that the data cannot tell apart, the named one first."""
    tied: tuple[tuple[Fit, ...], ...]
    """For each of these the fits with another effect in the place of the named one, in the same order."""
    sigma_deg: float
    """Noise floor."""
    unjudged: tuple[type[MissingEffect], ...]
    """Effects that need what the log does not hold."""
    covariance: FloatArray
    fitter: Fitter
    """What fitted it."""
    scatter_s: float = 0.0
    """Of time stamps, as far as the error of the final servo grows with its speed and has no sign [s]."""

    @property
    def simulations(self) -> int:
        """How many it took."""
        return self.fitter.simulations

    @property
    def final(self) -> Fit:
        """The servo with all effects."""
        return self.rungs[-1].fit if self.rungs else self.nominal


def select(record: Record, progress: Callable[[str], None] = lambda _step: None) -> Selection:
    """Find the effects that are missing.

    Parameters
    ----------
    record : Record
        What was asked and what happened.
    progress : callable
        Called with the name of each effect that was tried.
    """
    fitter = PoleFitter(record) if record.free_poles else Fitter(record)
    able, unable = judgeable(record)
    nominal = fitter.nominal()
    tried: Tried = {}
    most = _most_effects(record)
    # Where the poles are free, every start costs several fits, and each effect has had its chance from all of them.
    best = _grown(fitter, able, tried, _BEAM, progress, most if record.free_poles else _FEW)
    more = len(best.effects) == _FEW and worth_trying(record, best, floor_of(record, best))
    if not record.free_poles and (more or stays_above_noise(record, best)):
        wide = _grown(fitter, able, tried, _WIDE_BEAM, progress, most)
        best = min(best, wide, key=lambda fit: cost(record, fit))
    sure = convincing(fitter, pruned(fitter, _swapped(fitter, able, tried, best)), nominal)
    best = simplest(fitter, sure, able, tried)
    # A simpler word for an effect may be one that is not needed.
    best = ordered(fitter, with_steps(fitter, best if best is sure else pruned(fitter, best)))
    best = vouched(fitter, told(fitter, best, able, tried))
    best, final, covariance = _on_all(fitter, best)
    sigma = floor_of(record, best)
    rungs = rungs_of(fitter, nominal, best, tried, able)
    equal = [
        (effect, first_of_each(equals))
        for effect, equals in zip(best.effects, equals_of(fitter, best, able, tried, NO_MODEL_KNOWS), strict=True)
        if equals
    ]
    ties = tuple((effect.name, *(fit.names[-1] for fit in equals)) for effect, equals in equal)
    tied = tuple(fits for _, fits in equal)
    if rungs:
        rungs = (*rungs[:-1], Rung(final, rungs[-1].rivals))
    least = least_scatter(record, nominal, best, sigma)
    # Steps let readings stand while the surface does: that is no scatter of time stamps.
    scattered_s = 0.0 if Quantization in final.effects else scatter_s(record, final.error_deg, least)
    return Selection(nominal, rungs, ties, tied, sigma, tuple(unable), covariance, fitter, scattered_s)


def _most_effects(record: Record) -> int:
    return _MOST_ON_BENCH if record.runs else _MOST_EFFECTS


def _grown(
    fitter: Fitter,
    able: list[type[MissingEffect]],
    tried: Tried,
    width: int,
    progress: Callable[[str], None],
    most: int,
) -> Fit:
    """Forward search: the best few of each length go on."""
    record, best = fitter.record, fitter.nominal()
    beam = [best]
    for _ in range(most):
        sigma = floor_of(record, best)
        grown: list[Fit] = []
        for base in beam:
            if not worth_trying(record, base, sigma):
                continue
            fits = tried.get(keys_of(base)) or fitter.with_effects(base, able, progress)
            tried[keys_of(base)] = fits
            grown += [fit for fit in fits if accepted(record, base, fit, min(sigma, floor_of(record, fit)))]
            grown += _relieved(fitter, min(fits, key=lambda fit: cost(record, fit)))
        if not grown:
            break
        grown.sort(key=lambda fit: cost(record, fit))
        beam = _promising(record, _distinct(grown, able)[:width])
        first = None
        while (
            not record.free_poles and beam[0] is not first and worth_trying(record, beam[0], floor_of(record, beam[0]))
        ):
            # What was found first may stand in for two that are found now: not so late that nobody asks any more.
            first = beam[0]
            others = [fit for k in range(len(first.effects)) for fit in _exchanged(fitter, able, tried, first, k)]
            grown = sorted([*others, *beam], key=lambda fit: cost(record, fit))
            beam = _promising(record, _distinct(grown, able)[:width])
        if cost(record, beam[0]) < cost(record, best):
            best = beam[0]
        if not worth_trying(record, best, floor_of(record, best)):
            break
    return best


def _relieved(fitter: Fitter, fit: Fit) -> list[Fit]:
    """The fit without an effect that its last one made needless, which had stood in for it."""
    if len(fit.effects) < 3:
        return []
    fewer = [without(fitter, fit, k) for k in range(len(fit.effects) - 1)]
    return [each for each in fewer if cost(fitter.record, each) <= cost(fitter.record, fit)]


def _swapped(fitter: Fitter, able: list[type[MissingEffect]], tried: Tried, best: Fit) -> Fit:
    """With another effect in the place of one, if that is better: the first that was found is not always the right."""
    for k in range(len(best.effects)):
        others = _exchanged(fitter, able, tried, best, k)
        # The same servo in other words is not better, be it by a hair.
        best = _distinct(sorted((best, *others), key=lambda fit: cost(fitter.record, fit)), able)[0]
    return best


def _exchanged(fitter: Fitter, able: list[type[MissingEffect]], tried: Tried, best: Fit, k: int) -> list[Fit]:
    """With each of the other effects in the place of one, as far as that is any better than without it."""
    if len(best.effects) < 2:
        return []
    base = without(fitter, best, k)
    fits = tried.get(keys_of(base)) or fitter.with_effects(base, able, _quietly)
    tried[keys_of(base)] = fits
    return [fit for fit in fits if accepted(fitter.record, base, fit, floor_of(fitter.record, fit))]


def _on_all(fitter: Fitter, best: Fit) -> tuple[Fit, Fit, FloatArray]:
    """Fitted to all samples as well, without effects of which that drives a parameter to its bound."""
    while True:
        final, covariance = fitter.on_all(best)
        if not final.ran_away:
            return best, final, covariance
        best = without(fitter, best, final.ran_away[0])


def _quietly(_step: str) -> None:
    """Tell nobody."""


def _distinct(fits: list[Fit], able: list[type[MissingEffect]]) -> list[Fit]:
    """One fit for each set of names, and the simplest of those that move alike."""
    kept: list[Fit] = []
    for fit in fits:
        alike = [k for k, other in enumerate(kept) if abs(fit.total - other.total) < _SAME_LOSS * other.total]
        if not alike:
            kept += [] if any(sorted(fit.names) == sorted(other.names) for other in kept) else [fit]
        elif _words(fit, able) < _words(kept[alike[0]], able):
            kept[alike[0]] = fit
    return kept


def _words(fit: Fit, able: list[type[MissingEffect]]) -> tuple[int, int]:
    """How many effects, and how far down the catalogue, which begins with the simplest."""
    return len(fit.effects), sum(able.index(effect) for effect in fit.effects)


def _promising(record: Record, fits: list[Fit]) -> list[Fit]:
    """The first two, and of the others those that leave not much more than the first."""
    floor = float(record.counts.sum()) * floor_of(record, fits[0]) ** 2
    most = floor + _NOT_MUCH_MORE * max(fits[0].total - floor, 0.0)
    return fits[:_BEAM] + [fit for fit in fits[_BEAM:] if fit.total < most]


def unexplained(selection: Selection, record: Record) -> bool:
    """Whether more is left than noise, and more than a rounding of what was there; or noise that the motion makes."""
    return selection.scatter_s > 0.0 or rest_matters(record, selection.nominal, selection.final, selection.sigma_deg)
