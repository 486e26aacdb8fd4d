"""What explain saves judges the runs that it came from."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

import servofd
from servofd.aircraft import load_aircraft
from servofd.cli import main

if TYPE_CHECKING:
    from pathlib import Path


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
