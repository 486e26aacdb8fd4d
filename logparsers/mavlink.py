"""What MAVLink messages look like: field layouts, units and check-sum seeds, taken from pymavlink.

With the codec of live links the only file that imports pymavlink. Nothing is written down twice: a message that
pymavlink learns to read, this package reads.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import pymavlink.dialects.v20
from numpy.typing import NDArray

from logparsers.units import C_NUMBERS

DEFAULT_DIALECT = "all"
"""Knows every message of every dialect, except where two dialects use one number twice."""

_DTYPES = {**C_NUMBERS, "char": "u1", "uint8_t_mavlink_version": "u1"}
_CLOCK_FIELDS = {
    "time_boot_ms": 1e-3,
    "time_usec": 1e-6,
    "time_boot_us": 1e-6,
    "time_us": 1e-6,
    "usec": 1e-6,
    "timestamp": 0.0,  # its unit differs between messages
    "sue_time": 1e-3,
}
"""Fields that say when a message was made, and how long one count lasts [s]; 0 = see its unit."""

_RELEASES = ((255, ""), (192, "-rc"), (128, "-beta"), (64, "-alpha"), (0, "-dev"))
"""Lowest number of each kind of release, and its suffix (MAVLink, FIRMWARE_VERSION_TYPE)."""
_TICK_S = {"us": 1e-6, "ms": 1e-3}


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a message, where it lies in the payload.

    `name`: name, for example ``"servo3_raw"``. `dtype`: of one element, little-endian as on the wire. `length`:
    elements of an array; 0 for a scalar. `offset`: first byte within the payload [bytes]. `unit`: as the protocol
    states it, for example ``"us"``; empty if it states none. `is_text`: True for characters.
    """

    name: str
    dtype: np.dtype[Any]
    length: int
    offset: int
    unit: str
    is_text: bool

    @property
    def width(self) -> int:
        """Size in the payload [bytes]."""
        return self.dtype.itemsize * max(self.length, 1)


@dataclass(frozen=True, slots=True)
class Layout:
    """One message type.

    `id`, `name`: number and name of the message. `fields`: in the order in which the protocol declares them. `size`:
    full payload, extension fields included [bytes]. `seed`: the byte that ends its check-sum (``crc_extra``).
    `instance`: field that tells several sources within one component apart; empty if there is none.
    """

    id: int
    name: str
    fields: Mapping[str, Field]
    size: int
    seed: int
    instance: str

    @property
    def clock(self) -> tuple[Field, float] | None:
        """Time stamp field and the length of its tick [s], or None if the message carries no time."""
        for name, tick_s in _CLOCK_FIELDS.items():
            known = self.fields.get(name)
            if known is None or known.length or known.dtype.kind != "u":
                continue
            tick_s = tick_s or _TICK_S.get(known.unit, 0.0)  # noqa: PLW2901
            if tick_s:
                return known, tick_s
        return None


@dataclass(frozen=True, slots=True, eq=False)
class Dialect:
    """A set of message types.

    `name`: as pymavlink calls it, for example ``"ardupilotmega"``. `layouts`: by name, in the order of their ids.
    `slots` (shape (highest id + 1,)): position of an id in `layouts`; -1 where the id is unknown. `seeds` (shape
    (n,)): check-sum seed per position.
    """

    name: str
    layouts: Mapping[str, Layout]
    slots: NDArray[np.int32] = field(repr=False)
    seeds: NDArray[np.uint8] = field(repr=False)


@cache
def rival_names() -> tuple[str, ...]:
    """Dialects that read some message which the default one does not know, or takes for another."""
    known = _module(DEFAULT_DIALECT).mavlink_map
    seeds = {number: message.crc_extra for number, message in known.items()}
    names = {module.name for module in pkgutil.iter_modules(pymavlink.dialects.v20.__path__)}
    return tuple(
        name
        for name in sorted(names - {DEFAULT_DIALECT})
        if any(seeds.get(number) != message.crc_extra for number, message in _module(name).mavlink_map.items())
    )


@cache
def _module(name: str) -> Any:  # noqa: ANN401 - a generated module
    return importlib.import_module(f"pymavlink.dialects.v20.{name}")


