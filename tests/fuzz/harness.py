"""One way to break files and one way to read them, for the seeded tests and for the coverage-guided fuzzer."""

from __future__ import annotations

import io
import random

import numpy as np

import logparsers
from logparsers import FlightLog, LogError
from logparsers.dataflash.encode import encode
from tests.parsers import dataflash_writer, tlog_writer, ulog_writer, writers
from tests.parsers.writers import COMMAND, FLIGHT, TIME_S

SEEDS = {
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

EXTREMES = (
    b"\xff\xff\xff\xff",
    b"\x7f\xff\xff\xff",
    b"\xff\xff\xff\x7f",
    b"\0\0\0\0",
    b"\0\0\xf0\x7f",
    b"\x7f\xa0\0\0",
    b"\xa3\x95\x80",
    b"\xfd\xff\0\0",
)
MOST_CHANNELS = 12
"""Looked up in each file, spread over all of them; the time stamps of every one are looked at anyway."""


def mutated(rng: random.Random, content: bytes) -> bytes:
    """Cut, grow, shrink, repeat, flip or overwrite, up to eight times; half of the time where the headers are."""
    broken = bytearray(content)
    for _ in range(rng.choice([1, 1, 1, 2, 3, 8])):
        at = rng.randrange(max(len(broken), 1)) if rng.random() < 0.5 else rng.randrange(min(len(broken), 800) or 1)
        size = rng.randrange(1, 60)
        match rng.randrange(8):
            case 0:
                del broken[at + rng.randrange(len(broken) or 1) :]
            case 1:
                broken[at:at] = rng.randbytes(size)
            case 2:
                del broken[at : at + size]
            case 3:
                broken[at:at] = broken[at : at + 8 * size]
            case 4:
                broken[at : at + size] = bytes(min(size, len(broken) - at))
            case 5:
                extreme = rng.choice(EXTREMES)
                broken[at : at + len(extreme)] = extreme
            case _:
                for _ in range(rng.choice([1, 1, 2, 5])):
                    if broken:
                        broken[rng.randrange(min(at + 1, len(broken)))] ^= 1 << rng.randrange(8)
    return bytes(broken)


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
        assert str(log).startswith("<file>: ")
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
