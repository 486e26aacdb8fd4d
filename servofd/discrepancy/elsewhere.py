"""How a model that was fitted to one flight does on another."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from servofd.core.series import rms
from servofd.discrepancy.noise import noise_floor_deg
from servofd.discrepancy.record import record_of, simulate

if TYPE_CHECKING:
    from servofd.aircraft.segment import Segment
    from servofd.discrepancy.own import OwnEffect
    from servofd.servo.physics import Physics
    from servofd.servo.servo_model import ServoModel


@dataclass(frozen=True, slots=True)
class Elsewhere:
    """Errors on a flight to which nothing was fitted [deg]."""

    path: str
    nominal_rms_deg: float
    extended_rms_deg: float
    noise_floor_rms_deg: float

    def document(self) -> dict[str, Any]:
        """Plain dictionary."""
        return asdict(self)


def judged_elsewhere(
    path: str, segment: Segment, model: ServoModel, physics: Physics, own: OwnEffect | None = None
) -> Elsewhere:
    """Errors of the servo as it was known, and with the effects that were found in another flight.

    Parameters
    ----------
    own : OwnEffect, optional
        An effect of the user's own that is among them.
    """
    record = record_of(segment, model, own=own)
    before, after = (record.measured_deg - simulate(record, each) for each in (record.plant.neutral, physics))
    floor_deg = noise_floor_deg(record, after)
    before_deg, after_deg = rms(before[record.counts]), rms(after[record.counts])
    return Elsewhere(path, before_deg, after_deg, min(floor_deg, after_deg))