@cache
def dialect(name: str = DEFAULT_DIALECT) -> Dialect:
    """Message types of a dialect.

    `name`: as pymavlink calls it. Result: shared between callers; read only.

    Examples
    --------
    >>> servo = dialect("common").layouts["SERVO_OUTPUT_RAW"]
    >>> servo.fields["servo3_raw"].unit, servo.size, servo.instance
    ('us', 37, 'port')
    """
    by_id = dict(sorted(_module(name).mavlink_map.items()))
    layouts = [_layout(message) for message in by_id.values()]
    slots = np.full(max(by_id) + 1, -1, dtype=np.int32)
    slots[list(by_id)] = np.arange(len(by_id))
    seeds = np.array([layout.seed for layout in layouts], dtype=np.uint8)
    for shared in (slots, seeds):
        shared.setflags(write=False)
    return Dialect(name, MappingProxyType({layout.name: layout for layout in layouts}), slots, seeds)


def _layout(message: Any) -> Layout:  # noqa: ANN401 - a generated class
    """Offsets follow the wire order; fields are listed as declared."""
    types = dict(zip(message.fieldnames, message.fieldtypes, strict=True))
    wire: dict[str, Field] = {}
    offset = 0
    for name, length in zip(message.ordered_fieldnames, message.array_lengths, strict=True):
        dtype = np.dtype(_DTYPES[types[name]])
        unit = message.fieldunits_by_name.get(name, "")
        wire[name] = Field(name, dtype, int(length), offset, unit, types[name] == "char")
        offset += wire[name].width
    return Layout(
        id=int(message.id),
        name=str(message.msgname),
        fields=MappingProxyType({name: wire[name] for name in message.fieldnames}),
        size=offset,
        seed=int(message.crc_extra),
        instance=message.instance_field or "",
    )


_NEWER_NAMES = {
    ("MAV_TYPE", 19): "vtol tailsitter duorotor",
    ("MAV_TYPE", 20): "vtol tailsitter quadrotor",
    ("MAV_TYPE", 22): "vtol fixedrotor",
    ("MAV_TYPE", 23): "vtol tailsitter",
    ("MAV_TYPE", 24): "vtol tiltwing",
}
"""Where pymavlink's dialects still say "reserved": https://mavlink.io/en/messages/minimal.html#MAV_TYPE"""


def enum_name(enum: str, value: int) -> str:
    """Name of an enumerated value, without its prefix and in lower case.

    `enum`: for example ``"MAV_TYPE"``. Result: words in lower case; ``"<enum> <value>"`` if the value has no name.

    Examples
    --------
    >>> enum_name("MAV_TYPE", 1), enum_name("MAV_TYPE", 250)
    ('fixed wing', 'MAV_TYPE 250')
    >>> enum_name("MAV_TYPE", 22)  # a quadplane
    'vtol fixedrotor'
    """
    if (enum, value) in _NEWER_NAMES:
        return _NEWER_NAMES[enum, value]
    entry = _module(DEFAULT_DIALECT).enums.get(enum, {}).get(value)
    if entry is None or entry.name.endswith("_ENUM_END"):
        return f"{enum} {value}"
    return str(entry.name).removeprefix(f"{enum}_").replace("_", " ").lower()


@cache
def constants(prefix: str) -> SimpleNamespace:
    """Numbers that MAVLink names, by what follows the prefix of their names."""
    named = vars(_module(DEFAULT_DIALECT))
    return SimpleNamespace(**{name.removeprefix(prefix): n for name, n in named.items() if name.startswith(prefix)})


def message_name(number: int) -> str | None:
    """Name of a message, or None if it is unknown."""
    known = _module(DEFAULT_DIALECT).mavlink_map.get(number)
    return None if known is None else str(known.msgname)


def version_text(number: int) -> str:
    """Write out a firmware version as ArduPilot and PX4 pack it: one byte each, the last says how ripe it is."""
    major, minor, patch, release = (number & 0xFFFFFFFF).to_bytes(4, "big")
    return f"{major}.{minor}.{patch}" + next(word for low, word in _RELEASES if release >= low)
