"""Audits of real servos on the bench, each through a small aircraft file.

The parameters of the files were fitted by hand on the same data; the point is that reports are sensible: no servo is
at fault, healthy is said only where a jam and the loss of a third of the travel would have shown under the threshold
of the file, runs without commands are no data, nothing is silently skipped.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import servofd
from tests.external.test_bench_tables import DATA

if TYPE_CHECKING:
    from servofd.detection.verdict import LogAudit, SurfaceAudit

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


def assert_earned(verdict: SurfaceAudit, run: str) -> None:
    """No fault; and healthy exactly where the loss of a third of the travel would have shown."""
    lost = verdict.detectable.loss_share if verdict.detectable else None
    if lost is not None and lost <= 1.0 / 3.0:
        assert verdict.status == "healthy", run
    else:
        assert verdict.status == "unknown", run
        assert "too little motion" in verdict.reason or "after the first second" in verdict.reason, run
        assert "fly or bench-test" in verdict.reason, run


@pytest.mark.slow
def test_hobby_servo(tmp_path: Path) -> None:
    """A dead zone of about 2 deg and a 5 % gain error are not in this model: the threshold is wide, and hides much."""
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
    assert len(results) == 32
    for run, result in results.items():
        assert_earned(result.surfaces[0], f"run {run}")
    # Only one run moves so far that under 20 deg a third of its travel could not have been lost unseen.
    assert [run for run, result in results.items() if result.surfaces[0].status == "healthy"] == ["18"]


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


@pytest.mark.slow
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
    # Some runs hold no command at all (the slow returns), and the report says so.
    for run, result in results.items():
        if int(run) % 2:
            assert result.surfaces[0].status == "no_data"
            assert "holds no value" in result.surfaces[0].reason
        else:
            assert_earned(result.surfaces[0], f"run {run}")


@pytest.mark.parametrize("name", ["ardupilot_plane_1s.bin", "px4_small.ulg", "ardupilot_vtol.tlog"])
def test_logs_without_positions_are_refused_in_one_line(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    from servofd.cli import main

    path = DATA / "logs" / name
    if not path.exists():
        pytest.skip("real logs not found; set SERVOFD_EXTERNAL_DATA to their folder")
    assert main(["audit", str(path)]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert name in line
