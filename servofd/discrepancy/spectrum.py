"""At which frequencies a model is wrong, and up to which the position follows the command linearly at all."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from servofd.core.types import FloatArray
    from servofd.discrepancy.record import Record

_PIECE_S, _PIECES, _FEWEST_SAMPLES = 4.0, 5.5, 32
"""Length of what is transformed at once; the record is at least so many times as long, which makes ten of them, half
over half."""
_TAIL = 0.1
"""Share of the excess left out at either end of its band."""
_COHERENT, _ASKED = 0.9, 1e-2
"""Below the first the command tells less than nine tenths of the position; where its power is less than the second of
its largest, nothing was asked."""


class Spectrum(NamedTuple):
    """Densities over frequency; all of shape (k,)."""

    frequency_hz: FloatArray
    command_deg2_hz: FloatArray
    error_deg2_hz: FloatArray
    coherence: FloatArray
    """Of command and position: 1 where the position follows linearly and without noise, whatever the servo."""


def spectrum(record: Record, error_deg: FloatArray) -> Spectrum | None:
    """Welch's estimates, on evenly spaced samples; None if the record is too short for an average.

    Parameters
    ----------
    error_deg : ndarray, shape (n,)
        Measured minus simulated position [deg].

    Examples
    --------
    >>> from servofd.discrepancy.record import record_of
    >>> from servofd.servo.servo_model import ServoModel
    >>> from servofd.aircraft.segment import Segment
    >>> from servofd.servo.library import servo_named
    >>> rng, t = np.random.default_rng(0), np.arange(0.0, 60.0, 0.01)
    >>> asked = np.repeat(rng.standard_normal(1500), 4)
    >>> error = 0.5 * np.sin(2.0 * np.pi * 3.0 * t)
    >>> record = record_of(Segment("x", t, asked, t, asked + error), ServoModel.of(servo_named("s9254")))
    >>> low_hz, high_hz = excess_band_hz(spectrum(record, error), 0.0)
    >>> 2.5 < low_hz <= high_hz < 3.5
    True
    """
    from scipy.signal import coherence, welch

    known = np.flatnonzero(np.isfinite(record.measured_deg))
    period_s = record.period_s
    time_s = np.arange(record.time_s[known[0]], record.time_s[known[-1]], period_s)
    count = min(round(_PIECE_S / period_s), int(time_s.size / _PIECES))
    if count < _FEWEST_SAMPLES:
        return None
    command_deg = record.commands.at(time_s)
    measured_deg = np.interp(time_s, record.time_s[known], record.measured_deg[known])
    wrong_deg = np.interp(time_s, record.time_s, np.where(record.counts, np.nan_to_num(error_deg), 0.0))
    rate_hz = 1.0 / period_s
    frequency_hz, command = welch(command_deg, rate_hz, nperseg=count)
    _, error = welch(wrong_deg, rate_hz, nperseg=count)
    with np.errstate(invalid="ignore", divide="ignore"):
        _, follows = coherence(command_deg, measured_deg, rate_hz, nperseg=count)
    return Spectrum(frequency_hz, command, error, np.nan_to_num(follows))


def excess_band_hz(found: Spectrum, sigma_deg: float) -> tuple[float, float] | None:
    """Frequencies between which four fifths of what is more than white noise lie [Hz]; None if there is no more."""
    width_hz = found.frequency_hz[1]
    floor = sigma_deg**2 / (found.frequency_hz[-1] + 0.5 * width_hz)
    more = np.cumsum(np.maximum(found.error_deg2_hz - floor, 0.0)[1:])
    if more[-1] <= 0.0:
        return None
    low, high = np.searchsorted(more, [_TAIL * more[-1], (1.0 - _TAIL) * more[-1]]) + 1
    return float(found.frequency_hz[low] - 0.5 * width_hz), float(found.frequency_hz[high] + 0.5 * width_hz)


def coherent_to_hz(found: Spectrum) -> float | None:
    """Up to where command and position are coherent [Hz]; None if they are wherever anything was asked."""
    asked = found.command_deg2_hz >= _ASKED * found.command_deg2_hz[1:].max()
    asked[0] = False
    lost = np.flatnonzero(asked & (found.coherence < _COHERENT))
    return float(found.frequency_hz[lost[0]]) if lost.size else None
