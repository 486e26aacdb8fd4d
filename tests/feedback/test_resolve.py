"""One aircraft file for every log of an aircraft."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

import logparsers
import servofd
from servofd.aircraft.outputs import resolved, streamed
from servofd.aircraft.schema import Surface, load_aircraft
from servofd.aircraft.series import cut
from servofd.cli import main
from tests.fleet.conftest import in_line

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["csv", "bin", "tlog", "ulg"])
def test_the_shipped_aircraft_judges_every_log_that_it_flies_alike(suffix: str, tmp_path: Path) -> None:
    path = str(tmp_path / f"flown.{suffix}")
    stuck = ["--fault", "elevator:stuck@20"]
    assert main(["simulate", "-c", "simulated", "-o", path, "--duration", "40", *stuck]) == 0
    (result,) = servofd.audit(path, "simulated", surfaces=("elevator", "rudder"))
    verdicts = {surface.surface: surface for surface in result.surfaces}
    assert {name: s.status for name, s in verdicts.items()} == {"elevator": "fault", "rudder": "healthy"}
    (fault,) = verdicts["elevator"].faults
    assert (fault.kind, round(fault.start_s)) == ("stuck", 20)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [pytest.param("csv", marks=pytest.mark.nightly), "bin"])
def test_every_verb_reads_a_log_with_the_file_of_its_aircraft(
    suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("servofd.wear.trend.run_local", in_line)
    path = str(tmp_path / f"flown.{suffix}")
    assert main(["simulate", "-c", "simulated", "-o", path, "--duration", "40"]) == 0
    with_file = [path, "-c", "simulated"]
    assert main(["info", *with_file]) == 0
    assert capsys.readouterr().out.count("yes, servos of up to") == 3
    assert main(["trend", *with_file]) == 0
    for verb in ("identify", "explain"):
        assert main([verb, *with_file, "-s", "rudder"]) == 0, verb


@pytest.mark.parametrize(("suffix", "supply"), [("bin", True), ("tlog", False)])
def test_the_log_of_an_autopilot_tells_airspeed_and_supply(suffix: str, supply: bool, tmp_path: Path) -> None:
    path = str(tmp_path / f"flown.{suffix}")
    assert main(["simulate", "-c", "simulated", "-o", path, "--duration", "20"]) == 0
    log = logparsers.read(path)
    context = cut(log, "rudder", resolved(log, load_aircraft("simulated"))).context
    assert 5.0 < float(context.airspeed_m_s.mean()) < 60.0
    assert context.voltage_v.size == 0 or 4.0 < float(context.voltage_v.mean()) < 9.0
    assert bool(context.voltage_v.size) is supply


@pytest.mark.nightly
@pytest.mark.parametrize(("drafted", "judged"), [("tlog", "bin"), ("bin", "ulg")])
def test_an_aircraft_drafted_from_one_kind_of_log_judges_the_others(
    drafted: str, judged: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, bad, plane = tmp_path / f"good.{drafted}", tmp_path / f"bad.{judged}", tmp_path / "plane.toml"
    flight = ["simulate", "-c", "simulated", "--duration", "60"]
    assert main([*flight, "-o", str(good)]) == 0
    assert main([*flight, "-o", str(bad), "--seed", "7", "--fault", "elevator:stuck@20"]) == 0
    capsys.readouterr()
    assert main(["config", str(good)]) == 0
    plane.write_text(capsys.readouterr().out, encoding="utf-8")
    (result,) = servofd.audit(str(bad), str(plane))
    faults = {s.surface: [fault.kind for fault in s.faults] for s in result.surfaces if s.status == "fault"}
    assert len(result.surfaces) == 3
    assert list(faults.values()) == [["stuck"]]
    assert next(iter(faults)).startswith("elevator")


@pytest.mark.slow
def test_an_output_is_enough(tmp_path: Path) -> None:
    path = str(tmp_path / "flown.bin")
    assert main(["simulate", "-c", "simulated", "-o", path, "--duration", "40"]) == 0
    pulse = {"unit": "us", "trim_us": 1500.0, "slope_deg_per_us": 0.09}
    rudder = Surface.model_validate({"servo": "hs225bb-eq31", "output": 4, "command": pulse})
    plane = load_aircraft("simulated").model_copy(update={"surfaces": {"rudder": rudder}})
    (result,) = servofd.audit(path, plane)
    assert [surface.status for surface in result.surfaces] == ["healthy"]
    assert streamed(plane).surfaces["rudder"].command.channel == "SERVO_OUTPUT_RAW.servo4_raw"


@pytest.mark.slow
def test_a_file_drafted_from_the_log_of_an_autopilot_judges_its_telemetry_and_watches_its_link(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, bad, plane = tmp_path / "good.bin", tmp_path / "bad.tlog", tmp_path / "plane.toml"
    flight = ["simulate", "-c", "simulated", "--duration", "40"]
    assert main([*flight, "-o", str(good)]) == 0
    assert main([*flight, "-o", str(bad), "--seed", "7", "--fault", "elevator:stuck@20"]) == 0
    capsys.readouterr()
    assert main(["config", str(good)]) == 0
    plane.write_text(capsys.readouterr().out, encoding="utf-8")
    assert "SERVO_OUTPUT_RAW" not in plane.read_text()
    (result,) = servofd.audit(str(bad), str(plane))
    faults = {s.surface: [fault.kind for fault in s.faults] for s in result.surfaces}
    assert faults == {"aileron": [], "elevator": ["stuck"], "rudder": []}
    assert main(["monitor", str(bad), "-c", str(plane), "--speed", "0", "--plain"]) == 1
    assert "elevator: ALARM" in capsys.readouterr().out


def test_neither_channel_nor_output_is_refused() -> None:
    with pytest.raises(ValueError, match="output"):
        Surface.model_validate({"servo": "s9254", "command": {"unit": "deg"}})
