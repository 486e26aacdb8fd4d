"""What a calibration found, and the aircraft that follows from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from servofd.aircraft import Aircraft
    from servofd.calibrating.fit import ServoFit
    from servofd.calibrating.levels import Levels

__all__ = ["Before", "CalibratedSurface", "Calibration", "FlightRecord"]


@dataclass(frozen=True, slots=True)
class FlightRecord:
    """Where numbers come from."""

    label: str
    """Name of the log, without folders."""
    used_s: float
    """How much of it was used [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedSurface:
    """One surface, fitted."""

    surface: str
    fit: ServoFit
    levels: Levels
    filter_pole_rad_s: float
    """Of the residual filter that the levels belong to [rad/s]."""
    before: Before
    flights: tuple[FlightRecord, ...]
    stretches: int
    """How many stretches with motion the tolerances come from."""
    suspicions: bool
    """Whether faults below the threshold may be looked for: not if the good flights already look suspect."""
    notes: tuple[str, ...]
    """What a user should know before trusting it."""


@dataclass(frozen=True, slots=True)
class Before:
    """How the aircraft file did before."""

    residual_std_deg: float
    threshold_deg: float


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """An aircraft calibrated from good flights."""

    aircraft: Aircraft
    """Ready for an audit."""
    surfaces: tuple[CalibratedSurface, ...]
    kept: dict[str, str]
    """Surfaces left as they were, and why."""
    false_alarms_per_hour: float
    """Wanted, of all surfaces together."""
