"""Real servos on the bench that nobody named: each is fitted to the very run that is judged."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import pandas as pd
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
EVERY_TIME = {"rc_servo_steps_1khz", "teleop_arm_1", "emps_linear_drive", "smart_servo_gains", "smart_servo_play"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[] if name in EVERY_TIME else pytest.mark.nightly) for name in (*PLAIN, *OF_RUNS)],
)
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


@pytest.mark.slow
@pytest.mark.parametrize("load", [pytest.param("20kg", marks=pytest.mark.nightly), "-40kg"])
def test_a_cycle_of_thirteen_seconds_is_healthy_and_a_jam_in_it_is_found(load: str) -> None:
    """Each cycle of a ball screw begins in motion; the jam comes after a third of it."""
    cycles = pd.read_csv(DATA / "bench" / "ram" / f"ram_normal_{load}.csv.gz").groupby("run")
    for run, cycle in islice(cycles, 0, None, 10):
        columns = {name: cycle[f"ram_{name}"].to_numpy(float) for name in ("cmd_deg", "pos_deg")}
        time_s = (cycle["time_s"] - cycle["time_s"].iloc[0]).to_numpy(float)
        jammed_deg = columns["pos_deg"].copy()
        jammed_deg[time_s.size // 3 :] = jammed_deg[time_s.size // 3]
        for position_deg, expected in ((columns["pos_deg"], "healthy"), (jammed_deg, "fault")):
            log = {"time_s": time_s, "ram_cmd_deg": columns["cmd_deg"], "ram_pos_deg": position_deg}
            (audit,) = servofd.audit(log)
            assert audit.surfaces[0].status == expected, run


@pytest.mark.slow
def test_what_is_off_after_the_middle_of_a_run_at_1_khz_is_not_accused_before_it() -> None:
    table = pd.read_csv(DATA / "bench" / "rc_servo_steps_1khz.csv")
    time_s, command_deg, position_deg = table[["time_s", "servo_cmd_deg", "servo_pos_deg"]].to_numpy(float).T
    middle_s = 0.5 * (time_s[0] + time_s[-1])
    off_deg = position_deg + (time_s > middle_s) * 0.1 * (position_deg.max() - position_deg.min())
    (found,) = servofd.audit({"time_s": time_s, "servo_cmd_deg": command_deg, "servo_pos_deg": off_deg})
    assert all(fault.start_s > middle_s - 1.0 for fault in found.surfaces[0].faults)
