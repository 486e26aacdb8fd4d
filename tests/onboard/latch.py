"""What the script on the autopilot does with a residual, in Python."""

from __future__ import annotations

from statistics import median_low
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from servofd.detection.residual import Residuals
    from servofd.detection.threshold import Threshold

_QUIET_SHARE, _QUIET_S, _TRAVEL, _FOLLOWED = 0.5, 0.8, 1.5, 0.45


def alarms_s(residuals: Residuals, threshold: Threshold, persistence: int) -> list[float]:
    """When alarms are raised [s].

    One clears where |residual| stayed below half the threshold for 0.8 s in which the model moved by 1.5 thresholds,
    and what it leaves of the position by less than 0.45 of that.
    """
    judged = np.flatnonzero(residuals.settled)
    row, stands, raised, levels = 0.0, False, [], []
    begun_s, asked, left = -np.inf, [0.0], [0.0]
    for k in judged.tolist():
        level, residual, time_s = threshold.level_deg[k], residuals.residual_deg[k], float(residuals.time_s[k])
        simulated, off = residuals.simulated_deg[k], residuals.measured_deg[k] - residuals.simulated_deg[k]
        levels.append(level)
        typical = threshold.typical_deg if threshold.kind == "constant" else median_low(levels)
        asked.append(simulated)
        left.append(off)
        is_loud = abs(residual) >= _QUIET_SHARE * level
        if is_loud or time_s - begun_s >= _QUIET_S:
            enough = np.ptp(asked) >= _TRAVEL * max(typical, level)
            if not is_loud and enough and np.ptp(left) <= _FOLLOWED * np.ptp(asked):
                stands = False
            begun_s, asked, left = time_s, [simulated], [off]
        side = 0.0 if abs(residual) < level else float(np.sign(residual))
        row = row + side if row * side > 0.0 else side
        if abs(row) >= persistence and not stands:
            raised.append(time_s)
            stands = True
    return raised
