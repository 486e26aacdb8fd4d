"""Packed logs are read as they are; bombs, broken and encrypted archives cost one line, and no memory."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import resource
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import logparsers
from logparsers import LogError, SeveralRuns
from logparsers.archive import LIMIT_VARIABLE
from logparsers.dataflash import open_dataflash
from logparsers.dataflash.encode import encode
from tests.parsers import dataflash_writer, ulog_writer, writers
from tests.parsers.writers import COMMAND, FLIGHT, zipped

DATAFLASH = encode(dataflash_writer.servo_flight(0.2))
CONTENTS = {"mat": writers.matlab(FLIGHT), "bin": DATAFLASH, "ulg": ulog_writer.flight(6)}


@pytest.mark.parametrize("name", CONTENTS)
@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress, lzma.compress, lambda raw: zipped({"a": raw})])
def test_a_packed_log_is_the_log(name: str, pack: Callable[[bytes], bytes]) -> None:
    bare = logparsers.read(io.BytesIO(CONTENTS[name]))
    packed = logparsers.read(io.BytesIO(pack(CONTENTS[name])))
    assert list(packed.channels) == list(bare.channels)
    assert (packed.format, packed.duration_s, packed.run) == (bare.format, bare.duration_s, "")
    assert packed.damage == bare.damage
    for channel in bare.channels:
        np.testing.assert_array_equal(packed[channel].values, bare[channel].values)


def test_the_file_readers_unpack_too(tmp_path: Path) -> None:
    path = tmp_path / "flight.bin.gz"
    path.write_bytes(gzip.compress(DATAFLASH))
    assert open_dataflash(path).count("CSRV") == open_dataflash(DATAFLASH).count("CSRV")


def test_an_archive_of_several_logs_holds_several_runs(tmp_path: Path) -> None:
    path = tmp_path / "day.zip"
    path.write_bytes(zipped({"a/1.mat": CONTENTS["mat"], "a/2.bin": DATAFLASH, "logo.png": b"\x89PNG", "._x": b"?"}))
    first, second = logparsers.read_all(path)
    assert (first.source, first.run, second.run) == (path, "a/1.mat", "a/2.bin")
    np.testing.assert_array_equal(first["de"].values, COMMAND)
    assert second["CSRV[0].Pos"].values.size
    with pytest.raises(SeveralRuns, match="holds 2 runs"):
        logparsers.read(path)
    with pytest.raises(SeveralRuns, match="an archive of several files"):
        open_dataflash(path)


def test_a_log_of_an_archive_that_cannot_be_read_is_on_record(tmp_path: Path) -> None:
    path = tmp_path / "day.zip"
    path.write_bytes(zipped({"1.mat": CONTENTS["mat"], "2.ulg": b"ULog\x01\x12\x35\x01" + bytes(8)}))
    (log,) = logparsers.read_all(path)
    assert [(damage.kind, "2.ulg" in damage.note) for damage in log.damage] == [("corrupt", True)]


def test_the_beginning_of_a_cut_archive_is_kept_and_the_cut_is_on_record() -> None:
    rng = np.random.default_rng(1)
    rows = "".join(f"{k / 50},{value}\n" for k, value in enumerate(rng.standard_normal(5000)))
    whole = gzip.compress(f"time_s,tail_cmd_deg\n{rows}".encode())
    log = logparsers.read(io.BytesIO(whole[: len(whole) // 2]))
    assert 1000 < log["tail_cmd_deg"].values.size < 4000
    assert "the archive is cut" in log.damage[0].note


@pytest.mark.slow
@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress, lzma.compress, lambda raw: zipped({"a": raw})])
def test_a_bomb_is_refused_at_the_limit(pack: Callable[[bytes], bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(LIMIT_VARIABLE, "20")
    bomb = pack(bytes(50 << 20))
    assert len(bomb) < 200_000
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(LogError, match=rf"unpacks to more than 20 MB; unpack it yourself, or set {LIMIT_VARIABLE}"):
        logparsers.read(io.BytesIO(bomb))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 30_000  # kB
    monkeypatch.setenv(LIMIT_VARIABLE, "60")
    with pytest.raises(LogError, match="belong to no known format"):
        logparsers.read(io.BytesIO(bomb))


def test_an_archive_that_promises_2_gb_is_refused_before_it_is_unpacked() -> None:
    packed = bytearray(zipped({"flight.bin": DATAFLASH}))
    at = packed.rindex(b"PK\x01\x02")
    struct.pack_into("<I", packed, at + 24, 2_000_000_000)  # the size that its directory gives (APPNOTE 4.3.12)
    with pytest.raises(LogError, match="unpacks to more than 1024 MB"):
        logparsers.read(io.BytesIO(packed))


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"\x1f\x8b\x08" + bytes(30), "broken or encrypted archive|file is empty"),
        (gzip.compress(DATAFLASH)[:-8] + bytes(8), "broken or encrypted archive"),
        (zipped({"a": DATAFLASH})[:-30], "broken or encrypted archive"),
        (zipped({}), "the archive holds no file"),
        (zipped({"a.txt": b"hello\n", "b.png": b"\x89PNG"}), "no row below the header"),
        (zipped({"a": b""}), "the file is empty"),
        (gzip.compress(gzip.compress(DATAFLASH)), "belong to no known format"),
        (b"7z\xbc\xaf\x27\x1c" + bytes(20), "archive, which is no log to read; unpack it"),
    ],
)
def test_what_cannot_be_unpacked_is_one_line(content: bytes, why: str) -> None:
    with pytest.raises(LogError, match=why) as told:
        logparsers.read_all(io.BytesIO(content))
    assert "\n" not in str(told.value)
