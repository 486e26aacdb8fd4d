"""What a calibration found, and the aircraft that follows from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from servofd.core.evidence import NOTHING_DETECTABLE, Detectable
from servofd.detection.calibrated import FALSE_ALARMS_PER_HOUR

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servofd.aircraft.calibrated import CalibratedServo
    from servofd.aircraft.calibration import Calibration as Scale
    from servofd.aircraft.schema import Aircraft
    from servofd.core.tolerance import Tolerance
    from servofd.estimate.statistics import Estimate
    from servofd.servo.library import Servo


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
    known: CalibratedServo
    """Servo, noise, differences between flights, thresholds."""
    estimates: Mapping[str, Estimate]
    """Of the parameters, with 95 % intervals."""
    effects: tuple[str, ...]
    """Effects that predict flights better which they were not fitted to, in words, the most telling first."""
    measured: Scale
    """Channel of the position, so scaled that it reads in degrees of the command."""
    servo: Servo
    """The linear part alone, for constant thresholds, simulations and the script on board."""
    tolerance: Tolerance
    """How far a good servo strays from the linear part."""
    threshold_deg: float
    """Constant threshold that the flights stayed below, with a margin [deg]."""
    held_out_rms_deg: float
    explained_share: float
    flights: tuple[FlightRecord, ...]
    detectable: Detectable = NOTHING_DETECTABLE
    """What these flights would have shown."""
    sharper: str = ""
    """What more flights buy."""
    notes: tuple[str, ...] = ()
    """What a user should know before trusting it."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """An aircraft calibrated from good flights."""

    aircraft: Aircraft
    """Ready for an audit."""
    surfaces: tuple[CalibratedSurface, ...]
    kept: dict[str, str]
    """Surfaces left as they were, and why."""

    @property
    def false_alarms_per_hour(self) -> float:
        """Of all surfaces that were calibrated, in flights like those of simulated aircraft of other physics."""
        return len(self.surfaces) * FALSE_ALARMS_PER_HOUR

    """Wanted, of all surfaces together."""
