"""A folder of small logs that all tests of a fleet share."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from servofd.aircraft.schema import plain_aircraft
from servofd.cli import main
from servofd.servo.faults import Stuck
from servofd.simulation.flight import simulate_flight
from servofd.simulation.writers import write_flight

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path


@pytest.fixture(scope="session")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four healthy flights of 12 s, one whose rudder jams at 6 s, prose, noise, nothing, and a broken table."""
    folder = tmp_path_factory.mktemp("logs")
    plane = plain_aircraft(["elevator", "rudder"], "hs225bb-eq31")
    (folder / "may").mkdir()
    for seed in range(5):
        faults = {"rudder": Stuck(15.0)} if seed == 4 else {}
        flown = simulate_flight(plane, command="gusty", duration_s=30.0, seed=seed, faults=faults)
        write_flight(folder / ("may" if seed > 2 else ".") / f"flight{seed}.csv", flown, plane)
    (folder / "README.md").write_text("# Flights of May\n\nAll of them were windy.\n")
    (folder / "noise.bin").write_bytes(bytes(range(1, 32)) * 40)
    (folder / "empty.csv").write_bytes(b"")
    (folder / "broken.csv").write_text("time_s,elevator_cmd_deg,elevator_pos_deg\n0,1,x\n1,2,3\n")
    (folder / ".hidden").mkdir()
    (folder / ".hidden" / "flight9.csv").write_text("time_s\n")
    return folder


@pytest.fixture(scope="session")
def results(logs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What an audit of all of them leaves; only read."""
    folder = tmp_path_factory.mktemp("results") / "r"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("servofd.fleets.run.run_local", in_line)
        assert main(["audit", str(logs), "--servo", "hs225bb-eq31", "-o", str(folder)]) == 1
    return folder


@pytest.fixture(scope="session")
def of_may(logs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What an audit of the two flights of May leaves; only read or copied."""
    folder = tmp_path_factory.mktemp("may") / "r"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("servofd.fleets.run.run_local", in_line)
        assert main(["audit", str(logs / "may"), "--servo", "hs225bb-eq31", "-o", str(folder)]) == 1
    return folder


def in_line(task: Callable[[Any], Any], items: Sequence[Any], _workers: int | None) -> Iterator[tuple[Any, Any]]:
    """The work of other processes, in this one, which knows servofd already."""
    for item in items:
        yield item, task(item)
