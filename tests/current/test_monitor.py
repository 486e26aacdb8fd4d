"""In flight a current alone tells a blocked servo and one without power, with the identities of any other alarm."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from servofd.cli import main
from servofd.onboard.script import stream_script
from servofd.simulation.commands import gusty
from tests.current.hub import dataflash_of, telemetry_of
from tests.current.motor import Flown, Sensor, fly
from tests.current.replayed import watched

START_S = 60.0


def flown(seed: int, fault: str = "", seconds: float = 100.0, end_s: float = np.inf) -> Flown:
    command_deg = gusty(np.arange(0.0, seconds, 0.04), np.random.default_rng(1000 + seed))
    return fly(seconds, seed, sensor=Sensor(10.0), fault=fault, start_s=START_S, end_s=end_s, command_deg=command_deg)


@pytest.fixture(scope="module")
def plane(tmp_path_factory: pytest.TempPathFactory) -> str:
    """An aircraft whose aileron is known by the current of three good flights, from telemetry logs alone."""
    folder = tmp_path_factory.mktemp("good")
    for k in range(3):
        (folder / f"good{k}.tlog").write_bytes(telemetry_of(flown(500 + k, seconds=300.0)))
    output = str(folder / "plane.toml")
    assert main(["calibrate", *sorted(map(str, folder.glob("*.tlog"))), "-o", output]) == 0
    return output


@pytest.mark.slow
@pytest.mark.parametrize(
    ("suffix", "fault"),
    [
        (".tlog", "blocked"),
        pytest.param(".bin", "unpowered", marks=pytest.mark.nightly),
        pytest.param(".tlog", "unpowered", marks=pytest.mark.nightly),
        pytest.param(".bin", "blocked", marks=pytest.mark.nightly),
    ],
)
def test_a_stream_with_current_and_no_position_alarms(
    tmp_path: Path, plane: str, fault: str, suffix: str, capsys: pytest.CaptureFixture[str]
) -> None:
    log, flight = tmp_path / f"flight{suffix}", flown(5, fault)
    log.write_bytes(telemetry_of(flight) if suffix == ".tlog" else dataflash_of(flight))
    code, events = watched(log, plane)
    assert code == 1
    told = capsys.readouterr()
    assert "aileron: watched, command" in told.out
    assert " A from a good servo within " in told.out
    assert f"aileron: ALARM, {'blocked' if fault == 'blocked' else 'without power'}: draws" in told.out + told.err
    assert "10 currents a second" in told.out
    alarm = events[0]
    assert (alarm["event"], alarm["surface"]) == ("alarm", "aileron")
    assert alarm["id"].endswith("/aileron/1")
    assert {event["id"] for event in events} == {alarm["id"]}
    assert START_S <= alarm["time_s"] <= START_S + 5.0
    last = [event for event in events if event.get("fault")][-1]
    assert (last["kind"], last["severity"], last["fault"]["witness"]) == (fault, "critical", "current")
    assert last["residual_deg"] is None  # amperes are no degrees
    assert main(["audit", str(log), "-c", plane, "--json", "-"]) == 1  # an audit says the same, and when
    (found,) = json.loads(capsys.readouterr().out)["logs"][0]["surfaces"]["aileron"]["faults"]
    assert (found["kind"], found["witness"]) == (fault, "current")
    assert -3.0 <= alarm["time_s"] - found["alarm_s"] <= 1.0  # a monitor looks oftener, and may be sooner


@pytest.mark.slow
def test_what_it_records_is_judged_as_an_audit_of_the_log_would(
    tmp_path: Path, plane: str, capsys: pytest.CaptureFixture[str]
) -> None:
    log, recording = tmp_path / "flight.bin", str(tmp_path / "flight.rrd")
    log.write_bytes(dataflash_of(flown(5, "blocked")))
    assert main(["monitor", str(log), "-c", plane, "--speed", "0", "--plain", "--rrd", recording]) == 1
    said = []
    for words in (["audit", str(log), "-c", plane], ["review", recording]):
        capsys.readouterr()
        assert main([*words, "--json", "-"]) == 1
        (document,) = json.loads(capsys.readouterr().out)["logs"]
        aileron = document["surfaces"]["aileron"]
        said.append((document["sentence"], aileron["feedback"], [(f["kind"], f["alarm_s"]) for f in aileron["faults"]]))
    assert said[0] == said[1]
    ((alarm_s, level),) = [(event["time_s"], event["level"]) for event in document["events"]]
    assert (alarm_s, level) == (said[0][2][0][1], "ERROR")


def test_a_newcomer_with_a_hub_is_led_to_the_monitor(
    tmp_path: Path, plane: str, capsys: pytest.CaptureFixture[str]
) -> None:
    log, script = tmp_path / "flight.bin", str(tmp_path / "servofd.lua")
    log.write_bytes(dataflash_of(flown(5, seconds=20.0)))
    capsys.readouterr()
    assert main(["info", str(log)]) == 0
    assert "--stream-only -o servofd.lua` writes the script that sends it" in " ".join(capsys.readouterr().out.split())
    assert main(["onboard", plane, "-o", script]) == 2
    assert "--stream-only sends that, and 'servofd monitor' watches it" in capsys.readouterr().err
    assert main(["onboard", plane, "--stream-only", "-o", script]) == 0
    assert "from their currents" in Path(plane).read_text()


@pytest.mark.slow
def test_good_currents_raise_nothing(tmp_path: Path, plane: str) -> None:
    log = tmp_path / "flight.tlog"
    log.write_bytes(telemetry_of(flown(6, seconds=150.0)))
    assert watched(log, plane) == (0, [])


@pytest.mark.slow
def test_an_alarm_ends_when_it_is_over(tmp_path: Path, plane: str) -> None:
    log = tmp_path / "flight.tlog"
    log.write_bytes(telemetry_of(flown(7, "blocked", seconds=160.0, end_s=100.0)))
    code, events = watched(log, plane)
    assert code == 1
    assert [event["event"] for event in events if event["event"] != "named"] == ["alarm", "clear"]
    assert 100.0 < events[-1]["time_s"] < 140.0


@pytest.mark.slow
def test_currents_that_stop_are_no_verdict(tmp_path: Path, plane: str) -> None:
    flight = flown(8)
    kept = flight.current_s < START_S
    gone = replace(flight, current_s=flight.current_s[kept], current_a=flight.current_a[kept])
    log = tmp_path / "flight.tlog"
    log.write_bytes(telemetry_of(gone))
    code, events = watched(log, plane)
    assert code == 2
    assert [event["event"] for event in events] == ["no_data"]
    assert events[0]["text"].startswith("no current since ")


def test_the_script_sends_positions_and_currents() -> None:
    lua = pytest.importorskip("lupa.lua53").LuaRuntime()
    sent = lua.execute(
        """
        local sent = {}
        gcs = { send_named_float = function(_, name, value) sent[name] = value end, send_text = function() end }
        local of = {
           { measured_position = function() return 3.5 end, current = function() end },
           { measured_position = function() end, current = function() return 0.25 end },
        }
        servo_telem = { get_telem = function(_, channel) return of[channel + 1] end }
        (function(...) """
        + stream_script([1, 2, 3])
        + """ end)()
        return sent
        """
    )
    assert dict(sent) == {"SRVP1": 3.5, "SRVA2": 0.25}
