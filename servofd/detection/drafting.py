"""How wide tolerances have to be for a log to raise no alarm: what a threshold is drafted from."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from servofd.types import FloatArray

_BLOCK_S = 2.0
_USUAL, _QUIETEST, _ON_AVERAGE = 4.0, 25.0, 0.5
"""Blocks whose mean excess is so many times that of the quietest quarter of like ones, and more than half a tolerance,
are no part of what a threshold is drafted from."""
_MARGIN, _UNSURE = 1.25, 2.0
"""A threshold is so many times the largest residual, and more where few blocks were seen."""
_NOISE_SIGMAS = 3.0


class Width(NamedTuple):
    """What follows from the blocks of a log."""

    scale: float
    """How many times as wide the tolerances have to be."""
    usual: float
    """Largest excess that counted."""


def excess(residual_deg: FloatArray, sigma_deg: FloatArray, tolerance_deg: FloatArray) -> FloatArray:
    """What of a residual is no noise, in tolerances, of shape (n,).

    Examples
    --------
    >>> excess(np.array([0.1, -1.3]), np.array([0.1, 0.1]), np.array([0.5, 0.5]))
    array([0., 2.])
    """
    beyond = np.maximum(np.abs(residual_deg) - _NOISE_SIGMAS * sigma_deg, 0.0)
    return np.asarray(beyond / np.maximum(tolerance_deg, 1e-9))


def width(time_s: FloatArray, excesses: FloatArray, tolerance_deg: FloatArray, least: float = 1.0) -> Width:
    """How many times as wide tolerances have to be, by blocks of 2 s; never narrower than `least` times.

    What stands out is told by the mean excess of a block, among blocks of like motion (those whose tolerance reaches
    half as far at least): brisk manoeuvres that are rare in a calm flight, and single late stamps, are no faults.

    Examples
    --------
    Three blocks in a row that stand out do not count:

    >>> time_s = np.arange(0.0, 100.0, 0.1)
    >>> quiet, wide = np.full(time_s.size, 0.5), np.ones(time_s.size)
    >>> width(time_s, quiet, wide).scale, width(time_s, np.where(time_s > 94.0, 9.0, quiet), wide).scale
    (1.0, 1.0)
    """
    first = np.flatnonzero(np.diff(np.floor(time_s / _BLOCK_S), prepend=-np.inf))
    peaks = np.maximum.reduceat(excesses, first)
    means = np.add.reduceat(excesses, first) / np.diff(np.append(first, time_s.size))
    motion = np.maximum.reduceat(tolerance_deg, first)
    quietest = np.array([np.percentile(means[motion >= 0.5 * each], _QUIETEST) for each in motion])
    usual = peaks[(means <= np.maximum(_USUAL * quietest, _ON_AVERAGE)) | (peaks <= least)]
    if usual.size == 0:
        return Width(least, least)
    largest = float(usual.max())
    return Width(max(least, largest * (_MARGIN + _UNSURE / float(np.sqrt(usual.size)))), largest)
