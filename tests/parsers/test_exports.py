"""A flight that other tools took apart is the flight: every value, and every verdict."""

from __future__ import annotations

import gzip
import io
import os
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import logparsers
from logparsers import FlightLog, LogError, MissingChannel, TableLayout
from logparsers.dataflash import DataFlashFile
from logparsers.dataflash.encode import Message, encode
from servofd import audit
from servofd.batch.find import find_logs, flights_joined
from tests.parsers import dataflash_writer, export_writer, tlog_writer

SAMPLES = Path(__file__).parents[2] / "sample_logs"
MICROSECOND = 1e-6


def assert_same(part: FlightLog, whole: FlightLog, *, single: bool = False) -> None:
    """Every channel of the part is one of the whole; `single`: printed as 32-bit floats are."""
    assert part.channels
    for name, channel in part.channels.items():
        there = whole[name]
        values = (channel.values, there.values)
        if single:
            values = (channel.values.astype(np.float32), there.values.astype(np.float32))
        np.testing.assert_array_equal(*values, err_msg=name)
        np.testing.assert_allclose(channel.time_s, there.time_s, rtol=0.0, atol=MICROSECOND, err_msg=name)


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight with a stuck servo, and all that other tools make of it."""
    folder = tmp_path_factory.mktemp("sample")
    content = (SAMPLES / "ardupilot_volz_stuck.bin").read_bytes()
    (folder / "a.bin").write_bytes(content)
    (folder / "b.mat").write_bytes(export_writer.mavlogdump_mat(content))
    (folder / "c.mat").write_bytes(export_writer.mission_planner_mat(content))
    (folder / "d.bin.gz").write_bytes(gzip.compress(content))
    (folder / "g.log").write_bytes(dataflash_writer.text_of(content))
    names = [name for name in DataFlashFile.open(content).names if name in ("CSRV", "RCOU", "PARM", "MSG", "VER")]
    for name in names:
        (folder / f"e_{name}.csv").write_bytes(export_writer.mavlogdump(content, "--format", "csv", "--types", name))
    with zipfile.ZipFile(folder / "f.zip", "w") as archive:
        for name in names:
            archive.write(folder / f"e_{name}.csv", f"day/e_{name}.csv")
    return folder


@pytest.mark.slow
def test_tables_of_one_flight_are_the_log(sample: Path) -> None:
    whole = logparsers.read(sample / "a.bin")
    for path in ("e_*.csv", "f.zip"):
        log = logparsers.read(sample / path)
        assert (log.format, log.vehicle, log.firmware) == ("dataflash", whole.vehicle, whole.firmware)
        assert (log.parameters, log.damage) == (whole.parameters, ())
        assert_same(log, whole)
    alone = logparsers.read(sample / "e_CSRV.csv")
    assert_same(alone, whole)
    assert {channel.unit for name, channel in alone.channels.items() if name.endswith(".Pos")} == {"deg"}


@pytest.mark.slow
def test_the_same_flight_in_every_form_has_the_same_verdicts(sample: Path) -> None:
    found = {}
    for path in ("a.bin", "b.mat", "c.mat", "d.bin.gz", "e_*.csv", "f.zip", "g.log"):
        (result,) = audit(sample / path)
        found[path] = [
            (s.surface, s.status, [(f.kind, round(f.start_s, 1), f.end_s) for f in s.faults]) for s in result.surfaces
        ]
    assert any(status == "fault" for _, status, _ in found["a.bin"])
    assert all(verdicts == found["a.bin"] for verdicts in found.values())


@pytest.mark.slow
def test_a_folder_joins_the_tables_of_a_flight(sample: Path) -> None:
    names = [Path(log.path).name for log in find_logs([str(sample)]).logs]
    assert names == ["a.bin", "b.mat", "c.mat", "d.bin.gz", "e*.csv", "f.zip", "g.log"]
    tables = sorted(map(str, sample.glob("e_*.csv")))
    assert flights_joined(tables) == [str(sample / "e*.csv")]
    assert flights_joined(tables[:1]) == tables[:1]


def test_radians_of_old_firmware_are_told_by_its_version(tmp_path: Path) -> None:
    rows = {
        "TimeUS": range(0, 1_000_000, 20_000),
        "Id": [1] * 50,
        "Pos": np.linspace(-0.3, 0.3, 50),
        "PosCmd": [0.0] * 50,
    }
    for version, unit in (((4, 5), "rad"), ((4, 7), "deg"), (None, "")):
        (tmp_path / "CSRV.csv").write_text(
            "timestamp,TimeUS,Id,Pos,PosCmd\n"
            + "".join(f"1.0,{t},{i},{p},{c}\n" for t, i, p, c in zip(*rows.values(), strict=True))
        )
        (tmp_path / "VER.csv").unlink(missing_ok=True)
        if version:
            (tmp_path / "VER.csv").write_text("timestamp,TimeUS,Maj,Min\n1.0,10,{},{}\n".format(*version))
        assert logparsers.read(tmp_path / "*.csv")["CSRV[1].Pos"].unit == unit


@pytest.mark.slow
def test_a_reboot_within_exported_messages_is_told_and_goes_on() -> None:
    def run(start_us: int, rows: int) -> bytes:
        stamps = start_us + 40_000 * np.arange(rows)
        rcou = Message("RCOU", "QH", {"TimeUS": stamps, "C1": np.arange(rows) % 500 + 1000})
        return encode([rcou, Message("ATT", "Qf", {"TimeUS": stamps + 10_000, "Roll": np.arange(rows) / 8})])

    content = run(5_000_000, 100) + run(1_000_000, 60)
    whole = logparsers.read(io.BytesIO(content))
    assert [damage.kind for damage in whole.damage] == ["reboot"]
    for exported in (export_writer.mavlogdump_mat(content), export_writer.mission_planner_mat(content)):
        log = logparsers.read(io.BytesIO(exported))
        assert [damage.kind for damage in log.damage] == ["reboot"]
        assert_same(log, whole)


@pytest.mark.slow
def test_a_table_of_telemetry_is_that_of_the_log() -> None:
    content = tlog_writer.flight(4.0)
    table = export_writer.mavlogdump(
        content, "--format", "csv", "--types", "SERVO_OUTPUT_RAW,NAMED_VALUE_FLOAT,ATTITUDE,VFR_HUD", suffix=".tlog"
    )
    log, whole = logparsers.read(io.BytesIO(table)), logparsers.read(io.BytesIO(content))
    assert log.format == "tlog"
    for name in ("SERVO_OUTPUT_RAW.servo3_raw", "NAMED_VALUE_FLOAT[SRVP1].value", "ATTITUDE.roll"):
        np.testing.assert_array_equal(log[name].values, whole[name].values)
        np.testing.assert_allclose(log[name].time_s, whole[name].time_s, rtol=0.0, atol=MICROSECOND)
    arrived = log["VFR_HUD.airspeed"].time_s if "VFR_HUD.airspeed" in log.channels else np.zeros(0)
    assert np.all((arrived > -1.0) & (arrived < 60.0))


def test_ports_in_a_table_of_telemetry_are_apart() -> None:
    """Servos 1 and 17 share a column of the table."""
    head = b"timestamp,SERVO_OUTPUT_RAW.time_usec,SERVO_OUTPUT_RAW.port,SERVO_OUTPUT_RAW.servo1_raw\n"
    rows = b"".join(b"%d.0,%d,%d,%d\n" % (k, 1_000_000 * k, k % 2, 1000 + 500 * (k % 2) + k) for k in range(40))
    log = logparsers.read(io.BytesIO(head + rows + b"41.0,41000000,,1700\n"))
    assert log["SERVO_OUTPUT_RAW.servo1_raw"].values.tolist() == list(range(1000, 1040, 2))
    assert log["SERVO_OUTPUT_RAW[1].servo1_raw"].values.tolist() == list(range(1501, 1541, 2))
    assert {log[name].unit for name in log.channels} == {"us"}


@pytest.mark.slow
def test_tables_of_ulog2csv_are_the_log(tmp_path: Path) -> None:
    source = SAMPLES / "px4_stuck.ulg"
    command = [sys.executable, "-c", "from pyulog.ulog2csv import main; main()", "-o", str(tmp_path), str(source)]
    subprocess.run(command, check=True, capture_output=True, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"})
    whole = logparsers.read(source)
    (found,) = find_logs([str(tmp_path)]).logs
    log = logparsers.read(found.path)
    assert log.format == "ulog"
    assert set(log.channels) == set(whole.channels)
    assert_same(log, whole, single=True)
    (result,) = audit(found.path)
    (truth,) = audit(source)
    assert [(s.surface, s.status) for s in result.surfaces] == [(s.surface, s.status) for s in truth.surfaces]


ROS = {
    "flight_3-mavros-rc-out.csv": "%time,field.header.seq,field.channels0,field.channels1\n",
    "flight_3-mavros-imu-data.csv": "%time,field.header.frame_id,field.angular_velocity.x\n",
}


def test_topics_of_ros_are_named_by_what_their_files_do_not_share(tmp_path: Path) -> None:
    stamps = 1_531_000_000_000_000_000 + np.arange(50) * 20_000_000
    rc, imu = (tmp_path / name for name in ROS)
    rc.write_text(ROS[rc.name] + "".join(f"{t},{k},{1500 + k},1000\n" for k, t in enumerate(stamps)))
    imu.write_text(ROS[imu.name] + "".join(f"{t + 7_000_000},base_link,{k / 8}\n" for k, t in enumerate(stamps)))
    log = logparsers.read(tmp_path / "*.csv")
    assert list(log.channels) == [
        "imu-data.angular_velocity.x",
        "rc-out.header.seq",
        "rc-out.channels0",
        "rc-out.channels1",
    ]
    np.testing.assert_array_equal(log["rc-out.channels0"].values, 1500 + np.arange(50))
    offset_s = log["imu-data.angular_velocity.x"].time_s - log["rc-out.channels0"].time_s
    np.testing.assert_allclose(offset_s, 0.007, atol=1e-6)
    assert list(logparsers.read(rc).channels) == ["header.seq", "channels0", "channels1"]


def test_a_layout_reads_such_a_table_like_any_other() -> None:
    content = b"timestamp,a,b\n0,1,2\n20,3,4\n"
    log = logparsers.read(io.BytesIO(content), TableLayout(time="timestamp", time_unit="ms"))
    assert (log.format, list(log.channels), log.duration_s) == ("table", ["a", "b"], 0.02)


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"timestamp,a\n0.5,1\n0.7,2\n", "its timestamps are no microseconds"),
        (b"timestamp,a\nx,1\n", r"line 2, column 'timestamp': 'x' is not a number"),
        (b"timestamp,TimeUS,C1\n", "no row below the header"),
        (b"timestamp,TimeUS,C1\n1,x,2\n", r"line 2, column 'TimeUS': 'x' is not a number"),
        (b"%time,field.data\nnow,1\n", r"line 2, column '%time': 'now' is not a number"),
        (b"%time,field.data\n1,now\n", "no column of numbers beside the time"),
        (b"timestamp,ATTITUDE.roll,ATTITUDE.pitch\n1.0,,\n", "no message with numbers and a time stamp"),
    ],
)
def test_tables_of_no_use_are_one_line(content: bytes, why: str) -> None:
    with pytest.raises(LogError, match=why) as told:
        logparsers.read(io.BytesIO(content))
    assert "\n" not in str(told.value)


def test_a_cell_that_is_no_number_costs_that_cell() -> None:
    log = logparsers.read(io.BytesIO(b"timestamp,TimeUS,C1\n1,20,1500\n1,40,x\n1,60,1502\n"))
    (channel,) = log.channels.values()
    np.testing.assert_array_equal(channel.values, [1500.0, np.nan, 1502.0])
    assert [(damage.kind, damage.count) for damage in log.damage] == [("not_numeric", 1)]


def test_a_name_that_nothing_fits(tmp_path: Path) -> None:
    (tmp_path / "notes.csv").write_text("a,b\n1,2\n")
    with pytest.raises(LogError, match=r"no table of messages fits this name"):
        logparsers.read(tmp_path / "*.csv")
    with pytest.raises(LogError):
        logparsers.read(tmp_path / "**")


@pytest.mark.slow
def test_no_channel_of_that_name(sample: Path) -> None:
    with pytest.raises(MissingChannel, match="no channel FLUX"):
        logparsers.read(sample / "e_CSRV.csv", only=["FLUX"])
    some: dict[str, Any] = dict(logparsers.read(sample / "e_*.csv", only=["RCOU.C1"]).channels)
    assert list(some) == ["RCOU.C1"]
