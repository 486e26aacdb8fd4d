"""Faults and effects of a simulation as a user writes them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

from servofd.core.errors import ConfigError, ServofdError, UnknownName, suggest
from servofd.servo.catalogue import effect_of
from servofd.servo.effect import Effect
from servofd.servo.faults import FAULTS, Failure, in_order


def effects_of(texts: Sequence[str]) -> dict[str, list[Effect]]:
    """Effects of each surface, from ``SURFACE:EFFECT[:KEY=VALUE...]``.

    Examples
    --------
    >>> effects_of(["elevator:delay:delay_s=0.02"])
    {'elevator': [Delay(0.02)]}
    """
    effects: dict[str, list[Effect]] = {}
    for text in texts:
        where = f"--effect {text}"
        surface, _, rest = text.partition(":")
        name, *pairs = rest.split(":")
        if not (surface and name):
            raise ConfigError(f"{where}: write SURFACE:EFFECT:KEY=VALUE, e.g. elevator:delay:delay_s=0.02")
        forms = [pair for pair in pairs if pair.startswith("form=")]
        values: dict[str, float | str] = dict(numbers_of(where, [pair for pair in pairs if pair not in forms]))
        if forms:
            values["form"] = forms[-1].removeprefix("form=")
        try:
            effects.setdefault(surface, []).append(effect_of(name, values))
        except ServofdError as error:
            raise ConfigError(f"{where}: {error}") from None
    return effects


def faults_of(texts: Sequence[str], duration_s: float) -> dict[str, tuple[Failure, ...]]:
    """Faults of each surface, within the flight and one at a time, from ``SURFACE:KIND@START[:KEY=VALUE...]``.

    Examples
    --------
    >>> faults_of(["elevator:stuck@20"], 60.0)
    {'elevator': (Stuck(start_s=20.0, end_s=inf, position_deg=None),)}
    """
    faults: dict[str, tuple[Failure, ...]] = {}
    for text in texts:
        surface, fault = _fault(text)
        if not 0.0 <= fault.start_s < duration_s:
            raise ConfigError(
                f"--fault {text}: starts at {fault.start_s:g} s, the flight lasts from 0 to {duration_s:g} s"
            )
        try:
            faults[surface] = in_order([*faults.get(surface, ()), fault])
        except ConfigError as error:
            raise ConfigError(f"--fault {text}: {error}") from None
    return faults


def _fault(text: str) -> tuple[str, Failure]:
    """Read ``surface:kind@start:key=value``."""
    surface, _, rest = text.partition(":")
    what, *pairs = rest.split(":")
    kind, at, start = what.partition("@")
    if not (surface and at):
        raise ConfigError(f"--fault {text}: write SURFACE:KIND@START, for example elevator:stuck@20")
    if kind not in FAULTS:
        raise UnknownName(f"--fault {text}: {suggest('fault', kind, FAULTS)}")
    if any(pair.startswith("start_s=") for pair in pairs):
        raise ConfigError(f"--fault {text}: the time stands after the @, not in start_s")
    values = numbers_of(f"--fault {text}", [f"start_s={start}", *pairs])
    known = [field.name for field in dataclasses.fields(FAULTS[kind])]
    if unknown := sorted(set(values) - set(known)):
        raise ConfigError(f"--fault {text}: does not know {unknown[0]!r}; takes {', '.join(known)}")
    try:
        return surface, FAULTS[kind](**values)
    except ConfigError as error:
        raise ConfigError(f"--fault {text}: {error}") from None


def numbers_of(where: str, pairs: Sequence[str]) -> dict[str, float]:
    """Values of ``KEY=NUMBER``; `where` begins what is said of one that is none."""
    values = {}
    for pair in pairs:
        key, _, number = pair.partition("=")
        try:
            values[key] = float(number)
        except ValueError:
            raise ConfigError(f"{where}: {pair!r} is not KEY=NUMBER") from None
        if not math.isfinite(values[key]):
            raise ConfigError(f"{where}: {pair!r} is not finite")
    return values
