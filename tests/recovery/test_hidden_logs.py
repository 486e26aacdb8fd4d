"""The logs with hidden effects: made byte for byte from a sealed truth, and scored as an answer deserves."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import logparsers
from hidden_logs import SURFACE, TRUTH, Recipe, seal, unseal
from hidden_physics import CATALOGUE, OUTSIDE, STRUCTURAL, Effects
from hidden_runs import SCENES
from hidden_score import Answer, Score, score

FOLDER = Path(__file__).parent.parent.parent / "sample_logs" / "hidden"
RECIPES = unseal((FOLDER / TRUTH).read_text())
GAIN: Effects = {"gain": {"gain": 0.8}}
BOTH: Effects = {**GAIN, "delay": {"delay_s": 0.02}}


def step(effect: str, **values: tuple[float, float, float]) -> dict[str, Any]:
    keys = ("value", "low", "high")
    return {"effect": effect, "parameters": {key: dict(zip(keys, three, strict=True)) for key, three in values.items()}}


def scored(truth: Effects, conclusion: str, *steps: dict[str, Any], alike: tuple[tuple[str, ...], ...] = ()) -> Score:
    said = {
        "conclusion": conclusion,
        "nominal": {"held_out_rms_deg": 0.5},
        "steps": list(steps),
        "indistinguishable": [list(group) for group in alike],
        "final": {"held_out_rms_deg": 0.1},
    }
    return score(said, truth, 0.1)


def test_what_hardly_shows_need_not_be_named_but_may() -> None:
    said = {
        "conclusion": "explained",
        "steps": [step("gain", gain=(0.8, 0.79, 0.81)), step("rate_limit", rate_limit_deg_s=(50.0, 49.0, 51.0))],
    }
    assert score(said, GAIN, 0.1).extra == ("rate_limit",)
    lenient = score(said, GAIN, 0.1, unseen=("gain", "rate_limit"))
    assert lenient.first
    assert not lenient.extra
    assert not lenient.silently_wrong


@pytest.mark.slow
def test_every_log_is_made_byte_for_byte(tmp_path: Path) -> None:
    made = runpy.run_path(str(FOLDER / "make.py"))["make"](FOLDER / TRUTH, tmp_path)
    assert sorted(path.name for path in made) == sorted(path.name for path in FOLDER.glob("*.csv"))
    for path in made:
        assert path.read_bytes() == (FOLDER / path.name).read_bytes(), path.name
    assert max(path.stat().st_size for path in made) < 250_000
    assert sum(path.stat().st_size for path in made) < 3_000_000


def test_the_seal_shows_nothing_and_loses_nothing() -> None:
    text = (FOLDER / TRUTH).read_text()
    assert not any(name in text for name in (*CATALOGUE, *STRUCTURAL, *OUTSIDE))
    assert seal(RECIPES) == text
    assert len(RECIPES) == 17
    assert {recipe.scene for recipe in RECIPES} == {"", *SCENES}
    hidden = [len(recipe.effects) for recipe in RECIPES]
    assert {0, 1, 2, 3} <= set(hidden)


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda recipe: recipe.file)
def test_a_log_holds_what_happened(recipe: Recipe) -> None:
    columns = dict(recipe.columns())
    stamps_s, runs = columns.pop("time_s"), columns.pop("run", np.zeros(1))
    logs = logparsers.read_all(FOLDER / recipe.file)
    assert len(logs) == np.unique(runs).size
    for log, run in zip(logs, np.unique(runs), strict=True):
        at = np.broadcast_to(runs == run, stamps_s.shape)
        for name, values in columns.items():
            channel = log[f"{SURFACE}_{name}" if name in ("cmd_deg", "pos_deg") else name]
            atol = {"pos_deg": 5.1e-4, "airspeed_m_s": 0.051, "servo_voltage_v": 0.0051}.get(name, 1e-9)
            np.testing.assert_allclose(channel.values, values[at], rtol=0, atol=atol)
            np.testing.assert_allclose(channel.time_s, stamps_s[at], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("not_driven", "is_right"),
    [([], False), ([(3, 5.4)], True), ([(3, 5.6)], False), ([(2, 5.2)], False), ([(3, 5.2), (0, 1.0)], False)],
)
def test_a_loss_of_torque_has_to_be_told_where_it_is(not_driven: list[tuple[int, float]], is_right: bool) -> None:
    truth: Effects = {"torque_lost": {"run": 3.0, "start_s": 5.2}}
    said = {
        "conclusion": "nothing_missing",
        "steps": [],
        "not_driven": [{"run": run, "start_s": start_s} for run, start_s in not_driven],
    }
    one = score(said, truth, 0.1)
    assert (one.in_set, one.silently_wrong) == (is_right, not is_right)


@pytest.mark.parametrize(("slope", "is_right"), [(-0.5, True), (-0.52, True), (-0.3, False), (None, False)])
def test_a_size_that_goes_with_a_load_has_to_be_told_with_its_slope(slope: float | None, is_right: bool) -> None:
    truth: Effects = {"rate_limit": {"at_zero": 380.0, "slope": -0.5}}
    laws = [] if slope is None else [{"effect": "rate_limit", "at_zero": 370.0, "slope": slope}]
    said = {"conclusion": "explained", "steps": [step("rate_limit")], "varying": laws}
    one = score(said, truth, 0.1)
    assert (one.in_set, one.silently_wrong) == (is_right, not is_right)


def test_a_right_answer() -> None:
    one = scored(GAIN, "explained", step("gain", gain=(0.79, 0.78, 0.795)))
    assert (one.first, one.in_set, one.extra, one.silently_wrong, one.set_size) == (True, True, (), False, 1.0)
    assert one.errors["gain.gain"] == pytest.approx(0.05)
    assert not one.covered["gain.gain"]
    assert (one.floor_ratio, one.closure) == (1.0, 1.0)


def test_an_answer_that_is_right_among_others() -> None:
    one = scored(GAIN, "explained", step("airload"), alike=(("airload", "gain"), ("delay", "sensor_lag")))
    assert (one.first, one.in_set, one.extra, one.silently_wrong, one.set_size) == (False, True, (), False, 2.0)


def test_a_wrong_answer_is_silent_only_if_it_is_sure() -> None:
    assert scored(GAIN, "explained", step("bias")).silently_wrong
    assert scored(GAIN, "explained", step("gain"), step("bias")).extra == ("bias",)
    assert not scored(GAIN, "partly_explained", step("bias")).silently_wrong
    assert scored(GAIN, "nothing_missing").silently_wrong
    assert scored({}, "explained", step("bias")).silently_wrong
    assert not scored({}, "nothing_missing").silently_wrong
    assert not scored(GAIN, "unexplained").silently_wrong


def test_several_effects() -> None:
    assert scored(BOTH, "explained", step("delay"), step("gain")).first
    half = scored(BOTH, "explained", step("delay"))
    assert (half.found, half.in_set, half.silently_wrong) == (1, False, True)


def test_physics_by_another_law_has_its_own_right_names() -> None:
    truth: Effects = {"lugre_friction": {"friction_deg": 0.5}}
    assert not scored(truth, "explained", step("friction")).silently_wrong
    assert scored(truth, "explained", step("gain")).silently_wrong
    assert scored({"cyclic_error": {"amplitude_deg": 0.5}}, "explained", step("gain")).silently_wrong
    assert not scored({"cyclic_error": {"amplitude_deg": 0.5}}, "unexplained").silently_wrong


def test_no_answer_scores_nothing() -> None:
    one = score(None, GAIN, 0.1)
    assert (one.conclusion, one.first, one.in_set, one.silently_wrong) == ("could_not_tell", False, False, False)


def test_a_row_says_what_was_hidden_and_what_was_found() -> None:
    recipe = Recipe("a.csv", 1, GAIN, "flight", 0.1)
    one = scored(GAIN, "explained", step("bias"))
    line = runpy.run_path(str(FOLDER / "score.py"))["row"](recipe, one, Answer(1, 2.0, {}, ""))
    assert line == "| a.csv | gain 0.8 | explained **silently wrong** | bias |  | 100.0 % | 2.0 |"
