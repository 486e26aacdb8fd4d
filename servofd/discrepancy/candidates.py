"""Which effects are tried on a record, and which it cannot judge."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servofd.discrepancy.at_rest import AT_REST
from servofd.models.catalogue import CATALOGUE, Damping, PwmFrame, SlowDynamics

if TYPE_CHECKING:
    from servofd.discrepancy.fit import Fit
    from servofd.discrepancy.record import Record
    from servofd.models.catalogue import MissingEffect

__all__ = ["first_of_each", "judgeable"]


def judgeable(record: Record) -> tuple[list[type[MissingEffect]], list[type[MissingEffect]]]:
    """Effects that this record can judge, and those that need something it does not hold."""
    held = {
        name
        for name, values in (
            ("airspeed_m_s", record.pressure_pa),
            ("servo_voltage_v", record.voltage_v),
            ("servo_current_a", record.current_a),
        )
        if values is not None
    }
    if record.side is not None:
        return list(AT_REST), [effect for effect in CATALOGUE if effect not in AT_REST]
    own = (record.own.missing_effect(),) if record.own else ()
    able = [effect for effect in (*CATALOGUE, *own) if set(effect.needs) <= held]
    unable = [effect for effect in CATALOGUE if effect not in able]
    fitted = {SlowDynamics, Damping} if record.free_poles else set()
    # Frames run on between separate runs, so that nobody knows when each of them began.
    fitted |= {PwmFrame} if record.runs or record.free_poles else set()
    return [effect for effect in able if effect not in fitted], unable


def first_of_each(fits: list[Fit]) -> tuple[Fit, ...]:
    """The first fit of each name."""
    first: dict[str, Fit] = {}
    for fit in fits:
        first.setdefault(fit.names[-1], fit)
    return tuple(first.values())
