"""DataFlash messages that another tool has taken out of a log: columns by name, without the bytes they came from."""

from __future__ import annotations

import dataclasses
import re
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from logparsers.dataflash.formats import Layout, define
from logparsers.dataflash.scan import BACK_US
from logparsers.dataflash.store import Store

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

CLOCKS: Final = {"TimeUS": "Q", "TimeMS": "I"}
INSTANCES: Final = ("I", "Id", "Inst", "Instance", "C", "IMU", "chan", "Type")
"""Second columns that tell sensors, servos and estimators apart; the units that say so are never exported whole."""
LINE: Final = "LineNo"
"""Where Mission Planner found a row."""
MOST_INSTANCES: Final = 255
"""Largest instance number, which has one byte."""
MOST_US: Final = 2.0**53
"""Latest time stamp [us]; larger ones are no exact float64."""
CSRV_UNITS: Final = {"s#dtk%dvAOO-": "deg", "s#---%dvAOO-": "rad"}
"""Units of CSRV, by which its two generations are distinguished; the definition they belong to is never exported."""
DEGREES_SINCE: Final = (4, 7)
"""ArduPilot version from which on CSRV holds degrees."""


def is_exported(messages: Mapping[str, Mapping[str, Any]]) -> bool:
    """Tell whether these are messages of a DataFlash log: the vehicle's clock stands in some of them.

    Examples
    --------
    >>> is_exported({"RCOU": {"TimeUS": [1], "C1": [1500]}}), is_exported({"flight": {"time": [0.0]}})
    (True, False)
    """
    return any("TimeUS" in columns for columns in messages.values())


class ExportedStore(Store):
    """Index of exported messages, in the order of their time, or of the lines they had.

    `messages` (shape (n,)): columns of each message, numbers or text, n of that message.

    Examples
    --------
    >>> store = ExportedStore({"RCOU": {"TimeUS": np.array([20.0, 40.0]), "C1": np.array([1500, 1512])}})
    >>> store.read("RCOU", ["TimeUS", "C1"])["C1"].tolist(), store.layouts["RCOU"].clock
    ([1500, 1512], ('TimeUS', 1))
    """

    def __init__(self, messages: Mapping[str, Mapping[str, NDArray[Any]]]) -> None:
        super().__init__(0)
        self._columns = {name: {k: v for k, v in c.items() if k != LINE} for name, c in messages.items() if c}
        self.layouts = {name: _layout(k, name, c) for k, (name, c) in enumerate(self._columns.items())}
        self.size = sum(self.count(name) for name in self._columns)
        self._offsets = self._in_order({name: c[LINE].astype(np.int64) for name, c in messages.items() if LINE in c})
        timed = [name for name, layout in self.layouts.items() if layout.clock and self.count(name)]
        self.follow_clock(timed)
        self._give_csrv_its_unit()

    def count(self, name: str) -> int:
        """As of `Store`."""
        return next((len(v) for v in self._columns.get(name, {}).values()), 0)

    def offsets(self, name: str) -> NDArray[np.int64]:
        """Where each row stood among all rows."""
        return self._offsets.get(name, np.zeros(self.count(name), np.int64))

    def read(self, name: str, fields: Sequence[str], rows: NDArray[np.intp] | None = None) -> dict[str, NDArray[Any]]:
        """As of `Store`."""
        found = {}
        for field in fields:
            values = self._columns[name][field]
            values = values if rows is None else values[rows]
            if field == self.layouts[name].instance and values.dtype.kind == "f":
                values = values.astype(np.int64)
            if self.layouts[name].fields[field].character in CLOCKS.values():
                values = np.clip(np.nan_to_num(values.astype(np.float64)), 0, MOST_US).astype(np.int64)
            found[field] = values
        return found

    def _in_order(self, lines: Mapping[str, NDArray[np.int64]]) -> dict[str, NDArray[np.int64]]:
        """Place of each row: its line, or its time since the boot before it; those without a time come first."""
        if all(name in lines for name, layout in self.layouts.items() if layout.clock):
            return dict(lines)
        names, times, boots = [], [], []
        for name, layout in self.layouts.items():
            time_us = self.times_us(name) if layout.clock else np.zeros(self.count(name), np.int64)
            back = np.diff(time_us, prepend=time_us[:1]) < -BACK_US
            names.append(name)
            times.append(time_us)
            boots.append(np.cumsum(back))
        order = np.lexsort((np.concatenate(times), np.concatenate(boots))) if names else np.zeros(0, np.intp)
        place = np.empty(order.size, np.int64)
        place[order] = np.arange(order.size)
        return dict(zip(names, np.split(place, np.cumsum([len(t) for t in times])[:-1]), strict=True))

    def _give_csrv_its_unit(self) -> None:
        layout = self.layouts.get("CSRV")
        if layout is None or "Pos" not in layout.fields:
            return
        position = dataclasses.replace(layout.fields["Pos"], unit=self._csrv_unit())
        self.layouts["CSRV"] = dataclasses.replace(layout, fields={**layout.fields, "Pos": position})

    def _csrv_unit(self) -> str:
        """By the units of its definition, by a command beside it, or by the version of the firmware; else empty."""
        for ids in self._columns.get("FMTU", {}).get("UnitIds", ()):
            if str(ids) in CSRV_UNITS:
                return CSRV_UNITS[str(ids)]
        commands = self._columns["CSRV"].get("PosCmd", np.zeros(0))
        if commands.dtype.kind in "iuf" and np.any(np.isfinite(commands) & (commands != 0.0)):
            return "deg"  # DroneCAN's servos, which tell radians, tell no command
        version = next(zip(*(self._columns.get("VER", {}).get(k, ()) for k in ("Maj", "Min")), strict=False), None)
        if version is None:
            said = (re.match(r"Ardu\w+ V(\d+)\.(\d+)", str(text)) for text in self._texts())
            version = next((match.groups() for match in said if match), None)
        if version is None:
            return ""
        return "deg" if (int(version[0]), int(version[1])) >= DEGREES_SINCE else "rad"

    def _texts(self) -> NDArray[Any]:
        return self._columns.get("MSG", {}).get("Message", np.zeros(0, np.str_))


def _layout(kind: int, name: str, columns: Mapping[str, NDArray[Any]]) -> Layout:
    format_ = "".join(CLOCKS.get(k, "Z" if v.dtype.kind in "UO" else "d") for k, v in columns.items())
    layout = define(type=kind, name=name, length=1 << 30, format=format_, columns=",".join(columns))
    return dataclasses.replace(layout, instance=layout.instance or _instance(layout, columns))


def _instance(layout: Layout, columns: Mapping[str, NDArray[Any]]) -> str | None:
    """The second column, if it has the name of one and holds small whole numbers."""
    name = next((k for k, field in layout.fields.items() if field.position == 1 and k in INSTANCES), None)
    if name is None or columns[name].dtype.kind not in "iuf" or not len(columns[name]):
        return None
    numbers = columns[name].astype(np.float64)
    return name if numbers.min() >= 0 and numbers.max() <= MOST_INSTANCES and not np.any(numbers % 1) else None
