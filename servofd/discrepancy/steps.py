"""Noise under a converter with whole steps: how large it was before, and what it gains there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.discrepancy.record import simulate
from servofd.models.catalogue import Quantization

if TYPE_CHECKING:
    from servofd.discrepancy.fit import Fit, Fitter

__all__ = ["before_steps_deg", "dithered"]

_NODES = 15


def before_steps_deg(fitter: Fitter, fit: Fit) -> float:
    """Noise before a converter with whole steps [deg], whose differences do not show it; 0 without such a converter."""
    if Quantization not in fit.effects:
        return 0.0
    record, physics = fitter.record, fitter.physics(fit.effects, fit.values)
    error = (record.measured_deg - simulate(record, physics._replace(output_step_deg=0.0)))[record.counts]
    return float(np.sqrt(max(float(np.mean(error**2)) - physics.output_step_deg**2 / 12.0, 0.0)))


def dithered(fitter: Fitter, fit: Fit, noise_deg: float) -> list[float]:
    """Variance that noise gains by being converted to whole steps [deg^2], which no model of the servo can remove.

    Whole steps hide how large the noise was: for several sizes, up to a third of a step.
    """
    record, physics = fitter.record, fitter.physics(fit.effects, fit.values)
    step_deg = physics.output_step_deg
    smooth = simulate(record, physics._replace(output_step_deg=0.0))[record.held_out]
    nodes, weights = np.polynomial.hermite_e.hermegauss(_NODES)
    gained = []
    for sigma_deg in (noise_deg, 0.1 * step_deg, 0.2 * step_deg, 0.3 * step_deg):
        variance = 0.0
        for node, weight in zip(nodes, weights / weights.sum(), strict=True):
            moved = np.round((smooth + node * sigma_deg) / step_deg) - np.round(smooth / step_deg)
            variance += float(weight * np.mean(moved**2)) * step_deg**2
        gained.append(max(variance - noise_deg**2, 0.0))
    return gained
