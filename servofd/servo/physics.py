"""The sizes of a servo's effects."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache

from servofd.servo.effect import Effect
from servofd.servo.loop import INSIDE, Scales
from servofd.servo.registry import everything, fields_of

_SCALES = ("bandwidth_scale", "slow_scale", "pair_scale", "damping_scale", "slow_place", "torque_share")
_BESIDE = {"slow_place": INSIDE, "run_slope": 0.0, "run_field": 0.0, "run_condition": 0.0}
"""Where the slow pole of a servo of three acts, and of a size that goes with a condition of the runs by how much it is
larger in the run with the largest value than in the mean one, which size, and which condition."""


@lru_cache(maxsize=8)
def _off(effects: tuple[type[Effect], ...]) -> Mapping[str, float]:
    """Sizes of a servo without effects."""
    return {**_BESIDE, **fields_of(effects)}


def _unknown(field: str) -> AttributeError:
    return AttributeError(f"no effect has a size {field!r}")


@dataclass(init=False, repr=False, frozen=True)
class Physics:
    """Sizes of the effects of a servo by their fields; those that are not given are as of a servo without.

    Examples
    --------
    >>> worn = Physics(backlash_deg=0.5)
    >>> worn.backlash_deg, worn.gain, worn.follow_up_deg_s
    (0.5, 1.0, inf)
    >>> worn._replace(backlash_deg=0.0) == Physics()
    True
    """

    _sizes: dict[str, float]

    def __init__(self, **sizes: float) -> None:
        off = _off(everything())
        if not sizes.keys() <= off.keys():
            raise _unknown(next(name for name in sizes if name not in off))
        object.__setattr__(self, "_sizes", {name: float(v) for name, v in sizes.items() if v != off[name]})

    def __getattr__(self, field: str) -> float:
        if field.startswith("__"):  # what pickle asks for
            raise AttributeError(field)
        sizes: dict[str, float] = object.__getattribute__(self, "_sizes")
        if field in sizes:
            return sizes[field]
        off = _off(everything())
        if field not in off:
            raise _unknown(field)
        return off[field]

    def __hash__(self) -> int:
        return hash(frozenset(self._sizes.items()))

    def __repr__(self) -> str:
        return f"Physics({', '.join(f'{name}={value:g}' for name, value in self._sizes.items())})"

    def __iter__(self) -> Iterator[tuple[str, float]]:
        """Sizes that are not off, with their fields."""
        return iter(self._sizes.items())

    def _replace(self, **changes: float) -> Physics:
        """The same with other sizes."""
        return Physics(**{**self._sizes, **changes})

    @property
    def loose_deg(self) -> float:
        """How far a surface may rest from where it is asked to be, in its play, dead band or friction [deg]."""
        shares = loose_shares()
        return float(sum(abs(value) * shares[name] for name, value in self if name in shares))

    @property
    def scales(self) -> Scales:
        """How its poles differ from those of its type."""
        off, sizes = _off(everything()), self._sizes
        return Scales(*(sizes.get(name, off[name]) for name in _SCALES))

    @property
    def needs(self) -> frozenset[str]:
        """What of the servo's surroundings its effects depend on."""
        return frozenset(n for e in everything() if e.needs and self._sizes.keys() & e.switches for n in e.needs)


def rate_fields() -> tuple[str, ...]:
    """Sizes that are a largest speed, of which a weak servo has less."""
    limits = (p for e in everything() for p in e.parameters if p.off == math.inf and "deg_s" in p.name)
    return tuple(dict.fromkeys(field for p in limits for field in p.fields))


def loose_shares() -> Mapping[str, float]:
    """Sizes within which a surface rests anywhere, and the share of each that it may be off to either side."""
    return {field: p.loose for e in everything() for p in e.parameters if p.loose > 0.0 for field in p.fields}
