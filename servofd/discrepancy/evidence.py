"""Whether a fit is better than another, and whether anything is left: figures of held-out samples and of the noise."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.discrepancy.noise import floor_uncertainty, long_run_factor, noise_floor_deg
from servofd.discrepancy.steps import COARSE_STEP_DEG, noise_below_deg, stepped_noise_deg
from servofd.models.catalogue import Quantization

if TYPE_CHECKING:
    from servofd.discrepancy.fit import Fit
    from servofd.discrepancy.record import Record

__all__ = [
    "EXCESS_WORTH", "accepted", "cost", "excess", "floor_of", "least_scatter", "matters", "rest_is_large",
    "rest_matters", "stays_above_noise", "worth_trying",
]  # fmt: skip

_SHARE_OF_NOISE, _SHARE_OF_GAP = 0.03, 0.02
"""An effect must take away this share of the noise variance (the second twice as much, and so on: several effects bend
to anything), and of the gap that is left."""
_CHI_SQUARED = 30.0
"""And this much of the held-out error in units of the noise: 25 effects and their grids are tried each time."""
_BLOCK_T = 3.0
_USUAL_TRAVEL_DEG = 25.0
"""Of the surfaces for which the sizes of a linkage's curvature are typical."""
_SMALLEST_SIZE = 0.15
"""Of what is common on healthy servos: 0.5 ms of delay, 0.5 % of gain, 0.05 deg of play."""
EXCESS_WORTH = 0.06
"""The floor itself is uncertain by 3 %."""
_EXCESS_OF_NOISE, _EXCESS_OF_GAP = 0.15, 0.02
_SURE_SIGMAS = 3.0
"""Chance alone passes one record in 700."""
_MEMORY_SIGMAS = 4.0
"""Of the memory that chance makes of noise: one record in 30 000."""
_NOTHING_DEG = 1e-4
"""No noise is smaller: in logs that were simulated without any, the rounding of the file is no effect."""


def floor_of(record: Record, fit: Fit) -> float:
    """Noise floor as this fit shows it [deg]: a converter's steps at least, no more than its error, but not nothing."""
    noise_deg = max(noise_floor_deg(record, fit.error_deg), _floor_of_steps(record, fit))
    return max(min(noise_deg, float(np.sqrt(fit.total / max(record.counts.sum(), 1)))), _NOTHING_DEG)


def _floor_of_steps(record: Record, fit: Fit) -> float:
    """What a converter's steps, and the noise before it, leave of a true model [deg], even where readings stand."""
    step_deg = record.step_deg or 0.0
    if step_deg < COARSE_STEP_DEG:
        return step_deg / float(np.sqrt(12.0))
    read_deg = np.where(record.counts, record.measured_deg, np.nan)
    below_deg = noise_below_deg(read_deg, record.measured_deg - fit.unstepped_deg, step_deg)
    if Quantization in fit.effects:
        return stepped_noise_deg(below_deg, step_deg)
    return float(np.hypot(below_deg, step_deg / np.sqrt(12.0)))


def cost(record: Record, fit: Fit) -> float:
    """What ranks fits: the error on all samples, and a little for each parameter."""
    sigma = floor_of(record, fit)
    each = sigma**2 * float(np.log(max(int(record.counts.sum()), 2)))
    return float(fit.total + each * len(fit.values))


def worth_trying(record: Record, base: Fit, sigma: float) -> bool:
    """Whether more is left than noise: more variance than the floor, or memory, which white noise does not have."""
    count = int(record.counts.sum())
    if base.total <= count * _NOTHING_DEG**2:
        return False
    more = base.total / max(count, 1) / sigma**2 - 1.0
    return more > EXCESS_WORTH or _memory(record, base) > max(_SHARE_OF_NOISE, 2.5 / np.sqrt(2.0 * max(count, 1)))


def _memory(record: Record, fit: Fit) -> float:
    """Correlation of the error with itself, one and two samples later: the share of it that is smooth."""
    error = fit.error_deg[record.counts]
    return 0.5 * float(error[1:] @ error[:-1] + error[2:] @ error[:-2]) / max(float(error @ error), 1e-300)


