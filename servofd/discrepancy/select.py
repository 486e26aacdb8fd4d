"""Which effects are missing: forward with a beam, backward by significance, judged on blocks that were not fitted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from servofd.discrepancy.fit import Fit, Fitter
from servofd.discrepancy.noise import long_run_factor, noise_floor_deg
from servofd.discrepancy.poles import PoleFitter
from servofd.discrepancy.record import simulate
from servofd.models.catalogue import CATALOGUE, Damping, PwmFrame, Quantization, SlowDynamics

if TYPE_CHECKING:
    from collections.abc import Callable

    from servofd.discrepancy.record import Record
    from servofd.models.catalogue import MissingEffect, Parameter
    from servofd.types import FloatArray

__all__ = ["Rung", "Selection", "select"]

Tried = dict[tuple[str, ...], list[Fit]]
"""Fits that have one effect more than the effects of the key."""

_BEAM, _WIDE_BEAM, _FEW = 2, 4, 2
"""The wide one where something stays, or more than a few effects seem to be needed: two simple ones may do as well."""
_SAME_LOSS = 1e-3
"""Relative: the same servo in other words."""
_MOST_EFFECTS, _MOST_ON_BENCH = 4, 5
"""More where whole runs are held out, which no flexible combination survives for long."""
_SHARE_OF_NOISE, _SHARE_OF_GAP = 0.03, 0.02
"""An effect must take away this share of the noise variance, and of the gap that is left."""
_CHI_SQUARED = 30.0
"""And this much of the held-out error in units of the noise: 25 effects and their grids are tried each time."""
_BLOCK_T = 3.0
_TIE_CHI_SQUARED, _EVEN_CHI_SQUARED = 10.0, 4.0
"""Below the second, the data do not even hint at which it is, and the simplest is named."""
_TIE_OF_EXCESS = 0.15
"""Where something stays unexplained, two effects that differ by less than this share of it are not told apart, unless
that is as much of what they take away."""
_TIE_OF_KIND = 0.7
"""The same for two of one family, and for a rival of an effect with many minima, which had as many chances."""
_USUAL_TRAVEL_DEG = 25.0
"""Of the surfaces for which the sizes of a linkage's curvature are typical."""
_SMALLEST_SIZE = 0.15
"""Of what is common on healthy servos: 0.5 ms of delay, 0.5 % of gain, 0.05 deg of play."""
_SURE_Z = 4.0
_LEAST_SHARE, _LEAST_SHARE_OF_REST = 0.1, 0.05
"""Beside a large unexplained rest, an effect that takes away less of the gap names nothing."""
_NODES = 15
_EXCESS_WORTH = 0.06
"""The floor itself is uncertain by 3 %."""
_EXCESS_OF_NOISE, _EXCESS_OF_GAP = 0.15, 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Rung:
    """One effect added, and the ones that it defeated."""

    fit: Fit
    rivals: tuple[Fit, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """What was found in one record."""

    nominal: Fit
    rungs: tuple[Rung, ...]
    ties: tuple[tuple[str, ...], ...]
    """Effects that the data cannot tell apart, the named one first."""
    sigma_deg: float
    """Noise floor."""
    unjudged: tuple[type[MissingEffect], ...]
    """Effects that need what the log does not hold."""
    covariance: FloatArray
    fitter: Fitter
    """What fitted it."""

    @property
    def simulations(self) -> int:
        """How many it took."""
        return self.fitter.simulations

    @property
    def final(self) -> Fit:
        """The servo with all effects."""
        return self.rungs[-1].fit if self.rungs else self.nominal


def _quietly(_step: str) -> None:
    """Tell nobody."""


def judgeable(record: Record) -> tuple[list[type[MissingEffect]], list[type[MissingEffect]]]:
    """Effects that this record can judge, and those that need something it does not hold."""
    held = {
        name
        for name, values in (("airspeed_m_s", record.pressure_pa), ("servo_voltage_v", record.voltage_v))
        if values is not None
    }
    able = [effect for effect in CATALOGUE if set(effect.needs) <= held]
    unable = [effect for effect in CATALOGUE if effect not in able]
    fitted = {SlowDynamics, Damping} if record.free_poles else set()
    # Frames run on between separate runs, so that nobody knows when each of them began.
    fitted |= {PwmFrame} if record.runs else set()
    return [effect for effect in able if effect not in fitted], unable


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
    best = _grown(fitter, able, tried, _BEAM, progress)
    if len(best.effects) > _FEW or _rest_is_large(record, best, nominal):
        best = min(best, _grown(fitter, able, tried, _WIDE_BEAM, progress), key=lambda fit: _cost(record, fit))
    best = _ordered(fitter, _simplest(fitter, _convincing(fitter, _pruned(fitter, best), nominal), able, tried))
    sigma = max(floor_of(record, best), _before_steps_deg(fitter, best))
    rungs = _rungs(fitter, nominal, best, tried, able)
    ties = tuple(
        (effect.name, *dict.fromkeys(fit.names[-1] for fit in equals))
        for effect, equals in zip(best.effects, _equals(fitter, best, able, tried), strict=True)
        if equals
    )
    final, covariance = fitter.on_all(best)
    if rungs:
        rungs = (*rungs[:-1], Rung(final, rungs[-1].rivals))
    return Selection(nominal, rungs, ties, sigma, tuple(unable), covariance, fitter)


def _grown(
    fitter: Fitter, able: list[type[MissingEffect]], tried: Tried, width: int, progress: Callable[[str], None]
) -> Fit:
    """Forward search: the best few of each length go on."""
    record, best = fitter.record, fitter.nominal()
    beam = [best]
    for _ in range(_MOST_ON_BENCH if record.runs else _MOST_EFFECTS):
        sigma = floor_of(record, best)
        grown: list[Fit] = []
        for base in beam:
            if not _worth_trying(record, base, sigma):
                continue
            fits = tried.get(_keys(base)) or fitter.with_effects(base, able, progress)
            tried[_keys(base)] = fits
            grown += [fit for fit in fits if _accepted(record, base, fit, min(sigma, floor_of(record, fit)))]
        if not grown:
            break
        grown.sort(key=lambda fit: _cost(record, fit))
        beam = _distinct(grown)[:width]
        if _cost(record, beam[0]) < _cost(record, best):
            best = beam[0]
        if not _worth_trying(record, best, floor_of(record, best)):
            break
    return best


def floor_of(record: Record, fit: Fit) -> float:
    """Noise floor as this fit shows it [deg]: no more than its own error."""
    return min(noise_floor_deg(record, fit.error_deg), float(np.sqrt(fit.total / max(record.counts.sum(), 1))))


def _rms(fit: Fit, record: Record) -> float:
    return float(np.sqrt(fit.train / max(record.trained.sum(), 1)))


def _keys(fit: Fit) -> tuple[str, ...]:
    return tuple(sorted(effect.key() for effect in fit.effects))


def _cost(record: Record, fit: Fit) -> float:
    """What ranks fits: the error on all samples, and a little for each parameter."""
    sigma = floor_of(record, fit)
    return fit.total + sigma**2 * len(fit.values) * float(np.log(max(int(record.counts.sum()), 2)))


def _distinct(fits: list[Fit]) -> list[Fit]:
    """One fit for each set of names, and one of those that move alike."""
    seen: dict[tuple[str, ...], Fit] = {}
    for fit in fits:
        if not any(abs(fit.total - other.total) < _SAME_LOSS * other.total for other in seen.values()):
            seen.setdefault(tuple(sorted(fit.names)), fit)
    return list(seen.values())


def _worth_trying(record: Record, base: Fit, sigma: float) -> bool:
    """Whether more is left than noise: more variance than the floor, or memory, which white noise does not have."""
    count = int(record.counts.sum())
    more = base.total / max(count, 1) / sigma**2 - 1.0
    error = base.error_deg[record.counts]
    power = max(float(error @ error), 1e-300)
    smooth = 0.5 * float(error[1:] @ error[:-1] + error[2:] @ error[:-2]) / power
    return more > _EXCESS_WORTH or smooth > max(_SHARE_OF_NOISE, 2.5 / np.sqrt(2.0 * max(count, 1)))


def _accepted(record: Record, base: Fit, fit: Fit, sigma: float) -> bool:
    """Whether an effect took enough away on samples it was not fitted to, and none of its parameters ran away."""
    gain = base.held_out - fit.held_out
    count = int(record.held_out.sum())
    gap = max(base.held_out - count * sigma**2, 0.0)
    if gain < max(_SHARE_OF_NOISE * count * sigma**2, _SHARE_OF_GAP * gap) or base.train <= fit.train:
        return False
    factor = long_run_factor(fit.error_deg[record.counts])
    if gain / (sigma**2 * factor) < _CHI_SQUARED:
        return False
    if gain / (sigma**2 * factor) < 4.0 * _CHI_SQUARED and _block_t(record, base, fit) < _BLOCK_T:
        return False
    return _matters(record, fit) and not any(p.at_bound(v) for p, v in zip(fit.parameters, fit.values, strict=True))


def _matters(record: Record, fit: Fit) -> bool:
    """Whether each effect differs from none by more than servos of one kind do from each other."""
    first, widening = 0, max(float(np.nanmax(np.abs(record.measured_deg))) / _USUAL_TRAVEL_DEG, 1.0)
    for effect in fit.effects:
        values = fit.values[first : first + len(effect.parameters)]
        first += len(effect.parameters)
        sizes = [
            p.away(float(v), record.plant.neutral) / p.typical * widening**p.travel_power
            for p, v in zip(effect.parameters, values, strict=True)
            if not p.aside
        ]
        if max(sizes) < _SMALLEST_SIZE:
            return False
    return True


def _block_t(record: Record, base: Fit, fit: Fit) -> float:
    """Mean improvement of a block over its standard error, on the held-out blocks."""
    where = record.held_out
    gains = np.bincount(record.block[where], weights=base.error_deg[where] ** 2 - fit.error_deg[where] ** 2)
    used = np.bincount(record.block[where]) > 0
    gains = gains[used]
    return float(gains.mean() / max(gains.std(ddof=1) / np.sqrt(gains.size), 1e-300)) if gains.size > 2 else 0.0


def _pruned(fitter: Fitter, best: Fit) -> Fit:
    """Without the effects that the others made needless."""
    while len(best.effects) > 1:
        fewer = [_without(fitter, best, k) for k in range(len(best.effects))]
        sigma = floor_of(fitter.record, best)
        loose = [fit for fit in fewer if not _accepted(fitter.record, fit, best, sigma)]
        if not loose:
            return best
        best = min(loose, key=lambda fit: fit.held_out)
    return best


def _rest_is_large(record: Record, fit: Fit, nominal: Fit) -> bool:
    """Whether more is left than noise, and more than a rounding of what was there."""
    sigma, count = floor_of(record, fit), max(float(record.counts.sum()), 1.0)
    left, gap = (max(each.total - count * sigma**2, 0.0) for each in (fit, nominal))
    return left > max(_EXCESS_OF_NOISE * count * sigma**2, _EXCESS_OF_GAP * gap)


def _convincing(fitter: Fitter, fit: Fit, nominal: Fit) -> Fit:
    """Without the effects whose size might be none, and those that matter little beside what stays unexplained."""
    record = fitter.record
    while fit.effects:
        sigma, count = floor_of(record, fit), max(float(record.counts.sum()), 1.0)
        factor = long_run_factor(fit.error_deg[record.trained])
        deviation = np.sqrt(np.maximum(np.diag(fitter.covariance(fit, _rms(fit, record), factor)), 1e-300))
        gap, rest_is_large = max(nominal.total - count * sigma**2, 0.0), _rest_is_large(record, fit, nominal)
        first, losses, sure = 0, [], []
        for k, effect in enumerate(fit.effects):
            size = slice(first, first + len(effect.parameters))
            first = size.stop
            away = [
                _kinked_or(p, p.away(float(v), record.plant.neutral) / d)
                for p, v, d in zip(effect.parameters, fit.values[size], deviation[size], strict=True)
                if not p.aside
            ]
            sure.append(max(away) > _SURE_Z)
            losses.append(_without(fitter, fit, k).total - fit.total if rest_is_large else np.inf)
        # Runs that were held out whole vouch for effects that matter to what is left, not only to all of the gap.
        least = _LEAST_SHARE * gap
        if record.runs:
            least = min(least, _LEAST_SHARE_OF_REST * max(fit.total - count * sigma**2, 0.0))
        weak = [k for k in range(len(losses)) if not sure[k] or losses[k] < least]
        if not weak:
            break
        fit = _without(fitter, fit, min(weak, key=lambda k: losses[k]))
    return fit


def _kinked_or(parameter: Parameter, size: float) -> float:
    """Curvature says nothing about a parameter with many minima."""
    return np.inf if parameter.kinked else size


def _without(fitter: Fitter, fit: Fit, index: int) -> Fit:
    effects = fit.effects[:index] + fit.effects[index + 1 :]
    first = sum(len(effect.parameters) for effect in fit.effects[:index])
    values = np.delete(fit.values, range(first, first + len(fit.effects[index].parameters)))
    return fitter.refitted(effects, values.tolist())


def _ordered(fitter: Fitter, fit: Fit) -> Fit:
    """The effect that would be missed most comes first."""
    if len(fit.effects) < 2:
        return fit
    losses = [_without(fitter, fit, k).held_out for k in range(len(fit.effects))]
    order = np.argsort(losses)[::-1].tolist()
    pieces = np.split(fit.values, np.cumsum([len(e.parameters) for e in fit.effects])[:-1])
    return fitter.judged(tuple(fit.effects[k] for k in order), np.concatenate([pieces[k] for k in order]).tolist())


def _rungs(
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
        if _keys(base) not in tried:
            tried[_keys(base)] = fitter.with_effects(base, able, _quietly)
        others: dict[str, Fit] = {}
        for rival in sorted(tried[_keys(base)], key=lambda r: r.held_out):
            if rival.names[-1] != fit.names[-1]:
                others.setdefault(rival.names[-1], rival)
        rungs.append(Rung(fit, tuple(others.values())))
        base = fit
    return tuple(rungs)


def _equals(fitter: Fitter, best: Fit, able: list[type[MissingEffect]], tried: Tried) -> list[list[Fit]]:
    """For each effect, the fits with another one in its place that the data cannot tell from it."""
    record, sigma = fitter.record, floor_of(fitter.record, best)
    factor = long_run_factor(best.error_deg[record.counts])
    left = max(best.total - float(record.counts.sum()) * sigma**2 * (1.0 + _EXCESS_WORTH), 0.0)
    equals = []
    for k in range(len(best.effects)):
        base = _without(fitter, best, k)
        rivals = tried.get(_keys(base)) or fitter.with_effects(base, able, _quietly)
        tried[_keys(base)] = rivals
        common, unexplained_too = _TIE_CHI_SQUARED * sigma**2 * factor, min(left, base.total - best.total)
        equals.append(
            [
                rival
                for rival in rivals
                if rival.names[-1] not in best.names
                and rival.total - best.total < max(common, _slack(best.effects[k], rival) * unexplained_too)
                and not any(p.at_bound(v) for p, v in zip(rival.parameters, rival.values, strict=True))
            ]
        )
    return equals


def _slack(effect: type[MissingEffect], rival: Fit) -> float:
    """Share of what stays unexplained by which a rival may be worse than an effect and still pass for it."""
    alike = effect.family and effect.family == rival.effects[-1].family
    return _TIE_OF_KIND if alike or (_is_kinked(effect) and not _is_kinked(rival.effects[-1])) else _TIE_OF_EXCESS


def _simplest(fitter: Fitter, best: Fit, able: list[type[MissingEffect]], tried: Tried) -> Fit:
    """The same servo in the simplest of the words that fit equally well."""
    for k in range(len(best.effects)):
        if _is_kinked(best.effects[k]):
            smooth = [r for r in _equals(fitter, best, able, tried)[k] if not _is_kinked(r.effects[-1])]
            best = min((r for r in smooth if _matters(fitter.record, r)), key=lambda r: r.total, default=best)
    margin = _EVEN_CHI_SQUARED * floor_of(fitter.record, best) ** 2
    for k, equals in enumerate(_equals(fitter, best, able, tried)):
        effect = best.effects[k]
        before = [r for r in equals if CATALOGUE.index(r.effects[-1]) < CATALOGUE.index(effect)]
        even = [r for r in before if r.total - best.total < margin or (effect.family == r.effects[-1].family != "")]
        if even:
            return _simplest(fitter, min(even, key=lambda r: CATALOGUE.index(r.effects[-1])), able, tried)
    return best


def _is_kinked(effect: type[MissingEffect]) -> bool:
    return any(parameter.kinked for parameter in effect.parameters)


def excess(record: Record, fit: Fit, sigma: float) -> float:
    """Variance beyond the noise floor on the held-out samples [deg^2]."""
    return fit.held_out / max(int(record.held_out.sum()), 1) - sigma**2


def unexplained(selection: Selection, record: Record) -> bool:
    """Whether more is left than noise, and more than a rounding of what was there."""
    left = excess(record, selection.final, selection.sigma_deg)
    if Quantization in selection.final.effects:
        left = min(left, *(left - more for more in _dithered(record, selection)))
    gap = excess(record, selection.nominal, selection.sigma_deg)
    return left > _EXCESS_OF_NOISE * selection.sigma_deg**2 and left > _EXCESS_OF_GAP * gap


def _before_steps_deg(fitter: Fitter, fit: Fit) -> float:
    """Noise before a converter with whole steps [deg], whose differences do not show it; 0 without such a converter."""
    if Quantization not in fit.effects:
        return 0.0
    record, physics = fitter.record, fitter.physics(fit.effects, fit.values)
    error = (record.measured_deg - simulate(record, physics._replace(output_step_deg=0.0)))[record.counts]
    return float(np.sqrt(max(float(np.mean(error**2)) - physics.output_step_deg**2 / 12.0, 0.0)))


def _dithered(record: Record, selection: Selection) -> list[float]:
    """Variance that noise gains by being converted to whole steps [deg^2], which no model of the servo can remove.

    Whole steps hide how large the noise was: for several sizes, up to a third of a step.
    """
    physics = Fitter(record).physics(selection.final.effects, selection.final.values)
    step_deg = physics.output_step_deg
    smooth = simulate(record, physics._replace(output_step_deg=0.0))[record.held_out]
    nodes, weights = np.polynomial.hermite_e.hermegauss(_NODES)
    gained = []
    for sigma_deg in (selection.sigma_deg, 0.1 * step_deg, 0.2 * step_deg, 0.3 * step_deg):
        variance = 0.0
        for node, weight in zip(nodes, weights / weights.sum(), strict=True):
            moved = np.round((smooth + node * sigma_deg) / step_deg) - np.round(smooth / step_deg)
            variance += float(weight * np.mean(moved**2)) * step_deg**2
        gained.append(max(variance - selection.sigma_deg**2, 0.0))
    return gained
