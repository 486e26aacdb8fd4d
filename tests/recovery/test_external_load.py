"""What pushes a servo from outside and was logged is found with its size, beside what the servo itself lacks."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from servofd.cli import main
from servofd.core.types import FloatArray

STEP_S, EVERY = 2.5e-4, 80
SLOW, SUM, PRODUCT = 24.84, 70.04, 4921.0
"""Poles of an HS-225BB: a filter of the command, and the loop behind it."""
DEG_PER_NM, FRICTION_DEG = 22.0, 0.4


@cache
def pushed_servo(friction_deg: float, seed: int) -> tuple[FloatArray, ...]:
    """Time [s], command [deg], position [deg] and load [N m] of a servo integrated in steps of 0.25 ms."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, 40.0, STEP_S * EVERY)
    tones = rng.uniform(0.05, 1.2, 16)
    command = np.sum([0.9 * np.sin(2.0 * np.pi * f * time_s + rng.uniform(0.0, 6.0)) for f in tones], axis=0)
    pulses = rng.choice(np.array([-0.1, 0.0, 0.0, 0.1]), 1 + time_s.size // 60)
    load_nm: FloatArray = np.repeat(pulses, 60)[: time_s.size]
    y = filtered = float(command[0])
    v, position = 0.0, 0.1 * rng.standard_normal(time_s.size)
    for n in range(time_s.size):
        position[n] += y
        pull = PRODUCT * DEG_PER_NM * load_nm[n]
        for _ in range(EVERY):
            filtered += STEP_S * SLOW * (command[n] - filtered)
            free = v + STEP_S * (PRODUCT * (filtered - y) - SUM * v + pull)
            grip = STEP_S * PRODUCT * friction_deg
            v = free - min(max(free, -grip), grip)
            y += STEP_S * v
    return time_s, command, position, load_nm


def answer(folder: Path, columns: dict[str, FloatArray], *options: str) -> dict[str, object]:
    path = folder / "log.csv"
    np.savetxt(path, np.column_stack([*columns.values()]), "%.5f", ",", header=",".join(columns), comments="")
    out = folder / "said.json"
    code = main(["explain", str(path), "-s", "elevator", *options, "--json", str(out)])
    said: dict[str, object] = json.loads(out.read_text())
    assert code == (said["conclusion"] not in ("explained", "nothing_missing"))
    return said


def model(said: dict[str, object]) -> dict[str, dict[str, float]]:
    final = said["final"]
    assert isinstance(final, dict)
    found: dict[str, dict[str, float]] = final["model"]
    return found


KNOWN = ("--servo", "hs225bb-eq31")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("column", "unit"),
    [
        pytest.param("elevator_load_nm", 1.0, marks=pytest.mark.nightly),
        pytest.param("disturbance", 1.0, marks=pytest.mark.nightly),
        ("elevator_load_n", 5e4),
    ],
)
def test_a_load_that_was_logged_is_found_with_its_size_in_any_unit(column: str, unit: float, tmp_path: Path) -> None:
    time_s, command, position, load_nm = pushed_servo(0.0, 1)
    columns = {"time_s": time_s, "elevator_cmd_deg": command, "elevator_pos_deg": position, column: unit * load_nm}
    said = answer(tmp_path, columns, *KNOWN)
    assert said["conclusion"] == "explained"
    assert list(model(said)) == ["external_load"]
    assert model(said)["external_load"]["deg_per_unit"] == pytest.approx(DEG_PER_NM / unit, rel=0.02)
    assert "load" in str(said["answer"])


@pytest.mark.nightly
def test_it_is_found_beside_friction_in_any_unit(tmp_path: Path) -> None:
    time_s, command, position, load_nm = pushed_servo(FRICTION_DEG, 2)
    columns = {"time_s": time_s, "elevator_cmd_deg": command, "elevator_pos_deg": position, "load_n": 5e4 * load_nm}
    said = answer(tmp_path, columns, *KNOWN)
    assert said["conclusion"] == "explained"
    assert set(model(said)) == {"external_load", "friction"}
    assert model(said)["external_load"]["deg_per_unit"] == pytest.approx(DEG_PER_NM / 5e4, rel=0.03)
    assert model(said)["friction"]["friction_deg"] == pytest.approx(FRICTION_DEG, rel=0.1)


@pytest.mark.slow
def test_a_load_that_nobody_logged_is_no_other_effect(tmp_path: Path) -> None:
    time_s, command, position, _ = pushed_servo(0.0, 1)
    said = answer(tmp_path, {"time_s": time_s, "elevator_cmd_deg": command, "elevator_pos_deg": position}, *KNOWN)
    assert said["conclusion"] in ("unexplained", "partly_explained")


@pytest.mark.slow
def test_a_load_that_does_nothing_is_not_named(tmp_path: Path) -> None:
    time_s, command, position, load_nm = pushed_servo(0.0, 1)
    other = np.roll(load_nm, 700)
    columns = {"time_s": time_s, "elevator_cmd_deg": command, "elevator_pos_deg": position, "load_nm": other}
    said = answer(tmp_path, columns, *KNOWN)
    assert "external_load" not in model(said)
    columns["load_nm"] = np.full(time_s.size, 0.1)  # and one that never changes is a bias
    assert "external_load" not in model(answer(tmp_path, columns, *KNOWN))


@pytest.mark.slow
def test_the_aircraft_file_names_its_channel(tmp_path: Path) -> None:
    time_s, command, position, load_nm = pushed_servo(0.0, 1)
    aircraft = tmp_path / "bench.toml"
    aircraft.write_text(
        'name = "bench"\n[surfaces.elevator]\nservo = "hs225bb-eq31"\nload = "motor_2_a"\n'
        'command = { channel = "asked", unit = "deg" }\nmeasured = { channel = "seen", unit = "deg" }\n'
    )
    columns = {"time_s": time_s, "asked": command, "seen": position, "motor_2_a": load_nm}
    assert list(model(answer(tmp_path, columns, "-c", str(aircraft)))) == ["external_load"]
