"""A DataFlash log as a whole: any message by name, any column when it is asked for."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from logparsers.channels import MOST_CHANNELS, Series, recorded_log
from logparsers.dataflash.binary import BinaryStore
from logparsers.dataflash.formats import DICTIONARY, NUMBER, WORDS
from logparsers.dataflash.report import Boots, describe
from logparsers.dataflash.text import TextStore
from logparsers.errors import MissingChannel, UnreadableLog
from logparsers.only import Only
from logparsers.protocol import kind_of
from logparsers.records import Damage, FlightLog, Setting, Text, settings_changed
from logparsers.source import LogBytes, mapped
from logparsers.texts import split_rows

if TYPE_CHECKING:
    from logparsers.dataflash.formats import Layout
    from logparsers.dataflash.store import Store, Stretch

    Group = tuple[str, Any]
    """Message and instance."""

HEAD_SIZE: Final = 8192
"""Bytes at the beginning in which the form of a log is recognised."""
GPS_EPOCH: Final = datetime(1980, 1, 6, tzinfo=UTC)
# Since that year, UTC is this much behind GPS time [s].
LEAP_SECONDS: Final = (
    (2017, 18),
    (2015.5, 17),
    (2012.5, 16),
    (2009, 15),
    (2006, 14),
    (0, 13),
)
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


def _is_text(head: bytes) -> bool:
    return re.search(rb"(?:^|\n)FMT, ?\d", head[:HEAD_SIZE]) is not None and head[:2] != b"\xa3\x95"


class DataFlashFile:
    r"""An ArduPilot DataFlash log, binary (``.bin``) or text (``.log``), read column by column.

    The file is mapped, not loaded; only its records are located when it is opened. Every array that is
    handed out is a copy that outlives the file. Its channels are the numeric columns that carry a time stamp:
    ``"RCOU.C1"``, ``"CSRV[0].Pos"``, ``"NVF[UMPOS_1].Value"``.

    `stretches`: bytes that belong to no sound record, with place, length and kind.
    """

    def __init__(self, source: str, store: Store) -> None:
        self.source = source
        self._store = store
        self._instances: dict[str, dict[Any, NDArray[np.intp]]] = {}
        self._suspect: dict[str, NDArray[np.bool_]] = {}

    @classmethod
    def open(cls, source: LogBytes) -> Self:
        """Open a log and locate its records."""
        return cls.of(*mapped(source))

    @classmethod
    def of(cls, content: NDArray[np.uint8], label: str) -> Self:
        """Locate the records of a log.

        `content` (shape (n,)): the file; kept, not copied.
        """
        data = content.data
        form: Callable[[memoryview], Store] = TextStore if _is_text(bytes(data[:HEAD_SIZE])) else BinaryStore
        store = form(data)
        if not any(name != "FMT" for name in store.layouts):
            raise UnreadableLog(f"{label}: no DataFlash message definition (FMT) in it; copy the log again")
        return cls(label, store)

    def log(self, path: Path, only: Only) -> FlightLog:
        """The log as any other; `path`: where it comes from."""
        return recorded_log(
            self,
            path,
            "dataflash",
            only,
            damage=self.damage,
            parameters=self.parameters,
            texts=self.texts,
            vehicle=self.vehicle,
            firmware=self.firmware,
            start_utc=self.start_utc,
            changed=self.changed,
        )

    def series(self) -> dict[str, Series]:
        """Every series by the name of its channel."""
        found: dict[str, Series] = {}
        for message in self.names:
            layout = self.formats[message]
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
        suspect = self.suspect(*group)
        return self.times_s(*group), ~suspect if suspect.any() else None

    def values(self, series: Series) -> NDArray[Any]:
        """Numbers of a series in the order of the file."""
        group: Group = series.group  # type: ignore[assignment]
        return self.column(group[0], series.field, group[1])

    @property
    def formats(self) -> Mapping[str, Layout]:
        """Every message the log defines, logged or not, by name."""
        return MappingProxyType(dict(self._store.layouts))

    @property
    def stretches(self) -> Sequence[Stretch]:
        """Bytes that belong to no sound record; the first thousand one by one."""
        return self._store.stretches

    @property
    def names(self) -> tuple[str, ...]:
        """Messages with at least one row."""
        return tuple(n for n in self._store.layouts if self._store.count(n))

    def count(self, name: str) -> int:
        """Count the rows of a message.

        Result: 0 if it was never logged, or is not known.
        """
        return self._store.count(name)

    def instances(self, name: str) -> tuple[Any, ...]:
        """Which sensors, servos or names a message speaks of.

        Result: sorted; empty if the message has no instances.
        """
        return tuple(self._instance_rows(name))

    def column(self, name: str, field: str, instance: int | str | None = None) -> NDArray[Any]:
        """One column of a message.

        `name`, `field`: for example ``"CSRV"``, ``"Pos"``. `instance`: only the rows of this instance; None for all.
        Result (shape (n,)): scaled to the unit in `formats`. Bytes of ``a`` columns have shape (n, 32).
        """
        return self.table(name, (field,), instance)[field]

    def table(
        self, name: str, fields: Iterable[str] | None = None, instance: int | str | None = None
    ) -> dict[str, NDArray[Any]]:
        """Several columns of a message in one pass: faster than one by one.

        `fields`: which columns; None for all. `instance`: only the rows of this instance; None for all. Result (shape
        (n,)): in the order asked for.
        """
        known = self._layout(name).fields
        wanted = tuple(known) if fields is None else tuple(fields)
        for wrong in (f for f in wanted if f not in known):
            raise MissingChannel(f"{self.source}: {name} has no column {wrong!r}; it has {', '.join(known)}")
        return self._store.read(name, wanted, self._rows(name, instance))

    def times_us(self, name: str, instance: int | str | None = None) -> NDArray[np.int64]:
        """When each row was logged, exactly as the vehicle's clock had it.

        Result (shape (n,)): microseconds since boot.
        """
        clock = self._layout(name).clock
        if clock is None:
            raise MissingChannel(f"{self.source}: {name} carries no time")
        return self._times_us(name, clock, self._rows(name, instance))

    def _times_us(self, name: str, clock: tuple[str, int], rows: NDArray[np.intp] | None) -> NDArray[np.int64]:
        ticks = self._store.read(name, (clock[0],), rows)[clock[0]]
        if ticks.dtype.kind == "f":  # a text log with a broken cell
            ticks = np.clip(np.nan_to_num(ticks), 0, 2**53)
        times: NDArray[np.int64] = ticks.astype(np.int64)
        times *= clock[1]
        return times

    def times_s(self, name: str, instance: int | str | None = None) -> NDArray[np.float64]:
        """When each row was logged.

        Result (shape (n,)): since boot [s]; NaN if the message carries no time. If the vehicle rebooted within the
        file, its clock continues one second after the last record before (`damage` says so).
        """
        return self._times_s(name, self._rows(name, instance))

    def _times_s(self, name: str, rows: NDArray[np.intp] | None) -> NDArray[np.float64]:
        clock = self._layout(name).clock
        if clock is None:
            return np.full(self.count(name) if rows is None else len(rows), np.nan)
        times = self._times_us(name, clock, rows)
        where = self._store.offsets(name)
        times += self._boots.shift_us(where if rows is None else where[rows])
        return times / 1.0e6

    def suspect(self, name: str, instance: int | str | None = None) -> NDArray[np.bool_]:
        """Rows whose time stamp contradicts their neighbours: nothing in them can be trusted.

        Result (shape (n,)): True where suspect.
        """
        if name not in self._suspect:
            self._suspect[name] = self._store.suspect(name)
        mask, rows = self._suspect[name], self._rows(name, instance)
        return mask if rows is None else mask[rows]

    @cached_property
    def parameters(self) -> Mapping[str, float]:
        """The last value of each parameter."""
        return MappingProxyType(dict(self._store.rows("PARM", {"Name": WORDS, "Value": NUMBER})))

    @property
    def changed(self) -> tuple[Setting, ...]:
        """Parameters that became other ones while the log ran."""
        rows = self._store.rows("PARM", {"Name": WORDS, "Value": NUMBER})
        times_s = self.times_s("PARM").tolist() if rows else []
        return settings_changed((time_s, *row) for time_s, row in zip(times_s, rows, strict=True))

    @cached_property
    def texts(self) -> tuple[Text, ...]:
        """What the vehicle said (MSG), in order."""
        return self._texts("MSG", "Message")

    def _texts(self, message: str, field: str) -> tuple[Text, ...]:
        """A column of words with its times; empty if the log has no such column."""
        rows = self._store.rows(message, {field: WORDS})
        times_s = self.times_s(message).tolist() if rows else []
        return tuple(Text(time_s, text) for time_s, (text,) in zip(times_s, rows, strict=True))

    @cached_property
    def firmware(self) -> str:
        """For example ``"ArduPlane V4.5.1 (1a2b3c4d)"``, from VER, MSG or its first lines; empty if it does not say."""
        said = (*(t.text for t in (*self._texts("VER", "FWS"), *self.texts)), *self._store.said)
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
        layout = self.formats["GPS"] if self.count("GPS") else None
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
        """All that is wrong with the log: bytes lost, gaps, jumps of the clock."""
        return describe(self._store, self._boots)

    @cached_property
    def _boots(self) -> Boots:
        return Boots(self._store.steps)

    def _layout(self, name: str) -> Layout:
        try:
            return self._store.layouts[name]
        except KeyError:
            near = difflib.get_close_matches(name, self.names, n=3) or self.names[:12]
            known = ", ".join(near) or "none at all"
            raise MissingChannel(
                f"{self.source}: no message {name!r}; it has {len(self.names)}, among them {known}"
            ) from None

    def _instance_rows(self, name: str) -> dict[Any, NDArray[np.intp]]:
        """Rows of each instance of a message, by one sort, however many there are."""
        if name not in self._instances:
            field = self._layout(name).instance
            found: dict[Any, NDArray[np.intp]] = {}
            if field is not None and self.count(name):
                values, codes = np.unique(self._store.read(name, (field,))[field], return_inverse=True)
                found = split_rows(values.tolist(), codes)
            self._instances[name] = found
        return self._instances[name]

    def _rows(self, name: str, instance: int | str | None) -> NDArray[np.intp] | None:
        if instance is None:
            return None
        known = self._instance_rows(name)
        if instance not in known:
            raise MissingChannel(
                f"{self.source}: no {name}[{instance}]; instances: {', '.join(map(str, known)) or 'none'}"
            )
        return known[instance]

    def __repr__(self) -> str:
        rows = sum(self.count(n) for n in self.names)
        return f"<DataFlashFile {self.source}: {len(self.names)} messages, {rows} rows>"
