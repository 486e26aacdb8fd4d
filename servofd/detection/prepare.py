"""What has to be known of a log before it is judged: positions that are glitches, commands that were thinned out."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servofd.aircraft.segment import pace_steps
from servofd.detection.glitches import glitches

if TYPE_CHECKING:
    from servofd.aircraft.segment import Segment
    from servofd.detection.residual import ResidualGenerator, Residuals

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

    A position that leaves the model for one or two samples and is back is no servo's fault. Commands that were logged
    at 10 to 25 Hz, but given more often, look like steps that nobody commanded: if straight lines between them leave a
    clearly smaller residual, that is what they were.
    """
    notes = []
    residuals = generator.run(segment)
    if segment.command_period_s is None and _period_s(segment) >= _THIN_PERIOD_S:
        straight = replace(segment, command_period_s=_REAL_PERIOD_S)
        by_lines = generator.run(straight)
        if _rms_deg(by_lines) < _CLEARLY_SMALLER * _rms_deg(residuals):
            segment, residuals = straight, by_lines
            notes.append("commands are logged more thinly than they were given, and taken as straight lines between")
    jumps = glitches(residuals.error_deg, residuals.restart)
    if jumps.any():
        segment = replace(segment, measured_deg=np.where(jumps, np.nan, segment.measured_deg))
        residuals = generator.without(residuals, jumps)
        count = int(np.count_nonzero(jumps))
        notes.append(f"{count} reading{'s' if count > 1 else ''} away from the model for a moment only, not judged")
    return Prepared(segment, residuals, tuple(notes))


def _period_s(segment: Segment) -> float:
    """Usual time between the samples of the rarer stream [s]."""
    steps_s = pace_steps(segment.command_s)
    return max(segment.period_s, float(np.median(steps_s)) if steps_s.size else 0.0)


def _rms_deg(residuals: Residuals) -> float:
    judged = residuals.residual_deg[residuals.settled]
    return float(np.sqrt(np.mean(judged**2))) if judged.size else float("inf")
