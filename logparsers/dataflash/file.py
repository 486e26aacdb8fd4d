"""A DataFlash log as a whole: any message by name, any column when it is asked for."""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from functools import cached_property
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from logparsers.channels import MOST_CHANNELS, Series
from logparsers.dataflash.clock import NO_TIME, Clock
from logparsers.dataflash.formats import DICTIONARY, NUMBER, WORDS, Layout, with_units
from logparsers.protocol import kind_of
from logparsers.records import Damage, Setting, Text, settings_changed
from logparsers.texts import split_rows

Group = tuple[str, Any]
"""Message and instance."""

GPS_EPOCH: Final = datetime(1980, 1, 6, tzinfo=UTC)
LEAP_SECONDS: Final = ((2017, 18), (2015.5, 17), (2012.5, 16), (2009, 15), (2006, 14), (0, 13))
"""Since that year, UTC is this much behind GPS time [s] (IERS Bulletin C); half a year is 1 July."""
FIX_3D: Final = 3
"""GPS status from which on the time is good (ArduPilot, GPS.Status)."""
VEHICLES: Final = {
    "ArduPlane": "fixed wing", "ArduRover": "ground rover", "Rover": "ground rover", "ArduSub": "submarine",
    "AntennaTracker": "antenna tracker", "Blimp": "airship",
}  # fmt: skip
FRAMES: Final = {
    1: "quadrotor", 2: "hexarotor", 3: "octorotor", 4: "octorotor", 5: "hexarotor", 6: "helicopter", 7: "tricopter",
    8: "coaxial", 9: "coaxial", 10: "coaxial", 11: "helicopter", 12: "dodecarotor", 13: "helicopter",
}  # fmt: skip
FIRST_WEEK: Final = 1000
"""GPS week before which there was no autopilot (March 1999)."""
PAGE: Final = 528
"""Bytes that boards which log to flash pages leave unused at the end at most."""
WHAT: Final = {
    "zeros": "zeros",
    "erased": "erased memory (FF)",
    "garbage": "no record",
    "cut_record": "a record that is cut short",
    "unknown_type": "a message whose definition is missing",
    "truncated": "the file ends inside a record",
    "bad_line": "not a complete line of a known message",
}
"""Kinds of stretches, in words."""


class Stretch(NamedTuple):
    """Bytes of a log that belong to no sound record: where, how many [bytes], and one of `WHAT`."""

    offset: int
    length: int
    kind: str


