"""Audits of real servos on the bench, each through a small aircraft file.

The parameters of the files were fitted by hand on the same data; the point is that reports are sensible: healthy
servos are called healthy, runs without commands are no data, nothing is silently skipped.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import servofd
from tests.external.test_bench_tables import DATA

if TYPE_CHECKING:
    from servofd.detection.verdict import LogAudit

AIRCRAFT = """
name = "{name} on the bench"
[table]
time = "t_s"
run = "run"
[servos.bench]
title = "{name}"
bandwidth_hz = {bandwidth_hz}
damping = {damping}
delay_s = {delay_s}
hold = "zoh"
rate_limit_deg_s = {rate_limit_deg_s}
source = "fitted on the bench data"
[surfaces.shaft]
servo = "bench"
threshold_deg = {threshold_deg}
command = {{ channel = "cmd", unit = "deg" }}
measured = {{ channel = "meas", unit = "deg" }}
"""


def audited(tmp_path: Path, file: str, **numbers: float | str) -> dict[str, LogAudit]:
    if not (DATA / "bench" / file).exists():
        pytest.skip("real bench data not found; set SERVOFD_EXTERNAL_DATA to its folder")
    config = tmp_path / "bench.toml"
    config.write_text(AIRCRAFT.format(**numbers))
    return {result.log.run: result for result in servofd.audit(DATA / "bench" / file, config)}


def test_hobby_servo(tmp_path: Path) -> None:
    """A dead zone of about 2 deg and a 5 % gain error are not in this model: the threshold must be wide."""
    results = audited(
        tmp_path,
        "hobby_servo_encoder.csv",
        name="hobby servo",
        bandwidth_hz=15.0,
        damping=1.57,
        delay_s=0.0449,
        rate_limit_deg_s=276.0,
        threshold_deg=20.0,
    )
    statuses = {run: result.surfaces[0].status for run, result in results.items()}
    assert len(statuses) == 32
    # Run 13, a random binary sequence, works the dead zone harder than this model can follow.
    assert {run for run, status in statuses.items() if status == "fault"} <= {"13"}
    # Runs that stay within the threshold of their start cannot prove anything, and say so.
    assert {"healthy", "unknown"} >= {status for run, status in statuses.items() if run != "13"}
    assert sum(status == "healthy" for status in statuses.values()) >= 20


def test_smart_servo_under_gravity(tmp_path: Path) -> None:
    results = audited(
        tmp_path,
        "smart_servo_gravity_load.csv",
        name="smart servo",
        bandwidth_hz=6.9,
        damping=1.6,
        delay_s=0.0,
        rate_limit_deg_s=470.0,
        threshold_deg=3.0,
    )
    assert [result.surfaces[0].status for result in results.values()] == ["healthy", "healthy"]


def test_digital_servo_under_loads(tmp_path: Path) -> None:
    results = audited(
        tmp_path,
        "digital_servo_loads.csv",
        name="digital servo",
        bandwidth_hz=8.0,
        damping=0.8,
        delay_s=0.01,
        rate_limit_deg_s=388.0,
        threshold_deg=40.0,
    )
    statuses = {run: result.surfaces[0].status for run, result in results.items()}
    commanded = {status for run, status in statuses.items() if int(run) % 2 == 0 and int(run) <= 18}
    # Some runs hold no command at all (the slow returns), and the report says so.
    assert commanded <= {"healthy", "fault"}
    assert statuses["1"] == "no_data"
    assert "holds no value" in results["1"].surfaces[0].reason


@pytest.mark.parametrize("name", ["ardupilot_plane_1s.bin", "px4_small.ulg", "ardupilot_vtol.tlog"])
def test_logs_without_positions_are_refused_in_one_line(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    from servofd.cli import main

    path = DATA / "logs" / name
    if not path.exists():
        pytest.skip("real logs not found; set SERVOFD_EXTERNAL_DATA to their folder")
    assert main(["audit", str(path)]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert name in line
