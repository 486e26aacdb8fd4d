"""The layout of DataFlash messages, as the log itself defines it in FMT, FMTU, UNIT and MULT.

A log carries its own dictionary: every message type is introduced by a FMT record (length, name, one
format character per column, column names), and newer logs add FMTU records that give each column a unit
and a multiplier by one-character ids, spelled out in UNIT and MULT records.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

HEADER_SIZE: Final = 3
"""Bytes before a record's fields: A3 95 and the message type."""

# One character per column: how it is stored, and the divisor that turns it into its unit. Dividing by 100
# is what pymavlink does; multiplying by 0.01 gives other last bits.
CHARACTERS: Final[Mapping[str, tuple[str, float | None]]] = {
    "a": ("(32,)<i2", None), "b": ("i1", None), "B": ("u1", None), "h": ("<i2", None), "H": ("<u2", None),
    "i": ("<i4", None), "I": ("<u4", None), "f": ("<f4", None), "d": ("<f8", None), "g": ("<f2", None),
    "n": ("S4", None), "N": ("S16", None), "Z": ("S64", None), "c": ("<i2", 100.0), "C": ("<u2", 100.0),
    "e": ("<i4", 100.0), "E": ("<u4", 100.0), "L": ("<i4", 1.0e7), "M": ("i1", None), "q": ("<i8", None),
    "Q": ("<u8", None),
}  # fmt: skip
TEXT: Final = "nNZ"
DICTIONARY: Final = ("FMT", "FMTU", "MULT", "PARM", "UNIT")  # what the log says about itself
NUMBER, WORDS = True, False  # what a column holds
COLUMN_NAME: Final = re.compile(r"[!-\-/-Z\\^-~]+")  # printable, and free of the . [ ] of channel names
PREFIXES: Final[Mapping[float, str]] = {
    0.0: "", 1.0: "", 1.0e-1: "d", 1.0e-2: "c", 1.0e-3: "m", 1.0e-6: "u", 1.0e-9: "n",
}  # fmt: skip
PLAIN_UNITS: Final[Mapping[str, str]] = {
    "UNKNOWN": "", "instance": "", "deglatitude": "deg", "deglongitude": "deg", "degheading": "deg",
}  # fmt: skip

