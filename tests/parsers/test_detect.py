from __future__ import annotations

import io
import os
import struct
import subprocess
import sys
from pathlib import Path

import pytest

import logparsers
from logparsers import LogError, MissingLog, UnknownFormat
from logparsers.dataflash.encode import Message, encode
from logparsers.detect import FORMATS
from tests.parsers import writers

DATAFLASH = encode([Message("RCOU", "QH", {"TimeUS": [1], "C1": [1500]})])
MAVLINK1 = b"\xfe\x09" + bytes(4) + bytes(9) + b"\x12\x34"
MAVLINK2 = b"\xfd\x09\x00" + bytes(7) + bytes(9) + b"\x12\x34"
SIGNED = b"\xfd\x09\x01" + bytes(7) + bytes(9) + b"\x12\x34" + bytes(13)
SDLOG2 = b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", 2, 27, b"ATT", b"ffffff", b"roll,pitch,yaw,rollspeed,p,y") * 2
STAMP = struct.pack(">Q", 1_700_000_000_000_000)


@pytest.mark.parametrize(
    ("head", "name"),
    [
        (b"\x89PNG\r\n\x1a\n" + bytes(40), "PNG"),
        (b"\xff\xd8\xff\xe0\x00\x10JFIF", "JPEG"),
        (b"%PDF-1.7\n", "PDF"),
        (b"7z\xbc\xaf\x27\x1c" + bytes(30), "7z"),
        (bytes(257) + b"ustar", "tar"),
        ("time_s,x\n".encode("utf-16"), "UTF-16"),
        (b"#ROSBAG V2.0\nE\0\0\0", "ROS bag, .* rostopic echo"),
        (b"\x89MCAP0\r\n", "MCAP"),
        (b"SQLite format 3\0", "SQLite database, as ROS 2"),
        (b"H Product:Blackbox flight data recorder by Nicholas Sherlock\nH Data version:2\n", "Betaflight"),
        (bytes(16) + b"BUILD 2017-09-01" + bytes(300), "DJI"),
        (SDLOG2, "PX4 log of before 2016"),
        (b"PAR1" + bytes(30), "Parquet"),
        (b'\n<!DOCTYPE html>\n<html lang="en">', "web page, .* download the log itself"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n", "Git LFS, .* git lfs pull"),
        (b'<?xml version="1.0"?>\n<gpx></gpx>\n', "XML"),
        (b'{"logs": [1,2,3]}\n', "JSON"),
        (b"QGC WPL 110\n0\t1\t0\t16\n", "mission"),
        (b"SERVO1_MIN,1100\nSERVO1_MAX,1900\n", "file of parameters"),
        (b'# plane\nname = "x"\n\n[surfaces.elevator]\noutput = 1\n', "TOML file of an aircraft, .* with -c"),
        (b'[servos.mine]\ntitle = "mine"\n', "TOML file of a servo, .* with --servo"),
        (b"# Onboard parameters for Vehicle 1\n#\n1\t1\tARMING_CHECK\t1\t6\n", "file of parameters"),
        (b"PA\x06\0\0\x02\0\0" + bytes(60), "storage of ArduPilot's parameters"),
        (b"RRF2\0\x29\0\0", "Rerun recording, .* servofd review"),
        (b"\x93NUMPY\1\0v\0", "NumPy array"),
        (b"\x80\x04\x95\n\0\0\0\0\0\0\0", "Python pickle, .* may run programs"),
        (b"\x1b[2Jtime_s,x\n0,1\n", "text with control characters"),
    ],
)
def test_strangers_are_named_whatever_they_are_called(tmp_path: Path, head: bytes, name: str) -> None:
    path = tmp_path / "flight.mat"
    path.write_bytes(head)
    with pytest.raises(UnknownFormat, match=rf"flight\.mat: is a .*{name}.*"):
        logparsers.read(path)


@pytest.mark.parametrize("head", [bytes(64), b"\x01\x02\x03", b"\xfe\x00", STAMP + b"\xfe\xff\xff", b"MATLAB\x00\x00"])
def test_unknown_bytes_are_shown(head: bytes) -> None:
    with pytest.raises(UnknownFormat, match="first bytes"):
        logparsers.read(io.BytesIO(head))


@pytest.mark.parametrize(
    ("content", "name"),
    [
        (writers.flight_level4(), "MATLAB level 4"),
        (writers.flight_level4("<"), "MATLAB level 4"),
        (writers.matlab(writers.FLIGHT), "MATLAB level 5"),
        (writers.matlab73(writers.FLIGHT), "HDF5"),
        (writers.raptrs(), "HDF5"),
        (b"time_s,x\n", "text table"),
        ("zeit_s;höhe\n".encode("latin-1"), "text table"),
        (DATAFLASH, "ArduPilot DataFlash"),
        (b"FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n", "ArduPilot DataFlash"),
        (bytes(700) + DATAFLASH, "damaged ArduPilot DataFlash"),
        (b"# exported\nFMT, 128, 89, FMT, BBnNZ, Type\n", "damaged ArduPilot DataFlash"),
        (b"ULog\x01\x12\x35\x01" + bytes(8), "PX4 ULog"),
        ((STAMP + MAVLINK1) * 3, "MAVLink"),
        ((STAMP + MAVLINK2) * 3, "MAVLink"),
        ((STAMP + SIGNED) * 3, "MAVLink"),
        (MAVLINK2 + MAVLINK1, "MAVLink"),
        (STAMP + MAVLINK2, "MAVLink"),
        (bytes(700) + (STAMP + MAVLINK2) * 4, "damaged MAVLink"),
    ],
)
def test_the_first_line_of_the_registry_that_matches_decides(content: bytes, name: str) -> None:
    found = next(known for known in FORMATS if known.matches(content[:4096]))
    assert found.name.startswith(name)
    assert callable(found.read)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(MissingLog, match=r"nothing\.csv: no such file; give the path of a flight log"):
        logparsers.read(tmp_path / "nothing.csv")


def test_a_directory(tmp_path: Path) -> None:
    with pytest.raises(MissingLog, match="is a directory; give one of the files in it"):
        logparsers.read(tmp_path)


def test_a_pipe_would_block_and_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(MissingLog, match="not a regular file"):
        logparsers.read(tmp_path / "pipe")


def test_a_file_object_that_cannot_seek() -> None:
    end, other = os.pipe()
    os.close(other)
    with os.fdopen(end, "rb") as file, pytest.raises(MissingLog, match="give a file that can seek"):
        logparsers.read(file)


def test_a_name_no_file_can_have() -> None:
    with pytest.raises(LogError, match="cannot be opened"):
        logparsers.read("a\0b")
    with pytest.raises(LogError):
        logparsers.read("a" * 5000)


def test_no_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "locked.csv"
    path.write_bytes(b"time_s,x\n0,1\n")

    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)  # the superuser may read every file, so modes prove nothing
    with pytest.raises(MissingLog, match="no permission"):
        logparsers.read(path)


