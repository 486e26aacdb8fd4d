"""Each of several runs as the others predict it: the hardest test that bench records allow."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servofd.discrepancy.prune import without
from servofd.discrepancy.record import FEW_RUNS

if TYPE_CHECKING:
    from servofd.discrepancy.fit import Fit, Fitter
    from servofd.types import FloatArray

__all__ = ["RunErrors", "run_errors", "vouched"]

_MOST_FOLDS = 8
"""Runs that are held out at the same time, where there are many."""
_WORTH = 1.05
"""Times as badly as with an effect, the runs must be foreseen without it."""


class RunErrors(NamedTuple):
    """Error of one run, by models that were fitted to other runs."""

    run: int
    nominal_rms_deg: float
    held_out_rms_deg: float


def run_errors(fitter: Fitter, final: Fit) -> tuple[RunErrors, ...]:
    """Fit the servo with its effects again without each run, and judge that run; empty for a single run."""
    record = fitter.record
    if not record.runs:
        return ()
    nominal = replace(final, effects=(), values=np.zeros(0))
    errors_deg = [_foreseen_deg(fitter, fit) for fit in (nominal, final)]
    return tuple(
        RunErrors(k, *(_rms(error[(record.run == k) & record.counts]) for error in errors_deg))
        for k in range(len(record.runs))
    )


def vouched(fitter: Fitter, best: Fit) -> Fit:
    """Without the effects that do not help to foresee a run from the others, where these are few.

    Each was fitted in part, and held-out blocks of it are no proof of what another run would do.
    """
    record = fitter.record
    while 0 < len(record.runs) < FEW_RUNS and len(best.effects) > 1:
        fewer = [without(fitter, best, k) for k in range(len(best.effects))]
        losses = [_loss(fitter, fit) for fit in fewer]
        if min(losses) > _WORTH * _loss(fitter, best):
            break
        best = fewer[int(np.argmin(losses))]
    return best


def _loss(fitter: Fitter, fit: Fit) -> float:
    error_deg = _foreseen_deg(fitter, fit)[fitter.record.counts]
    return float(error_deg @ error_deg)


def _foreseen_deg(fitter: Fitter, fit: Fit) -> FloatArray:
    """Error of each run, with the servo fitted again to the others, shape (n,)."""
    record = fitter.record
    error_deg = np.full(record.time_s.size, np.nan)
    for fold in range(min(len(record.runs), _MOST_FOLDS)):
        left_out = record.run % _MOST_FOLDS == fold
        part = fitter.on(replace(record, block=2 * (record.block // 2) + left_out))
        fitted = part.refitted(fit.effects, fit.values) if fit.effects else part.nominal()
        error_deg[left_out] = fitted.error_deg[left_out]
    return error_deg


def _rms(error_deg: FloatArray) -> float:
    return float(np.sqrt(np.mean(error_deg**2))) if error_deg.size else float("nan")
