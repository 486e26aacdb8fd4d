"""Real servos on the bench that nobody named: each is fitted to the very run that is judged."""

from __future__ import annotations

from pathlib import Path

import pytest

import servofd
from servofd.detection.evidence import MOST_LOST
from tests.external.test_bench_tables import DATA

pytestmark = pytest.mark.skipif(
    not (DATA / "bench").is_dir(),
    reason="no bench records: set SERVOFD_EXTERNAL_DATA to the directory that holds bench/ and logs/",
)

TABLE = """
[table]
time = "t_s"
run = "run"
[surfaces.shaft]
command = { channel = "cmd", unit = "deg" }
measured = { channel = "meas", unit = "deg" }
"""
PLAIN = ("geared_joint_multisine", "geared_joint_plc", "rc_servo_steps_1khz", "teleop_arm_1", "teleop_arm_2")
OF_RUNS = (
    "digital_servo_loads",
    "emps_linear_drive",
    "hobby_servo_encoder",
    "smart_servo_gains",
    "smart_servo_gravity_load",
    "smart_servo_no_play",
    "smart_servo_play",
    "vtol_surface_steps",
)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*PLAIN, *OF_RUNS])
def test_no_run_is_at_fault_and_healthy_is_earned(name: str, tmp_path: Path) -> None:
    config = tmp_path / "shaft.toml"
    config.write_text(TABLE)
    aircraft = config if name in OF_RUNS else None
    judged = 0
    for result in servofd.audit(DATA / "bench" / f"{name}.csv", aircraft, servo="unknown"):
        for verdict in result.surfaces:
            where = f"run {result.log.run}, {verdict.surface}: {verdict.reason}"
            assert verdict.status != "fault", where
            assert verdict.model.origin in ("fitted", "none"), where
            lost = verdict.detectable.loss_share
            if verdict.status == "healthy":
                assert lost is not None, where
                assert lost <= MOST_LOST, where
            judged += 1
    assert judged
