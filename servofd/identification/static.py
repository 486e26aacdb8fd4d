"""What slow motion shows: static gain, offset, dead band; and the calibration of a sensor (thesis 3.2.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from servofd.models.play import play

if TYPE_CHECKING:
    from servofd.identification.records import Run
    from servofd.types import FloatArray

__all__ = ["CalibrationLine", "StaticLine", "calibration_line", "static_line"]

_WIDEST_SHARE, _WIDTHS = 0.3, 40
"""Dead bands are searched up to this part of the range of motion, in so many steps before the last refinement."""
_WINDOW_S = 0.1


@dataclass(frozen=True, slots=True)
class StaticLine:
    """Position against command of slow motion."""

    gain: float
    """[deg/deg]."""
    offset_deg: float
    dead_band_deg: float
    """Full width of the zone in which the command may turn back without effect [deg]."""
    lag_s: float
    """How late a slow ramp is followed [s]."""


@dataclass(frozen=True, slots=True)
class CalibrationLine:
    """Reading of a sensor, or pulse of a command, to angle: angle = slope (reading - trim)."""

    slope_deg: float
    """Degrees per count, or per microsecond."""
    trim: float
    """Reading at zero degrees."""
    largest_error_deg: float
    """Of the points about the line: a converter or a linkage that is not straight needs a table."""


def static_line(runs: Sequence[Run]) -> StaticLine:
    """Regress position on command behind a dead band, and on its rate; the width that leaves least is the dead band.

    A servo that is late lags a ramp in proportion to its rate; a dead band holds it at every turn.

    Parameters
    ----------
    runs : sequence of Run
        Slow motion: ramps, triangles, slow sines.

    Returns
    -------
    StaticLine
        Least squares.

    Examples
    --------
    >>> from servofd.identification.records import prepared
    >>> from servofd.segment import Segment
    >>> t = np.arange(2000) / 100.0
    >>> command = 20.0 * np.abs(np.mod(t / 5.0, 2.0) - 1.0)
    >>> line = static_line([prepared(Segment("x", t, command, t, 1.0 + 0.9 * play(command, 2.0, 20.0)))])
    >>> round(line.gain, 2), round(line.dead_band_deg, 2)
    (0.9, 2.0)
    """
    from scipy.optimize import minimize_scalar

    widest_deg = _WIDEST_SHARE * max(run.span_deg for run in runs)
    grid = np.linspace(0.0, widest_deg, _WIDTHS)
    best = int(np.argmin([_regressed(runs, width)[1] for width in grid]))
    around = grid[max(best - 1, 0)], grid[min(best + 1, _WIDTHS - 1)]
    found = minimize_scalar(lambda width: _regressed(runs, width)[1], bounds=around, method="bounded")
    width = float(found.x) if found.fun < _regressed(runs, 0.0)[1] else 0.0
    (gain, lag, offset), _ = _regressed(runs, width)
    return StaticLine(float(gain), float(offset), width, float(-lag / gain))


def _regressed(runs: Sequence[Run], width_deg: float) -> tuple[FloatArray, float]:
    """Coefficients of command, rate and constant, and the squared error."""
    rows, positions = [], []
    for run in runs:
        at = np.searchsorted(run.command_s, run.measured_s + 1e-9, side="right") - 1
        command = play(run.command_deg, width_deg, float(run.command_deg[0]))[at]
        rate = (command - np.interp(run.measured_s - _WINDOW_S, run.measured_s, command)) / _WINDOW_S
        rows.append(np.column_stack([command, rate, np.ones(rate.size)]))
        positions.append(run.measured_deg)
    matrix, position = np.vstack(rows), np.concatenate(positions)
    solution = np.linalg.lstsq(matrix, position, rcond=None)[0]
    error = position - matrix @ solution
    return solution, float(error @ error)


def calibration_line(reading: FloatArray, angle_deg: FloatArray) -> CalibrationLine:
    """Line through the points of a calibration test.

    Parameters
    ----------
    reading : ndarray, shape (n,)
        Counts or microseconds, at least two different ones.
    angle_deg : ndarray, shape (n,)
        Angle the shaft was set to [deg].

    Returns
    -------
    CalibrationLine
        Slope and trim for an aircraft file (``slope_deg_per_count``, ``trim_count``).

    Examples
    --------
    >>> line = calibration_line(np.array([1000.0, 2000.0, 3000.0]), np.array([-45.0, 0.0, 45.0]))
    >>> round(line.slope_deg, 6), round(line.trim, 6)
    (0.045, 2000.0)
    """
    slope, offset = np.polyfit(reading, angle_deg, 1)
    error = angle_deg - (slope * reading + offset)
    return CalibrationLine(float(slope), float(-offset / slope), float(np.max(np.abs(error))))
