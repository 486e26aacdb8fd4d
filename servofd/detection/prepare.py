"""What has to be known of a log before it is judged: positions that are glitches, commands that were thinned out."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from servofd.detection.residual import ResidualGenerator, Residuals
    from servofd.segment import Segment
    from servofd.types import BoolArray, FloatArray

__all__ = ["Prepared", "glitches", "prepared"]

_GLITCH_SIGMAS, _AGREEMENT_SIGMAS = 10.0, 8.0
_MOST_GLITCHES = 0.02
"""Where more than this share of the positions jump, jumping is what this position does."""
_FEW_GLITCHES = 2
_SMALLEST_NOISE_DEG = 0.02
_THIN_PERIOD_S = 0.039
"""Logs at up to 25 Hz may hold fewer commands than the servo received; autopilots command at 50 Hz and more."""
_REAL_PERIOD_S = 0.02
_CLEARLY_SMALLER = 0.7


class Prepared(NamedTuple):
    """A segment that can be judged, and what was done to it."""

    segment: Segment
    residuals: Residuals
    notes: tuple[str, ...]


def prepared(generator: ResidualGenerator, segment: Segment) -> Prepared:
    """Run the generator, without glitches and with the hold that suits the commands.

    A position that jumps away for one or two samples and back is no servo's motion. Commands that were logged at
    10 to 25 Hz, but given more often, look like steps that nobody commanded: if straight lines between them leave a
    clearly smaller residual, that is what they were.
    """
    notes = []
    residuals = generator.run(segment)
    if segment.command_period_s is None and segment.period_s >= _THIN_PERIOD_S:
        straight = replace(segment, command_period_s=_REAL_PERIOD_S)
        by_lines = generator.run(straight)
        if _rms_deg(by_lines) < _CLEARLY_SMALLER * _rms_deg(residuals):
            segment, residuals = straight, by_lines
            notes.append("commands are logged more thinly than they were given, and taken as straight lines between")
    jumps = glitches(residuals.error_deg)
    if jumps.any():
        segment = replace(segment, measured_deg=np.where(jumps, np.nan, segment.measured_deg))
        residuals = generator.run(segment)
        count = int(np.count_nonzero(jumps))
        notes.append(f"{count} position{'s' if count > 1 else ''} that jumped away and back not judged")
    return Prepared(segment, residuals, tuple(notes))


def glitches(error_deg: FloatArray) -> BoolArray:
    """Samples that jump away from their neighbours, alone or in pairs, while the neighbours agree; shape (n,).

    Examples
    --------
    >>> error_deg = np.zeros(20)
    >>> error_deg[9] = 25.0
    >>> np.flatnonzero(glitches(error_deg)).tolist()
    [9]
    """
    known = np.flatnonzero(np.isfinite(error_deg))
    values = error_deg[known]
    found = np.zeros(error_deg.size, dtype=bool)
    if values.size < 8:
        return found
    curvature = np.abs(np.diff(values, 2))
    noise_deg = max(float(np.median(curvature)) * 1.4826 / np.sqrt(6.0), _SMALLEST_NOISE_DEG)
    candidates = np.flatnonzero(curvature > _GLITCH_SIGMAS * noise_deg) + 1
    if candidates.size == 0:
        return found
    for width in (1, 2):
        # The neighbours of a jump from `first` on: two before, two after.
        first = candidates[(candidates >= 2) & (candidates + width + 1 < values.size)]
        around = np.stack([values[first - 2], values[first - 1], values[first + width], values[first + width + 1]])
        middle = np.median(around, axis=0)
        away = np.min([np.abs(values[first + i] - middle) for i in range(width)], axis=0)
        agree = np.ptp(around, axis=0) <= _AGREEMENT_SIGMAS * noise_deg
        jumps = first[agree & (away > _GLITCH_SIGMAS * noise_deg)]
        for i in range(width):
            found[known[jumps + i]] = True
    if np.count_nonzero(found) > max(_MOST_GLITCHES * values.size, _FEW_GLITCHES):
        found[:] = False
    return found


def _rms_deg(residuals: Residuals) -> float:
    judged = residuals.residual_deg[residuals.settled]
    return float(np.sqrt(np.mean(judged**2))) if judged.size else float("inf")
