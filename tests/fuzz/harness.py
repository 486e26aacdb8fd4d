"""A small sound file of every kind, and one way to read them, for the seeded tests and for the fuzzers."""

from __future__ import annotations

import gzip
import io

import numpy as np

import logparsers
from logparsers import FlightLog, LogError
from logparsers.dataflash.encode import encode
from tests.parsers import dataflash_writer, tlog_writer, ulog_writer, writers
from tests.parsers.writers import COMMAND, FLIGHT, TIME_S

SEEDS = {
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
