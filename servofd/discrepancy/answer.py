"""The answer first: what is missing, how much of it, whether that is a fault, and what to do next."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servofd.discrepancy.words import effect_values

if TYPE_CHECKING:
    from servofd.discrepancy.explanation import Explanation

__all__ = ["answer_of"]

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


def answer_of(found: Explanation) -> str:
    """A few sentences, the most important first."""
    before, after = (found.rms_deg(fit)["held_out_rms_deg"] for fit in (found.selection.nominal, found.selection.final))
    parts = []
    if found.fault_s is not None:
        parts.append(f"FAULT from {found.fault_s:.1f} s on: the servo no longer does what its command asks")
    elif found.undriven:
        parts.append("not driven in part (see below), which was left out")
    if not found.selection.rungs:
        if found.conclusion == "nothing_missing":
            told = "before that, nothing is missing" if found.fault_s is not None else "nothing is missing"
            parts.append(f"{told}: what is left is noise of {found.selection.sigma_deg:.3g} deg")
        else:
            parts.append(f"unexplained: {after:.3g} deg are left and no known effect tells them")
    else:
        parts += [_named(found, k) for k in range(len(found.selection.rungs))]
        parts.append(f"gap {before:.3g} -> {after:.3g} deg on data not fitted")
        if found.conclusion == "partly_explained" and found.selection.adequacy.reasons:
            parts.append(f"something is left: {found.selection.adequacy.reasons[0]}")
    advice = [_SOUND[name][1] for name in _beyond_sound(found)]
    if found.separating and found.separating[0].manoeuvre:
        advice.append(f"fly {found.separating[0].manoeuvre} to tell {' from '.join(found.separating[0].effects)}")
    if found.selection.rungs and found.is_simulated_by_audit and found.record.side is None and found.fault_s is None:
        advice.append("keep the model with --save")
    return "; ".join(parts) + (f". Next: {'; '.join(advice)}." if advice else ".")


def _named(found: Explanation, index: int) -> str:
    """One effect with its size, what it may be instead, and whether a sound servo may have it."""
    effect = found.selection.final.effects[index]
    values = effect_values(found.selection, index)
    name, value = next(iter(values.items()))
    unit = next((words for end, words in _UNITS if name.endswith(end)), "")
    size = f"{value['value']:.3g}{unit} ({value['low']:.3g} to {value['high']:.3g})"
    ties = next((tie[1:] for tie in found.selection.ties if tie[0] == effect.name), ())
    instead = f", or {' or '.join(_NAMES.get(n, n) for n in ties)}: cannot tell which" if ties else ""
    sound = ""
    if effect.name in _SOUND:
        limit = _SOUND[effect.name][0]
        beyond = abs(value["value"]) > limit
        sound = f" - a sound hobby servo has up to {limit:g}: {'FAULT' if beyond else 'acceptable'}"
    return f"{_NAMES.get(effect.name, effect.name)} of {size}{instead}{sound}"


def _beyond_sound(found: Explanation) -> list[str]:
    names = []
    for k, effect in enumerate(found.selection.final.effects):
        value = next(iter(effect_values(found.selection, k).values()))["value"]
        if effect.name in _SOUND and abs(value) > _SOUND[effect.name][0]:
            names.append(effect.name)
    return names
