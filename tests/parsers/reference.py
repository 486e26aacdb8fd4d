"""What pymavlink and pyulog read in a small log, named as the channels of this package."""

from __future__ import annotations

import contextlib
import io
import os
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink import DFReader
from pyulog import ULog

from tests.parsers.writers import Floats

Series = Mapping[str, tuple[Floats, Floats]]
"""Time stamps [s] and values by name of the channel."""


@contextlib.contextmanager
def stored(content: bytes, suffix: str) -> Iterator[str]:
    """A file of that content, while its decoder looks at it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"flight{suffix}"
        path.write_bytes(content)
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
            yield str(path)


def _arrays(rows: Mapping[str, list[tuple[float, float]]]) -> Series:
    return {
        name: (np.array([time_s for time_s, _ in pairs]), np.array([value for _, value in pairs], dtype=np.float64))
        for name, pairs in rows.items()
    }


def _dataflash(reader: Any) -> Series:
    rows: dict[str, list[tuple[float, float]]] = defaultdict(list)
    while (row := reader.recv_msg()) is not None:
        name = row.get_type()
        if name in ("FMT", "FMTU", "MULT", "PARM", "UNIT"):
            continue
        instance = {"CSRV": "Id"}.get(name)
        which = f"[{getattr(row, instance)}]" if instance else ""
        for field in row.get_fieldnames():
            value = getattr(row, field)
            if field not in ("TimeUS", instance) and isinstance(value, int | float):
                rows[f"{name}{which}.{field}"].append((row.TimeUS * 1e-6, value))
    reader.close()
    return _arrays(rows)


@cache
def dataflash(content: bytes) -> Series:
    """By pymavlink."""
    with stored(content, ".bin") as path:
        return _dataflash(DFReader.DFReader_binary(path))


def without_stamps(content: bytes) -> Mapping[str, Floats]:
    """Values of a text log in which no message has a time, by pymavlink."""
    found: dict[str, list[float]] = defaultdict(list)
    with stored(content, ".log") as path:
        reader: Any = DFReader.DFReader_text(path)
        while (row := reader.recv_msg()) is not None:
            if row.get_type() not in ("FMT", "PARM"):
                for field in row.get_fieldnames():
                    found[f"{row.get_type()}.{field}"].append(getattr(row, field))
        reader.filehandle.close()
        reader.close()
    return {name: np.array(values, np.float64) for name, values in found.items()}


@cache
def dataflash_text(content: bytes) -> Series:
    """By pymavlink."""
    with stored(content, ".log") as path:
        return _dataflash(DFReader.DFReader_text(path))


@cache
def tlog(content: bytes) -> Series:
    """By pymavlink; stamps of the vehicle where there are any, arrival otherwise."""
    os.environ["MAVLINK20"] = "1"
    from pymavlink import mavutil

    with stored(content, ".tlog") as path:
        mavutil.set_dialect("all")
        log = mavutil.mavlogfile(path)
        messages = []
        while (message := log.recv_msg()) is not None:
            messages.append(message)
        log.close()
    senders = defaultdict(set)
    for message in messages:
        senders[message.get_type()].add((message.get_srcSystem(), message.get_srcComponent()))
    lag_s = min(m._timestamp - m.time_boot_ms * 1e-3 for m in messages if m.get_type() == "ATTITUDE")
    rows: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for message in messages:
        name = message.get_type()
        if name in ("PARAM_VALUE", "STATUSTEXT"):
            continue
        source = f"{message.get_srcSystem()}/{message.get_srcComponent()}:" if len(senders[name]) > 1 else ""
        instance = {"NAMED_VALUE_FLOAT": "name", "DEBUG_FLOAT_ARRAY": "array_id", "SERVO_OUTPUT_RAW": "port"}.get(name)
        which = getattr(message, instance) if instance else 0
        bracket = f"[{which}]" if which else ""
        clock = next((f for f in ("time_boot_ms", "time_usec") if f in message.fieldnames), None)
        tick_s = 1e-3 if clock == "time_boot_ms" else 1e-6
        time_s = getattr(message, clock) * tick_s if clock else message._timestamp - lag_s
        for field in message.fieldnames:
            value = getattr(message, field)
            if field in (clock, instance) or isinstance(value, str):
                continue
            cells = enumerate(value) if isinstance(value, list) else [(None, value)]
            for k, cell in cells:
                index = "" if k is None else f"[{k}]"
                rows[f"{source}{name}{bracket}.{field}{index}"].append((time_s, cell))
    return _arrays(rows)


@cache
def ulog(content: bytes) -> Series:
    """By pyulog; a topic that several senders share is split by their names."""
    found = {}
    for topic in ULog(io.BytesIO(content)).data_list:
        rows: dict[str, Any] = {"": slice(None)}
        if "name[0]" in topic.data:
            letters = np.stack([topic.data[f"name[{k}]"] for k in range(10)], axis=1).astype(np.uint8)
            names = np.array([bytes(word).split(b"\0")[0].decode() for word in letters])
            rows = {f"[{name}]": np.flatnonzero(names == name) for name in set(names.tolist())}
        for label, chosen in rows.items():
            for field, values in topic.data.items():
                if field != "timestamp" and not field.startswith("name["):
                    key = f"{topic.name}[{topic.multi_id}]{label}.{field}"
                    found[key] = (topic.data["timestamp"][chosen] * 1e-6, values[chosen].astype(np.float64))
    return found
