"""Steps in which commands and readings come: nothing smaller than one of each together is known of a servo."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from servofd.core.types import FloatArray

_DECIMALS = 6
_FEW_VALUES = 0.5
"""Values that come again and again, fewer than this share of all, are steps; others are as fine as they can be."""
_SMALL_STEP = 10.0


def step_deg(values_deg: FloatArray) -> float:
    """Smallest step in which a stream comes [deg]; 0 if it is finer than it is noisy.

    Examples
    --------
    >>> coarse = np.round(np.sin(np.arange(1000) / 50.0) / 0.05) * 0.05
    >>> round(step_deg(coarse), 6), step_deg(np.random.default_rng(0).normal(size=1000))
    (0.05, 0.0)
    """
    given = values_deg[np.isfinite(values_deg)]
    moved = given[1:][np.diff(given) != 0.0] if given.size > 1 else given
    values = np.unique(np.round(moved, _DECIMALS))
    if values.size < 2 or values.size > _FEW_VALUES * moved.size:
        return 0.0
    return float(np.percentile(np.diff(values), _SMALL_STEP))
