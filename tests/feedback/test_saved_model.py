"""What explain saves judges the runs that it came from."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import servofd
from servofd.aircraft.schema import Surface, load_aircraft, plain_aircraft
from servofd.aircraft.series import Series
from servofd.calibrating.levels import levels_of
from servofd.cli import main
from servofd.detection.audit import audit_segment


@pytest.mark.slow
@pytest.mark.parametrize(
    "effect", ["deadband:width_deg=1.5", pytest.param("rate_limit:rate_limit_deg_s=40", marks=pytest.mark.nightly)]
)
def test_what_is_saved_is_what_was_shown_with_its_effects(effect: str, tmp_path: Path) -> None:
    run, saved = str(tmp_path / "run.csv"), str(tmp_path / "better.toml")
    shown, again = tmp_path / "shown.json", tmp_path / "again.json"
    assert main(["simulate", "-o", run, "--duration", "40", "--effect", f"elevator:{effect}"]) == 0
    known = ["-s", "elevator", "--servo", "hs225bb-eq31"]
    assert main(["explain", run, *known, "--save", saved, "--json", str(shown)]) == 0
    assert main(["explain", run, "-s", "elevator", "--servo", saved, "--json", str(again)]) == 0
    final, nominal = json.loads(shown.read_text())["final"], json.loads(again.read_text())["nominal"]
    assert nominal["held_out_rms_deg"] == pytest.approx(final["held_out_rms_deg"], rel=0.05)
    elevator = load_aircraft(saved).surfaces["elevator"]
    assert elevator.model.origin == "fitted"
    assert elevator.tolerance is not None
    one = ("elevator",)
    for (result,) in (servofd.audit(run, servo=saved, surfaces=one), servofd.audit(run, saved, surfaces=one)):
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


@pytest.mark.nightly
def test_a_saved_model_keeps_its_slow_pole_ahead_of_the_loop(tmp_path: Path) -> None:
    """A stiction that holds until the whole error acts, behind a slow pole: as the joints of an arm have it."""
    rng, time_s = np.random.default_rng(4), np.arange(2000) / 50.0
    command_deg = 20.0 * np.cumsum(rng.standard_normal(time_s.size) * (rng.random(time_s.size) < 0.05))
    command_deg = 40.0 * np.sin(command_deg / 40.0)
    fine_s = np.arange(0.0, time_s[-1], 0.001)
    goal_deg, position_deg, speed_deg_s, moved = command_deg[0], command_deg[0], 0.0, []
    for asked_deg in command_deg[np.searchsorted(time_s, fine_s, side="right") - 1]:
        goal_deg += 0.001 * 10.0 * (asked_deg - goal_deg)
        error_deg = goal_deg - position_deg
        pull = 900.0 * error_deg if abs(error_deg) > 1.0 else 0.0
        speed_deg_s += 0.001 * (pull - 45.0 * speed_deg_s)
        position_deg += 0.001 * speed_deg_s
        moved.append(position_deg)
    measured_deg = np.interp(time_s, fine_s, moved) + 0.03 * rng.standard_normal(time_s.size)
    run, saved = tmp_path / "run.csv", str(tmp_path / "saved.toml")
    shown, again = tmp_path / "shown.json", tmp_path / "again.json"
    rows = np.column_stack([time_s, command_deg, measured_deg])
    np.savetxt(run, rows, "%.4f", ",", header="time_s,x_cmd_deg,x_pos_deg", comments="")
    main(["explain", str(run), "--save", saved, "--json", str(shown)])
    main(["explain", str(run), "--servo", saved, "--json", str(again)])
    assert load_aircraft(saved).surfaces["x"].effects["poles"]["form"] == "before"
    final, nominal = json.loads(shown.read_text())["final"], json.loads(again.read_text())["nominal"]
    assert nominal["train_rms_deg"] == pytest.approx(final["train_rms_deg"], rel=0.05)


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
    [pytest.param(log, id=log.stem, marks=[] if k == 9 else pytest.mark.nightly) for k, log in enumerate(HIDDEN)],
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


@pytest.mark.slow
def test_a_model_that_no_tolerance_fits_accuses_not_its_own_run() -> None:
    """A position that jumps by 6 deg twice a second, whatever the command: no tolerance of a servo allows that."""
    plane = plain_aircraft(["rudder"], "s9256")
    time_s = np.arange(3000) / 50.0
    command_deg = 8.0 * np.sin(2.0 * np.pi * 0.3 * time_s)
    position_deg = plane.model("rudder").simulate(time_s, command_deg, time_s) + 3.0 * np.sign(np.sin(12.0 * time_s))
    run = Series("rudder", time_s, command_deg, time_s, position_deg)
    levels = levels_of(plane.model("rudder"), [run])
    assert levels["threshold"] == "constant"
    surface = Surface.model_validate({**plane.surfaces["rudder"].model_dump(), **levels})
    verdict = audit_segment(run, plane.model_copy(update={"surfaces": {"rudder": surface}}), duration_s=60.0)
    assert not verdict.faults


def test_levels_of_a_servo_file_are_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    saved = tmp_path / "mine.toml"
    saved.write_text(
        '[servos.mine]\ntitle = "m"\nbandwidth_hz = 5.0\ndamping = 0.7\ndelay_s = 0.01\nhold = "zoh"\nsource = "x"\n'
        "[surface]\npersistence = 0\n"
    )
    assert main(["audit", "sample_logs/table_three_faults.csv", "--servo", str(saved)]) == 2
    assert "surface.persistence" in capsys.readouterr().err
