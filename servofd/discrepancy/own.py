"""Effects of a user's own: a Python file with one function that acts on the command, or on the deflection."""

from __future__ import annotations

import math
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from servofd.core.errors import ConfigError
from servofd.core.types import FloatArray
from servofd.servo.catalogue import CATALOGUE
from servofd.servo.effects import MissingEffect, Parameter, Place

if TYPE_CHECKING:
    from collections.abc import Callable

    from servofd.servo.physics import Physics

_FIELDS = ("own_1", "own_2", "own_3", "own_4")
_GRID = (0.3, 1.0, 3.0, 10.0)
"""Values to start from, in typical sizes from neutral, on either side."""
_PLACES = {"command": Place.LINK, "deflection": Place.LINKAGE}


@dataclass(frozen=True, slots=True)
class OwnParameter:
    """A number of an effect, its unit the last word of its name; `neutral` is what it is without the effect."""

    name: str
    low: float
    high: float
    neutral: float
    typical: float
    """Deviation from neutral that is common on a healthy servo."""

    def __post_init__(self) -> None:
        if not (self.low <= self.neutral <= self.high and self.low < self.high and self.typical > 0.0):
            raise ConfigError(f"parameter {self.name}: low <= neutral <= high, low < high and typical > 0 are needed")


@dataclass(frozen=True, slots=True)
class OwnEffect:
    """An effect that `servofd explain --effect` tries beside those of the catalogue.

    Parameters
    ----------
    name : str
        What it is called; not the name of an effect of the catalogue.
    place : {"command", "deflection"}
        What it changes: the command before the servo hears it, or the deflection before it is measured.
    parameters : tuple of OwnParameter
        One to four.
    apply : callable
        ``apply(time_s, values_deg, *parameters)``: times [s] and commands or deflections [deg], both of shape (n,), and
        the parameters in order; returns the changed values, shape (n,). It must be pure: the same numbers in, the same
        numbers out.

    Raises
    ------
    ConfigError
        If a part of it is not what it must be.

    Examples
    --------
    >>> OwnEffect("tilt", "deflection", (OwnParameter("tilt", -0.1, 0.1, 0.0, 0.01),), lambda t, y, a: y + a * t).place
    'deflection'
    """

    name: str
    place: Literal["command", "deflection"]
    parameters: tuple[OwnParameter, ...]
    apply: Callable[..., FloatArray]

    def __post_init__(self) -> None:
        if self.name in {effect.name for effect in CATALOGUE} or not self.name.isidentifier():
            raise ConfigError(f"name {self.name!r}: must be a word that is no effect of the catalogue")
        if self.place not in _PLACES:
            raise ConfigError(f'place {self.place!r}: must be "command" or "deflection"')
        if not 1 <= len(self.parameters) <= len(_FIELDS):
            raise ConfigError(f"{len(self.parameters)} parameters: an effect has one to {len(_FIELDS)}")

    def missing_effect(self) -> type[MissingEffect]:
        """The effect as the search for missing ones sees it."""
        parameters = tuple(_parameter(p, field) for p, field in zip(self.parameters, _FIELDS, strict=False))
        members = {"name": self.name, "place": _PLACES[self.place], "parameters": parameters}
        return type(self.name, (MissingEffect,), {**members, "__doc__": "Of a user's own."})

    def changed(self, place: str, physics: Physics, time_s: FloatArray, values_deg: FloatArray) -> FloatArray:
        """Commands or deflections with the effect, if it acts there and is part of the servo [deg], shape (n,)."""
        sizes = [getattr(physics, field) for field in _FIELDS[: len(self.parameters)]]
        if place != self.place or any(math.isnan(size) for size in sizes):
            return values_deg
        return self.checked(time_s, values_deg, sizes)

    def checked(self, time_s: FloatArray, values_deg: FloatArray, sizes: list[float]) -> FloatArray:
        """What the function makes of these values; errors in it are told in a line.

        Raises
        ------
        ConfigError
            If it fails, or does not return as many finite numbers.
        """
        try:
            result = np.asarray(self.apply(time_s, values_deg.copy(), *sizes), dtype=float)
        except Exception as error:
            raise ConfigError(f"effect {self.name}: {_where(error)}") from None
        if result.shape != values_deg.shape or not np.isfinite(result[np.isfinite(values_deg)]).all():
            raise ConfigError(
                f"effect {self.name}: apply() must return {values_deg.size} finite numbers, one for each time"
            )
        return result


def load_own_effect(path: str | Path) -> OwnEffect:
    """Run a Python file and take the one effect that it makes."""
    try:
        source = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file"
        raise ConfigError(f"{path}: cannot read the effect: {reason}") from None
    names: dict[str, object] = {"__name__": "effect", "__file__": str(path)}
    try:
        exec(compile(source, str(path), "exec"), names)  # noqa: S102 - the user asked for this file to be run
    except Exception as error:
        raise ConfigError(f"{path}: {_where(error)}") from None
    made = [value for value in names.values() if isinstance(value, OwnEffect)]
    if len(made) != 1:
        found = "no effect" if not made else f"{len(made)} effects"
        raise ConfigError(f"{path}: makes {found}; one is needed: effect = servofd.OwnEffect(...), see docs/explain.md")
    time_s = np.linspace(0.0, 1.0, 101)
    try:
        made[0].checked(time_s, np.sin(time_s), [p.neutral for p in made[0].parameters])
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    return made[0]


def _parameter(own: OwnParameter, field: str) -> Parameter:
    grid = [own.neutral + sign * size * own.typical for size in _GRID for sign in (-1.0, 1.0)]
    inside = [value for value in grid if own.low < value < own.high] or [0.5 * (own.low + own.high)]
    return Parameter(own.name, (field,), own.low, own.high, own.neutral, own.typical, tuple(sorted(inside)))


def _where(error: Exception) -> str:
    """Kind, message and line of an error in the user's file."""
    if isinstance(error, ConfigError):
        return str(error)
    frames = traceback.extract_tb(error.__traceback__)
    line = error.lineno if isinstance(error, SyntaxError) else frames[-1].lineno if len(frames) > 1 else None
    return f"{f'line {line}: ' if line else ''}{type(error).__name__}: {error}"
