"""With an aircraft file whose servos were fitted to a flight: what the monitor tells, an audit finds."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest
from strangers import Failure, fly, stranger

import servofd
from servofd.aircraft.schema import load_aircraft
from servofd.cli import main
from servofd.live.session import Session
from servofd.outputs.recording.read import read_recording, rejudged

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Drafted from a good flight of 120 s."""
    folder: Path = tmp_path_factory.mktemp("fitted")
    good = fly(stranger(5), 1, "aerobatics", duration_s=120.0).only("elevator", "rudder").write(folder / "good.csv")
    with pytest.MonkeyPatch.context() as patch, (folder / "plane.toml").open("w") as target:
        patch.setattr("sys.stdout", target)
        assert main(["config", str(good)]) == 0
    return folder / "plane.toml"


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("failure", "kinds"),
    [
        (None, []),
        (Failure("bias", "rudder", 36.0, 4.0), ["bias"]),
        (Failure("stuck", "rudder", 36.0), ["stuck"]),
    ],
    ids=["healthy", "bias", "stuck"],
)
def test_it_finds_what_an_audit_with_the_same_drafted_file_finds(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], failure: Failure | None, kinds: list[str]
) -> None:
    flight, recording = tmp_path / "flight.csv", tmp_path / "flight.rrd"
    flown = fly(stranger(5), 2, "aerobatics", duration_s=100.0, failure=failure)
    flown.only("elevator", "rudder").write(flight)
    (audited,) = servofd.audit(flight, load_aircraft(file))
    sessions: list[Session] = []

    def kept(*arguments: Any, **options: Any) -> Session:
        sessions.append(Session(*arguments, **options))
        return sessions[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("servofd.cli.monitor.Session", kept)
        words = ["-c", str(file), "--speed", "0", "--json-lines", "-", "--no-alert", "--rrd", str(recording)]
        code = main(["monitor", str(flight), *words])
    said = capsys.readouterr()
    told = [json.loads(line) for line in said.out.splitlines() if line.startswith("{")]
    assert {event["surface"] for event in told if event["event"] == "alarm"} == {"rudder" for _ in kinds}
    assert [fault.kind for surface in audited.surfaces for fault in surface.faults] == kinds
    assert ("not cleared" in said.err) == (code == 2)
    found = {monitor.name: monitor for _, monitor in sessions[0].watched}
    for surface in audited.surfaces:
        monitor = found[surface.surface]
        assert [(f.kind, f.start_s) for f in monitor.faults] == [(f.kind, f.start_s) for f in surface.faults]
        assert bool(monitor.suspicions) == bool(surface.suspicions)
    assert code == main(["audit", str(flight), "-c", str(file)]) == main(["review", str(recording)])
    assert [
        [(f.kind, f.start_s, f.alarm_s) for f in s.faults] for s in rejudged(read_recording(recording)).audit.surfaces
    ] == [[(f.kind, f.start_s, f.alarm_s) for f in s.faults] for s in audited.surfaces]
