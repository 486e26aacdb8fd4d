"""``servofd audit`` as tools and people use it."""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import servofd
from logparsers.dataflash.encode import Message, encode
from servofd.cli import main
from tests.parsers import tlog_writer

SAMPLES = Path(__file__).parent.parent.parent / "sample_logs"
STATUSES = {"healthy", "suspect", "fault", "no_data", "unknown"}


def audited(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, Any]]:
    code = main(["audit", *arguments, "--json", "-"])
    return code, json.loads(capsys.readouterr().out)


@pytest.mark.slow
def test_the_json_is_what_the_contract_says(capsys: pytest.CaptureFixture[str]) -> None:
    path = str(SAMPLES / "faser_stuck_flight.mat")
    code, document = audited([path], capsys)
    assert code == 1
    assert document["schema"] == "servofd.audit/1"
    (log,) = document["logs"]
    assert (log["path"], log["format"], log["error"], log["damage"]) == (path, "faser", None, [])
    assert log["duration_s"] == pytest.approx(40.0, abs=0.02)
    for surface in log["surfaces"].values():
        assert surface["status"] in STATUSES
        assert surface["reason"]
        assert surface["servo"] == "hs225bb-eq31"
        assert surface["threshold"] == {"kind": "constant", "deg": 1.5}
    elevator = log["surfaces"]["elevator"]
    assert elevator["status"] == "fault"
    (fault,) = elevator["faults"]
    assert fault["kind"] == "stuck"
    assert fault["start_s"] == pytest.approx(5.0, abs=0.2)
    assert fault["start_s"] <= fault["alarm_s"]
    assert fault["end_s"] is None
    assert elevator["suspicions"] == []
    rudder = log["surfaces"]["rudder"]
    assert rudder["status"] == "healthy"
    assert rudder["faults"] == []
    assert rudder["residual"]["max_abs_deg"] < 0.3
    assert rudder["simulation_error_rms_deg"] == pytest.approx(0.1, abs=0.01)
    assert 0.0 <= rudder["false_alarms_per_hour"] < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "suffix"),
    [
        ("chirp", "mat"),
        *(
            pytest.param(command, suffix, marks=pytest.mark.nightly)
            for command in ("flight", "chirp", "steps", "doublets")
            for suffix in ("csv", "mat")
            if (command, suffix) != ("chirp", "mat")
        ),
    ],
)
def test_what_simulate_writes_audit_reads(
    command: str, suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"flown.{suffix}"
    assert main(["simulate", "-o", str(path), "--command", command, "--duration", "60"]) == 0
    capsys.readouterr()
    code, document = audited([str(path)], capsys)
    assert code == 0
    assert {s["status"] for s in document["logs"][0]["surfaces"].values()} <= {"healthy", "no_data"}


@pytest.mark.slow
def test_a_noise_free_table_comes_back_to_the_nanodegree(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "clean.csv"
    main(["simulate", "-o", str(path), "--noise-deg", "0", "--command", "doublets"])
    capsys.readouterr()
    _, document = audited([str(path), "--servo", "hs225bb-eq31"], capsys)
    assert document["logs"][0]["surfaces"]["elevator"]["residual"]["max_abs_deg"] < 1e-9


@pytest.mark.nightly
def test_another_servo_can_be_assumed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(tmp_path / "fast.csv")
    main(["simulate", "-o", path, "--servo", "s9254", "--command", "steps"])
    capsys.readouterr()
    right, document = audited([path, "--servo", "s9254"], capsys)
    wrong, _ = audited([path, "--servo", "hs225bb-eq31"], capsys)
    fitted, of_itself = audited([path, "--servo", "unknown"], capsys)
    assert (right, wrong, fitted) == (0, 2, 0)  # of all surfaces at once: it is the model, not the servos
    assert of_itself["logs"][0]["surfaces"]["elevator"]["model"]["origin"] == "fitted"
    assert document["logs"][0]["surfaces"]["elevator"]["servo"] == "s9254"


@pytest.mark.slow
def test_the_servo_that_is_named_judges_an_autopilots_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(tmp_path / "flight.bin")
    main(["simulate", "-o", path, "--servo", "s9254", "--command", "steps", "--duration", "25"])
    capsys.readouterr()
    right, document = audited([path, "--servo", "s9254"], capsys)
    wrong, _ = audited([path, "--servo", "hs225bb-eq31"], capsys)
    surfaces = document["logs"][0]["surfaces"].values()
    assert {(one["model"]["origin"], one["servo"]) for one in surfaces} == {("named", "s9254")}
    assert {one["threshold"]["deg"] for one in surfaces} == {1.5}  # not the level of the servo that the log shows
    assert (right, wrong) == (0, 2)  # of all surfaces at once: it is the model, not the servos


@pytest.mark.slow
def test_the_threshold_can_be_chosen(capsys: pytest.CaptureFixture[str]) -> None:
    path = str(SAMPLES / "faser_healthy_flight.mat")
    code, document = audited([path, "--threshold-deg", "3"], capsys)
    assert code == 0
    assert document["logs"][0]["surfaces"]["elevator"]["threshold"]["deg"] == 3.0
    below_the_noise, _ = audited([path, "--threshold-deg", "0.05"], capsys)
    assert below_the_noise == 1


def test_a_surface_can_be_chosen(capsys: pytest.CaptureFixture[str]) -> None:
    code, document = audited([str(SAMPLES / "faser_stuck_flight.mat"), "-s", "rudder"], capsys)
    assert code == 0
    assert list(document["logs"][0]["surfaces"]) == ["rudder"]


@pytest.mark.slow
def test_a_surface_without_data_keeps_the_log_from_being_called_healthy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "half.csv"
    main(["simulate", "-o", str(path)])
    lines = path.read_text().splitlines()
    column = lines[0].split(",").index("rudder_pos_deg")
    rows = [line.split(",") for line in lines[1:]]
    for row in rows:
        row[column] = "nan"
    path.write_text("\n".join([lines[0], *(",".join(row) for row in rows)]) + "\n")
    capsys.readouterr()
    code = main(["audit", str(path), "--json", str(tmp_path / "a.json")])
    captured = capsys.readouterr()
    surfaces = json.loads((tmp_path / "a.json").read_text())["logs"][0]["surfaces"]
    assert code == 2
    assert "rudder" in captured.err
    assert surfaces["rudder"]["status"] == "no_data"
    assert surfaces["elevator"]["status"] == "healthy"


@pytest.mark.slow
def test_damage_is_recorded_and_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "gap.csv"
    main(["simulate", "-o", str(path)])
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:2000] + lines[2300:-1]) + lines[-1][:12])
    capsys.readouterr()
    code = main(["audit", str(path), "--json", str(tmp_path / "a.json")])
    (document,) = json.loads((tmp_path / "a.json").read_text())["logs"]
    assert {damage["kind"] for damage in document["damage"]} == {"gap", "truncated"}
    assert code == 0
    assert re.search(r"Damage of the log.* gap ", capsys.readouterr().out, re.DOTALL)


