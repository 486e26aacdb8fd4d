"""What was found of a gap, in words: what is missing, how large it is, what to do next."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.core.statistics import Z_95
from servofd.discrepancy.noise import rest_sentence
from servofd.servo.loop import AFTER, BEFORE, scaled, split

if TYPE_CHECKING:
    from servofd.discrepancy.explanation import Explanation
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
        f"position comes at {rate_hz:.3g} Hz: only where the surface rests is judged, for how it moves cannot be told "
        f"below 20 Hz; {rest_sentence(record)}, now at one end and now at the other, which is hysteresis"
    )


def linear_sentence(record: Record, selection: Selection) -> str:
    """Which linear servo was fitted, as nobody knew one."""
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


_NAMES = {
    "delay": "a longer delay",
    "clock_offset": "positions stamped late",
    "slow_dynamics": "slower dynamics",
    "rate_limit": "a rate limit",
    "voltage_rate": "a rate limit that falls with the supply",
    "position_limit": "a stop",
    "deadband": "a dead band",
    "backlash": "play",
    "friction": "friction",
    "load_friction": "friction under load",
    "gain": "another gain",
    "bias": "an offset",
    "airload": "a surface that yields to the airload",
    "gravity_load": "a load that hangs on it",
    "external_load": "the load that was logged",
    "pwm_frame": "commands that wait for pulse frames",
    "sensor_lag": "a sensor that lags",
    "quantization": "coarse steps",
    "current_limit": "a supply that limits its current",
    "resonance": "a flexible linkage",
    "damping": "another damping",
    "supply_coupling": "a reading that moves with the current",
    "linkage_nonlinearity": "a crooked linkage",
}
_UNITS = (("deg_s_per_v", " deg/s per V"), ("deg_s", " deg/s"), ("_deg", " deg"), ("_s", " s"), ("_hz", " Hz"))
_SOUND = {
    "backlash": (0.3, "check horn, rod and gear for play"),
    "deadband": (0.4, "check the servo's electronics and its dead band setting"),
    "friction": (0.3, "check for binding, and the gear"),
    "bias": (1.0, "trim it, and check whether the horn slipped"),
}
"""Width or size that a sound hobby servo may have [deg], and what to do beyond: HS-225BB has 0.3 deg of free play."""
_MOSTLY = 0.5
"""Share of the mean square that, left over, is most of it."""
_ANOTHER = "compare it with a second servo of its kind"
_TELLING = "record steps of two sizes, a slow triangle and a sine of 3 Hz"


def answer_of(found: Explanation) -> str:
    """A few sentences, the most important first."""
    before, after = found.held_out_deg
    reasons, rungs = found.selection.adequacy.reasons, found.selection.rungs
    parts = []
    if found.fault_s is not None:
        parts.append(f"FAULT from {found.fault_s:.1f} s on: the servo no longer does what its command asks")
    elif found.undriven:
        parts.append("The servo was not driven for part of the record (times below); that part was left out")
    if not rungs and not reasons:
        told = "Before that, nothing is missing" if found.fault_s is not None else "Nothing is missing"
        parts.append(f"{told}: what is left is noise of {found.selection.sigma_deg:.3g} deg")
    elif not rungs:
        parts.append(f"Unexplained: the model is wrong by {after:.3g} deg, and no effect that is known accounts for it")
        if found.fault_s is None:
            parts.append("That alone is no sign of a fault")
    else:
        mostly = is_mostly_left(found)
        if mostly:
            parts.append(f"Mostly unexplained: {after:.3g} of {before:.3g} deg remain on data not fitted")
        named = [_named(found, k, judged=not mostly) for k in range(len(rungs))]
        parts += [f"A part of it looks like {' and '.join(named)}"] if mostly else [_capital(each) for each in named]
        if not mostly:
            parts.append(f"With this the error falls from {before:.3g} to {after:.3g} deg on data not fitted")
        if reasons and not mostly:
            parts.append(f"Not all is explained: {reasons[0]}")
    advice = _advice(found)
    return ". ".join(parts) + (f". Next: {'; '.join(advice)}." if advice else ".")


def _capital(words: str) -> str:
    return words[:1].upper() + words[1:]


def is_mostly_left(found: Explanation) -> bool:
    """Whether the names account for less than half of what was wrong."""
    before, after = found.held_out_deg
    return bool(found.selection.adequacy.reasons) and after**2 > _MOSTLY * before**2


def _advice(found: Explanation) -> list[str]:
    """What to do next."""
    rungs, is_unknown = found.selection.rungs, found.record.free_poles
    beyond = [] if is_mostly_left(found) else beyond_sound(found)
    advice = [_SOUND[name][1] for name in beyond]
    if is_unknown and (beyond or (not rungs and found.selection.adequacy.reasons)):
        advice.append(_ANOTHER)
    if found.fault_s is None and found.selection.adequacy.reasons and (not rungs or is_mostly_left(found)):
        advice.append(_TELLING)
    if found.separating and (manoeuvre := found.separating[0].manoeuvre):
        advice.append(f"record {manoeuvre}, which tells {' from '.join(found.separating[0].effects)}")
    if rungs and found.is_simulated_by_audit and found.record.side is None and found.fault_s is None:
        advice.append("keep the model with --save")
    return advice


def _named(found: Explanation, index: int, *, judged: bool) -> str:
    """One effect with its size, what it may be instead, and, if judged, whether a sound servo may have it."""
    effect = found.selection.final.effects[index]
    values = effect_values(found.selection, index)
    name, value = next(iter(values.items()))
    unit = next((words for end, words in _UNITS if name.endswith(end)), "")
    law = next((each for each in found.varying if (each.effect, each.parameter) == (effect.name, name)), None)
    if law:
        (low, first), (high, last) = law.ends
        way = "falls" if last < first else "rises"
        size = f"{first:.3g}{unit} at {law.conditions[0]} {low:.3g} that {way} to {last:.3g}{unit} at {high:.3g}"
    else:
        size = f"{value['value']:.3g}{unit} ({value['low']:.3g} to {value['high']:.3g})"
    ties = next((tie[1:] for tie in found.selection.ties if tie[0] == effect.name), ())
    instead = f", or else {' or '.join(_NAMES.get(n, n) for n in ties)} (the data cannot tell which)" if ties else ""
    sound = ""
    if judged and effect.name in _SOUND:
        limit = _SOUND[effect.name][0]
        if abs(value["value"]) <= limit:
            sound = f": acceptable, a sound hobby servo has up to {limit:g} deg"
        elif found.record.free_poles:  # what a servo that nobody knows has may be how it was made
            sound = f": more than the {limit:g} deg of a sound hobby servo, which may be how this one is made"
        else:
            sound = f": FAULT, a sound hobby servo has at most {limit:g} deg"
    return f"{_NAMES.get(effect.name, effect.name)} of {size}{instead}{sound}"


def beyond_sound(found: Explanation) -> list[str]:
    """Effects that are larger than a sound servo has them."""
    names = []
    for k, effect in enumerate(found.selection.final.effects):
        value = next(iter(effect_values(found.selection, k).values()))["value"]
        if effect.name in _SOUND and abs(value) > _SOUND[effect.name][0]:
            names.append(effect.name)
    return names
