"""Tables that people hand in by mistake: one line that says so, or the right answer all the same; never a crash."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servofd.cli import main
from servofd.core.types import FloatArray
from servofd.simulation.commands import hand_flown

STEP_S, FRICTION_DEG, RUN = 0.01, 0.6, 750
KNOWN = ("--servo", "hs225bb-eq31")


@cache
def swept() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Time [s], command [deg] and position [deg] of a servo of two poles (40 rad/s) that sticks, in steps of 0.5 ms."""
    rng, h = np.random.default_rng(1), STEP_S / 20
    time_s: FloatArray = np.array(np.arange(3000) * STEP_S, dtype=np.float64)
    command: FloatArray = 8.0 * np.sin(2.0 * np.pi * (0.3 * time_s + 0.02 * time_s**2))
    y = v = 0.0
    position = 0.05 * rng.standard_normal(time_s.size)
    for n, asked in enumerate(command.tolist()):
        position[n] += y
        for _ in range(20):
            free = v + h * (1600.0 * (asked - y) - 64.0 * v)
            grip = h * 1600.0 * FRICTION_DEG
            v = free - min(max(free, -grip), grip)
            y += h * v
    return time_s, command, position


def table(path: Path, *, gains: tuple[float, float] = (1.0, 1.0), runs: int = 0, **more: object) -> Path:
    """The sweep as a table, in runs of so many rows, with further columns: of one value, or of one for each run."""
    time_s, command, position = swept()
    lines = [",".join([*(["run"] if runs else []), "time_s,x_cmd_deg,x_pos_deg", *more])]
    for k, row in enumerate(zip(time_s, gains[0] * command, gains[1] * position, strict=True)):
        begins_s = time_s[k - k % runs] if runs else 0.0
        values = [f"{row[0] - begins_s:.4f}", f"{row[1]:.5f}", f"{row[2]:.5f}"]
        further = [str(each[k // runs % len(each)] if isinstance(each, list) else each) for each in more.values()]
        lines.append(",".join([*([str(k // runs)] if runs else []), *values, *further]))
    path.write_text("\n".join(lines) + "\n")
    return path


def said(path: Path, *options: str) -> dict[str, Any]:
    out = path.with_suffix(".json")
    assert main(["explain", str(path), *options, "--json", str(out)]) == 0
    found: dict[str, Any] = json.loads(out.read_text())
    return found


def refused(path: Path, capsys: pytest.CaptureFixture[str], *options: str) -> str:
    assert main(["explain", str(path), *options]) == 2
    errors = capsys.readouterr().err
    assert errors.count("\n") == 1
    return errors


def is_friction(found: dict[str, Any]) -> None:
    """Not a dead band: the two pass for one another until the servo's poles are right."""
    assert found["conclusion"] == "explained"
    assert list(found["final"]["model"]) == ["friction"]
    assert found["final"]["model"]["friction"]["friction_deg"] == pytest.approx(FRICTION_DEG, rel=0.03)
    assert found["final"]["held_out_rms_deg"] < 0.051


@pytest.mark.nightly
def test_one_run_only(tmp_path: Path) -> None:
    is_friction(said(table(tmp_path / "log.csv", runs=3000)))


@pytest.mark.slow
def test_runs_of_a_fifth_of_a_second(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "at least 1 s are needed" in refused(table(tmp_path / "log.csv", runs=20), capsys)


@pytest.mark.nightly
@pytest.mark.filterwarnings("error")
def test_one_such_run_among_others_a_load_that_never_changes_and_a_current_without_noise(tmp_path: Path) -> None:
    path = table(tmp_path / "log.csv", runs=RUN, load_g=200, servo_current_a=0.5)
    path.write_text("\n".join(path.read_text().splitlines()[: 1 + 3 * RUN + 20]) + "\n")
    found = said(path)
    is_friction(found)
    assert "run 4 is too short: nothing of it counts" in found["notes"]
    assert any("load_g is 200 in every run: its influence cannot be found" in each for each in found["notes"])


@pytest.mark.parametrize("gain", [1e-3, 1.0], ids=["still", "moved by something else"])
def test_a_constant_command(gain: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "hardly asked to move" in refused(table(tmp_path / "log.csv", gains=(0.0, gain)), capsys)


@pytest.mark.parametrize("options", [(), KNOWN], ids=["unknown", "known"])
def test_a_position_that_stands_still(
    options: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = table(tmp_path / "log.csv")
    header, *rows = path.read_text().splitlines()
    noisy = [f"{row.rsplit(',', 1)[0]},{3.0 + 0.05 * (k * k % 7):.5f}" for k, row in enumerate(rows)]
    path.write_text("\n".join([header, *noisy]) + "\n")
    said_of_it = refused(path, capsys, *options)
    assert "position stands still" in said_of_it
    assert "jammed, without power, or no reading of this servo" in said_of_it


@pytest.mark.parametrize("options", [(), KNOWN], ids=["unknown", "known"])
def test_swapped_columns(options: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = table(tmp_path / "log.csv")
    path.write_text(path.read_text().replace("x_cmd_deg,x_pos_deg", "x_pos_deg,x_cmd_deg"))
    assert "columns swapped" in refused(path, capsys, *options)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("load", "note"),
    [
        (["none", "light", "heavy", "heavy"], "'none' is not a number"),
        (["0 g", "100 g", "200 g", "300 g"], "'0 g' is not a number"),
    ],
    ids=["words", "with units"],
)
def test_loads_that_tell_nothing(load: object, note: str, tmp_path: Path) -> None:
    found = said(table(tmp_path / "log.csv", runs=RUN, load_g=load))
    is_friction(found)
    assert any(note in each for each in found["notes"])


@pytest.mark.nightly
def test_percent_for_degrees(tmp_path: Path) -> None:
    """What is called a degree is one: sizes come out in its unit."""
    found = said(table(tmp_path / "log.csv", gains=(12.5, 12.5)))
    assert found["final"]["model"]["friction"]["friction_deg"] == pytest.approx(12.5 * FRICTION_DEG, rel=0.03)


@pytest.mark.parametrize("options", [(), KNOWN], ids=["unknown", "known"])
def test_percent_for_the_command_alone(
    options: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "check the scale of the calibration" in refused(
        table(tmp_path / "log.csv", gains=(12.5, 1.0)), capsys, *options
    )


@pytest.mark.parametrize(("seed", "shift_deg", "words"), [(2, 0.0, "does not follow"), (1, 550.0, "550 deg from it")])
def test_a_position_of_another_surface_belongs_to_no_command(
    seed: int, shift_deg: float, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is said before any effect is tried."""
    time_s = np.arange(0.0, 30.0, STEP_S)
    asked_deg, flown_deg = (hand_flown(time_s, np.random.default_rng(each)) for each in (1, seed))
    rows = [f"{t:.2f},{u:.3f},{y + shift_deg:.3f}" for t, u, y in zip(time_s, asked_deg, flown_deg, strict=True)]
    path = tmp_path / "swapped.csv"
    path.write_text("\n".join(["time_s,x_cmd_deg,x_pos_deg", *rows]) + "\n")
    said = refused(path, capsys, *KNOWN)
    assert "this position does not belong to this command" in said
    assert words in said
