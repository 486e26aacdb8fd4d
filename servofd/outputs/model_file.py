"""An aircraft file with the model that an explanation found, for ``servofd audit -c``."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.calibration import DegreeCalibration
from servofd.discrepancy.catalogue import FollowedRate, PositionLimit, RateLimit
from servofd.discrepancy.fit import Fitter
from servofd.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servofd.aircraft import Aircraft, Surface
    from servofd.discrepancy.explanation import Explanation
    from servofd.discrepancy.physics import Physics

__all__ = ["model_file"]

_SAVED = {"delay", "slow_dynamics", "damping", "gain", "bias", "rate_limit", "position_limit"}
_WORTH_SAVING = 0.9
"""A model that leaves more of the error than this is no better."""


def model_file(found: Explanation, aircraft: Aircraft, source: str) -> str:
    """Text of an aircraft file whose surface has what was missing, as far as the audit can simulate it.

    Parameters
    ----------
    found : Explanation
        What was missing.
    aircraft : Aircraft
        The aircraft as it was known.
    source : str
        Where the data came from.

    Raises
    ------
    ConfigError
        If nothing was missing, or nothing of it is part of the models that the audit simulates.
    """
    final = found.selection.final
    surface = aircraft.surfaces[found.surface]
    degrees = isinstance(surface.measured, DegreeCalibration)
    kept = [e for e in final.effects if e.name in _SAVED and (degrees or e.name != "bias") and "asymm" not in e.form]
    left_out = [e.name for e in final.effects if e not in kept]
    if not final.effects:
        raise ConfigError(f"{source}: {found.surface}: no effect was found, so there is no better model to save")
    values = [v for e, part in _parts(final.effects, final.values) if e in kept for v in part]
    followed = tuple(FollowedRate if e is RateLimit else e for e in kept)
    saved = Fitter(found.record).judged(followed, values)
    before, after = (found.rms_deg(fit)["held_out_rms_deg"] for fit in (found.selection.nominal, saved))
    if not kept or after > _WORTH_SAVING * before:
        raise ConfigError(
            f"{source}: {found.surface}: nothing saved: {', '.join(left_out) or 'this motion'} is not part of the "
            f"models that an audit simulates, and without it {after:.3g} of {before:.3g} deg rms would stay"
        )
    physics = Fitter(found.record).physics(followed, values)
    name = f"{found.surface}-explained"
    document = aircraft.model_dump(exclude_none=True, exclude_defaults=True)
    document["surfaces"][found.surface] |= {"servo": name} | _surface_changes(surface, physics, kept)
    document.setdefault("servos", {})[name] = _servo(found, physics, name, source)
    lines = [
        f"# Found by servofd explain in {' '.join(source.split())}: {', '.join(e.name for e in kept)}.",
        f"# Held-out error of {found.surface}: {before:.4g} deg rms before, {after:.4g} with this model.",
    ]
    if left_out:
        lines.append(f"# Not saved, because an audit cannot simulate it: {', '.join(left_out)}.")
    return "\n".join([*lines, "", *_toml(document)]) + "\n"


def _parts(effects: Any, values: Any) -> list[tuple[Any, list[float]]]:  # noqa: ANN401 - as in Fit
    pieces = np.split(values, np.cumsum([len(e.parameters) for e in effects])[:-1])
    return [(effect, piece.tolist()) for effect, piece in zip(effects, pieces, strict=True)]


def _servo(found: Explanation, physics: Physics, name: str, source: str) -> dict[str, Any]:
    """The servo with its new delay, poles, gain and rate."""
    plant = found.record.plant
    loop = plant.loop(physics.bandwidth_scale, physics.damping_scale)
    denominator = _characteristic(loop.closed_rate, len(plant.transfer.denominator) - 1)
    gain = plant.dc_gain * physics.gain
    servo: dict[str, Any] = {
        "title": name,
        "numerator": [gain * denominator[-1]],
        "denominator": denominator,
        "delay_s": physics.delay_s,
        "hold": "zoh",
        "unity_dc": False,
        "source": f"servofd explain: {source}",
    }
    rate = min(physics.follow_up_deg_s, physics.follow_down_deg_s) * physics.gain
    return servo | ({"rate_limit_deg_s": rate} if np.isfinite(rate) else {})


def _characteristic(rate: Any, order: int) -> list[float]:  # noqa: ANN401 - of shape (3, 7)
    return [float(c) for c in np.poly(rate[:order, :order]).real]


def _surface_changes(surface: Surface, physics: Physics, kept: list[Any]) -> dict[str, Any]:
    """Stops and trim of the surface."""
    changes: dict[str, Any] = {}
    if PositionLimit in kept:
        changes["position_limit_deg"] = [physics.lower_deg, physics.upper_deg]
    if isinstance(surface.measured, DegreeCalibration) and physics.bias_deg:
        measured = surface.measured.model_dump(exclude_defaults=True)
        trim_deg = surface.measured.trim_deg + surface.measured.sign * physics.bias_deg
        changes["measured"] = measured | {"trim_deg": trim_deg}
    return changes


def _toml(document: Mapping[str, Any]) -> list[str]:
    """Lines of the file: plain keys first, then a table for each surface and servo."""
    lines = [f"{key} = {_value(value)}" for key, value in document.items() if not isinstance(value, dict)]
    for group in ("table", "surfaces", "servos"):
        entries = document.get(group, {})
        tables = {group: entries} if group == "table" else {f"{group}.{json.dumps(k)}": v for k, v in entries.items()}
        for title, table in tables.items():
            if table:
                lines += ["", f"[{title}]", *(f"{key} = {_value(value)}" for key, value in table.items())]
    return lines


def _value(value: Any) -> str:  # noqa: ANN401 - anything a TOML file can hold here
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(key)} = {_value(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str | bool) else repr(value)
