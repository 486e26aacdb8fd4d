"""With an aircraft file whose servos were fitted to a flight: what the monitor tells, an audit finds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from strangers import Failure, fly, stranger

import logparsers
import servofd
from logparsers.codec import Codec
from servofd.aircraft.resolve import resolved
from servofd.aircraft.schema import load_aircraft
from servofd.cli import main
from servofd.live.run import Pace, replay_log
from servofd.live.session import Session
from servofd.outputs.recording.read import read_recording
from servofd.outputs.recording.review import rejudged

if TYPE_CHECKING:
    from pathlib import Path

    from servofd.detection.events import Event


class Noted:
    """Keeps what it is told."""

    def __init__(self) -> None:
        self.told: list[Event] = []

    def events(self, events: list[Event], now_s: float) -> None:
        assert now_s >= 0.0
        self.told += events

    def tick(self, now_s: float) -> None:
        assert now_s >= 0.0


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Drafted from a good flight of 120 s."""
    folder: Path = tmp_path_factory.mktemp("fitted")
    good = fly(stranger(5), 1, "aerobatics", duration_s=120.0).write(folder / "good.csv")
    with pytest.MonkeyPatch.context() as patch, (folder / "plane.toml").open("w") as target:
        patch.setattr("sys.stdout", target)
        assert main(["config", str(good)]) == 0
    return folder / "plane.toml"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("failure", "kinds"),
    [
        pytest.param(None, [], marks=pytest.mark.nightly),
        pytest.param(Failure("bias", "rudder", 36.0, 4.0), [], marks=pytest.mark.nightly),
        pytest.param(Failure("slow", "rudder", 36.0, 0.5), [], marks=pytest.mark.nightly),
        (Failure("stuck", "rudder", 36.0), ["stuck"]),
    ],
    ids=["healthy", "bias", "slow", "stuck"],
)
def test_it_accuses_of_what_contradicts_any_servo(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], failure: Failure | None, kinds: list[str]
) -> None:
    """A jam of more than a minute stays one alarm; what is smaller is not told, and not cleared in the end."""
    flight = tmp_path / "flight.csv"
    fly(stranger(5), 2, "aerobatics", duration_s=100.0, failure=failure).write(flight)
    aircraft = load_aircraft(file)
    (audited,) = servofd.audit(flight, aircraft)
    log, noted = logparsers.read(flight), Noted()
    session = Session(Codec(0, 191), {0: resolved(log, aircraft)}, is_stream=False)
    now_s = replay_log(session, log, noted, Pace(0.0), float("inf"))
    told = noted.told + session.finish(now_s)
    assert [event.kind for event in told if event.event == "alarm"] == kinds
    found = {monitor.name: monitor for _, monitor in session.watched}
    for surface in audited.surfaces:
        monitor = found[surface.surface]
        assert [(f.kind, f.start_s) for f in monitor.faults] == [(f.kind, f.start_s) for f in surface.faults]
        assert bool(monitor.suspicions) == bool(surface.suspicions)
    recording = tmp_path / "flight.rrd"
    words = ["-c", str(file), "--speed", "0", "--json-lines", "-", "--no-alert", "--rrd", str(recording)]
    code = main(["monitor", str(flight), *words])
    assert code == main(["audit", str(flight), "-c", str(file)]) == main(["review", str(recording)])
    assert [
        [(f.kind, f.start_s, f.alarm_s) for f in s.faults] for s in rejudged(read_recording(recording)).audit.surfaces
    ] == [[(f.kind, f.start_s, f.alarm_s) for f in s.faults] for s in audited.surfaces]
    assert ("not cleared" in capsys.readouterr().err) == (code == 2)
