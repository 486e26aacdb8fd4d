"""What a calibration would show, as a picture: the smallest faults of each surface."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.outputs.picture import finish, new_figure
from servofd.outputs.sentence import spoken

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from servofd.calibrating.result import Calibration

_ANGLES_DEG = {"offset": "bias_deg", "play": "deadband_deg", "oscillation": "oscillation_deg"}


def calibrate_figure(found: Calibration) -> Figure:
    """Bars of the smallest faults that flights like the good ones show, 19 times in 20; none where none would show."""
    figure, (angles, shares) = new_figure(1, 2, height=1.4 + 0.7 * len(found.surfaces), share_x=False)
    shown = [one.detectable for one in found.surfaces]
    in_degrees = {words: [getattr(one, name) or 0.0 for one in shown] for words, name in _ANGLES_DEG.items()}
    in_percent = {
        "travel lost": [100.0 * (one.loss_share or 0.0) for one in shown],
        "speed lost": [0.0 if one.slow_share is None else 100.0 * (1.0 - one.slow_share) for one in shown],
    }
    places = np.arange(len(shown))
    for axes, sizes, unit in ((angles, in_degrees, "deg"), (shares, in_percent, "%")):
        height = 0.8 / len(sizes)
        for k, (words, values) in enumerate(sizes.items()):
            axes.barh(places + (k - 0.5 * (len(sizes) - 1)) * height, values, 0.9 * height, label=words)
        axes.set_axisbelow(True)
        axes.set_yticks(places, [spoken(one.surface) for one in found.surfaces])
        axes.invert_yaxis()
        axes.set_xlabel(f"smallest fault that shows [{unit}]")
        finish(axes, legend="above")
    return figure
