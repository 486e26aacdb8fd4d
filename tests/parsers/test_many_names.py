"""Forged logs of very many names: message types, named values, columns, variables. Bounded time, bounded memory."""

from __future__ import annotations

import io
import resource
import struct
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

import logparsers
import logparsers.telemetry.file
import logparsers.telemetry.messages
from logparsers import LogError
from logparsers.channels import MOST_CHANNELS
from logparsers.dataflash.binary import LAYOUT_LIMIT
from tests.parsers import tlog_writer

FMT_HEAD = (
    b"\xa3\x95\x80\x80\x59FMT\0" + b"BBnNZ".ljust(16, b"\0") + b"Type,Length,Name,Format,Columns".ljust(64, b"\0")
)
LETTERS = np.frombuffer(b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789", np.uint8)
STAMP_US = 1_700_000_000_000_000
FEWER_CHANNELS = 20_000


def dataflash(count: int) -> bytes:
    """A definition of another name for the same type, again and again."""
    record = b"\xa3\x95\x80\x82\x0bABCD" + b"Q".ljust(16, b"\0") + b"TimeUS".ljust(64, b"\0")
    rows = np.tile(np.frombuffer(record, np.uint8), (count, 1))
    for place in range(4):
        rows[:, 5 + place] = LETTERS[np.arange(count) // 62**place % 62]
    return FMT_HEAD + rows.tobytes()


def ulog(count: int) -> bytes:
    """Formats of another name, all of one length."""
    bodies = b"".join(b"%%\0Ft%08d:uint64_t timestamp;float x;" % k for k in range(count))
    return b"ULog\x01\x12\x35\x01" + bytes(8) + struct.pack("<HB", 40, ord("B")) + bytes(40) + bodies


def telemetry(count: int) -> bytes:
    """Frames of other message numbers, none of which can be checked, behind one heartbeat."""
    rows = np.zeros((count, 20), np.uint8)
    stamps = np.array(STAMP_US + np.arange(count), ">u8")
    rows[:, :8] = stamps.view(np.uint8).reshape(-1, 8)
    rows[:, 8], rows[:, 13], rows[:, 14] = 0xFD, 1, 1
    for place in range(3):
        rows[:, 15 + place] = np.arange(1 << 23, (1 << 23) + count) >> 8 * place & 0xFF
    beat = bytes.fromhex("fe 09 00 01 01 00 00 00 00 00 01 0c 00 00 03 30 11")
    return struct.pack(">Q", STAMP_US) + beat + rows.tobytes()


def named_values(count: int) -> bytes:
    """A named value of another name in every message."""
    out = []
    for k in range(count):
        values = {"time_boot_ms": k, "name": f"{k:x}", "value": 1.0}
        out.append(struct.pack(">Q", STAMP_US + 1000 * k) + tlog_writer.frame("NAMED_VALUE_FLOAT", values, sequence=k))
    return b"".join(out)


def table(count: int) -> bytes:
    names = ",".join(f"c{k}" for k in range(count))
    return f"time_s,{names}\n0{',1' * count}\n1{',1' * count}\n".encode()


def matlab(count: int) -> bytes:
    """Vectors beside a clock, as level 4 writes them."""
    names = [b"time", *(b"v%d" % k for k in range(count))]
    return b"".join(struct.pack("<5i", 0, 2, 1, 0, len(n) + 1) + n + b"\0" + struct.pack("<2d", 0, 1) for n in names)


def hdf5(count: int) -> bytes:
    file = io.BytesIO()
    with h5py.File(file, "w") as h5:
        for name in ("time", *(f"v{k}" for k in range(count))):
            h5[name] = np.arange(2.0)
    return file.getvalue()


def outcome(content: bytes) -> tuple[str, float, float]:
    """What became of it, processor time [us per byte], and memory beyond what was there [bytes per byte]."""
    before, begun = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    try:
        log = logparsers.read(io.BytesIO(content))
        told = f"{len(log.channels)} channels; {'; '.join(damage.note for damage in log.damage)}"
    except LogError as error:
        told = str(error)
    spent_s, after = time.process_time() - begun, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return told, 1e6 * spent_s / len(content), 1e3 * (after - before) / len(content)


MADE: dict[str, tuple[Callable[[int], bytes], int, str]] = {
    "dataflash": (dataflash, 100_000, "no message with numbers"),
    "ulog": (ulog, 100_000, "more than 10000 message formats"),
    "telemetry": (telemetry, 100_000, "100000 messages that dialect"),
    "named_values": (named_values, FEWER_CHANNELS + 100, f"{FEWER_CHANNELS} channels; more than {FEWER_CHANNELS}"),
    "most_named_values": (named_values, MOST_CHANNELS + 100, f"{MOST_CHANNELS} channels; more than {MOST_CHANNELS}"),
    "table": (table, 100_000, f"100001 columns, and a log has at most {MOST_CHANNELS}"),
    "wide_table": (table, MOST_CHANNELS - 1, f"{MOST_CHANNELS - 1} channels"),
    "matlab": (matlab, MOST_CHANNELS + 100, f"columns, and a log has at most {MOST_CHANNELS}"),
    "hdf5": (hdf5, 2000, "2000 channels"),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=pytest.mark.nightly if kind == "most_named_values" else ()) for kind in MADE]
)
def test_very_many_names_are_bounded(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    make, count, expected = MADE[kind]
    if kind == "named_values":
        for module in (logparsers.channels, logparsers.telemetry.file, logparsers.telemetry.messages):
            monkeypatch.setattr(module, "MOST_CHANNELS", FEWER_CHANNELS)
    content = make(count)
    told, us_per_byte, _ = outcome(content)
    assert expected in told
    assert "\n" not in told
    assert us_per_byte < 20.0  # as for other hostile files


@pytest.mark.nightly
@pytest.mark.parametrize("make", [dataflash, ulog, telemetry, table])
def test_ten_million_names(make: Callable[[int], bytes]) -> None:
    content = make(10_000_000)
    _, us_per_byte, memory = outcome(content)
    assert us_per_byte < 1.0
    assert memory < 6.0


@pytest.mark.slow
def test_a_log_of_so_many_definitions_keeps_the_first() -> None:
    rcou = b"\xa3\x95\x80\x96\x0dRCOU" + b"QH".ljust(16, b"\0") + b"TimeUS,C1".ljust(64, b"\0")
    rows = b"".join(b"\xa3\x95\x96" + struct.pack("<QH", 20_000 * k, 1500 + k) for k in range(1, 50))
    log = logparsers.read(io.BytesIO(FMT_HEAD + rcou + rows + dataflash(2 * LAYOUT_LIMIT)[len(FMT_HEAD) :]))
    np.testing.assert_array_equal(log["RCOU.C1"].values, 1500.0 + np.arange(1, 50))
    assert [d.kind for d in log.damage] == ["bad_format"]
    assert f"{LAYOUT_LIMIT} message definitions; further ones are ignored" in log.damage[0].note


@pytest.mark.parametrize("suffix", ["csv", "mat", "log"])
def test_names_of_300_letters(suffix: str, tmp_path: Path) -> None:
    name = "wing_" * 60
    assert len(name) == 300
    stamps = range(1, 20)
    content = {
        "csv": f"time_s,{name}\n".encode() + b"".join(b"%d,%d\n" % (k, k) for k in stamps),
        "mat": struct.pack("<5i", 0, 19, 1, 0, 5) + b"time\0" + np.arange(1.0, 20.0).tobytes()
        + struct.pack("<5i", 0, 19, 1, 0, 301) + name.encode() + b"\0" + np.arange(1.0, 20.0).tobytes(),
        "log": f"FMT, 150, 13, {name}, QH, TimeUS,C1\n".encode()
        + b"".join(b"%s, %d, %d\n" % (name.encode(), 1000 * k, k) for k in stamps),
    }[suffix]  # fmt: skip
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(content)
    if suffix != "csv":  # neither MATLAB nor ArduPilot has such names
        with pytest.raises(LogError) as told:
            logparsers.read(path)
        assert len(str(told.value)) < 600 + len(str(path))
        return
    (channel,) = logparsers.read(path).channels.values()
    assert channel.name == name
    np.testing.assert_array_equal(channel.values, np.arange(1.0, 20.0))
