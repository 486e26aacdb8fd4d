"""Messages that other tools took out of an autopilot's log: put together again, by name and column.

mavlogdump and Mission Planner write MATLAB files of all messages; mavlogdump, ulog2csv and rostopic write a CSV file of
one or some, of which those of one flight, recognised by the beginnings of their names, become one log.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from logparsers.assemble import Column, assemble
from logparsers.channels import MOST_CHANNELS, Series, recorded_log, together
from logparsers.errors import MissingChannel, UnreadableLog, decoding
from logparsers.records import Damage, FlightLog
from logparsers.text import convert, header_cells, read_grid, texts_of
from logparsers.texts import rows_by_text
from logparsers.units import S_PER_MS, S_PER_NS, S_PER_US, suffix_unit

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from logparsers.only import Only
    from logparsers.source import Source

    Table = tuple[NDArray[np.float64], Mapping[str, NDArray[Any]]]
    """Times [s] and columns of numbers."""

LABEL: Final = "_label"
MESSAGE_FIELD: Final = re.compile(r"([A-Z][A-Z0-9_]+)\.(\w+)")
DATAFLASH_FILE: Final = re.compile(r"(?:(?P<flight>.*)[._-])?(?:[A-Za-z][A-Za-z0-9]{1,3})")
ULOG_FILE: Final = re.compile(
    r"(?:(?P<flight>.*?)_)??(?:(?:action|actuator|adc|airspeed|battery|camera|collision|commander|config|control|"
    r"cpuload|debug|differential|distance|ekf2|esc|estimator|event|failsafe|failure|follow|gimbal|gps|hover|input|"
    r"iridium|irlock|land|landing|launch|logger|mag|magnetometer|manual|mission|mount|navigator|obstacle|offboard|"
    r"onboard|optical|orb|parameter|position|power|px4io|qshell|radio|rate|rc|register|rpm|rtl|safety|satellite|sensor|"
    r"sensors|servo|system|task|tecs|telemetry|timesync|tiltrotor|trajectory|transponder|tune|uavcan|vehicle|"
    r"velocity|vtol|wheel|wind|yaw)(?:_[a-z0-9_]+?)?)_\d+"
)
CLOCKS: Final = ("timestamp", "TimeUS", "%time")
NAMED: Final = ("name", "key")
"""Columns by which several senders share a message."""
WRAP_US: Final = 2.0**32
"""A 32-bit count of microseconds begins anew after this [us]."""
_CLOCKS: Final = "time_boot_ms", "time_usec"


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """One exported table.

    `kind`: ``"dataflash"``, ``"tlog"``, ``"ulog"`` or ``"ros"``. `path`: the file; its name tells flight and message.
    `columns` (shape (n,)): numbers or text; whoever makes a log of them takes them away. `damage`: what is wrong with
    the table. `flight`: beginning of the file's name that the other tables of its flight share.
    """

    kind: str
    path: Path
    columns: dict[str, NDArray[Any]]
    damage: tuple[Damage, ...]
    flight: str

    @property
    def message(self) -> str:
        """What stands behind that in the name."""
        return self.path.stem.removeprefix(self.flight).lstrip("._-")


def kind_of(head: bytes) -> str:
    r"""Kind of an exported table by its first bytes; empty for a plain one.

    Examples
    --------
    >>> kind_of(b"timestamp,TimeUS,C1\n"), kind_of(b"%time,field.data\n"), kind_of(b"time_s,tail_cmd_deg\n")
    ('dataflash', 'ros', '')
    """
    return _kind(header_cells(head))


def _kind(names: Sequence[str]) -> str:
    if not names or "time_s" in names or any(name.endswith(("_cmd_deg", "_pos_deg")) for name in names):
        return ""
    if names[0] == "%time":
        return "ros"
    if "TimeUS" in names[:2]:
        return "dataflash"
    if names[0] == "timestamp" and len(names) > 1:
        return "tlog" if MESSAGE_FIELD.fullmatch(names[1]) else "ulog"
    return ""


def flight_of(path: Path, kind: str) -> str:
    """Beginning of a file's name that the other tables of its flight share; empty if the name is the message.

    Topics of ROS have names that tell nothing: those of a folder are one flight.

    Examples
    --------
    >>> flight_of(Path("log_7_actuator_outputs_0.csv"), "ulog"), flight_of(Path("may.RCOU.csv"), "dataflash")
    ('log_7', 'may')
    """
    patterns = {"ulog": ULOG_FILE, "dataflash": DATAFLASH_FILE}
    match = patterns[kind].fullmatch(path.stem) if kind in patterns else None
    return (match["flight"] or "") if match else ""


def read_part(source: Source, beginning: str = "") -> Part:
    """Read an exported table; text columns stay text.

    `beginning`: of the names of its flight, if that is known.
    """
    grid = read_grid(source.path, source.content())
    with decoding(source.path, "table of messages"):
        cells = convert(grid)
        words = {name for name, column in cells.items() if 2 * column.strange > np.isfinite(column.values).sum()}
        texts = texts_of(grid, words)
    columns, damage = {}, []
    for name, column in cells.items():
        columns[name] = texts[name] if name in words else column.values
        if not column.strange:
            continue
        row, text = column.first_strange
        where = f"line {grid.line[row]}, column {name!r}: {text[:40]!r} is not a number"
        if name in CLOCKS:
            raise UnreadableLog(f"{source.path}: {where}")
        if name not in words:
            damage.append(Damage("not_numeric", f"{where}; {column.strange} such cells", column.strange))
    kind = _kind(grid.names)
    flight = beginning if beginning and source.path.stem.startswith(beginning) else flight_of(source.path, kind)
    return Part(kind, source.path, columns, (*source.damage, *grid.damage, *damage), flight)


def flights(parts: Iterable[Part], path: Path, only: Only) -> tuple[FlightLog, ...]:
    """Join the tables of each flight.

    `parts`: tables of one folder, archive or file. `path`: where they come from.
    """
    together: dict[tuple[str, str], list[Part]] = {}
    for part in parts:
        together.setdefault((part.kind, part.flight), []).append(part)
    logs = []
    for (kind, flight), members in together.items():
        log = {"dataflash": _dataflash, "tlog": _telemetry, "ulog": _ulog, "ros": _ros}[kind](members, path, only)
        damage = tuple(d for part in members for d in part.damage)
        logs.append(replace(log, damage=(*damage, *log.damage), run=flight if len(together) > 1 else ""))
    return tuple(logs)


def _dataflash(parts: Sequence[Part], path: Path, only: Only) -> FlightLog:
    messages = {}
    for part in parts:
        name = "CSRV" if {"Id", "Pos", "PosCmd"} <= part.columns.keys() else part.message.upper()
        messages[name] = {k: v for k, v in part.columns.items() if k != "timestamp"}
    return dataflash_log(messages, path, only)


def _ulog(parts: Sequence[Part], path: Path, only: Only) -> FlightLog:
    tables = _Tables()
    for part in parts:
        match = re.fullmatch(r"(.+)_(\d+)", part.message)
        name, instance = match.groups() if match else (part.message, "0")
        stamps = part.columns["timestamp"]
        if stamps.dtype.kind != "f" or np.any(stamps % 1):
            raise MissingChannel(f"{part.path}: its timestamps are no microseconds; name its clock in a table layout")
        filled = stamps > 0.0  # PX4 leaves the stamp of a topic that was never published at 0
        if not filled.all():
            part.columns.update({field: values[filled] for field, values in part.columns.items()})
        tables.add(f"{name}[{instance}]", name, part.columns.pop("timestamp") * S_PER_US, part.columns)
    return tables.log(path, "ulog", only)


def _telemetry(parts: Sequence[Part], path: Path, only: Only) -> FlightLog:
    """The vehicle's own clock, and the arrival mapped to it for messages without one."""
    from logparsers.mavlink import dialect

    found: list[tuple[str, NDArray[Any], dict[str, NDArray[Any]], str]] = []
    for part in parts:
        fields: dict[str, dict[str, NDArray[Any]]] = {}
        for name, values in part.columns.items():
            if match := MESSAGE_FIELD.fullmatch(name):
                fields.setdefault(match[1], {})[match[2]] = values
        for message, columns in fields.items():
            rows = ~np.logical_and.reduce([v == "" if v.dtype.kind in "UO" else np.isnan(v) for v in columns.values()])
            clock = next((k for k in _CLOCKS if k in columns and columns[k].dtype.kind == "f"), "")
            mine = {name: values[rows] for name, values in columns.items()}
            found.append((message, part.columns["timestamp"][rows], mine, clock))
    found = [table for table in found if len(table[1])]
    booted = [np.median(arrival - _own_s(columns, clock)) for _, arrival, columns, clock in found if clock]
    boot_s = float(np.median(booted or [arrival.min() for _, arrival, _, _ in found])) if found else 0.0
    tables, layouts = _Tables(), dialect().layouts
    for message, arrival, columns, clock in found:
        time_s = _own_s(columns, clock) if clock else arrival - boot_s
        columns.pop(clock, None)
        known = layouts.get(message)
        units = {name: field.unit for name, field in known.fields.items()} if known else {}
        tables.add(message, message, time_s, columns, known.instance if known else "", units)
    return tables.log(path, "tlog", only)


