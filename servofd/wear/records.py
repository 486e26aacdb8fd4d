"""What is followed over flights, and what one flight tells of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from types import MappingProxyType
from typing import Literal

from servofd.estimate.statistics import Estimate


@dataclass(frozen=True, slots=True)
class Quantity:
    """One number of a servo."""

    name: str
    """With its unit as the last word."""
    title: str
    unit: str
    worse: Literal["up", "down", "away"]
    """Which way wear goes; ``away`` from zero to either side."""
    scale: float = 1.0
    """From the number to what is shown in `unit`."""
    digits: int = 2
    of_axis: bool = False
    """Told by the motion of an aircraft whose servos report nothing."""


QUANTITIES: Mapping[str, Quantity] = MappingProxyType(
    {
        one.name: one
        for one in (
            Quantity("dead_band_deg", "dead band or backlash, full width", "deg", "up"),
            Quantity("bias_deg", "bias", "deg", "away"),
            Quantity("delay_s", "delay", "ms", "up", 1e3, 1),
            Quantity("bandwidth_hz", "bandwidth", "Hz", "down"),
            Quantity("rate_limit_deg_s", "rate limit", "deg/s", "down", digits=0),
            Quantity("rate_per_volt_deg_s_v", "rate limit per volt", "deg/s/V", "down", digits=1),
            Quantity("noise_deg", "noise of the position", "deg", "up", digits=3),
            Quantity("residual_p95_deg", "residual, 95th percentile", "deg", "up", digits=3),
            Quantity("margin", "threshold margin", "%", "down", 100.0, 0),
            Quantity("effect", "effect that is left", "%", "down", 100.0, 0, of_axis=True),
            Quantity("offset_us", "offset", "us", "away", digits=0, of_axis=True),
        )
    }
)
"""By name, in the order in which they are shown."""


@dataclass(frozen=True, slots=True)
class FlightEstimate:
    """One servo in one flight."""

    path: str
    run: str
    surface: str
    start_utc: datetime | None
    duration_s: float
    values: Mapping[str, Estimate]
    """Of `QUANTITIES`, with 95 % intervals; what the flight does not show is left out."""
    missing: Mapping[str, str]
    """Why, for those that are left out."""
    linkage: Mapping[str, Estimate] = field(default_factory=dict)
    """What differs if the zone of rest is not the servo's dead band but backlash of the linkage."""
    evidence: float = 0.0
    """Logarithm of how much better backlash explains the flight."""
    alarm: str = ""
    """What an axis did not do as calibrated in this flight; empty if it answered."""

    @property
    def name(self) -> str:
        """Path, and the run where there are several."""
        return f"{self.path} (run {self.run})" if self.run else self.path