def test_a_disk_that_fails() -> None:
    class Broken(io.BytesIO):
        def read(self, size: int | None = -1, /) -> bytes:
            if size == -1:
                raise OSError(5, "Input/output error")
            return super().read(size)

    with pytest.raises(LogError, match="cannot be read to its end: Input/output error"):
        logparsers.read(Broken(b"time_s,x\n0,1\n"))


def test_a_text_file_object_is_a_mistake_of_the_caller() -> None:
    with pytest.raises(TypeError, match="'rb'"):
        logparsers.read(io.StringIO("time_s,x\n0,1\n"))  # type: ignore[arg-type]


def test_the_name_of_a_file_object_is_its_label(tmp_path: Path) -> None:
    path = tmp_path / "flight.csv"
    path.write_bytes(b"time_s,x\n0,1\n")
    with path.open("rb") as file:
        assert logparsers.read(file).source == path


@pytest.mark.slow
def test_importing_stays_light() -> None:
    heavy = ("pandas", "scipy", "h5py", "numba", "pymavlink", "servofd")
    code = (
        "import time, sys, numpy; begun = time.process_time(); import logparsers;"
        f"print([m for m in {heavy!r} if m in sys.modules], time.process_time() - begun)"
    )
    runs = [subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True) for _ in range(3)]
    assert all(done.stdout.startswith("[] ") for done in runs)
    assert min(float(done.stdout.split()[-1]) for done in runs) < 0.15
