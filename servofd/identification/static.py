"""What slow motion shows: static gain, offset, dead band; and the calibration of a sensor (thesis 3.2.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from servofd.identification.records import Run
    from servofd.types import FloatArray

__all__ = ["CalibrationLine", "StaticLine", "calibration_line", "static_line"]

_SLOW_SHARE = 0.5
"""Of the fastest motion: faster commands may have met the rate limit."""
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
    """Regress position on command, its direction and its rate, over slow motion.

    A servo that is late lags a ramp in proportion to its rate, a dead band by half its width whatever the rate:
    that tells them apart.

    Parameters
    ----------
    runs : sequence of Run
        Slow motion among them: ramps, triangles, slow sines.

    Returns
    -------
    StaticLine
        Least squares.

    Examples
    --------
    >>> from servofd.identification.records import prepared
    >>> from servofd.models.play import play
    >>> from servofd.segment import Segment
    >>> t = np.arange(2000) / 100.0
    >>> command = 20.0 * np.abs(np.mod(t / 5.0, 2.0) - 1.0)
    >>> line = static_line([prepared(Segment("x", t, command, t, 1.0 + 0.9 * play(command, 2.0, 20.0)))])
    >>> round(line.gain, 2), round(line.dead_band_deg, 1)
    (0.9, 2.0)
    """
    commands, directions, rates, positions = [], [], [], []
    for run in runs:
        at = np.searchsorted(run.command_s, run.measured_s + 1e-9, side="right") - 1
        command = run.command_deg[at]
        before = np.interp(run.measured_s - _WINDOW_S, run.measured_s, command)
        rate = (command - before) / _WINDOW_S
        held = np.concatenate([[0], np.flatnonzero(rate)])
        last = held[np.searchsorted(held, np.arange(rate.size), side="right") - 1]
        commands.append(command)
        directions.append(np.sign(rate)[last])
        rates.append(rate)
        positions.append(run.measured_deg)
    command, direction, rate, position = (np.concatenate(x) for x in (commands, directions, rates, positions))
    fastest = float(np.quantile(np.abs(rate[rate != 0.0]), 0.9)) if np.any(rate) else 0.0
    slow = np.abs(rate) <= _SLOW_SHARE * fastest if np.ptp(np.abs(rate)) > 0.1 * fastest else np.ones(rate.size, bool)
    matrix = np.column_stack([command, direction, rate, np.ones(rate.size)])[slow]
    gain, half, lag, offset = np.linalg.lstsq(matrix, position[slow], rcond=None)[0]
    return StaticLine(float(gain), float(offset), max(0.0, float(-2.0 * half / gain)), float(-lag / gain))


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
