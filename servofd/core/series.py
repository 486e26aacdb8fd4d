"""What was known at an instant, where a flag stands, and how large values are."""

from __future__ import annotations

import numpy as np

from servofd.core.types import BoolArray, FloatArray, IntArray


def latest(known_s: FloatArray, values: FloatArray, at_s: FloatArray) -> FloatArray:
    """The last value that was known at each of some instants; the first one before it.

    Examples
    --------
    >>> latest(np.array([1.0, 2.0]), np.array([5.0, 6.0]), np.array([0.0, 1.5, 2.0]))
    array([5., 5., 6.])
    """
    return values[np.maximum(np.searchsorted(known_s, at_s, side="right") - 1, 0)]


def subdivided(time_s: FloatArray, values: FloatArray, pieces: IntArray) -> tuple[FloatArray, FloatArray]:
    """Instants and values with more of them on the straight lines between; `pieces` (n - 1,) says how many parts.

    Examples
    --------
    >>> subdivided(np.array([0.0, 1.0, 3.0]), np.array([0.0, 1.0, 5.0]), np.array([1, 2]))[1]
    array([0., 1., 3., 5.])
    """
    owner = np.repeat(np.arange(pieces.size), pieces)
    share = (np.arange(owner.size) - np.repeat(np.cumsum(pieces) - pieces, pieces)) / pieces[owner]
    both = [np.append(each[owner] + share * np.diff(each)[owner], each[-1:]) for each in (time_s, values)]
    return both[0], both[1]


def stretches(flags: BoolArray) -> list[tuple[int, int]]:
    """Where flags stand, each stretch as (first, last + 1).

    Examples
    --------
    >>> stretches(np.array([True, False, True, True]))
    [(0, 1), (2, 4)]
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def rms(values: FloatArray) -> float:
    """Root mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


_OUTLINE_PARTS = 60
"""Parts of a record whose extremes outline it."""


def outline(time_s: FloatArray, residual_deg: FloatArray, level_deg: FloatArray) -> tuple[float | None, ...]:
    """Largest residual over its threshold in each of equal parts of the flight; None where nothing was judged.

    Of shape (n,) each; the residual is NaN where it was not judged.

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


def tenths(time_s: FloatArray) -> IntArray:
    """The first sample of each tenth of a second: what an eye can follow."""
    return np.flatnonzero(np.diff(np.floor(time_s / 0.1), prepend=-np.inf))
