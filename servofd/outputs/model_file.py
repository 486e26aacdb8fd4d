"""What was identified or explained as a file: a servo, or an aircraft with the effects that were found."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from logparsers.records import FlightLog
from servofd.aircraft.schema import Aircraft
from servofd.calibrating.levels import good_levels, levels_of
from servofd.core.toml_text import toml_comment, toml_key, toml_lines
from servofd.servo.catalogue import EffectTable, effects_named, table_of
from servofd.servo.effect import Effect
from servofd.servo.effects.commands import Delay
from servofd.servo.effects.linkage import Gain
from servofd.servo.effects.sensor import Bias
from servofd.servo.library import Servo
from servofd.servo.loop import INSIDE
from servofd.servo.servo_model import ServoModel

if TYPE_CHECKING:
    from servofd.discrepancy.explanation import Explanation
    from servofd.identification.result import Identification

_SCALES = {"slow_dynamics": "bandwidth_scale", "damping": "damping_scale"}


def model_file(
    found: Sequence[Explanation], aircraft: Aircraft, source: str, logs: Sequence[FlightLog]
) -> tuple[str, dict[str, str]]:
    """Aircraft file whose surfaces have what was missing; empty if nothing is better than what was known.

    Beside it the surfaces that have no better model and stay as they were, and why.
    """
    document = aircraft.model_dump(exclude_none=True, exclude_defaults=True)
    kept = {one.surface: one.not_saved for one in found if one.not_saved}
    lines, is_better = [], False
    for one in found:
        entry, servos = dict(document["surfaces"][one.surface]), document.get("servos", {})
        if one.surface not in kept:
            entry["effects"] = _merged(entry.get("effects", {}), _table(one))
            entry.pop("calibrated", None)  # of the servo without them
            if one.record.known.starts and not one.is_servo_of_its_own:
                # The servo that the search began with, of which the effects tell how the poles differ.
                begun = one.record.model.transfer
                poles = {"numerator": begun.numerator, "denominator": begun.denominator}
                servos = {**servos, entry["servo"]: {**servos[entry["servo"]], **poles}}
        elif one.selection.final.effects or not one.is_own_fit:
            continue
        document = {**document, "servos": servos, "surfaces": {**document["surfaces"], one.surface: entry}}
        levels = good_levels(type(aircraft).model_validate(document), one.surface, logs)
        if levels:  # what was shown: an audit also counts what follows a start, or a lost command
            levels["model"]["held_out_rms_deg"] = round(one.held_out_deg[1], 4)
        entry |= levels
        is_better = True
        if one.surface not in kept:
            names, (before_deg, after_deg) = ", ".join(one.selection.final.names), one.held_out_deg
            lines += [
                f"# Found by servofd explain in {toml_comment(source)}: {one.surface}: {names}.",
                f"# Held-out error of {one.surface}: {before_deg:.4g} deg rms before, {after_deg:.4g} with this model.",
            ]
    if not is_better:
        return "", kept
    lines = [*(f"# {surface}: as it was: {toml_comment(reason)}." for surface, reason in kept.items()), *lines]
    return "\n".join(lines) + "\n\n" + "\n".join(_toml(document)).lstrip("\n") + "\n", kept


def _table(found: Explanation) -> EffectTable:
    """The effects, and what the servo's own numbers came to beside them."""
    final, known, physics = found.selection.final, found.record.model.physics, found.physics
    poles = next(each for each in effects_named("poles") if each.fixed["slow_place"] == final.place)
    if found.is_servo_of_its_own:  # its poles are written as the servo's own
        physics = physics._replace(**{p.fields[0]: p.neutral for p in poles.parameters})
    fields = {name for effect in final.effects for p in effect.parameters for name in p.fields}
    beside: list[type[Effect]] = []
    for effect in (poles, Gain, Delay, Bias):
        names = [p.fields[0] for p in effect.parameters]
        moved = any(getattr(physics, name) != getattr(known, name) for name in names)
        if not fields.issuperset(names) and (moved or (effect is poles and final.place != INSIDE)):
            beside.append(effect)
    values = [getattr(physics, p.fields[0]) for effect in beside for p in effect.parameters]
    return table_of([*beside, *final.effects], np.array([*values, *final.values]))


