"""What the script on the autopilot does with a residual, in Python."""

from __future__ import annotations

from statistics import median_low
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from servofd.detection.residual import Residuals
    from servofd.detection.threshold import Threshold

_QUIET_SHARE, _TRAVEL_TO_CLEAR = 0.5, 20.0


def alarms_s(residuals: Residuals, threshold: Threshold, persistence: int) -> list[float]:
    """When alarms are raised [s].

    One clears when |residual| stayed below half the threshold during manoeuvres in which that of an immobile surface
    would have made large moves: beyond a zone of twice the threshold, 20 thresholds of travel in all.
    """
    judged = np.flatnonzero(residuals.settled)
    held, travel, loud, row, stands, raised, levels = np.nan, 0.0, np.nan, 0.0, False, [], []
    for k in judged.tolist():
        level, residual, immobile = threshold.level_deg[k], residuals.residual_deg[k], residuals.immobile_deg[k]
        levels.append(level)
        typical = threshold.typical_deg if threshold.kind == "constant" else median_low(levels)
        typical = max(typical, level)
        moved = held if np.isfinite(held) else immobile
        moved = min(max(moved, immobile - typical), immobile + typical)
        travel += abs(moved - held) / typical if np.isfinite(held) else 0.0
        held = moved
        if travel - loud >= _TRAVEL_TO_CLEAR:
            stands = False
        if abs(residual) >= _QUIET_SHARE * level:
            loud = travel
        side = 0.0 if abs(residual) < level else float(np.sign(residual))
        row = row + side if row * side > 0.0 else side
        if abs(row) >= persistence and not stands:
            raised.append(float(residuals.time_s[k]))
            stands = True
    return raised
