"""The benchmark of hidden effects: what it flies, what its yardsticks say, and what it prints of given answers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hidden_effects
from hidden_effects import Case, cases, judge, report
from hidden_peers import regression_closure
from hidden_physics import CATALOGUE, EXCITATIONS, hidden
from hidden_rivals import leftover_sigmas
from hidden_score import Answer, ask


def test_everything_is_flown() -> None:
    full, quick = list(cases([0])), list(cases([0], quick=True))
    singles = [case for case in full if case.kind == "single"]
    assert len(singles) == len(CATALOGUE) * 3 * len(EXCITATIONS) * 3
    assert {case.names[0] for case in quick if case.kind == "single"} == set(CATALOGUE)
    assert {case.kind for case in quick} == {"none", "single", "pair", "triple", "structural", "outside"}
    assert len(quick) < 120
    assert len(set(full)) == len(full)


@pytest.mark.slow
def test_a_steady_supply_cannot_tell_voltage_from_speed_and_a_battery_can() -> None:
    effects = {"voltage_rate": {"deg_s_per_v": 7.0}}
    steady, flown = (
        leftover_sigmas(hidden(1, effects, way, duration_s=20.0), 1, effects, way, 0.1) for way in ("sweep", "doublets")
    )
    assert steady[0] == "rate_limit"
    assert steady[1] < 1.0
    assert flown[1] > 20.0


def test_regressions_close_what_is_linear_and_not_what_sticks() -> None:
    linear = hidden(1, {"delay": {"delay_s": 0.03}}, "flight")
    sticking = hidden(1, {"friction": {"friction_deg": 2.0}}, "flight")
    assert regression_closure(linear, 0.1, nonlinear=False) > 0.9
    assert regression_closure(sticking, 0.1, nonlinear=True) < 0.9


def test_answers_come_through_the_command_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: list[str] = []

    def answering(arguments: list[str]) -> int:
        asked.extend(arguments)
        Path(arguments[arguments.index("--json") + 1]).write_text(json.dumps({"conclusion": "unexplained"}))
        return 1

    monkeypatch.setattr("servofd.cli.main", answering)
    answer = ask(tmp_path / "log.csv", "elevator", "--servo", "s9254")
    assert (answer.code, answer.said) == (1, {"conclusion": "unexplained"})
    assert asked[:4] == ["explain", str(tmp_path / "log.csv"), "-s", "elevator"]
    assert asked[-2:] == ["--servo", "s9254"]


@pytest.mark.nightly
def test_tables_say_what_was_answered(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    said: dict[str, Any] = {
        "conclusion": "explained",
        "nominal": {"held_out_rms_deg": 0.6},
        "steps": [{"effect": "gain", "parameters": {"gain": {"value": 0.87, "low": 0.8, "high": 0.95}}}],
        "indistinguishable": [],
        "final": {"held_out_rms_deg": 0.1},
    }
    monkeypatch.setattr(hidden_effects, "ask", lambda *_: Answer(1, 0.5, said, ""))
    results = [judge(Case("single", (name,), "medium", "flight", 0.1, 1)) for name in ("gain", "bias")]
    results.append(judge(Case("none", (), "", "flight", 0.1, 1)))
    assert [one.fair for one in results] == [True, True, False]
    report(results)
    printed = " ".join(capsys.readouterr().out.split())
    assert "single, flight 2 50.0 % 50.0 % 1.00 50.0 % 1 100.0 %" in printed
    assert "bias gain 1" in printed
    assert "flight, gain.gain 1" in printed
    assert "Nothing hidden, called so: 0.0 %" in printed
    assert np.isfinite(results[0].linear)
