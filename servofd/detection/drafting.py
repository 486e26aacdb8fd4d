"""How wide tolerances have to be for a log to raise no alarm: what a threshold is drafted from."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from servofd.core.types import FloatArray

PERSISTENCE = 3
"""Judged samples in a row that make an alarm of a servo fitted to its log: a reading may be as old as the interval
since the one before it, and so may a command, and for as many samples a step of the command contradicts no servo."""
_BLOCK_S = 2.0
_MOVES_DEG = 2.0
"""Blocks in which the servo travels by so much are compared with each other, and so are the others: what a model lacks
shows in motion, and a log is at rest for most of its time."""
_USUAL, _QUIETEST = 4.0, 25.0
"""Blocks whose residual is so many times that of the quietest quarter of their kind, and beyond what tolerances explain
anyway, are no part of what a threshold is drafted from."""
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


def width(time_s: FloatArray, excesses: FloatArray, moved_deg: FloatArray, least: float = 1.0) -> Width:
    """How many times as wide tolerances have to be, by blocks of 2 s; never narrower than `least` times.

    Examples
    --------
    Three blocks in a row that stand out do not count; but a model that is wrong in motion is wrong as a rule:

    >>> time_s = np.arange(0.0, 100.0, 0.1)
    >>> moved_deg = np.where(time_s > 90.0, 5.0 * np.sin(4.0 * time_s), 0.0)
    >>> quiet = np.full(time_s.size, 0.5)
    >>> width(time_s, quiet, moved_deg).scale, width(time_s, np.where(time_s < 6.0, 9.0, quiet), moved_deg).scale
    (1.0, 1.0)
    >>> width(time_s, np.where(time_s > 90.0, 3.0, quiet), moved_deg).usual
    3.0
    """
    first = np.flatnonzero(np.diff(np.floor(time_s / _BLOCK_S), prepend=-np.inf))
    peaks = np.maximum.reduceat(excesses, first)
    moves = np.maximum.reduceat(moved_deg, first) - np.minimum.reduceat(moved_deg, first) >= _MOVES_DEG
    kinds = [peaks[kind] for kind in (moves, ~moves) if kind.any()]
    alike = [kind[kind <= max(_USUAL * float(np.percentile(kind, _QUIETEST)), least)] for kind in kinds]
    usual = np.concatenate(alike)
    if usual.size == 0:
        return Width(least, least)
    largest = float(usual.max())
    return Width(max(least, largest * (_MARGIN + _UNSURE / float(np.sqrt(usual.size)))), largest)
