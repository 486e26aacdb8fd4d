"""Sentences about an explanation: the linear servo, what a slow log tells, what could not be judged, and sizes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.core.statistics import Z_95
from servofd.discrepancy.noise import rest_sentence
from servofd.servo.loop import AFTER, BEFORE, scaled, split

if TYPE_CHECKING:
    from servofd.discrepancy.record import Record
    from servofd.discrepancy.select import Selection
    from servofd.servo.effect import Effect

_CONTEXT = {
    "airspeed_m_s": "airspeed (column airspeed_m_s)",
    "servo_voltage_v": "supply voltage (servo_voltage_v)",
    "servo_current_a": "current (servo_current_a)",
    "servo_load": "load (servo_load)",
}


def effect_values(selection: Selection, index: int) -> dict[str, dict[str, float]]:
    """Parameters of one of the final effects, with 95 % intervals; infinite where the data do not show them."""
    final = selection.final
    first = sum(len(effect.parameters) for effect in final.effects[:index])
    result = {}
    for k, parameter in enumerate(final.effects[index].parameters, start=first):
        if parameter.aside:
            continue
        value, deviation = float(final.values[k]), float(np.sqrt(max(selection.covariance[k, k], 0.0)))
        if not np.isfinite(deviation):
            value = float("nan")
        result[parameter.name] = {
            "value": value,
            "low": max(value - Z_95 * deviation, parameter.low),
            "high": min(value + Z_95 * deviation, parameter.high),
        }
    return result


def unjudged_sentence(selection: Selection) -> str:
    """Which effects cannot be judged, and what would have to be logged."""
    names = ", ".join(dict.fromkeys(effect.name for effect in selection.unjudged))
    if selection.fitter.record.side is not None:
        return f"cannot be judged: {names}; the log comes too slowly"
    needs = " and ".join(_CONTEXT[need] for need in dict.fromkeys(n for e in selection.unjudged for n in e.needs))
    return f"cannot be judged: {names}; the log holds no {needs}"


def only_rests_sentence(record: Record) -> str:
    """What a slow log does not tell, and what it does."""
    rate_hz = min(1.0 / each.period_s for each in record.runs or (record,))
    return (
        f"position comes at {rate_hz:.3g} Hz: only rests are judged, and not how the surface moves, which takes "
        f"20 Hz; {rest_sentence(record)}, now at one end and now at the other, which is hysteresis"
    )


def linear_sentence(record: Record, selection: Selection) -> str:
    """Which linear servo was fitted, as none was known."""
    said = []
    for fit in (selection.nominal, selection.final):
        transfer = scaled(record.plant.transfer, fit.physics.scales)
        monic = np.array(transfer.denominator) / transfer.denominator[0]
        words = []
        if record.plant.has_places:
            slow, pair = split(monic)
            monic = np.array([1.0, *pair])
            words.append(f"a pole at {slow:.3g} rad/s")
        natural = float(np.sqrt(monic[2]))
        words.insert(0, f"{natural / (2.0 * np.pi):.3g} Hz, damping ratio {monic[1] / (2.0 * natural):.2g}")
        said.append(" and ".join(words))
    return f"no servo was known: one was fitted, by itself {said[0]}; beside the effects {said[1]}"


def form_of(effect: type[Effect], place: float) -> str | None:
    """Which machine an effect is, and on which side of the servo's slow pole it acts, where that matters."""
    where = {BEFORE: "behind the slow pole", AFTER: "ahead of the slow pole"}.get(place) if effect.places else None
    return "; ".join(filter(None, (effect.form, where))) or None
