"""One surface's flight as the bank gets it, and a fault as the bank gives it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from servofd.detection.bank.window import Onset, Window

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servofd.core.tolerance import Tolerance
    from servofd.detection.alarm import Level
    from servofd.detection.residual import Commands, ResidualGenerator, Residuals
    from servofd.estimate.statistics import Estimate

_FEWEST_SAMPLES = 12


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault of one surface."""

    kind: str
    """`unknown` if no hypothesis explains it, or several do alike."""
    start_s: float
    """Best estimate of the onset [s]."""
    alarm_s: float
    """When the alarm would have been raised in flight [s]."""
    end_s: float | None
    """When it was last seen [s]; None if it lasts to the end of the log."""
    parameters: Mapping[str, Estimate]
    probability: float
    """Of that kind; of the likeliest alternative if several do alike."""
    alternatives: tuple[str, ...]
    level: Level = "fault"
    named_s: float | None = None
    """When there were data enough for this name [s]."""
    first_signs: tuple[str, ...] = ()
    """What it could have been for all that was known within its first second."""


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """All that the bank needs to know of one surface's flight."""

    generator: ResidualGenerator
    tolerance: Tolerance
    noise_deg: float
    """Of the position."""
    sigma_deg: float
    """Of the healthy residual."""
    residuals: Residuals
    commands: Commands
    is_report: bool = True
    """Whether what only reports tell is wanted: the first signs of each fault."""

    def window(self, from_s: float, to_s: float, onset: Onset | None) -> Window | None:
        """Cut out a stretch; None if it holds too few samples."""
        time_s = self.residuals.time_s
        first, last = (int(i) for i in np.searchsorted(time_s, (from_s, to_s + 1e-9)))
        span = slice(first, last)
        if np.count_nonzero(self.residuals.settled[span]) < _FEWEST_SAMPLES:
            return None
        return Window.of(
            self.generator.model, self.tolerance, self.noise_deg, self.residuals, self.commands, span, onset
        )

    @property
    def end_s(self) -> float:
        """Last sample [s]."""
        return float(self.residuals.time_s[-1])
