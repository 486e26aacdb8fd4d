"""Sign and scale of a surface, as its log shows them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.core.statistics import LEAST_DIVISOR

if TYPE_CHECKING:
    from servofd.core.types import IntArray
    from servofd.detection.residual import Residuals

_FIT = 0.9
"""Share of the position's variance that a line through the healthy deflection has to explain."""
_SAME_SLOPE = 0.15
"""Share by which the gains of the parts of a log may differ to be one."""
_SMALLEST_GAIN, _LARGEST_GAIN = 0.1, 1.3
"""Gains of a servo whose scale is right."""
ENOUGH_MOTION_DEG = 1.0
_PARTS = 3
"""Parts of a log whose gains are compared."""


def wiring_problem(residuals: Residuals) -> str:
    """That position follows the command with a gain that no servo has, from the first to the last third.

    Empty if sign and scale are plausible, or it does not follow at all.
    """
    parts = [_gain(residuals, part) for part in np.array_split(np.flatnonzero(residuals.settled), _PARTS)]
    gains = [gain for gain in parts if gain is not None]
    if not gains or not all(gains):
        return ""
    gain = float(np.median(gains))
    if _SMALLEST_GAIN <= gain <= _LARGEST_GAIN or max(abs(g - gain) for g in gains) > _SAME_SLOPE * abs(gain):
        return ""
    what = "sign" if gain < 0.0 else "scale"
    return f"position is {gain:.2f}x the command throughout: check the {what} of the calibration"


def _gain(residuals: Residuals, part: IntArray) -> float | None:
    """Slope of the position over the healthy deflection; 0 if it does not follow, None without motion."""
    asked, measured = residuals.simulated_deg[part], residuals.measured_deg[part]
    if part.size < 2 or np.std(asked) < ENOUGH_MOTION_DEG / 2.0:
        return None
    spread = np.cov(asked, measured)
    slope = spread[0, 1] / spread[0, 0]
    explained = spread[0, 1] ** 2 / max(spread[0, 0] * spread[1, 1], LEAST_DIVISOR)
    return float(slope) if explained >= _FIT else 0.0