def test_json_never_holds_nan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "short.csv"
    time_s = np.arange(12) * 0.01
    rows = "".join(f"{t:.2f},{5 * math.sin(40 * t)},{4 * math.sin(40 * t)}\n" for t in time_s)
    path.write_text("time_s,elevator_cmd_deg,elevator_pos_deg\n" + rows)
    code = main(["audit", str(path), "--json", "-"])
    text = capsys.readouterr().out
    assert code == 2
    assert json.loads(text, parse_constant=lambda name: pytest.fail(f"JSON holds {name}"))


@pytest.mark.slow
def test_a_folder_gets_everything_and_names_never_collide(tmp_path: Path) -> None:
    for name in ("f.csv", "f.mat"):
        main(["simulate", "-o", str(tmp_path / name), "--duration", "30"])
    logs = [str(tmp_path / name) for name in ("f.csv", "f.mat")]
    assert main(["audit", *logs, "-s", "elevator", "-o", str(tmp_path / "out")]) == 0
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"audit.json", "f.rrd", "f~2.rrd", "f-elevator.png", "f~2-elevator.png"} <= written


def test_a_log_too_short_to_judge_goes_into_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "short.csv"
    log.write_text("time_s,elevator_cmd_deg,elevator_pos_deg\n0,1,1\n0.02,1,2\n0.04,1,1\n")
    assert main(["audit", str(log), "-o", str(tmp_path / "out")]) == 2
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"audit.json", "short.html", "short.rrd"}
    assert capsys.readouterr().err.count("\n") == 1


