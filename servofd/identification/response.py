"""Smoothed frequency response of a servo from a sweep: Blackman and Tukey's method, MATLAB's ``spa`` (thesis 3.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servofd.core.series import stretches
from servofd.core.types import BoolArray, ComplexArray, FloatArray

LAGS_S = 4.0
"""Reach of the lag window: 400 lags at 100 Hz. With 100 (thesis Appendix A) poles come out four times as wrong,
because a narrow window smears the resonance; with more the estimate is no longer smooth (measured)."""

LOWEST_COHERENCE = 0.8
"""Below this the response says nothing (thesis 3.4)."""

_EXCITED_SHARE = 0.1
"""Of the strongest power of the command, per hertz or per octave: linear and exponential sweeps count as a whole."""
_UPPER_SHARE = 0.8
"""Of the highest excited frequency: the thesis sweeps to 25 Hz and fits to 20 Hz (Appendix A)."""
_FREQUENCIES = 4096
"""Frequencies of the response at least."""
_LEAST_POWER = 1e-100
"""Smallest power, so that nothing is divided by zero."""


@dataclass(frozen=True, slots=True, eq=False)
class FrequencyResponse:
    """Response of sampled position to sampled command; it contains the hold of the command.

    `frequency_rad_s` (shape (m,)): rising, above zero [rad/s]. `response` (shape (m,)): complex gain [deg/deg].
    `coherence` (shape (m,)): between 0 and 1: share of the position's power that a linear servo explains.
    `command_power` (shape (m,)): spectral density of the command, of any scale. `sample_time_s`: period of the samples
    and of the hold [s].
    """

    frequency_rad_s: FloatArray
    response: ComplexArray
    coherence: FloatArray
    command_power: FloatArray
    sample_time_s: float

    @property
    def phase_rad(self) -> FloatArray:
        """Unwrapped phase, shape (m,)."""
        return np.unwrap(np.angle(self.response))

    def band_rad_s(self) -> tuple[float, float] | None:
        """Range of frequencies that were excited and in which the position follows the command.

        Result: lowest and highest frequency [rad/s]; None if the coherence is nowhere above 0.8.
        """
        per_octave = self.frequency_rad_s * self.command_power
        excited = (self.command_power >= _EXCITED_SHARE * self.command_power.max()) | (
            per_octave >= _EXCITED_SHARE * per_octave.max()
        )
        highest = _UPPER_SHARE * self.frequency_rad_s[excited][-1]
        good = excited & (self.frequency_rad_s <= highest) & (self.coherence > LOWEST_COHERENCE)
        first, last = _longest_run(good)
        return (float(self.frequency_rad_s[first]), float(self.frequency_rad_s[last])) if last > first else None


def estimate(command_deg: FloatArray, measured_deg: FloatArray, sample_time_s: float) -> FrequencyResponse:
    """Estimate the response from uniform samples.

    Biased covariances up to `LAGS_S`, a Hann window over them, and their Fourier transforms: the ratio of the cross
    to the command's spectrum is the response, what remains of the position's spectrum sets the coherence.
    """
    reach = min(round(LAGS_S / sample_time_s), command_deg.size // 4)
    window = 0.5 * (1.0 + np.cos(np.pi * np.arange(-reach, reach + 1) / reach))
    u, y = command_deg - command_deg.mean(), measured_deg - measured_deg.mean()
    size = 2 * max(_FREQUENCIES, 1 << int(np.ceil(np.log2(2 * reach + 1))))
    cross, *powers = (_spectrum(a, b, window, size) for a, b in ((y, u), (u, u), (y, y)))
    command, position = (np.maximum(power.real, _LEAST_POWER) for power in powers)
    frequency_rad_s: FloatArray = np.arange(size // 2 + 1, dtype=float) * (2.0 * np.pi / (size * sample_time_s))
    coherence = np.minimum(np.abs(cross) ** 2 / (command * position), 1.0)
    inner = slice(1, -1)
    return FrequencyResponse(
        frequency_rad_s[inner], (cross / command)[inner], coherence[inner], command[inner], sample_time_s
    )


def raw_response(command_deg: FloatArray, measured_deg: FloatArray) -> ComplexArray:
    """Ratio of the plain Fourier transforms, the thesis' "raw" response, shape (n // 2 + 1,); NaN where unexcited."""
    command, measured = np.fft.rfft(command_deg), np.fft.rfft(measured_deg)
    excited = np.abs(command) > 1e-12 * np.abs(command).max()
    ratio: ComplexArray = np.full(command.size, np.nan, dtype=complex)
    ratio[excited] = measured[excited] / command[excited]
    return ratio


def average(responses: Sequence[FrequencyResponse]) -> FrequencyResponse:
    """Average servos of one kind: logarithm of magnitude and unwrapped phase, weighted by coherence (thesis 3.3)."""
    grid = responses[0].frequency_rad_s
    rows = [
        [np.interp(grid, r.frequency_rad_s, v) for v in (np.log(np.abs(r.response)), r.phase_rad, r.coherence)]
        for r in responses
    ]
    magnitudes, phases, coherences = (np.array(values) for values in zip(*rows, strict=True))
    weights = coherences + 1e-12
    weights /= weights.sum(axis=0)
    magnitude, phase = (weights * magnitudes).sum(axis=0), (weights * phases).sum(axis=0)
    power = np.mean([np.interp(grid, r.frequency_rad_s, r.command_power) for r in responses], axis=0)
    return FrequencyResponse(
        grid, np.exp(magnitude + 1j * phase), (weights * coherences).sum(axis=0), power, responses[0].sample_time_s
    )


def _spectrum(a: FloatArray, b: FloatArray, window: FloatArray, size: int) -> ComplexArray:
    """Fourier transform of the biased covariance of a(t + k) and b(t), windowed over k, lag zero in the middle."""
    from scipy.fft import irfft, next_fast_len, rfft

    reach = window.size // 2
    padded = next_fast_len(a.size + reach, real=True)
    circular = irfft(rfft(a, padded) * np.conj(rfft(b, padded)), padded) / a.size
    folded = np.zeros(size)
    folded[: reach + 1], folded[-reach:] = window[reach:] * circular[: reach + 1], window[:reach] * circular[-reach:]
    return np.fft.rfft(folded)


def _longest_run(flags: BoolArray) -> tuple[int, int]:
    """First and last index of the longest stretch of true flags; a hole of one tenth of it may be bridged."""
    merged: list[tuple[int, int]] = []
    for first, last in ((a, b - 1) for a, b in stretches(flags)):
        if merged and first - merged[-1][1] <= 0.1 * (merged[-1][1] - merged[-1][0]):
            merged[-1] = (merged[-1][0], last)
        else:
            merged.append((first, last))
    return max(merged, key=lambda run: run[1] - run[0], default=(0, -1))
