"""Servos: what a servo is described by, and the library of known ones."""

from __future__ import annotations

import tomllib
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from servofd.core.errors import ConfigError, DesignError, UnknownName, suggest
from servofd.core.evidence import ModelOrigin
from servofd.core.tolerance import Tolerance
from servofd.core.toml_text import read_toml
from servofd.servo.transfer import BANDWIDTH_DROP_DB, TransferFunction

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False, strict=True)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False, strict=True)]
Bandwidth = Annotated[float, Field(ge=0.01, le=10_000.0, strict=True)]
"""In rad/s."""
Damping = Annotated[float, Field(ge=0.01, le=100.0, strict=True)]
"""As a ratio; 1 is critical."""
Delay = Annotated[float, Field(ge=0.0, le=10.0, strict=True)]
"""In seconds. What lies outside these bounds is a wrong unit."""


class Servo(BaseModel):
    """A servo as its source describes it.

    Either `numerator` and `denominator` (polynomials in s) or `bandwidth_hz` and `damping` (second order).

    Examples
    --------
    >>> servo = Servo(title="mine", bandwidth_hz=5.0, damping=0.7, delay_s=0.01, hold="zoh", source="bench")
    >>> round(servo.transfer.bandwidth_rad_s / (2 * np.pi), 6)
    5.0
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    title: str
    numerator: tuple[float, ...] | None = None
    denominator: tuple[float, ...] | None = None
    bandwidth_hz: Bandwidth | None = None
    damping: Damping | None = None
    delay_s: Delay
    hold: Literal["zoh", "none"]
    """Whether `delay_s` excludes ("zoh") or contains ("none") the mean lag of the command's hold."""
    hold_period_s: Positive | None = None
    rate_limit_deg_s: Positive | None = None
    free_play_deg: NonNegative | None = None
    unity_dc: bool = True
    """Scale to a dc gain of one; False keeps the gain as printed."""
    source: str
    notes: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _complete_and_stable(self) -> Self:
        given = (self.numerator, self.denominator, self.bandwidth_hz, self.damping)
        if [one is not None for one in given] not in ([True, True, False, False], [False, False, True, True]):
            raise ValueError("give either numerator and denominator, or bandwidth_hz and damping")
        if (self.hold == "none") != (self.hold_period_s is not None):
            raise ValueError('hold_period_s belongs to hold = "none", and to that alone')
        try:
            dc_gain = self.printed.dc_gain
            if 0.0 < abs(dc_gain) < float("inf"):
                self.transfer.modes()
        except DesignError as error:
            raise ValueError(str(error)) from None
        if not 0.0 < abs(dc_gain) < float("inf"):
            raise ValueError("the dc gain of a servo must be finite and not zero")
        return self

    @property
    def printed(self) -> TransferFunction:
        """Transfer function as the source gives it."""
        if self.numerator is not None and self.denominator is not None:
            return TransferFunction(self.numerator, self.denominator)
        if self.bandwidth_hz is None or self.damping is None:
            raise DesignError(f"{self.title}: neither polynomials nor bandwidth and damping")
        return second_order(2.0 * np.pi * self.bandwidth_hz, self.damping)

    @property
    def transfer(self) -> TransferFunction:
        """Transfer function used for simulation: `printed`, scaled to unity dc gain unless `unity_dc` is false."""
        return self.printed.with_unity_dc() if self.unity_dc else self.printed

    @property
    def transport_delay_s(self) -> float:
        """Delay between a command leaving the hold and the servo receiving it [s]."""
        if self.hold == "zoh" or self.hold_period_s is None:
            return self.delay_s
        return max(0.0, self.delay_s - self.hold_period_s / 2.0)


def second_order(bandwidth_rad_s: float, damping: float) -> TransferFunction:
    """Second order with the given bandwidth 3.00 dB below dc [rad/s]."""
    drop = 10.0 ** (BANDWIDTH_DROP_DB / 10.0)
    # |G|^2 = 1 / ((1 - x)^2 + 4 damping^2 x) with x = (w / wn)^2; solve for |G|^2 = 1 / drop.
    half = 1.0 - 2.0 * damping**2
    x = half + np.sqrt(half**2 + drop - 1.0)
    natural_rad_s = bandwidth_rad_s / float(np.sqrt(x))
    return TransferFunction((natural_rad_s**2,), (1.0, 2.0 * damping * natural_rad_s, natural_rad_s**2))


@lru_cache(maxsize=1)
def library() -> dict[str, Servo]:
    """All servos known by name, in the order of the library file.

    Examples
    --------
    >>> "hs225bb-eq31" in library()
    True
    """
    text = resources.files("servofd").joinpath("servo", "library.toml").read_text(encoding="utf-8")
    return {name: Servo.model_validate(entry) for name, entry in tomllib.loads(text).items()}


def servo_named(name: str) -> Servo:
    """Servo from the library.

    Raises
    ------
    UnknownName
        If there is none of that name; the message lists the known ones.

    Examples
    --------
    >>> servo_named("s3151").rate_limit_deg_s
    265.0
    """
    servos = library()
    if name not in servos:
        raise UnknownName(suggest("servo", name, servos))
    return servos[name]


def find_servo(name: str) -> tuple[str, Servo, dict[str, Any]]:
    """Servo of the library, or the one of a servo file: its name, the servo, and how its surfaces are judged.

    `name`: name in the library, or path of a TOML file with one entry ``[servos.NAME]``, such as ``servofd identify
    --save`` writes. How they are judged is empty if the file says nothing.

    Examples
    --------
    >>> key, _, levels = find_servo("s3151")
    >>> key, levels
    ('s3151', {})
    """
    if not name.endswith(".toml"):
        return name, servo_named(name), {}
    file = read_toml(Path(name), name, "servo file")
    entries = file.get("servos", {})
    if not isinstance(entries, dict) or len(entries) != 1:
        raise ConfigError(f"{name}: a servo file has one entry [servos.NAME]; 'servofd identify --save' writes one")
    ((key, entry),) = entries.items()
    servo = _checked(Servo, entry, name, ("servos", key))
    levels = _checked(_Levels, file.get("surface", {}), name, ("surface",))
    return key, servo, {each: getattr(levels, each) for each in levels.model_fields_set}


class _Levels(BaseModel):
    """Entries of a surface that belong to the model of its servo."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    threshold: Literal["constant", "interval"] = "constant"
    threshold_deg: Positive | None = None
    tolerance: Tolerance | None = None
    persistence: Annotated[int, Field(ge=1, le=100, strict=True)] = 1
    suspicions: bool = True
    model: ModelOrigin = ModelOrigin()


_Model = TypeVar("_Model", bound=BaseModel)


def _checked(kind: type[_Model], entry: object, name: str, place: tuple[str, ...]) -> _Model:
    try:
        return kind.model_validate(entry)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in (*place, *first["loc"]))
        raise ConfigError(f"{name}: {where}: {first['msg'].removeprefix('Value error, ')}") from None


ORDINARY: Final = Servo(
    title="an ordinary servo, for want of a better one",
    bandwidth_hz=6.0,
    damping=0.8,
    delay_s=0.02,
    hold="zoh",
    source="no servo explains the log",
)
"""What is drawn where no servo is known."""
