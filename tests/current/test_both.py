"""A servo with a position and a current is watched by both: a monitor says in flight what an audit says of its log."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import servofd
from servofd.cli import main
from servofd.detection.verdict import gravest
from servofd.simulation.commands import gusty
from tests.current.motor import Flown, Sensor, fly
from tests.current.replayed import watched

START_S, SECONDS = 50.0, 110.0


def flown(seed: int, fault: str = "", seconds: float = SECONDS) -> Flown:
    command_deg = gusty(np.arange(0.0, seconds, 0.04), np.random.default_rng(1000 + seed))
    return fly(seconds, seed, sensor=Sensor(25.0), fault=fault, start_s=START_S, command_deg=command_deg)


def held(flight: Flown, *, position: bool) -> Flown:
    """The same with a sensor that fails in flight: a position that freezes, or a current that is 0."""
    late = flight.current_s > START_S
    if not position:
        return replace(flight, current_a=np.where(late, 0.0, flight.current_a))
    frozen_deg = flight.position_deg[np.argmax(late)]
    return replace(flight, position_deg=np.where(late, frozen_deg, flight.position_deg))


@pytest.fixture(scope="module")
def plane(tmp_path_factory: pytest.TempPathFactory) -> str:
    """An aircraft whose aileron is known by position and current of three good flights."""
    folder = tmp_path_factory.mktemp("good")
    for k in range(3):
        (folder / f"good{k}.csv").write_text(flown(500 + k, seconds=150.0).csv("aileron", position=True))
    output = str(folder / "plane.toml")
    assert main(["calibrate", *sorted(map(str, folder.glob("*.csv"))), "-o", output]) == 0
    return output


@pytest.mark.slow
@pytest.mark.parametrize(
    ("flight", "kind", "other"),
    [
        (flown(5, "blocked"), "stuck", "blocked"),
        (held(flown(10), position=True), "stuck", "sensor"),
        pytest.param(flown(2, "unpowered"), "stuck", "unpowered", marks=pytest.mark.nightly),
        pytest.param(flown(4, "binding", 140.0), "binding", "", marks=pytest.mark.nightly),
    ],
    ids=["blocked", "frozen", "unpowered", "binding"],
)
def test_a_monitor_says_what_an_audit_says(
    tmp_path: Path, plane: str, flight: Flown, kind: str, other: str, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "flight.csv"
    log.write_text(flight.csv("aileron", position=True))
    found = servofd.audit(log, plane)["aileron"]
    fault = gravest(found.faults)
    code, events = watched(log, plane)
    assert code == 1
    told = [event for event in events if event.get("fault")][-1]
    assert (fault.kind, fault.other) == (told["kind"], told["fault"].get("other_witness", "")) == (kind, other)
    assert {event["id"] for event in events} == {"0/aileron/1"}  # one alarm, whoever raised it
    assert abs(told["fault"]["start_s"] - fault.start_s) < 2.0
    assert events[0]["event"] == "alarm"
    assert events[0]["time_s"] <= min(one.alarm_s for one in found.faults) + 1.0
    shown = capsys.readouterr().out
    assert "aileron current: watched, command" in shown
    assert ("or, by its current, its sensor: land soon" in shown) == (other == "sensor")


@pytest.mark.slow
def test_a_servo_that_is_blocked_after_its_last_position_is_told_when_it_was(tmp_path: Path, plane: str) -> None:
    flight, log = flown(0, "blocked"), tmp_path / "flight.csv"
    ends = np.where(flight.current_s > START_S - 20.0, np.nan, flight.position_deg)
    log.write_text(replace(flight, position_deg=ends).csv("aileron", position=True).replace("nan", ""))
    code, events = watched(log, plane)
    alarms = [event for event in events if event["event"] == "alarm"]
    assert (code, [event["kind"] for event in alarms]) == (1, ["blocked"])
    assert START_S < alarms[0]["time_s"] < START_S + 10.0
    assert alarms[0]["residual_deg"] is None


@pytest.mark.slow
def test_a_current_that_dies_while_the_position_follows_alarms_nobody(tmp_path: Path, plane: str) -> None:
    log = tmp_path / "flight.csv"
    log.write_text(held(flown(8), position=False).csv("aileron", position=True))
    assert watched(log, plane) == (0, [])
    assert servofd.audit(log, plane)["aileron"].status == "healthy"


@pytest.mark.nightly
def test_what_it_records_of_both_is_judged_as_an_audit_would(
    tmp_path: Path, plane: str, capsys: pytest.CaptureFixture[str]
) -> None:
    log, recording, said = tmp_path / "flight.csv", str(tmp_path / "flight.rrd"), []
    log.write_text(flown(5, "blocked").csv("aileron", position=True))
    assert main(["monitor", str(log), "-c", plane, "--speed", "0", "--plain", "--rrd", recording]) == 1
    for words in (["audit", str(log), "-c", plane], ["review", recording]):
        capsys.readouterr()
        assert main([*words, "--json", "-"]) == 1
        (document,) = json.loads(capsys.readouterr().out)["logs"]
        aileron = document["surfaces"]["aileron"]
        said.append((document["sentence"], aileron["feedback"], aileron["faults"][0]["confirmed_by"]["kind"]))
    assert said[0] == said[1]
