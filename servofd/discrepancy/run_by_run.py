"""Each of several runs as the others predict it: the hardest test that bench records allow."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servofd.core.series import rms
from servofd.discrepancy.fit import Fitter

if TYPE_CHECKING:
    from servofd.core.types import FloatArray
    from servofd.discrepancy.fit import Fit

_MOST_FOLDS = 8
"""Runs that are held out at the same time, where there are many."""


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
    errors_deg = [_foreseen_deg(fitter, fit) for fit in (fitter.nominal(), final)]
    return tuple(
        RunErrors(k, *(rms(error[(record.run == k) & record.counts]) for error in errors_deg))
        for k in range(len(record.runs))
    )


def _foreseen_deg(fitter: Fitter, fit: Fit) -> FloatArray:
    """Error of each run, with the servo fitted again to the others, shape (n,)."""
    record = fitter.record
    error_deg = np.full(record.time_s.size, np.nan)
    for fold in range(min(len(record.runs), _MOST_FOLDS)):
        left_out = record.run % _MOST_FOLDS == fold
        physics = fit.physics
        if fit.effects or record.free_poles:
            physics = (
                Fitter(replace(record, counts=record.counts & ~left_out)).descended(fit.effects, physics, 4).physics
            )
        error_deg[left_out] = fitter.judged(fit.effects, physics).error_deg[left_out]
    return error_deg
