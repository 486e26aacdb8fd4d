"""``servofd config --filter`` and ``servofd config --servos``."""

from __future__ import annotations

import json

import pytest

from servofd.cli import main
from servofd.servo.library import library


def test_design_prints_thesis_eq_4_10(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "--filter", "hs225bb-eq31", "--pole", "-50", "--printed-gain"]) == 0
    out = capsys.readouterr().out
    for number in ("51.10384301", "4848.732625", "340392.1504", "6246813.164", "-6250000"):
        assert number in out
    assert "noise gain     0.4183" in out


def test_servos_prints_every_servo(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "--servos", "--notes"]) == 0
    out = capsys.readouterr().out
    for name, servo in library().items():
        assert name in out
        assert all(note in out for note in servo.notes)


def test_servos_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "--servos", "--json"]) == 0
    servos = json.loads(capsys.readouterr().out)
    assert servos["s3151"]["bandwidth_rad_s"] == pytest.approx(36.47, abs=0.005)
    assert servos["s3151"]["poles_rad_s"][0] == pytest.approx([-8.635, -24.0736], abs=1e-3)
