"""Which effects are tried on a record, at which places of the servo's slow pole, and which it cannot judge."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from servofd.discrepancy.at_rest import AT_REST
from servofd.discrepancy.steps import COARSE_STEP_DEG
from servofd.servo import catalogue
from servofd.servo.catalogue import CATALOGUE
from servofd.servo.laws import plain
from servofd.servo.physics import AFTER, BEFORE, INSIDE

if TYPE_CHECKING:
    from servofd.discrepancy.record import Record
    from servofd.servo.missing_effect import MissingEffect

_PLACES: dict[type[MissingEffect], tuple[float, ...]] = {
    catalogue.DeadBand: (BEFORE, INSIDE, AFTER),
    catalogue.InsensitiveBand: (BEFORE, INSIDE),
    catalogue.Friction: (BEFORE, INSIDE, AFTER),
    catalogue.StribeckFriction: (BEFORE, INSIDE, AFTER),
    catalogue.RateLimit: (BEFORE, INSIDE, AFTER),
    catalogue.AsymmetricRate: (BEFORE, INSIDE),
    catalogue.ShaftSpeed: (BEFORE, AFTER, INSIDE),
    catalogue.VoltageRate: (BEFORE, INSIDE, AFTER),
    catalogue.ShaftSpeedBySupply: (BEFORE, AFTER, INSIDE),
    catalogue.AirLoad: (BEFORE, INSIDE),
    catalogue.GravityLoad: (BEFORE, INSIDE),
    catalogue.TiltedLoad: (BEFORE, INSIDE),
    catalogue.ExternalLoad: (BEFORE, INSIDE),
    catalogue.LoadFriction: (BEFORE, INSIDE),
    catalogue.CurrentLimit: (BEFORE, INSIDE),
    catalogue.Backlash: (INSIDE, BEFORE, AFTER),
}
"""Effects that act within the loop, or before what may follow it, and so differ with the place of the slow pole."""
_BEYOND_LOOP = (catalogue.Backlash,)
"""Of these, what acts on what the loop moves: a slow pole before the loop is then one inside it, unless something
within the loop tells them apart."""


def places_of(effect: type[MissingEffect]) -> tuple[float, ...]:
    """Where the slow pole may lie with this effect; empty if it does not matter."""
    return _PLACES.get(plain(effect), ())


def common_places(effects: tuple[type[MissingEffect], ...]) -> tuple[float, ...]:
    """Where the slow pole may lie with all of some effects; empty if it does not matter to any.

    Examples
    --------
    >>> common_places((catalogue.Backlash,)), common_places((catalogue.Backlash, catalogue.VoltageRate))
    ((0.0, 1.0), (0.0, -1.0, 1.0))
    """
    placed = [effect for effect in effects if places_of(effect)]
    if not placed:
        return ()
    same = {BEFORE} if all(plain(effect) in _BEYOND_LOOP for effect in placed) else set()
    if catalogue.SensorLag in effects:  # that and a slow pole after the loop are one thing
        same.add(AFTER)
    return tuple(
        each for each in places_of(placed[0]) if each not in same and all(each in places_of(other) for other in placed)
    )


SMALLEST = {
    "gain": 0.02,
    "bandwidth_scale": 0.08,
    "damping_scale": 0.2,
    "delay_s": 0.004,
    "offset_s": 0.004,
    "lag_s": 0.004,
    "deadband_deg": 0.15,
    "insensitive_deg": 0.15,
    "friction_deg": 0.08,
    "backlash_deg": 0.12,
    "bias_deg": 0.2,
    "droop_deg": 0.1,
    "load_friction": 0.03,
}
"""What is smaller is the difference between two servos of a type, or no servo's at all; by field of `Physics`.

A weight that turns the shaft by less than the least step of its pulses (1 us: 0.1 deg) can be nobody's finding."""
SURPRISE = {
    "clock_offset": 4.0,
    "damping": 8.0,
    "quantization": 24.0,
    "supply_coupling": 8.0,
    "load_friction": 8.0,
    "current_limit": 8.0,
    "linkage_nonlinearity": 12.0,
    "resonance": 8.0,
}
"""Minus twice the logarithm of how much rarer than the others an effect is, or how much more it can pass for."""


_EITHER = (
    ("rate_limit", "voltage_rate"),
    ("delay", "clock_offset"),
    ("friction", "load_friction"),
    ("gravity_load", "linkage_nonlinearity"),
)
"""Two forms of one thing, or one that bends the position much as the other does."""


class Candidate(NamedTuple):
    """An effect, and where the slow pole lies."""

    effect: type[MissingEffect]
    place: float


def judgeable(record: Record) -> tuple[list[type[MissingEffect]], list[type[MissingEffect]]]:
    """Effects that this record can judge, and those that need something it does not hold."""
    held = {
        name
        for name, values in (
            ("airspeed_m_s", record.pressure_pa),
            ("servo_voltage_v", record.voltage_v),
            ("servo_current_a", record.current_a),
            ("servo_load", record.pushed),
        )
        if values is not None
    }
    if record.side is not None:
        return list(AT_REST), [effect for effect in CATALOGUE if effect not in AT_REST]
    own = (record.own.missing_effect(),) if record.own else ()
    able = [effect for effect in (*CATALOGUE, *own) if set(effect.needs) <= held]
    unable = [effect for effect in CATALOGUE if effect not in able and effect is not catalogue.ExternalLoad]
    linear: set[type[MissingEffect]] = {
        catalogue.SlowDynamics,
        catalogue.Damping,
        catalogue.SensorLag,
        catalogue.ClockOffset,
    }
    fitted: set[type[MissingEffect]] = linear if record.free_poles else set()
    # A surface's weight is balanced about its hinge, and a bench's horn hangs at zero; an arm's joint hangs anywhere.
    is_arm = record.free_poles and not record.runs and record.pressure_pa is None
    fitted |= set() if is_arm else {catalogue.TiltedLoad}
    # Frames run on between separate runs, so that nobody knows when each of them began.
    fitted |= {catalogue.PwmFrame} if record.runs or record.free_poles else set()
    # A converter whose steps do not show in the readings has none that matter.
    fitted |= {catalogue.CommandSteps} if (record.step_deg or 0.0) >= COARSE_STEP_DEG else {catalogue.Quantization}
    return [effect for effect in able if effect not in fitted], unable


def excluded(known: tuple[type[MissingEffect], ...]) -> set[str]:
    """Names that cannot come on top of known effects: they are there already, in this form or another."""
    names = {effect.name for effect in known}
    return names | {other for pair in _EITHER for name in pair if name in names for other in pair}


def candidates(
    record: Record, able: list[type[MissingEffect]], known: tuple[type[MissingEffect], ...], place: float
) -> list[Candidate]:
    """What may come on top of known effects; a servo has one slow pole, in one place."""
    names = excluded(known)
    found = []
    for effect in able:
        if effect.name in names or effect is catalogue.PwmFrame:
            continue
        where: tuple[float, ...] = (place,)
        if places_of(effect) and record.plant.has_places and record.side is None:
            where = common_places((*known, effect))
        found += [Candidate(effect, each) for each in where]
    if catalogue.SensorLag in known:
        return [each for each in found if each.place != AFTER]
    return [each for each in found if each != Candidate(catalogue.SensorLag, AFTER)]