def _own_s(columns: Mapping[str, NDArray[Any]], clock: str) -> NDArray[np.float64]:
    """Time since boot by the message itself [s]; microseconds of 32 bits begin again after 71 minutes."""
    if clock == "time_boot_ms":
        return columns[clock] * S_PER_MS
    own_us = columns[clock]
    if own_us.size and own_us.max() < WRAP_US:
        own_us = own_us + WRAP_US * np.cumsum(np.diff(own_us, prepend=own_us[:1]) < -WRAP_US / 2)
    return own_us * S_PER_US


def _ros(parts: Sequence[Part], path: Path, only: Only) -> FlightLog:
    """Topics by the names of their files, without what those have in common."""
    stems = [part.path.stem for part in parts]
    alike = takewhile(lambda letters: len(set(letters)) == 1, zip(*stems, strict=False))
    shared = re.sub(r"[^-_.]*$", "", "".join(letters[0] for letters in alike))
    homes: dict[str, Mapping[str, Any]] = {}
    damage: list[Damage] = []
    for part, stem in zip(parts, stems, strict=True):
        prefix = f"{stem.removeprefix(shared)}." if len(parts) > 1 else ""
        columns = [
            Column(name := prefix + key.removeprefix("field."), values, suffix_unit(name), key)
            for key, values in part.columns.items()
            if values.dtype.kind == "f" and key != "%time"
        ]
        if not columns:
            raise MissingChannel(f"{part.path}: no column of numbers beside the time; export another topic")
        log = assemble(part.path, kind="table", time_s=part.columns["%time"] * S_PER_NS, columns=columns)
        homes |= dict.fromkeys(log.channels, log.channels)
        damage += log.damage
    return FlightLog(path, "table", together(homes), tuple(damage)).only(only)


