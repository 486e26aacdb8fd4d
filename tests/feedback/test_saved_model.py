"""What explain saves judges the runs that it came from."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import servofd
from servofd.aircraft.schema import load_aircraft
from servofd.cli import main


@pytest.mark.slow
def test_a_saved_explanation_finds_its_own_run_healthy(tmp_path: Path) -> None:
    run, saved = str(tmp_path / "run.csv"), str(tmp_path / "better.toml")
    slow = ["--effect", "elevator:rate_limit:rate_limit_deg_s=40"]
    assert main(["simulate", "-o", run, "--duration", "60", *slow]) == 0
    assert main(["explain", run, "-s", "elevator", "--servo", "hs225bb-eq31", "--save", saved]) == 0
    elevator = load_aircraft(saved).surfaces["elevator"]
    assert elevator.model.origin == "fitted"
    assert elevator.tolerance is not None
    (result,) = servofd.audit(run, saved, surfaces=("elevator",))
    assert result.surfaces[0].status == "healthy"


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["deadband:width_deg=1.5", "rate_limit:rate_limit_deg_s=40"])
def test_what_is_saved_is_what_was_shown_with_its_effects(effect: str, tmp_path: Path) -> None:
    run, saved = str(tmp_path / "run.csv"), str(tmp_path / "better.toml")
    shown, again = tmp_path / "shown.json", tmp_path / "again.json"
    assert main(["simulate", "-o", run, "--duration", "60", "--effect", f"elevator:{effect}"]) == 0
    known = ["-s", "elevator", "--servo", "hs225bb-eq31"]
    assert main(["explain", run, *known, "--save", saved, "--json", str(shown)]) == 0
    assert main(["explain", run, "-s", "elevator", "--servo", saved, "--json", str(again)]) == 0
    final, nominal = json.loads(shown.read_text())["final"], json.loads(again.read_text())["nominal"]
    assert nominal["held_out_rms_deg"] == pytest.approx(final["held_out_rms_deg"], rel=0.05)
    (result,) = servofd.audit(run, servo=saved, surfaces=("elevator",))
    assert result.surfaces[0].status == "healthy"


@pytest.mark.nightly
def test_a_file_saved_for_one_surface_of_an_unknown_servo_serves_the_whole_log(tmp_path: Path) -> None:
    """Nobody knows these servos: the one that was explained is as it was shown, the others fit themselves."""
    run, saved, shown = str(tmp_path / "run.csv"), str(tmp_path / "one.toml"), tmp_path / "shown.json"
    slow = ["--effect", "elevator:rate_limit:rate_limit_deg_s=40"]
    assert main(["simulate", "-o", run, "--duration", "40", *slow]) == 0
    assert main(["explain", run, "-s", "elevator", "--save", saved, "--json", str(shown)]) == 0
    (result,) = servofd.audit(run, servo=saved)
    errors = {one.surface: one.statistics.simulation_error_rms_deg for one in result.surfaces if one.statistics}
    assert set(errors) == {"aileron", "elevator", "rudder"}
    final = json.loads(shown.read_text())["final"]
    assert errors["elevator"] == pytest.approx(final["held_out_rms_deg"], rel=0.05)


def test_a_saved_file_without_any_of_the_surfaces_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    two = tmp_path / "two.toml"
    entry = 'servo = "s9254"\ncommand = { channel = "a", unit = "deg" }\n'
    lines = [f"[surfaces.{name}]\n{entry}" for name in ("flap", "slat")]
    two.write_text("\n".join(lines))
    assert main(["audit", "sample_logs/table_three_faults.csv", "--servo", str(two)]) == 2
    assert "has flap, slat, and none of aileron, elevator, rudder" in capsys.readouterr().err


HIDDEN = sorted((Path(__file__).parents[2] / "sample_logs" / "hidden").glob("hidden_*.csv"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "log",
    [pytest.param(log, id=log.stem, marks=[] if k % 3 == 0 else pytest.mark.nightly) for k, log in enumerate(HIDDEN)],
)
def test_an_identified_servo_accuses_none_of_its_own_tests(log: Path, tmp_path: Path) -> None:
    saved = tmp_path / "mine.toml"
    if main(["identify", str(log), "--save", str(saved)]) != 0:
        assert not saved.exists()
        return
    results = list(servofd.audit(log, servo=str(saved)))
    for result in results:
        (verdict,) = result.surfaces
        assert verdict.model.origin == "fitted"
        assert verdict.model.good_runs == len(results)
        assert verdict.status == "healthy" or verdict.reason.startswith("too little motion")


@pytest.mark.slow
def test_a_servo_that_does_not_explain_its_own_test_is_not_saved(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    saved = tmp_path / "mine.toml"
    assert main(["identify", "sample_logs/faser_loss_flight.mat", "-s", "rudder", "--save", str(saved)]) == 2
    assert "no servo model explains this motion" in capsys.readouterr().err
    assert not saved.exists()


def test_levels_of_a_servo_file_are_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    saved = tmp_path / "mine.toml"
    saved.write_text(
        '[servos.mine]\ntitle = "m"\nbandwidth_hz = 5.0\ndamping = 0.7\ndelay_s = 0.01\nhold = "zoh"\nsource = "x"\n'
        "[surface]\npersistence = 0\n"
    )
    assert main(["audit", "sample_logs/table_three_faults.csv", "--servo", str(saved)]) == 2
    assert "surface.persistence" in capsys.readouterr().err
