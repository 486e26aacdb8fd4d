"""How large a residual was while it was judged: the same numbers for an audit and for a recording of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from servofd.core.types import FloatArray

_OUTLINE_PARTS = 60


@dataclass(frozen=True, slots=True)
class Statistics:
    """Size of the residual while it was judged [deg]."""

    mean_deg: float
    std_deg: float
    max_abs_deg: float
    simulation_error_rms_deg: float

    @classmethod
    def of(cls, residual_deg: FloatArray, error_deg: FloatArray) -> Statistics:
        """Of the residual and of the error of the simulation at the samples that were judged, shape (n,) each.

        Infinite where squares are no numbers any more: such positions are wrong, and their verdict needs no more.

        Examples
        --------
        >>> Statistics.of(np.array([1.0, -3.0]), np.array([0.5, 0.5]))
        Statistics(mean_deg=-1.0, std_deg=2.0, max_abs_deg=3.0, simulation_error_rms_deg=0.5)
        """
        with np.errstate(over="ignore", invalid="ignore"):
            return cls(
                mean_deg=float(np.mean(residual_deg)),
                std_deg=float(np.std(residual_deg)),
                max_abs_deg=float(np.max(np.abs(residual_deg))),
                simulation_error_rms_deg=float(np.sqrt(np.mean(error_deg**2))),
            )


def outline(time_s: FloatArray, residual_deg: FloatArray, level_deg: FloatArray) -> tuple[float | None, ...]:
    """Largest residual over its threshold in each of equal parts of the flight; None where nothing was judged.

    Parameters
    ----------
    time_s : ndarray, shape (n,)
        Rising [s].
    residual_deg : ndarray, shape (n,)
        NaN where it was not judged.
    level_deg : ndarray, shape (n,)
        Threshold.

    Examples
    --------
    >>> time_s = np.arange(600.0)
    >>> outline(time_s, np.where(time_s < 10.0, np.nan, time_s), np.full(600, 100.0))[:3]
    (None, 0.19, 0.29)
    """
    if time_s.size < 2:
        return ()
    share = np.abs(residual_deg) / level_deg
    edges_s = np.linspace(time_s[0], time_s[-1], _OUTLINE_PARTS + 1)[:-1]
    parts = np.split(share, np.searchsorted(time_s, edges_s)[1:])
    return tuple(round(float(np.nanmax(part)), 3) if np.isfinite(part).any() else None for part in parts)
