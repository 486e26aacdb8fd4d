"""Backwards: which of the effects that were found are needed, sure, and worth a name."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.discrepancy.evidence import accepted, floor_of, rest_is_large
from servofd.discrepancy.noise import long_run_factor
from servofd.discrepancy.steps import COARSE_STEP_DEG
from servofd.models.catalogue import Quantization

if TYPE_CHECKING:
    from servofd.discrepancy.fit import Fit, Fitter
    from servofd.discrepancy.record import Record
    from servofd.models.catalogue import Parameter

__all__ = ["convincing", "ordered", "pruned", "with_steps", "without"]

_STEPS_OF_ERROR = 0.25
_SURE_Z = 4.0
_LEAST_SHARE, _LEAST_SHARE_OF_REST = 0.1, 0.05
"""Beside a large unexplained rest, an effect that takes away less of the gap names nothing."""
_MUCH_OF_GAP, _MOST_OF_GAP = 0.1, 0.5
_FORESEEN = 1.5
"""Times the held-out error of the runs without an effect, by which it vouches for itself."""


def pruned(fitter: Fitter, best: Fit) -> Fit:
    """Without the effects that ran away, and those that the others made needless."""
    while len(best.effects) > 1:
        fewer = [without(fitter, best, k) for k in range(len(best.effects))]
        sigma = floor_of(fitter.record, best)
        # What ran away goes first, for beside it none of the others looks needed.
        loose = [fewer[k] for k in best.ran_away] or [
            fit
            for fit in fewer
            if not (_foreseen(fitter.record, fit, best) or accepted(fitter.record, fit, best, sigma))
        ]
        if not loose:
            return best
        best = min(loose, key=lambda fit: fit.held_out)
    return best


def _foreseen(record: Record, fewer: Fit, best: Fit) -> bool:
    """Whether whole runs that were held out are foreseen so much better that the fitted ones need not say it, too.

    With few long runs the descent ends in one of several minima of the fitted runs' error, and only the others tell
    which of them is the servo.
    """
    return bool(record.runs) and fewer.held_out > _FORESEEN * best.held_out


def convincing(fitter: Fitter, fit: Fit, nominal: Fit) -> Fit:
    """Without the effects whose size might be none, and those that matter little beside what stays unexplained."""
    record = fitter.record
    while fit.effects:
        sigma, count = floor_of(record, fit), max(float(record.counts.sum()), 1.0)
        factor = long_run_factor(fit.error_deg[record.trained])
        deviation = np.sqrt(
            np.maximum(
                np.diag(fitter.covariance(fit, float(np.sqrt(fit.train / max(record.trained.sum(), 1))), factor)),
                1e-300,
            )
        )
        gap, much_is_left = max(nominal.total - count * sigma**2, 0.0), rest_is_large(record, fit, nominal)
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
            losses.append(without(fitter, fit, k).total - fit.total if much_is_left else np.inf)
        # Runs that were held out whole vouch for effects that matter to what is left, not only to all of the gap.
        least = _LEAST_SHARE * gap
        if record.runs:
            least = min(least, _LEAST_SHARE_OF_REST * max(fit.total - count * sigma**2, 0.0))
        weak = [k for k in range(len(losses)) if not sure[k] or losses[k] < least]
        if not weak:
            break
        fit = without(fitter, fit, min(weak, key=lambda k: losses[k]))
    return _sober(fitter, fit, nominal)


def _sober(fitter: Fitter, fit: Fit, nominal: Fit) -> Fit:
    """Beside a rest that is much of the gap, at most one effect, and only if it is most of what there was.

    Several effects that together leave much are no physics but a flexible curve, unless they foresee whole runs.
    """
    record = fitter.record
    if not fit.effects or record.runs or not rest_is_large(record, fit, nominal):
        return fit
    noise = float(record.counts.sum()) * floor_of(record, fit) ** 2
    gap = max(nominal.total - noise, 0.0)
    while len(fit.effects) > 1 and fit.total - noise > _MUCH_OF_GAP * gap:
        fewer = [without(fitter, fit, k) for k in range(len(fit.effects))]
        fit = min(fewer, key=lambda each: each.total)
    too_little = len(fit.effects) == 1 and fit.total - noise > _MOST_OF_GAP * gap
    return nominal if too_little else fit


def _kinked_or(parameter: Parameter, size: float) -> float:
    """Curvature says nothing about a parameter with many minima."""
    return np.inf if parameter.kinked else size


def with_steps(fitter: Fitter, best: Fit) -> Fit:
    """With the steps of the position's converter, if they are coarse, and much of what is left.

    The readings themselves prove them: they need not foresee anything.
    """
    step_deg, count = fitter.record.step_deg or 0.0, max(int(fitter.record.counts.sum()), 1)
    if step_deg < COARSE_STEP_DEG or step_deg**2 / 12.0 < _STEPS_OF_ERROR * best.total / count:
        return best
    return fitter.judged((*best.effects, Quantization), [*best.values, step_deg])


def without(fitter: Fitter, fit: Fit, index: int) -> Fit:
    """The others refitted, without one effect."""
    if fitter.record.free_poles:  # the poles that go with each set of effects get better and better
        return _without(fitter, fit, index)
    if (fit, index) not in fitter.fewer:
        fitter.fewer[fit, index] = _without(fitter, fit, index)
    return fitter.fewer[fit, index]


def _without(fitter: Fitter, fit: Fit, index: int) -> Fit:
    effects = fit.effects[:index] + fit.effects[index + 1 :]
    first = sum(len(effect.parameters) for effect in fit.effects[:index])
    values = np.delete(fit.values, range(first, first + len(fit.effects[index].parameters)))
    return fitter.refitted(effects, values.tolist())


def ordered(fitter: Fitter, fit: Fit) -> Fit:
    """The effect that would be missed most comes first."""
    if len(fit.effects) < 2:
        return fit
    losses = [without(fitter, fit, k).held_out for k in range(len(fit.effects))]
    order = np.argsort(losses)[::-1].tolist()
    pieces = np.split(fit.values, np.cumsum([len(e.parameters) for e in fit.effects])[:-1])
    return fitter.judged(tuple(fit.effects[k] for k in order), np.concatenate([pieces[k] for k in order]).tolist())
