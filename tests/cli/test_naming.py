"""What ``servofd audit`` says about named faults, in JSON and in words."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servofd.cli import main
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel
from servofd.simulation.commands import COMMANDS

SAMPLES = Path(__file__).parent.parent.parent / "sample_logs"
KINDS = {
    "stuck",
    "bias",
    "hardover",
    "floating",
    "intermittent",
    "oscillation",
    "deadband",
    "slow",
    "loss_of_effectiveness",
    "unknown",
}
# Log, surface, kind, and what was hidden in it, with how close the audit comes.
HIDDEN: dict[str, tuple[str, str, dict[str, tuple[float, float]]]] = {
    "faser_stuck_flight": ("elevator", "stuck", {}),
    "faser_deadband_flight": ("aileron_right", "deadband", {"width_deg": (6.0, 0.3)}),
    "faser_bias_flight": ("rudder", "bias", {"bias_deg": (3.0, 0.05)}),
    "faser_hardover_flight": ("elevator", "hardover", {"position_deg": (-20.0, 0.05)}),
    "faser_floating_flight": ("aileron_left", "floating", {}),
    "faser_oscillation_flight": (
        "elevator",
        "oscillation",
        {"amplitude_deg": (2.0, 0.05), "frequency_hz": (3.0, 0.05)},
    ),
    "faser_slow_flight": ("aileron_right", "slow", {"bandwidth_scale": (0.4, 0.02)}),
    "faser_loss_flight": ("rudder", "loss_of_effectiveness", {"gain": (0.4, 0.02)}),
}


def audited(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, dict[str, Any]]:
    code = main(["audit", *arguments, "--json", "-"])
    (log,) = json.loads(capsys.readouterr().out)["logs"]
    return code, log["surfaces"]


def check_promises(code: int, surfaces: dict[str, Any]) -> None:
    statuses = {verdict["status"] for verdict in surfaces.values()}
    assert code == (1 if "fault" in statuses else 0 if statuses <= {"healthy", "no_data"} else 2)
    for verdict in surfaces.values():
        assert bool(verdict["faults"]) == (verdict["status"] == "fault")
        assert verdict["status"] != "suspect" or verdict["suspicions"]
        for fault in verdict["faults"] + verdict["suspicions"]:
            assert fault["kind"] in KINDS
            assert 0.0 < fault["probability"] <= 1.0
            assert fault["start_s"] <= fault["alarm_s"]
            assert fault["end_s"] is None or fault["end_s"] >= fault["alarm_s"]
            assert set(fault["alternatives"]) <= KINDS - {fault["kind"]} | {"healthy"}
            assert set(fault["intervals"]) == set(fault["parameters"])
            for name, (low, high) in fault["intervals"].items():
                assert low <= fault["parameters"][name] <= high


@pytest.mark.slow
@pytest.mark.parametrize("kind_of_threshold", [pytest.param("constant", marks=pytest.mark.nightly), "interval"])
@pytest.mark.parametrize("name", HIDDEN)
def test_sample_logs_are_named(name: str, kind_of_threshold: str, capsys: pytest.CaptureFixture[str]) -> None:
    """By day with the interval; `tests/replay/test_sample_logs.py` judges them with the constant threshold."""
    surface, kind, hidden = HIDDEN[name]
    code, surfaces = audited(capsys, str(SAMPLES / f"{name}.mat"), "--threshold", kind_of_threshold)
    check_promises(code, surfaces)
    assert code == 1
    assert {other for other, verdict in surfaces.items() if verdict["status"] in ("fault", "suspect")} == {surface}
    verdict = surfaces[surface]
    assert verdict["threshold"]["kind"] == kind_of_threshold
    assert verdict["suspicions"] == []
    (fault,) = verdict["faults"]
    assert fault["kind"] == kind
    for parameter, (truth, within) in hidden.items():
        assert fault["parameters"][parameter] == pytest.approx(truth, abs=within)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["faser_deadband_chirp", "faser_stuck_chirp", "table_three_faults"])
def test_every_fault_has_what_the_contract_promises(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Also of those above."""
    (path,) = SAMPLES.glob(f"{name}.*")
    some = ["-s", "elevator"] if name.startswith("table") else []  # whose servos are fitted
    check_promises(*audited(capsys, str(path), *some))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["faser_healthy_flight", "faser_healthy_chirp"])
def test_healthy_logs_raise_nothing(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, surfaces = audited(capsys, str(SAMPLES / f"{name}.mat"), "--threshold", "interval")
    assert code == 0
    assert {verdict["status"] for verdict in surfaces.values()} <= {"healthy", "no_data"}
    assert all(v["faults"] == [] and v["suspicions"] == [] for v in surfaces.values())


@pytest.mark.slow
def test_a_suspect_is_no_fault(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """0.8 deg off: beyond the tolerance of 0.3 deg, within the threshold of 1.5 deg."""
    time_s = np.arange(6000) / 100.0
    rng = np.random.default_rng(1)
    command_deg = COMMANDS["calm"](time_s, rng)
    model = ServoModel.of(servo_named("hs225bb-eq31"))
    measured_deg = model.simulate(time_s, command_deg, time_s) + 0.8 * (time_s > 20.0)
    measured_deg += 0.1 * rng.standard_normal(time_s.size)
    path = tmp_path / "slightly_off.csv"
    table = np.column_stack([time_s, command_deg, measured_deg])
    header = "time_s,elevator_cmd_deg,elevator_pos_deg"
    np.savetxt(path, table, fmt="%.5f", delimiter=",", header=header, comments="")
    named = ["--servo", "hs225bb-eq31"]
    code, surfaces = audited(capsys, str(path), *named)
    assert (code, surfaces["elevator"]["status"], surfaces["elevator"]["faults"]) == (2, "suspect", [])
    (suspicion,) = surfaces["elevator"]["suspicions"]
    assert suspicion["kind"] == "bias"
    assert suspicion["parameters"]["bias_deg"] == pytest.approx(0.8, abs=0.1)
    assert suspicion["start_s"] == pytest.approx(20.0, abs=1.0)
    assert main(["audit", str(path), *named]) == 2
    shown = capsys.readouterr().out
    assert "suspect" in shown
    assert "off by +0.8 deg" in shown


def test_a_level_contradicts_the_interval_threshold(capsys: pytest.CaptureFixture[str]) -> None:
    log = str(SAMPLES / "faser_healthy_flight.mat")
    assert main(["audit", log, "--threshold", "interval", "--threshold-deg", "2"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert len(captured.err.splitlines()) == 1
    assert "--threshold-deg" in captured.err
    assert "--threshold interval" in captured.err
