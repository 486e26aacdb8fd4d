"""`servofd config` on a plain table: a file under which the table is judged as without one."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

import servofd
from servofd.cli import main

TABLE = Path("sample_logs/table_three_faults.csv")


@pytest.mark.slow
def test_the_drafted_file_gives_the_verdicts_of_the_fit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of which `tests/detection/test_fitted.py` asks the same."""
    two = ["aileron_cmd_deg", "aileron_pos_deg", "rudder_cmd_deg", "rudder_pos_deg"]
    pd.read_csv(TABLE)[["time_s", *two]].to_csv(table := tmp_path / "two.csv", index=False)
    assert main(["config", str(table)]) == 0
    config = tmp_path / "plane.toml"
    config.write_text(capsys.readouterr().out)
    (drafted,) = servofd.audit(table, config)
    assert {own.surface: own.status for own in drafted.surfaces} == {"aileron": "healthy", "rudder": "fault"}
    (fault,) = drafted["rudder"].faults
    assert (fault.kind, fault.start_s) == ("bias", pytest.approx(10.0, abs=0.5))
    for own in drafted.surfaces:
        assert own.model.origin == "fitted"
        assert own.model.fitted_between_s is None, "a part of the log of the file is none of the log that is judged"
        assert "of this log" not in own.reason


def test_a_table_without_pairs_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = tmp_path / "alone.csv"
    table.write_text("time_s,rudder_cmd_deg\n" + "".join(f"{0.02 * k:.2f},{k % 7}\n" for k in range(200)))
    assert main(["config", str(table)]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_a_monitor_assumes_no_servo(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "plane.toml"
    config.write_text(
        '[surfaces.rudder]\ncommand = { channel = "rudder_cmd_deg", unit = "deg" }\n'
        'measured = { channel = "rudder_pos_deg", unit = "deg" }\n'
    )
    assert main(["monitor", str(TABLE), "-c", str(config), "--plain"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "rudder: no servo is named" in line


def test_a_monitor_watches_the_surfaces_of_which_a_servo_is_known(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, plane = str(tmp_path / "flight.tlog"), tmp_path / "plane.toml"
    assert main(["simulate", "-o", log, "--duration", "30", "--seed", "5"]) == 0
    assert main(["calibrate", log, "-s", "elevator", "-o", str(plane)]) == 0
    capsys.readouterr()
    watch = ["monitor", log, "-c", str(plane), "--speed", "0", "--plain"]
    assert main(watch) == 0
    shown = capsys.readouterr()
    assert not shown.err
    for name in ("aileron", "elevator", "rudder"):
        assert f"{name}: no alarm" in shown.out
    pulse = 'unit = "us", trim_us = 1500.0, slope_deg_per_us = 0.09'
    others = "".join(
        f'\n[surfaces.{name}]\ncommand = {{ channel = "SERVO_OUTPUT_RAW.servo{n}_raw", {pulse} }}\n'
        f'measured = {{ channel = "NAMED_VALUE_FLOAT[SRVP{n}].value", unit = "deg" }}\n'
        for name, n in (("flap", 1), ("tail", 4))
    )
    plane.write_text(plane.read_text() + others)
    assert main(watch) == 0
    shown = capsys.readouterr()
    assert "flap, tail: not watched: no servo is named" in shown.err
    assert "elevator: no alarm" in shown.out