def _merged(known: EffectTable, found: EffectTable) -> EffectTable:
    """Effects that were found take the place of those that were known, but for scales, which are relative to them."""
    merged = known | found
    for name, key in _SCALES.items():
        if name in known and name in found:
            merged[name] = {key: float(known[name][key]) * float(found[name][key])}
    return merged


def _toml(document: Mapping[str, Any]) -> list[str]:
    """Lines of the file: plain keys first, then a table for each surface and servo."""
    lines = toml_lines({key: value for key, value in document.items() if not isinstance(value, dict)})
    if document.get("table"):
        lines += ["", "[table]", *toml_lines(document["table"])]
    for group in ("surfaces", "servos"):
        for name, table in document.get(group, {}).items():
            effects = table.get("effects", {})
            plain = {key: value for key, value in table.items() if key != "effects"}
            lines += ["", f"[{group}.{toml_key(name)}]", *toml_lines(plain)]
            if effects:
                lines += ["", f"[{group}.{toml_key(name)}.effects]", *toml_lines(effects)]
    return lines


_LEVELS = (
    "# How a surface is judged that this servo turns: its tests are healthy by it. --servo takes it along; in an",
    "# aircraft file these keys belong to the surface.",
)


def servo_file(found: Identification, name: str, source: str) -> str:
    """Text of a servo file that ``servofd audit --servo`` and an aircraft file's ``[servos]`` take as it is."""
    linear, servo = found.servo.linear, found.servo
    known = {"up": servo.rate_up_deg_s, "down": servo.rate_down_deg_s}
    rates = [f"{way} {rate:.4g} {_interval(found, f'rate_{way}_deg_s')}" for way, rate in known.items() if rate]
    poles = [(p.real, f" +- {p.imag:.4g}i" if p.imag else "") for p in found.poles_rad_s if p.imag >= 0.0]
    table = {
        "title": name,
        "numerator": [float(value) for value in linear.transfer.numerator],
        "denominator": [float(value) for value in linear.transfer.denominator],
        "delay_s": linear.delay_s,
        "hold": "zoh",
        "unity_dc": False,
        "rate_limit_deg_s": found.rate_limit_deg_s,
        "free_play_deg": servo.dead_band_deg,
        "source": f"servofd identify: {source}",
        "notes": list(found.notes) or None,
    }
    comments = {
        "denominator": f"poles {', '.join(f'{real:.4g}{pair}' for real, pair in poles)} rad/s",
        "delay_s": _interval(found, "delay_s"),
        "hold": "the delay does not contain the hold of the sampled command",
        "unity_dc": f"dc gain {linear.gain:.5g} {_interval(found, 'dc_gain')}".rstrip(),
        "rate_limit_deg_s": ", ".join(map(str.rstrip, rates)),
        "free_play_deg": _interval(found, "dead_band_deg"),
    }
    lines = [
        f"# Identified by servofd from {toml_comment(source)}, method {found.method}.",
        "# Intervals in brackets hold the truth with a probability of 95 %.",
        f"# rms error {found.rms_deg:.4g} deg; bandwidth {linear.transfer.bandwidth_rad_s:.5g} rad/s "
        f"{_interval(found, 'bandwidth_rad_s')}".rstrip(),
        *(f"# note: {toml_comment(note)}" for note in found.notes),
        "",
        f"[servos.{toml_key(name)}]",
        *toml_lines(table, comments),
    ]
    servo_entry = Servo.model_validate({key: value for key, value in table.items() if value is not None})
    levels = levels_of(ServoModel.of(servo_entry), found.segments)
    if levels:
        lines += ["", *_LEVELS, "[surface]", *toml_lines(levels)]
    return "\n".join(lines) + "\n"


def _interval(found: Identification, name: str) -> str:
    interval = found.intervals.get(name)
    if interval is None or not (math.isfinite(interval.low) and math.isfinite(interval.high)):
        return ""
    return f"[{interval.low:.5g}, {interval.high:.5g}]"