def accepted(record: Record, base: Fit, fit: Fit, sigma: float) -> bool:
    """Whether an effect took enough away on samples it was not fitted to, and none of its parameters ran away."""
    gain = base.held_out - fit.held_out
    count = int(record.held_out.sum())
    gap = max(base.held_out - count * sigma**2, 0.0)
    share = _SHARE_OF_NOISE * len(fit.effects)
    if gain < max(share * count * sigma**2, _SHARE_OF_GAP * gap) or base.train <= fit.train:
        return False
    if record.runs and base.train - fit.train < _SHARE_OF_GAP * base.train:
        # What the fitted runs did not need cannot be told from the others' luck.
        return False
    factor = long_run_factor(fit.error_deg[record.counts])
    if gain / (sigma**2 * factor) < _CHI_SQUARED:
        return False
    if gain / (sigma**2 * factor) < 4.0 * _CHI_SQUARED and _block_t(record, base, fit) < _BLOCK_T:
        return False
    return matters(record, fit) and not any(p.at_bound(v) for p, v in zip(fit.parameters, fit.values, strict=True))


def matters(record: Record, fit: Fit) -> bool:
    """Whether each effect differs from none by more than servos of one kind do from each other.

    Of a servo that nobody knows there is no kind: what its data show is there, however small.
    """
    if record.free_poles:
        return True
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


def rest_is_large(record: Record, fit: Fit, nominal: Fit) -> bool:
    """Whether more is left than noise, and more than a rounding of what was there."""
    sigma, count = floor_of(record, fit), max(float(record.counts.sum()), 1.0)
    left, gap = (max(each.total - count * sigma**2, 0.0) for each in (fit, nominal))
    return left > max(_EXCESS_OF_NOISE * count * sigma**2, _EXCESS_OF_GAP * gap)


def stays_above_noise(record: Record, fit: Fit) -> bool:
    """Whether more is left than noise, be it ever so little of what there was."""
    return fit.total > (1.0 + _EXCESS_OF_NOISE) * float(record.counts.sum()) * floor_of(record, fit) ** 2


def excess(record: Record, fit: Fit, sigma: float) -> float:
    """Variance beyond the noise floor on the held-out samples [deg^2]."""
    return fit.held_out / max(int(record.held_out.sum()), 1) - sigma**2


def least_scatter(record: Record, nominal: Fit, final: Fit, sigma_deg: float) -> float:
    """Share of the noise below which noise that the motion makes is nothing, or a rounding of what was there."""
    return max(EXCESS_WORTH, _rounding(record, final) * excess(record, nominal, sigma_deg) / sigma_deg**2)


def _rounding(record: Record, final: Fit) -> float:
    """Share of the gap that may stay of an effect whose law is nearly right.

    Several effects that leave a little may be a flexible curve beside physics that is none of them.
    """
    return _EXCESS_OF_GAP if record.runs or len(final.effects) < 2 else 0.0


def rest_matters(record: Record, nominal: Fit, final: Fit, sigma_deg: float) -> bool:
    """Whether more is left on held-out samples than noise, and more than a rounding of what was there.

    Several effects that fit nearly as well as they should may be a flexible curve: nothing smooth may be left of them.
    """
    left, gap = excess(record, final, sigma_deg), excess(record, nominal, sigma_deg)
    if record.runs and not final.effects:
        # Runs that were fitted are not like those held out: what is missing in them alone is missing all the same.
        fitted = final.train / max(int(record.trained.sum()), 1) - sigma_deg**2
        left, gap = max(left, fitted), max(gap, fitted)
    several = len(final.effects) > 1 and not record.runs
    if several and _memory(record, final) > max(EXCESS_WORTH, _MEMORY_SIGMAS / np.sqrt(2.0 * record.counts.sum())):
        return True  # which needs no floor to be seen
    # Of few samples, neither the floor nor what is left is known well.
    chance = float(np.hypot(floor_uncertainty(record), np.sqrt(2.0 / max(int(record.held_out.sum()), 1))))
    return left > max(_EXCESS_OF_NOISE, _SURE_SIGMAS * chance) * sigma_deg**2 and left > _rounding(record, final) * gap
