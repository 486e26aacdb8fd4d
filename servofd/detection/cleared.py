"""What a surface without an alarm has earned: it is healthy only if a log would have shown that it is not."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from servofd.core.evidence import Detectable
    from servofd.detection.residual import Residuals

MOST_LOST = 0.34
"""A surface that could have lost more than a third of its travel unseen is not called healthy."""
_LEAST_SPEED, _LIVELIER = 1.0 / 3.0, 1.5
"""Motion so much larger shows that much less of a loss."""
_MARGIN = 1.2
_FARTHEST_DEG = 30.0
"""No control surface moves much further to either side: one that would have to needs a narrower threshold."""
_NAMES = {
    "bias_deg": "offset",
    "slow_share": "speed",
    "loss_share": "travel",
    "deadband_deg": "play",
    "oscillation_deg": "oscillation",
}


def why_not_cleared(residuals: Residuals, shown: Detectable, level_deg: float) -> str:
    """Why a log without an alarm does not clear a surface, and what to fly; empty if it does."""
    if shown.loss_share is not None and shown.loss_share <= MOST_LOST:
        return ""
    moved = residuals.simulated_deg[residuals.settled]
    reach_deg = float(np.ptp(moved)) / 2.0 if moved.size else 0.0
    unseen = "a jam" if shown.loss_share is None else f"the loss of {shown.loss_share:.0%} of its travel"
    wanted_deg = max(3.0 * _MARGIN * level_deg, _MARGIN * reach_deg)
    if wanted_deg > max(_FARTHEST_DEG, _MARGIN * reach_deg):
        return (
            f"too little motion for so wide a threshold ({level_deg:.2g} deg): even {unseen} might not have shown; fly "
            "or bench-test slow movements beside fast ones, or calibrate on a good flight"
        )
    return (
        f"too little motion: even {unseen} might not have shown (threshold {level_deg:.2g} deg); fly or bench-test "
        f"several movements of ±{wanted_deg:.0f} deg or more, or calibrate on a good flight"
    )


def is_blind(shown: Detectable) -> bool:
    """Whether a servo at a third of its speed would not show, nor the loss of a third of its travel in livelier flight.

    Examples
    --------
    >>> from servofd.core.evidence import Detectable
    >>> is_blind(Detectable(loss_share=0.6)), is_blind(Detectable(loss_share=0.6, slow_share=0.4))
    (True, False)
    """
    loss_shows = shown.loss_share is not None and shown.loss_share <= _LIVELIER * MOST_LOST
    speed_shows = shown.slow_share is not None and shown.slow_share >= _LEAST_SPEED
    return not (loss_shows or speed_shows)


def not_judgeable(shown: Detectable, *, own_fit: bool = False) -> str:
    """Kinds of faults that a log could not have shown, in words; `own_fit` if its servo was fitted to this very log.

    Examples
    --------
    >>> from servofd.core.evidence import Detectable
    >>> not_judgeable(Detectable(bias_deg=0.5, loss_share=0.1, deadband_deg=1.0, oscillation_deg=0.5))
    'speed not judgeable: no brisk motion'
    >>> not_judgeable(Detectable(loss_share=0.1, deadband_deg=1.0, oscillation_deg=0.5), own_fit=True)
    'offset and speed not judgeable: fitted to this log'
    >>> not_judgeable(Detectable(loss_share=0.1, deadband_deg=1.0))
    'offset, speed and oscillation not judgeable'
    """
    missing = [_NAMES[name] for name in shown.missing]
    if not missing:
        return ""
    if own_fit and set(missing) <= {"offset", "speed"}:
        return f"{_in_words(missing)} not judgeable: fitted to this log"
    why = ": no brisk motion" if missing == ["speed"] else ""
    return f"{_in_words(missing)} not judgeable{why}"


def _in_words(names: list[str]) -> str:
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last
