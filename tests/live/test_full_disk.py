"""A disk that is full ends what is written, and nothing else."""

from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from servofd.cli import main
from servofd.servo.faults import Stuck
from servofd.simulation.telemetry_writer import telemetry_log
from tests.live.vehicles import DEADLINE_S, PLANE, flown, plane_file

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.slow

_LIMITED = """
import resource, sys
from servofd.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), int(sys.argv[1])))
sys.exit(main(sys.argv[2:]))
"""
"""No file of this process grows beyond a limit, which is what a full disk looks like."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made: Path = tmp_path_factory.mktemp("disk")
    flight = flown(duration_s=30.0, command="lively", faults={"elevator": Stuck(15.0)})
    (made / "flight.tlog").write_bytes(telemetry_log(flight, PLANE))
    (made / "plane.toml").write_text(plane_file())
    # What is compiled on a machine's first run is kept in files that a limit would cut, too.
    assert main(["monitor", str(made / "flight.tlog"), "-c", str(made / "plane.toml"), "--speed", "0", "--plain"]) == 1
    return made


def _monitor(folder: Path, limit_bytes: int, *outputs: str) -> subprocess.CompletedProcess[str]:
    given = ["monitor", "flight.tlog", "-c", "plane.toml", "--speed", "0", "--plain", *outputs]
    return subprocess.run(
        [sys.executable, "-c", _LIMITED, str(limit_bytes), *given],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=3.0 * DEADLINE_S,
        check=False,
    )


def test_a_disk_that_fills_up_in_flight_stops_no_alarm(folder: Path) -> None:
    done = _monitor(folder, 150_000, "--rrd", "own.rrd", "--tlog", "own.tlog")
    assert done.returncode == 1, done.stderr
    assert "elevator: ALARM" in done.stdout
    said = sorted(done.stderr.splitlines())
    assert [line.split(": no more")[0] for line in said] == ["servofd: recording", "servofd: telemetry log"]
    # What fitted is whole.
    whole, kept = (folder / "flight.tlog").read_bytes(), (folder / "own.tlog").read_bytes()
    assert len(kept) == 150_000
    assert whole.startswith(kept)


def test_a_disk_that_is_full_already_is_told_in_one_line(folder: Path) -> None:
    done = _monitor(folder, 10, "--rrd", "none.rrd")
    assert done.returncode == 2
    assert done.stderr.startswith("servofd: none.rrd: cannot record: ")
    assert done.stderr.count("\n") == 1
