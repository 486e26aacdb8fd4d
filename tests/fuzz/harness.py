"""A small sound file of every kind, and one way to read them, for the seeded tests and for the fuzzers."""

from __future__ import annotations

import gzip
import io
from typing import Any

import numpy as np

import logparsers
from logparsers import FlightLog, LogError
from logparsers.dataflash.encode import encode
from tests.parsers import dataflash_writer, tlog_writer, ulog_writer, writers
from tests.parsers.writers import COMMAND, FLIGHT, TIME_S

STAMPS = 1_000_000 + 20_000 * np.arange(TIME_S.size)
MESSAGES: dict[str, dict[str, Any]] = {
    "CSRV": {"TimeUS": STAMPS, "Id": STAMPS // 20_000 % 2, "Pos": COMMAND},
    "RCOU": {"TimeUS": STAMPS, "C1": STAMPS},
}
SAID: dict[str, dict[str, Any]] = {
    "MSG": {"TimeUS": STAMPS[:2], "Message": ["ArduPlane V4.5.1", "ready"]},
    "PARM": {"Name": ["A"], "Value": [1.0]},
}
LABELLED = {
    **{name: np.column_stack([STAMPS, *columns.values()]) for name, columns in MESSAGES.items()},
    **{f"{name}_label": np.array([["LineNo"], *([c] for c in columns)], object) for name, columns in MESSAGES.items()},
    "MSG1": np.array([[np.array([["MSG"], [1e6], ["ready"]], object)]], object),
    "PARM": np.array([["A", 1.0], ["B", 2.0]], object),
}


SEEDS = {
    "mavlogdump_mat": writers.matlab({**MESSAGES, **SAID}),
    "mission_planner_mat": writers.matlab(LABELLED),
    "mavlogdump_table": writers.table({"timestamp": TIME_S, **MESSAGES["CSRV"]}),
    "telemetry_table": writers.table(
        {
            "timestamp": TIME_S,
            "SERVO_OUTPUT_RAW.time_usec": STAMPS,
            "SERVO_OUTPUT_RAW.servo1_raw": STAMPS,
            "NAMED_VALUE_FLOAT.name": ["SRVP1", "POS"] * (TIME_S.size // 2),
        }
    ),
    "ulog_table": writers.table({"timestamp": STAMPS, "control[0]": COMMAND, "name": ["SRVP"] * TIME_S.size}),
    "ros_table": writers.table({"%time": STAMPS * 1000, "field.data": COMMAND, "field.frame": ["a"] * TIME_S.size}),
    "gzipped": gzip.compress(writers.table({"time_s": TIME_S, "tail_cmd_deg": COMMAND}), mtime=0),
    "zipped": writers.zipped({"a": writers.matlab(FLIGHT), "b": b"\x89PNG"}),
    "level4": writers.flight_level4(),
    "level5": writers.matlab({**FLIGHT, "inner": {"more": {"dr": COMMAND}}}),
    "level7": writers.matlab({"flight": FLIGHT}, compressed=True),
    "matlab73": writers.matlab73(FLIGHT),
    "raptrs": writers.raptrs(),
    "table": writers.table({"time_s": TIME_S, "tail_cmd_deg": COMMAND, "note": ["a"] * TIME_S.size}, end="\r\n"),
    "quoted": writers.table({"time_s": TIME_S, "note": ['"a;b"'] * TIME_S.size, "tail_cmd_deg": COMMAND}, ";"),
    "blanks": writers.table({"time_s": TIME_S, "tail_cmd_deg": COMMAND}, "   "),
    "dataflash": encode(dataflash_writer.servo_flight(0.2)),
    "dataflash_text": dataflash_writer.as_text(dataflash_writer.servo_flight(0.2)),
    "tlog": tlog_writer.flight(1.2),
    "ulog": ulog_writer.flight(6),
}
"""A small sound file of every kind."""

MOST_CHANNELS = 12
"""Looked up in each file, spread over all of them; the time stamps of every one are looked at anyway."""


def attempt(content: bytes) -> FlightLog | LogError:
    """Read a file; a refusal is an answer."""
    try:
        return logparsers.read(io.BytesIO(content))
    except LogError as error:
        return error


def outcome(content: bytes) -> FlightLog | LogError:
    """Read a file and look at all of it, as `info` would; anything but a log or a `LogError` is a defect."""
    log = attempt(content)
    if isinstance(log, LogError):
        assert "\n" not in str(log)
        assert str(log).startswith(("<file>: ", "<file>/"))  # a file of an archive
        return log
    names = list(log.channels)
    for name in names[:: len(names) // MOST_CHANNELS + 1]:
        channel = log[name]
        assert (np.diff(channel.time_s) > 0.0).all(), name
        assert channel.values.shape == channel.time_s.shape
    assert log.channels
    assert repr(log)
    assert log.duration_s >= 0.0
    assert all(damage.count > 0 for damage in log.damage)
    return log