def test_a_second_run_replaces_the_first(tmp_path: Path) -> None:
    target = tmp_path / "a.json"
    target.write_text("old")
    assert main(["audit", str(SAMPLES / "faser_healthy_flight.mat"), "--json", str(target)]) == 0
    assert json.loads(target.read_text())["logs"]
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


@pytest.mark.slow
def test_results_go_to_stdout_and_nothing_else_does() -> None:
    path = str(SAMPLES / "faser_healthy_flight.mat")
    command = [sys.executable, "-m", "servofd", "audit", path, "--json", "-"]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert json.loads(result.stdout)
    assert result.stderr == ""


@pytest.mark.slow
def test_a_reader_that_goes_away_is_no_error() -> None:
    command = f"{sys.executable} -m servofd config --servos --json | head -n 1"
    result = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=True)  # noqa: S607
    assert result.stdout.strip() == "{"
    assert result.stderr == ""


def test_the_json_of_a_log_that_cannot_be_judged_tells_what_is_known_of_it(tmp_path: Path) -> None:
    stamps = 40_000 * np.arange(200)
    rows = encode([Message("RCOU", "QH", {"TimeUS": stamps, "C1": [1500] * 200})])
    log, told = tmp_path / "a.bin", tmp_path / "a.json"
    log.write_bytes(rows + bytes(700) + rows[89 * 2 :])
    assert main(["audit", str(log), "--json", str(told)]) == 2
    (document,) = json.loads(told.read_text())["logs"]
    assert (document["format"], document["surfaces"]) == ("dataflash", {})
    assert document["duration_s"] == pytest.approx(7.96)  # of the first boot: each is a flight of its own
    assert "no measured deflection" in document["error"]
    assert {damage["kind"] for damage in document["damage"]} >= {"corrupt"}


def motion(rate_hz: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, command and position of a servo 60 ms behind; stuck from 40 s on."""
    time_s = np.arange(round(60.0 * rate_hz)) / rate_hz
    command = 8.0 * np.sin(1.3 * time_s) + 3.0 * np.sin(4.1 * time_s)
    position = np.interp(np.minimum(time_s, 40.0) - 0.06, time_s, command)
    return time_s, command, position


@pytest.mark.slow
def test_commands_and_positions_in_rows_of_their_own_have_the_verdict_of_one_table(tmp_path: Path) -> None:
    """At stamps of their own, and at the same ones; the one table is that of the test below."""
    time_s, command, position = motion(25.0)
    head, found = "time_s,tail_cmd_deg,tail_pos_deg\n", {}
    for name, later_s in (("same", 0.0), ("between", 0.007)):
        rows = []
        for t, c, p in zip(time_s, command, position, strict=True):
            rows += [f"{t:.4f},{c:.5f},", f"{t + later_s:.4f},,{p:.5f}"]
        path = tmp_path / f"{name}.csv"
        path.write_text(head + "\n".join(rows) + "\n")
        (log,) = servofd.audit(str(path))
        assert log.log.damage == ()
        (surface,) = log.surfaces
        (fault,) = surface.faults
        found[name] = (surface.status, fault.kind, round(fault.start_s))
    assert set(found.values()) == {("fault", "stuck", 40)}


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", [9.9, 10.02])
def test_ten_positions_a_second_are_judged(rate_hz: float, tmp_path: Path) -> None:
    path = tmp_path / "slow.csv"
    np.savetxt(
        path, np.column_stack(motion(rate_hz)), "%.4f", ",", header="time_s,tail_cmd_deg,tail_pos_deg", comments=""
    )
    ((surface,),) = (log.surfaces for log in servofd.audit(str(path)))
    assert (surface.status, [fault.kind for fault in surface.faults]) == ("fault", ["stuck"])


@pytest.mark.slow
def test_a_thousand_bad_check_sums_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sound = tlog_writer.frame("ATTITUDE", {"time_boot_ms": 50_000, "roll": 0.1})
    noisy = bytearray(sound)
    noisy[12] ^= 0x55
    path = tmp_path / "noisy.tlog"
    pairs = [(3.0 + 0.01 * k, content) for k in range(1000) for content in (bytes(noisy), sound)]
    path.write_bytes(tlog_writer.flight(2.0) + tlog_writer.log(pairs))
    assert main(["info", str(path)]) == 0
    told = capsys.readouterr().out
    assert "1000 times" in told
    assert len(told.splitlines()) < 20
