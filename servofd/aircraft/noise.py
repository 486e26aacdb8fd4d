"""Noise of a reading."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from servofd.core.types import FloatArray


@dataclass(frozen=True, slots=True)
class Noise:
    """What the reading does beside the position: sigma^2 = still^2 + (lag * speed)^2, coloured as an AR(2) process."""

    still_deg: float
    lag_s: float
    colour: tuple[float, float]
    """Of neighbouring samples, each over its sigma."""
    innovation: float
    """Standard deviation of what is new in each sample, over sigma."""
    period_s: float
    """Time between samples that the colour belongs to."""

    def sigma_deg(self, speed_deg_s: FloatArray) -> FloatArray:
        """Standard deviation at some largest speeds [deg]."""
        return np.sqrt(self.still_deg**2 + (self.lag_s * speed_deg_s) ** 2)

    def at(self, period_s: float) -> Noise:
        """The same noise, sampled at another rate."""
        ratio = period_s / self.period_s
        if 1 / 1.3 < ratio < 1.3:
            return self
        first, second = self.colour
        near = first / (1.0 - second)
        pole = float(np.clip(max(near, 0.0) ** ratio, 0.0, 0.95))
        return Noise(self.still_deg, self.lag_s, (pole, 0.0), float(np.sqrt(1.0 - pole**2)), period_s)
