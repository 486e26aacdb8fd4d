"""What a log tells before it is judged: the step of its reading, sign and scale, and how wide tolerances have to be."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from servofd.core.types import FloatArray, IntArray
    from servofd.detection.residual import Residuals

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


_FIT = 0.9
"""Share of the position's variance that a line through the healthy deflection has to explain."""
_SAME_SLOPE = 0.15
_SMALLEST_GAIN, _LARGEST_GAIN = 0.1, 1.3
ENOUGH_MOTION_DEG = 1.0
_PARTS = 3


def wiring_problem(residuals: Residuals) -> str:
    """Tell if position follows the command with a gain that no servo has, from the first to the last third.

    Returns
    -------
    str
        A sentence; empty if sign and scale are plausible, or the position does not follow at all.

    Examples
    --------
    >>> import numpy as np
    >>> from servofd.detection.residual import ResidualGenerator
    >>> from servofd.servo.servo_model import ServoModel
    >>> from servofd.aircraft.segment import Segment
    >>> from servofd.servo.library import servo_named
    >>> model = ServoModel.of(servo_named("hs225bb-eq31"))
    >>> time_s = np.arange(0.0, 9.0, 0.01)
    >>> command_deg = 5.0 * np.sin(5.0 * time_s)
    >>> position_deg = -model.simulate(time_s, command_deg, time_s)
    >>> wiring_problem(ResidualGenerator(model, 50.0).run(Segment("x", time_s, command_deg, time_s, position_deg)))
    'position is -1.00x the command throughout: check the sign of the calibration'
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
    explained = spread[0, 1] ** 2 / max(spread[0, 0] * spread[1, 1], 1e-300)
    return float(slope) if explained >= _FIT else 0.0


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
