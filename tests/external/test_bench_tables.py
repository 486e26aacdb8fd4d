"""Real bench records, read with layouts and compared with Python's own csv reader."""

from __future__ import annotations

import csv
import os
from pathlib import Path

import numpy as np
import pytest

import logparsers
from logparsers import FlightLog, TableLayout

BESIDE = Path(__file__).resolve().parents[3] / "shared" / "data"
DATA = Path(os.environ.get("SERVOFD_EXTERNAL_DATA", BESIDE))

pytestmark = pytest.mark.skipif(
    not (DATA / "bench").is_dir(),
    reason="no bench records: set SERVOFD_EXTERNAL_DATA to the directory that holds bench/ and logs/",
)

RUNS = {
    "digital_servo_loads": 66,
    "emps_linear_drive": 1,
    "hobby_servo_encoder": 32,
    "smart_servo_gains": 8,
    "smart_servo_gravity_load": 2,
    "smart_servo_no_play": 4,
    "smart_servo_play": 4,
    "vtol_surface_steps": 6,
}


def rows_of(name: str) -> list[dict[str, str]]:
    with (DATA / "bench" / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def number(text: str) -> float:
    return float(text or "nan")


def logs_of(name: str) -> tuple[FlightLog, ...]:
    return logparsers.read_all(DATA / "bench" / f"{name}.csv", TableLayout(time="t_s", run="run"))


@pytest.mark.parametrize("name", RUNS)
def test_every_run_and_every_number(name: str) -> None:
    logs, rows = logs_of(name), rows_of(name)
    assert [log.run for log in logs] == list(dict.fromkeys(row["run"] for row in rows))
    assert len(logs) == RUNS[name]
    for log in logs:
        mine = [row for row in rows if row["run"] == log.run]
        assert "type" not in log.channels
        np.testing.assert_array_equal(log["meas"].time_s, [float(row["t_s"]) for row in mine])
        for channel in log.channels.values():
            np.testing.assert_array_equal(channel.values, [number(row[channel.name]) for row in mine])


def test_steps_of_unknown_onset_have_no_command_and_say_so() -> None:
    blank = [log for log in logs_of("digital_servo_loads") if np.isnan(log["cmd"].values).all()]
    assert blank
    assert all(any(damage.kind == "non_finite" for damage in log.damage) for log in blank)


def test_one_load_of_many() -> None:
    layout = TableLayout(time="t_s", run="run", where={"load_g": "400"}, units={"cmd": "deg", "meas": "deg"})
    logs = logparsers.read_all(DATA / "bench" / "digital_servo_loads.csv", layout)
    assert 1 <= len(logs) < RUNS["digital_servo_loads"]
    assert all(np.all(log["load_g"].values == 400.0) for log in logs)
    assert {log["meas"].unit for log in logs} == {"deg"}


@pytest.mark.parametrize(("pattern", "name"), [("*.bin", "dataflash"), ("*.tlog", "tlog"), ("*.ulg", "ulog")])
def test_logs_of_autopilots_are_told_apart_by_content(pattern: str, name: str) -> None:
    paths = sorted((DATA / "logs").glob(pattern))
    assert paths
    for path in paths:
        assert logparsers.read(path).format == name