# Which servo, battery or name a row speaks of, where the log has no '#' unit to say so.
INSTANCE_FIELDS: Final[Mapping[str, str]] = {
    "CSRV": "Id", "CVOL": "Id", "NVAL": "Name", "NVF": "Name", "SMVZ": "Id", "UMSV": "Id", "VOLZ": "I",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Field:
    """One column of a message.

    `name`: as logged, for example ``"PosCmd"``. `character`: format character; fixes storage and scaling. `dtype`: how
    the value is stored in the record. `offset`: where it begins within the record, the 3 header bytes included
    [bytes]. `position`: which column it is, counted from 0. `unit`: from FMTU, ``""`` if unknown.
    """

    name: str
    character: str
    dtype: np.dtype[Any]
    offset: int
    position: int
    unit: str = ""

    @property
    def divisor(self) -> float | None:
        """What stored values are divided by (``c C e E``: 100, ``L``: 1e7), or None."""
        return CHARACTERS[self.character][1]

    @property
    def is_text(self) -> bool:
        """True for ``n N Z``."""
        return self.character in TEXT

    @property
    def is_number(self) -> bool:
        """True if a sample is one number."""
        return not self.is_text and self.character != "a"

    @property
    def decoded(self) -> np.dtype[Any]:
        """Type of a decoded sample: scaled columns float64, half floats float32, the rest as stored."""
        if self.divisor is not None:
            return np.dtype(np.float64)
        return np.dtype(np.float32) if self.character == "g" else self.dtype.base


@dataclass(frozen=True)
class Layout:
    """One message type of one log.

    `type`: third byte of its records. `name`: for example ``"RCOU"``. If a log defines the name again with other
    columns, that is ``"RCOU~2"``. `length`: of a record, header included [bytes]. `format`, `columns`: as the log
    defines them. `fields`: the columns that can be read. `instance`: the column that tells instances apart (unit id
    ``#``).
    """

    type: int
    name: str
    length: int
    format: str
    columns: tuple[str, ...]
    fields: Mapping[str, Field] = field(repr=False)
    instance: str | None = None

    def has(self, wanted: Mapping[str, bool]) -> bool:
        """Tell whether it has these columns, and they hold numbers or words as they should.

        `wanted`: `NUMBER` or `WORDS` by name.
        """
        fields = self.fields
        return all(f in fields and (fields[f].is_number if n else fields[f].is_text) for f, n in wanted.items())

    @cached_property
    def clock(self) -> tuple[str, int] | None:
        """The column with the vehicle's own time and its step [us], or None.

        TimeMS of GPS is the time of week there (the vehicle's time is in T), and TimeMS of ACC and GYR
        is not the vehicle's clock.
        """
        first = next((f for f in self.fields.values() if f.position == 0), None)
        if first is not None and first.name == "TimeUS" and first.character in "Qq":
            return "TimeUS", 1
        foreign = self.name[:3] in ("ACC", "GYR")
        if first is not None and first.name == "TimeMS" and first.character == "I" and not foreign:
            return "TimeMS", 1000
        if self.name in ("GPS", "GPS2") and "T" in self.fields and self.fields["T"].character == "I":
            return "T", 1000
        return None

    @property
    def is_timed(self) -> bool:
        """Whether the vehicle's clock stands first."""
        return self.clock is not None and self.clock[0] == self.columns[0]


def define(*, type: int, name: str, length: int, format: str, columns: str) -> Layout:  # noqa: A002 - the words of FMT
    """Lay out one message type.

    Unknown format characters end the readable part; what is behind them cannot be placed.

    `type`, `name`, `length`, `format`, `columns`: the columns of a FMT record; `columns` separated by commas.
    """
    names = tuple(columns.split(",")) if columns else ()
    fields: dict[str, Field] = {}
    offset = HEADER_SIZE
    for position, character in enumerate(format):
        if character not in CHARACTERS or position >= len(names):
            break
        dtype = np.dtype(CHARACTERS[character][0])
        if offset + dtype.itemsize > length:
            break
        if COLUMN_NAME.fullmatch(names[position]):
            fields[names[position]] = Field(names[position], character, dtype, offset, position)
        offset += dtype.itemsize
    instance = INSTANCE_FIELDS.get(name)
    return Layout(type, name, length, format, names, fields, instance if instance in fields else None)


FMT: Final = define(type=128, name="FMT", length=89, format="BBnNZ", columns="Type,Length,Name,Format,Columns")


def stored_size(format_characters: str) -> int | None:
    """Count the bytes of a record with this format, header included, or None if a character is unknown."""
    if any(c not in CHARACTERS for c in format_characters):
        return None
    return HEADER_SIZE + sum(np.dtype(CHARACTERS[c][0]).itemsize for c in format_characters)


def is_consistent(layout: Layout) -> bool:
    """Tell whether length, format characters and column names agree with each other."""
    return stored_size(layout.format) == layout.length and len(layout.columns) == len(layout.format)


def parse_fmt(record: bytes) -> Layout | None:
    """Read a FMT record.

    Where the length contradicts format characters and column names that agree with each other, they are
    believed and it is not: one flipped bit must not cost a whole message type.

    `record`: 89 bytes, header included. Result: None if this cannot be a definition.
    """
    type_, length = record[3], record[4]
    name, format_, columns = (
        part.split(b"\0")[0].decode("latin-1") for part in (record[5:9], record[9:25], record[25:89])
    )
    if not re.fullmatch(r"[\w ]{1,4}", name, re.ASCII) or not re.fullmatch(r"[!-~]*", format_):
        return None
    implied = stored_size(format_)
    if implied is not None and implied != length and columns.count(",") + 1 == len(format_):
        length = implied
    if not HEADER_SIZE <= length <= 255:
        return None
    return define(type=type_, name=name, length=length, format=format_, columns=columns)


def decode_text(stored: NDArray[Any]) -> NDArray[np.str_]:
    """Text up to its first NUL; UTF-8, or Latin-1 where it is not UTF-8.

    `stored` (shape (n,)): padded with NUL. Result (shape (n,)): only as wide as the longest text.
    """
    distinct, which = np.unique(stored, return_inverse=True)
    return np.array([_text(raw) for raw in distinct.tolist()] or [""], dtype=np.str_)[which]


def _text(raw: bytes) -> str:
    try:
        return raw.decode("utf-8").split("\0")[0]
    except UnicodeDecodeError:
        return raw.decode("latin-1").split("\0")[0]


def with_units(
    layout: Layout, unit_ids: str, multiplier_ids: str, units: Mapping[str, str], multipliers: Mapping[str, float]
) -> Layout:
    """Give the columns the units of a FMTU record.

    A format character with a scale of its own (``c``, ``L``, ...) is not scaled again by the multiplier.
    The position in CSRV is in degrees from ArduPilot 4.7 on, which says so; up to 4.6 it is the radians of
    DroneCAN's actuator status, logged without a unit (``-``).

    `units`, `multipliers`: what the characters mean, from UNIT and MULT. Result: the same with units, and with the
    instance column (``#``) marked.
    """
    fields = {}
    for name, column in layout.fields.items():
        unit_id = unit_ids[column.position : column.position + 1]
        unit = units.get(unit_id, "")
        unit = PLAIN_UNITS.get(unit, unit)
        if unit and column.divisor is None:
            scale = multipliers.get(multiplier_ids[column.position : column.position + 1], 1.0)
            unit = PREFIXES[scale] + unit if scale in PREFIXES else f"{scale:.4g} {unit}"
        if layout.name == "CSRV" and name == "Pos" and unit_id == "-":
            unit = "rad"
        fields[name] = dataclasses.replace(column, unit=unit)
    at = unit_ids.find("#")
    marked = next((f.name for f in fields.values() if f.position == at), None)
    return dataclasses.replace(layout, fields=fields, instance=marked or layout.instance)
