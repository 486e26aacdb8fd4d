"""Tables as recorders write them: positions held between updates, loads that are words or never change, other units."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from servofd import explain
from servofd.core.errors import NoMeasurement
from servofd.core.types import FloatArray

_TIME_S: FloatArray = np.array(np.arange(2000) * 0.01, dtype=np.float64)


def written(path: Path, size: float = 8.0, held: int = 1, words: str = "", more: str = "") -> Path:
    """A sweep of a servo of second order (40 rad/s), refreshed every so many rows; shares no code with servofd."""
    rng, step_s = np.random.default_rng(1), 1e-3
    command = size * np.sin(2.0 * np.pi * (0.3 * _TIME_S + 0.02 * _TIME_S**2))
    position, speed, lines, reading = 0.0, 0.0, [f"time_s,x_cmd_deg,x_pos_deg{words}"], 0.0
    for k, asked in enumerate(command.tolist()):
        if k % held == 0:
            reading = position + 0.05 * rng.standard_normal()
        lines.append(f"{_TIME_S[k]:.4f},{asked:.4f},{reading:.4f}{more}")
        for _ in range(10):
            speed += step_s * (1600.0 * (asked - position) - 64.0 * speed)
            position += step_s * speed
    path.write_text("\n".join(lines) + "\n")
    return path


def without_commands(path: Path) -> Path:
    """For 2 s, in which the servo moves on by commands that nobody knows."""
    lines = path.read_text().splitlines()
    for k in range(1001, 1201):
        time_s, _, reading = lines[k].split(",")
        lines[k] = f"{time_s},,{reading}"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.slow
@pytest.mark.parametrize("gap", [pytest.param(False, marks=pytest.mark.nightly), True])
def test_positions_held_between_updates_are_judged_once(gap: bool, tmp_path: Path) -> None:
    """Held, they leave 0.48 deg over a noise of 0.00007 deg; each once, the noise of 0.05 deg that they have."""
    log = written(tmp_path / "held.csv", held=5)
    found = explain(without_commands(log) if gap else log).explanation
    assert found.conclusion == "nothing_missing"
    assert found.fault_s is None
    assert found.selection.sigma_deg == pytest.approx(0.05, rel=0.1)
    assert any("refreshed every 0.05 s" in note and "400 of 2000 rows" in note for note in found.notes)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("words", "more", "size"),
    [
        (",load_g,servo_current_a", ",200,0.5", 8.0),
        (",load_g", ",heavy", 8.0),
        ("", "", 80.0),
    ],
    ids=["constant", "words", "units of 100"],
)
def test_columns_that_say_nothing_change_nothing(tmp_path: Path, words: str, more: str, size: float) -> None:
    found = explain(written(tmp_path / "log.csv", words=words, more=more, size=size)).explanation
    assert found.conclusion == "nothing_missing"
    assert "FAULT" not in found.answer


@pytest.mark.nightly
def test_a_servo_whose_commands_were_not_logged_for_a_while_has_no_fault(tmp_path: Path) -> None:
    """Those 2 s are no part of the comparison."""
    found = explain(without_commands(written(tmp_path / "log.csv"))).explanation
    assert found.conclusion == "nothing_missing"
    assert found.fault_s is None


@pytest.mark.parametrize("seconds", [0.2, 3.0])
def test_a_log_that_is_too_short_is_one_line(tmp_path: Path, seconds: float) -> None:
    lines = written(tmp_path / "log.csv").read_text().splitlines()
    short = tmp_path / "short.csv"
    short.write_text("\n".join(lines[: 1 + round(seconds / 0.01)]) + "\n")
    with pytest.raises(NoMeasurement, match="at least"):
        explain(short)