class _Tables:
    """Tables of messages as a `logparsers.channels.Recording`: rows of each name that shares a message apart."""

    def __init__(self) -> None:
        self._series: dict[str, Series] = {}
        self._rows: dict[str, tuple[Table, Any]] = {}

    def add(
        self,
        label: str,
        origin: str,
        time_s: NDArray[np.float64],
        columns: dict[str, NDArray[Any]],
        instance: str = "",
        units: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Add a table, whose texts go: another one in each row takes four times the file.

        Rows of each number of `instance` are apart, as in a log; without a unit, the end of a column's name tells it.
        """
        numbered = instance in columns and columns[instance].dtype.kind == "f"
        by_name = next((k for k in NAMED if k in columns and columns[k].dtype.kind in "UO"), None)
        rows_of: dict[str, Any] = {"": slice(None)}
        if numbered:
            numbers = np.nan_to_num(columns.pop(instance), nan=-1.0)
            apart = rows_by_text(numbers, MOST_CHANNELS + 1)
            rows_of = {"" if float(number) == 0.0 else f"{float(number):.12g}": rows for number, rows in apart.items()}
        elif by_name is not None:
            rows_of = rows_by_text(columns[by_name], MOST_CHANNELS + 1)
            for field in [field for field, values in columns.items() if values.dtype.kind != "f"]:
                del columns[field]
        table = time_s, {field: values for field, values in columns.items() if values.dtype.kind == "f"}
        for name, rows in rows_of.items():
            if len(self._series) > MOST_CHANNELS:
                return
            group = f"{label}[{name}]" if name else label
            self._rows[group] = table, rows
            for field in table[1]:
                unit = units.get(field, suffix_unit(field))
                series = Series(group, field, None, unit, f"{origin}.{field}")
                self._series[f"{group}.{field}"] = series

    def series(self) -> dict[str, Series]:
        return self._series

    def stamps(self, group: str) -> tuple[NDArray[np.float64], None]:
        (time_s, _), rows = self._rows[group]
        return time_s[rows], None

    def values(self, series: Series) -> NDArray[Any]:
        (_, columns), rows = self._rows[str(series.group)]
        values: NDArray[Any] = columns[series.field][rows]
        return values

    def log(self, path: Path, kind: str, only: Only) -> FlightLog:
        return recorded_log(self, path, kind, only)


def labelled_messages(variables: Mapping[str, Any]) -> dict[str, dict[str, NDArray[Any]]]:
    """Columns of the messages in a MATLAB file; empty if it has none.

    mavlogdump makes a structure of each message. Mission Planner makes a matrix ``RCOU`` and a cell ``RCOU_label`` with
    the names of its columns, a cell ``PARM`` of names and values, and ``MSG1`` of cells with a text each.

    `variables`: as `logparsers.mat.level5` reads them.

    Examples
    --------
    >>> variables = {"RCOU": np.array([[7.0, 20.0, 1500.0]]), "RCOU_label": ["LineNo", "TimeUS", "C1"]}
    >>> labelled_messages(variables)["RCOU"]["C1"].tolist()
    [1500.0]
    """
    messages: dict[str, dict[str, NDArray[Any]]] = {}
    for name, value in variables.items():
        if isinstance(value, dict):
            arrays = {k: v for k, v in value.items() if isinstance(v, np.ndarray) and v.size == max(v.shape)}
            columns = {k: v.reshape(-1) for k, v in arrays.items()}
            count = max(map(len, columns.values()), default=0)
            messages[name] = {k: v for k, v in columns.items() if len(v) == count}
        elif isinstance(value, np.ndarray) and value.ndim == 2:
            label = variables.get(name + LABEL)
            if isinstance(label, list) and len(label) == value.shape[1]:
                messages[name] = {_word(text): value[:, k] for k, text in enumerate(label)}
    if isinstance(parameters := variables.get("PARM"), list):
        half = len(parameters) // 2
        names = np.array([_word(text) for text in parameters[:half]], np.str_)
        messages["PARM"] = {"Name": names, "Value": np.array([_number(cell) for cell in parameters[half : 2 * half]])}
    if isinstance(said := variables.get("MSG1"), list):
        rows = [row for row in said if isinstance(row, list) and len(row) >= 3]
        texts = np.array([_word(row[2]) for row in rows], np.str_)
        words = {"TimeUS": np.array([_number(row[1]) for row in rows]), "Message": texts}
        lines = messages.get("MSG", {}).get("LineNo")
        messages["MSG"] = words if lines is None or len(lines) != len(rows) else {**words, "LineNo": lines}
    return messages


def dataflash_log(messages: Mapping[str, Mapping[str, NDArray[Any]]], path: Path, only: Only) -> FlightLog:
    """Make a log of exported DataFlash messages.

    `messages` (shape (n,)): columns of each message. `path`: where they come from.
    """
    from logparsers.dataflash import DataFlashFile
    from logparsers.dataflash.exported import ExportedStore

    return DataFlashFile(str(path), ExportedStore(messages)).log(path, only)


def _word(cell: object) -> str:
    """Text of a cell, whether it holds that or an array of it."""
    return str(cell.flat[0]) if isinstance(cell, np.ndarray) and cell.size else "" if cell is None else str(cell)


def _number(cell: object) -> float:
    try:
        return float(_word(cell))
    except ValueError:
        return float("nan")
