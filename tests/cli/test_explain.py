"""``servofd explain`` as tools and people use it; whatever is wrong with a log is told in a sentence."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from servofd.aircraft import load_aircraft
from servofd.cli import main
from tests.recovery.fine_servo import FineServo, Hidden, hide

SLOW = hide(FineServo(delay_s=0.03), duration_s=20.0)
HEALTHY = hide(FineServo(), duration_s=20.0)


def test_the_json_is_what_the_contract_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = SLOW.write(tmp_path / "log.csv")
    assert main(["explain", str(path), "-s", "elevator", "--json", "-"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == "servofd.explain/1"
    assert (document["surface"], document["conclusion"]) == ("elevator", "explained")
    assert document["nominal"]["held_out_rms_deg"] > 2.0 * document["noise_floor_rms_deg"] > 0.1
    (step,) = document["steps"]
    assert step["effect"] == "delay"
    assert step["parameters"]["delay_s"]["low"] < step["parameters"]["delay_s"]["high"]
    assert {"effect", "held_out_rms_deg"} == set(step["rivals"][0])
    assert document["indistinguishable"] == [["delay", "clock_offset"]]
    assert document["final"]["model"] == {"delay": {"delay_s": step["parameters"]["delay_s"]["value"]}}
    assert all(isinstance(sentence, str) for sentence in document["where"])


def test_the_better_model_makes_the_audit_quieter(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, better = SLOW.write(tmp_path / "log.csv"), tmp_path / "better.toml"
    assert main(["explain", str(path), "--save", str(better)]) == 0
    text = capsys.readouterr().out
    assert "+ delay" in text
    assert "these data cannot tell delay from clock_offset" in text
    errors = []
    for options in ([], ["-c", str(better)]):
        main(["audit", str(path), "--json", "-", *options])
        surface = json.loads(capsys.readouterr().out)["logs"][0]["surfaces"]["elevator"]
        errors.append(surface["simulation_error_rms_deg"])
    assert errors[1] < 0.11 < 2.0 * errors[1] < errors[0]


def test_what_is_found_in_the_linkage_is_saved_and_simulated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = hide(FineServo(backlash_deg=1.0), duration_s=20.0).write(tmp_path / "log.csv")
    better = tmp_path / "better.toml"
    assert main(["explain", str(path), "--save", str(better)]) == 0
    capsys.readouterr()
    assert load_aircraft(better).surfaces["elevator"].effects["backlash"]["width_deg"] == pytest.approx(1.0, abs=0.03)
    assert main(["audit", str(path), "-c", str(better), "--json", "-"]) == 0
    surface = json.loads(capsys.readouterr().out)["logs"][0]["surfaces"]["elevator"]
    assert surface["status"] == "healthy"
    # Noise of 0.1 deg passes the filter with a gain of 0.42.
    assert surface["residual"]["std_deg"] < 0.045


def _scaled(log: Hidden, factor: float) -> Hidden:
    return replace(log, position_deg=factor * log.position_deg)


@pytest.mark.parametrize(
    ("log", "reason"),
    [
        (_scaled(HEALTHY, -1.0), "check the sign"),
        (_scaled(HEALTHY, 0.1), "check the scale"),
        (replace(HEALTHY, command_deg=HEALTHY.position_deg, position_deg=HEALTHY.command_deg), "swapped"),
        (replace(HEALTHY, time_s=10.0 * HEALTHY.time_s), "at 10 Hz"),
        (replace(HEALTHY, command_deg=np.linspace(0.0, 0.1, HEALTHY.time_s.size)), "hardly asked to move"),
        (Hidden(*(v[:200] for v in (getattr(HEALTHY, n) for n in HEALTHY.__dataclass_fields__))), "at least 4 s"),
    ],
    ids=["sign", "scale", "swapped", "10 Hz", "rest", "short"],
)
def test_unfit_logs(log: Hidden, reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = log.write(tmp_path / "log.csv")
    assert main(["explain", str(path), "-s", "elevator"]) == 2
    message = capsys.readouterr().err
    assert reason in message
    assert message.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["-s", "elevtor"], "did you mean elevator"),
        (["--servo", "nonsense"], "unknown servo"),
        (["--json", "/nowhere/at/all.json"], "does not exist"),
    ],
)
def test_wrong_calls(options: list[str], reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = HEALTHY.write(tmp_path / "log.csv")
    assert main(["explain", str(path), *options]) == 2
    assert reason in capsys.readouterr().err


def test_nothing_to_save_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = HEALTHY.write(tmp_path / "log.csv")
    assert main(["explain", str(path), "--save", str(tmp_path / "same.toml")]) == 2
    captured = capsys.readouterr()
    assert "nothing missing" in captured.out
    assert "no better model to save" in captured.err
