"""``servofd config --odds`` from the shell."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from servofd.cli import main

SAMPLES = Path(__file__).parent.parent.parent / "sample_logs"
HEALTHY, STUCK = str(SAMPLES / "faser_healthy_flight.mat"), str(SAMPLES / "faser_stuck_flight.mat")


@pytest.mark.slow
def test_odds_of_a_design(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    target = tmp_path / "odds.json"
    code = main(
        ["config", "--odds", "-c", "faser", "-s", "rudder", "--false-alarms-per-hour", "1e-6", "--json", str(target)]
    )
    assert code == 0
    document = json.loads(target.read_text())
    assert document["schema"] == "servofd.odds/1"
    rudder = document["surfaces"]["rudder"]
    assert rudder["wished"]["threshold_deg"]["gaussian"] == pytest.approx(0.292, abs=1e-3)
    assert rudder["residual"]["correlation"] == pytest.approx(0.62066, abs=1e-4)
    assert rudder["at_threshold_in_force"]["smallest_bias_deg"]["within_0.2_s"] == pytest.approx(1.57, abs=0.01)
    printed = capsys.readouterr().out
    assert "rudder" in printed
    assert "elevator" not in printed
    assert "designed for white noise of 0.1 deg, not measured" in printed


@pytest.mark.slow
def test_odds_of_a_servo_scale_with_its_noise(capsys: pytest.CaptureFixture[str]) -> None:
    thresholds = []
    for noise in ("0.1", "0.2"):
        assert (
            main(["config", "--odds", "--servo", "s9254", "--noise-deg", noise, "--rate-hz", "50", "--json", "-"]) == 0
        )
        (surface,) = json.loads(capsys.readouterr().out)["surfaces"].values()
        thresholds.append(surface["wished"]["threshold_deg"]["gaussian"])
    assert thresholds[1] == pytest.approx(2.0 * thresholds[0])


@pytest.mark.slow
def test_odds_of_flights(capsys: pytest.CaptureFixture[str]) -> None:
    command = [
        "config",
        "--odds",
        "--log",
        HEALTHY,
        STUCK,
        "-s",
        "elevator",
        "-s",
        "rudder",
        "--json",
        "-",
    ]
    assert main(command) == 0
    surfaces = json.loads(capsys.readouterr().out)["surfaces"]
    assert surfaces["rudder"]["healthy_hours"] == pytest.approx(2.0 * surfaces["elevator"]["healthy_hours"], rel=0.01)
    assert any("faser_stuck_flight.mat left out, fault" in note for note in surfaces["elevator"]["notes"])
    assert surfaces["rudder"]["alarms_counted"] == 0
    # 0.1 deg of noise went into these flights.
    assert surfaces["elevator"]["residual"]["std_deg"] == pytest.approx(0.0418, rel=0.1)


@pytest.mark.slow
def test_a_surface_at_fault_tells_nothing_and_writes_nothing(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    outputs = ["--json", str(tmp_path / "odds.json")]
    assert main(["config", "--odds", "--log", STUCK, "-s", "elevator", *outputs]) == 2
    assert "no healthy surface to learn the odds from: elevator" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_one_bad_log_does_not_stop_the_others(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "--odds", "--log", "no_such.mat", HEALTHY, "-s", "rudder"]) == 2
    captured = capsys.readouterr()
    assert "rudder" in captured.out
    assert "no such file" in captured.err
    assert captured.err.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ([], "odds of what?"),
        (["-c", "faser", "-s", "elevtor"], "did you mean elevator"),
        (["-c", "nonsense"], "no such file"),
        (["--servo", "nonsense"], "unknown servo"),
        (["-c", "faser", "--false-alarms-per-hour", "1e9"], "choose one between"),
        (["-c", "faser", "--log", HEALTHY, "--noise-deg", "0.1"], "leave them out"),
        (["--servo", "s9254", "--noise-deg", "1e9"], "1e+09 deg is no noise of positions"),
        (["-c", "faser", "--json", "/no/such/folder/x.json"], "cannot write"),
    ],
)
def test_wrong_calls_are_told_in_one_line(words: list[str], reason: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "--odds", *words]) == 2
    error = capsys.readouterr().err
    assert reason in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "x"])
def test_a_rate_must_be_positive(value: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["config", "--odds", "-c", "faser", f"--false-alarms-per-hour={value}"])
    assert stopped.value.code == 2
    assert "positive" in capsys.readouterr().err