class DataFlashFile(ABC):
    r"""An ArduPilot DataFlash log, binary (``.bin``) or text (``.log``), read column by column.

    The file is mapped, not loaded; only its records are located when it is opened. Every array that is
    handed out is a copy that outlives the file. Its channels are the numeric columns that carry a time stamp:
    ``"RCOU.C1"``, ``"CSRV[0].Pos"``, ``"NVF[UMPOS_1].Value"``.
    """

    def __init__(self, source: str, data: memoryview) -> None:
        self.source, self._data, self._size = source, data, len(data)
        self.layouts: dict[str, Layout] = {}
        """Every message the log defines, logged or not, by name."""
        self.stretches: list[Stretch] = []
        """Damaged bytes, the first thousand one by one."""
        self.more_stretches = (0, 0)
        """Stretches beyond that limit: how many, how many bytes."""
        self._notes: list[str] = []
        """What is odd about the definitions."""
        self._said: tuple[str, ...] = ()
        """What a text log says before its first definition: firmware and board, as those of 2013 do."""
        self._instances: dict[str, dict[Any, NDArray[np.intp]]] = {}
        self._suspect: dict[str, NDArray[np.bool_]] = {}

    @abstractmethod
    def count(self, name: str) -> int:
        """Count the rows of a message; 0 if it was never logged, or is not known."""

    @abstractmethod
    def offsets(self, name: str) -> NDArray[Any]:
        """Where in the file each row begins, in its order, shape (n,) [bytes]."""

    @abstractmethod
    def _read(self, name: str, fields: Sequence[str], rows: NDArray[np.intp] | None) -> dict[str, NDArray[Any]]:
        """Decode columns, of all rows or of some; the arrays are copies and outlive the file."""

    def _apply_units(self) -> None:
        """Replace layouts by the same with units: FMTU gives them as characters, which UNIT and MULT spell out."""
        types = defaultdict(list)
        for name, layout in self.layouts.items():
            types[layout.type].append(name)
        labels, multiples = (
            {chr(int(k) & 255): v for k, v in self._rows(name, {"Id": NUMBER, column: kind}) if math.isfinite(k)}
            for name, column, kind in (("UNIT", "Label", WORDS), ("MULT", "Mult", NUMBER))
        )
        scales = {k: float(f"{v:.7g}") for k, v in multiples.items()}
        for type_, units, scale in self._rows("FMTU", {"FmtType": NUMBER, "UnitIds": WORDS, "MultIds": WORDS}):
            for name in types.get(type_, ()):
                self.layouts[name] = with_units(self.layouts[name], units, scale, labels, scales)

    def _rows(self, name: str, wanted: Mapping[str, bool]) -> list[tuple[Any, ...]]:
        """Rows of a message, if it has these columns and they hold `NUMBER` or `WORDS` as they should."""
        if name not in self.layouts or not self.layouts[name].has(wanted):
            return []
        columns = self.table(name, list(wanted))
        return list(zip(*(columns[field].tolist() for field in wanted), strict=True))

    @property
    def names(self) -> tuple[str, ...]:
        """Messages with at least one row."""
        return tuple(n for n in self.layouts if self.count(n))

    def instances(self, name: str) -> tuple[Any, ...]:
        """Which sensors, servos or names a message speaks of, sorted; empty if it has no instances."""
        return tuple(self._by_instance(name))

    def _by_instance(self, name: str) -> dict[Any, NDArray[np.intp]]:
        """Rows of each instance of a message, by one sort, however many there are."""
        if name not in self._instances:
            field, found = self.layouts[name].instance, {}
            if field is not None and self.count(name):
                values, codes = np.unique(self.column(name, field), return_inverse=True)
                found = split_rows(values.tolist(), codes)
            self._instances[name] = found
        return self._instances[name]

    def table(
        self, name: str, fields: Sequence[str] | None = None, instance: int | str | None = None
    ) -> dict[str, NDArray[Any]]:
        """Several columns of a message in one pass: faster than one by one.

        `fields`: which columns; None for all. `instance`: only the rows of this instance; None for all. Result (shape
        (n,)): scaled to the unit in `layouts`. Bytes of ``a`` columns have shape (n, 32).
        """
        rows = None if instance is None else self._by_instance(name)[instance]
        return self._read(name, list(self.layouts[name].fields) if fields is None else fields, rows)

    def column(self, name: str, field: str, instance: int | str | None = None) -> NDArray[Any]:
        """One column of a message, such as ``"CSRV"``, ``"Pos"``; as of `table`."""
        return self.table(name, [field], instance)[field]

    def times_us(self, name: str, instance: int | str | None = None) -> NDArray[np.int64]:
        """When each row of a message with a clock was logged, by the vehicle's clock, shape (n,) [us since boot]."""
        field, step_us = self.layouts[name].clock or ("", 1)
        ticks = self.column(name, field, instance)
        if ticks.dtype.kind == "f":  # a text log with a broken cell
            ticks = np.where((ticks >= 0) & (ticks < 2**53), ticks, NO_TIME)
        return ticks.astype(np.int64) * step_us

    def times_s(self, name: str, instance: int | str | None = None) -> NDArray[np.float64]:
        """When each row was logged.

        Result (shape (n,)): since boot [s]; NaN if the message carries no time. If the vehicle rebooted within the
        file, its clock continues one second after the last record before (`damage` says so).
        """
        where = self.offsets(name) if instance is None else self.offsets(name)[self._by_instance(name)[instance]]
        if self.layouts[name].clock is None:
            return np.full(where.size, np.nan)
        return (self.times_us(name, instance) + self.clock.shift_us(where)) / 1.0e6

    def suspect(self, name: str, instance: int | str | None = None) -> NDArray[np.bool_]:
        """Rows whose time stamp contradicts their neighbours, shape (n,): nothing in them can be trusted.

        No row if that would be most of them: then the message simply keeps another clock.
        """
        if name not in self._suspect:
            mask = np.isin(self.offsets(name), self.clock.odd)
            self._suspect[name] = mask & (2 * np.count_nonzero(mask) <= mask.size)
        mask = self._suspect[name]
        return mask if instance is None else mask[self._by_instance(name)[instance]]

    @cached_property
    def clock(self) -> Clock:
        """The clock of all messages whose time stamp stands first."""
        timed = [name for name in self.names if self.layouts[name].is_timed]
        return Clock([self.times_us(name) for name in timed], [self.offsets(name) for name in timed])

    def series(self) -> dict[str, Series]:
        """Every series by the name of its channel."""
        found: dict[str, Series] = {}
        for message in self.names:
            layout = self.layouts[message]
            if message in DICTIONARY or layout.clock is None:
                continue
            skipped = (layout.clock[0], layout.instance)
            fields = [f for f in layout.fields.values() if f.is_number and f.name not in skipped]
            for instance in self.instances(message) if layout.instance is not None else (None,):
                if len(found) > MOST_CHANNELS:
                    return found
                which = "" if instance is None else f"[{instance}]"
                for field in fields:
                    series = Series((message, instance), field.name, None, field.unit, f"{message}.{field.name}")
                    found[f"{message}{which}.{field.name}"] = series
        return found

    def stamps(self, group: Group) -> tuple[NDArray[np.float64], NDArray[np.bool_] | None]:
        """Time of each row [s], and whether it agrees with the rows around it (None: all do)."""
        suspect = self.suspect(*group) if self.clock.odd.size else np.zeros(0, np.bool_)
        return self.times_s(*group), ~suspect if suspect.any() else None

    def values(self, series: Series) -> NDArray[Any]:
        """Numbers of a series in the order of the file."""
        group: Group = series.group  # type: ignore[assignment]
        return self.column(group[0], series.field, group[1])

    @cached_property
    def parameters(self) -> Mapping[str, float]:
        """The last value of each parameter."""
        return MappingProxyType(dict(self._rows("PARM", {"Name": WORDS, "Value": NUMBER})))

    @property
    def changed(self) -> tuple[Setting, ...]:
        """Parameters that became other ones while the log ran."""
        rows = self._rows("PARM", {"Name": WORDS, "Value": NUMBER})
        times_s = self.times_s("PARM").tolist() if rows else []
        return settings_changed((time_s, *row) for time_s, row in zip(times_s, rows, strict=True))

    @cached_property
    def texts(self) -> tuple[Text, ...]:
        """What the vehicle said (MSG), in order."""
        return self._texts("MSG", "Message")

    def _texts(self, message: str, field: str) -> tuple[Text, ...]:
        """A column of words with its times; empty if the log has no such column."""
        rows = self._rows(message, {field: WORDS})
        times_s = self.times_s(message).tolist() if rows else []
        return tuple(Text(time_s, text) for time_s, (text,) in zip(times_s, rows, strict=True))

    @cached_property
    def firmware(self) -> str:
        """For example ``"ArduPlane V4.5.1 (1a2b3c4d)"``, from VER, MSG or its first lines; empty if it does not say."""
        said = (*(t.text for t in (*self._texts("VER", "FWS"), *self.texts)), *self._said)
        return next((t for t in said if re.match(r"[A-Za-z][\w:]* V?\d+\.\d", t)), "")

    @property
    def vehicle(self) -> str:
        """Kind of aircraft, for example ``"fixed wing"``; empty if the log does not say."""
        name = self.firmware.partition(" ")[0]
        if name in ("ArduCopter", "APM:Copter"):
            return FRAMES.get(int(np.nan_to_num(self.parameters.get("FRAME_CLASS", 0.0))), "multirotor")
        return kind_of(VEHICLES.get(name, name), self.parameters)

    @cached_property
    def start_utc(self) -> datetime | None:
        """When the vehicle was booted, by the first GPS message with a 3D fix; None without one."""
        layout = self.layouts["GPS"] if self.count("GPS") else None
        if layout is None or layout.clock is None:
            return None
        week, ms = ("GWk", "GMS") if "GWk" in layout.fields else ("Week", "TimeMS")
        if not layout.has({week: NUMBER, ms: NUMBER, "Status": NUMBER}):
            return None
        rows = self.table("GPS", (week, ms, "Status"))
        fixed = np.flatnonzero((rows["Status"] >= FIX_3D) & (rows[week] > FIRST_WEEK) & ~self.suspect("GPS"))
        if not len(fixed):
            return None
        first = fixed[0]
        try:
            since_boot = timedelta(seconds=float(self.times_s("GPS")[first]))
            gps = GPS_EPOCH + timedelta(weeks=int(rows[week][first]), milliseconds=int(rows[ms][first]))
            year = gps.year + (gps.month - 1) / 12
            return gps - timedelta(seconds=next(s for since, s in LEAP_SECONDS if year >= since)) - since_boot
        except (OverflowError, ValueError):  # a damaged row: no such year, or no number
            return None

    @cached_property
    def damage(self) -> tuple[Damage, ...]:
        """All that is wrong with the log: bytes lost, gaps, jumps of the clock.

        Unused space at the end of the last flash page is not damage.
        """
        found = []
        begins = [*(stretch.offset for stretch in self.stretches[1:]), self._size]
        for (offset, length, kind), limit in zip(self.stretches, begins, strict=False):
            end = offset + length
            if end == self._size and length <= PAGE and kind in ("zeros", "erased"):
                continue
            note = f"{length} bytes at byte {offset}: {WHAT[kind]}"
            ends = (None, None) if kind == "bad_line" else self.clock.around(offset, end, limit)
            found.append(Damage("truncated" if kind == "truncated" else "corrupt", note, length, *ends))
        number, size = self.more_stretches
        if number:
            found.append(Damage("corrupt", f"{number} more damaged stretches, {size} bytes", size))
        return (*found, *self.clock.damage(), *(Damage("bad_format", note) for note in self._notes))

    def __repr__(self) -> str:
        rows = sum(self.count(n) for n in self.names)
        return f"<DataFlashFile {self.source}: {len(self.names)} messages, {rows} rows>"
