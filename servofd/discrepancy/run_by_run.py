"""Each of several runs as the others predict it: the hardest test that bench records allow."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from servofd.discrepancy.fit import Fit, Fitter
    from servofd.types import FloatArray

__all__ = ["RunErrors", "run_errors"]

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
    nominal_deg, final_deg = (np.full(record.time_s.size, np.nan) for _ in range(2))
    for fold in range(min(len(record.runs), _MOST_FOLDS)):
        left_out = record.run % _MOST_FOLDS == fold
        part = fitter.on(replace(record, block=2 * (record.block // 2) + left_out))
        for error_deg, fit in ((nominal_deg, part.nominal()), (final_deg, part.refitted(final.effects, final.values))):
            error_deg[left_out] = fit.error_deg[left_out]
    return tuple(
        RunErrors(k, *(_rms(error[(record.run == k) & record.counts]) for error in (nominal_deg, final_deg)))
        for k in range(len(record.runs))
    )


def _rms(error_deg: FloatArray) -> float:
    return float(np.sqrt(np.mean(error_deg**2))) if error_deg.size else float("nan")
