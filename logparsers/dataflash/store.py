"""What the binary and the text form of a DataFlash log have in common: messages by name, column by column."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from logparsers.dataflash.formats import NUMBER, WORDS, Layout, with_units
from logparsers.dataflash.scan import NO_TIME, clock_steps

MOST_US: Final = 2**48
"""Latest time stamp [us]: more than eight years."""
LISTED: Final = 1000
"""Stretches, steps and notes that are listed one by one."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """Bytes of a log that belong to no sound record.

    `offset`, `length`: where, and how many [bytes]. `kind`: ``"zeros"``, ``"erased"`` (all FF), ``"garbage"``,
    ``"cut_record"`` (shorter than its type, or a header that never was one), ``"unknown_type"``, ``"truncated"`` (the
    file ends inside it) or ``"bad_line"``. `before_us`, `after_us`: the vehicle's time before and after it [us].
    """

    offset: int
    length: int
    kind: str
    before_us: int | None = None
    after_us: int | None = None


@dataclass(frozen=True, slots=True)
class Step:
    """The clock went from one time to another without passing between.

    `offset`: first record after it [bytes]. `before_us`, `after_us`: the vehicle's time before and after it [us].
    """

    offset: int
    before_us: int
    after_us: int


class Store(ABC):
    """Where the columns come from, and what is wrong with it."""

    def __init__(self, size: int) -> None:
        self.size = size
        """Bytes of the file, or rows where there is none."""
        self.layouts: dict[str, Layout] = {}
        """Every message that is defined, by name."""
        self.stretches: list[Stretch] = []
        """Damaged bytes, up to a limit."""
        self.more_stretches = (0, 0)
        """Stretches beyond that limit: how many, how many bytes."""
        self.steps: list[Step] = []
        """Gaps and jumps of the clock."""
        self.notes: list[str] = []
        """What is odd about the definitions."""
        self.said: tuple[str, ...] = ()
        """What a text log says before its first definition: firmware and board, as those of 2013 do."""
        self.odd: NDArray[np.int64] = np.zeros(0, np.int64)
        """Where rows begin whose time stamp contradicts the rows around them."""

    @abstractmethod
    def count(self, name: str) -> int:
        """Count the rows of a message; 0 for one that is defined and never logged."""

    @abstractmethod
    def offsets(self, name: str) -> NDArray[Any]:
        """Where in the file each row begins, in its order, shape (n,) [bytes]."""

    @abstractmethod
    def read(self, name: str, fields: Sequence[str], rows: NDArray[np.intp] | None = None) -> dict[str, NDArray[Any]]:
        """Decode columns, of all rows or of some; the arrays are copies and outlive the file."""

    def rows(self, name: str, wanted: Mapping[str, bool]) -> list[tuple[Any, ...]]:
        """Rows of a message, if it has these columns and they hold `NUMBER` or `WORDS` as they should."""
        if name not in self.layouts or not self.layouts[name].has(wanted):
            return []
        columns = self.read(name, list(wanted))
        return list(zip(*(columns[field].tolist() for field in wanted), strict=True))

    def apply_units(self) -> None:
        """Replace layouts by the same with units: FMTU gives them as characters, which UNIT and MULT spell out."""
        types = defaultdict(list)
        for name, layout in self.layouts.items():
            types[layout.type].append(name)
        labels, multiples = (
            {chr(int(k) & 255): value for k, value in self.rows(name, {"Id": NUMBER, column: kind}) if math.isfinite(k)}
            for name, column, kind in (("UNIT", "Label", WORDS), ("MULT", "Mult", NUMBER))
        )
        scales = {k: float(f"{v:.7g}") for k, v in multiples.items()}
        for type_, units, scale in self.rows("FMTU", {"FmtType": NUMBER, "UnitIds": WORDS, "MultIds": WORDS}):
            for name in types.get(type_, ()):
                self.layouts[name] = with_units(self.layouts[name], units, scale, labels, scales)

    def suspect(self, name: str) -> NDArray[np.bool_]:
        """Mark rows whose time stamp contradicts the rows around them: damaged inside.

        None if it would be most rows: then the message simply keeps another clock.
        """
        mask = np.isin(self.offsets(name), self.odd)
        return mask if 2 * np.count_nonzero(mask) <= mask.size else np.zeros(mask.size, np.bool_)

    def follow_clock(self, names: Sequence[str]) -> None:
        """Find gaps and jumps of the clock that these messages share, and rows whose time stamp is wrong."""
        self.odd, steps = clock_steps([self.times_us(name) for name in names], [self.offsets(name) for name in names])
        self.steps = [Step(*found) for found in steps[:LISTED]]

    def times_us(self, name: str) -> NDArray[np.int64]:
        """Time stamps of a message by its own clock, as far as they are possible [us]; else `NO_TIME`."""
        field, scale = self.layouts[name].clock or ("", 1)
        times = self.read(name, [field])[field].astype(np.float64) * scale
        known = (times >= 0.0) & (times < MOST_US)  # NaN is not
        return np.where(known, times, NO_TIME).astype(np.int64)
