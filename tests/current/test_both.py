"""A servo with a position and a current is watched by both: a monitor says in flight what an audit says of its log."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest

import servofd
from servofd.cli import main
from servofd.detection.event import Event
from servofd.detection.monitor import SurfaceMonitor
from servofd.detection.verdict import gravest
from servofd.live.witnesses import Witnesses
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
    (alarm,) = (event for event in events if event["event"] == "alarm")
    named = [event for event in events if event.get("fault")]
    assert (code, {event["kind"] for event in named}, {event["id"] for event in named}) == (
        1,
        {"blocked"},
        {alarm["id"]},
    )
    assert START_S < alarm["time_s"] <= named[0]["time_s"] < START_S + 5.0
    assert alarm["residual_deg"] is None


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


def without(flight: Flown, hz: float, position_hz: float) -> Flown:
    """The same with fewer currents and positions; none of the latter at 0 Hz."""
    every = np.arange(flight.current_s.size)
    kept = every % round(25.0 / hz) == 0
    has = every % round(25.0 / position_hz) == 0 if position_hz else np.zeros(every.size, dtype=bool)
    current_a, position_deg = np.where(kept, flight.current_a, np.nan), np.where(has, flight.position_deg, np.nan)
    return replace(flight, current_a=current_a, position_deg=position_deg)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "fault", "hz", "position_hz"),
    [
        (6, "blocked", 5.0, 0.0),
        (2, "unpowered", 25.0, 0.0),
        (4, "blocked", 1.0, 1.0),
        (8, "", 5.0, 0.0),
        (8, "", 5.0, 1.0),
        pytest.param(6, "unpowered", 5.0, 1.0, marks=pytest.mark.nightly),
        pytest.param(6, "blocked", 1.0, 0.0, marks=pytest.mark.nightly),
        pytest.param(2, "unpowered", 1.0, 0.0, marks=pytest.mark.nightly),
    ],
)
def test_where_its_position_tells_nothing_its_current_is_watched_alone(
    tmp_path: Path, plane: str, seed: int, fault: str, hz: float, position_hz: float, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "flight.csv"
    log.write_text(without(flown(seed, fault), hz, position_hz).csv("aileron", position=True).replace("nan", ""))
    code, events = watched(log, plane)
    shown = capsys.readouterr().out
    assert main(["audit", str(log), "-c", plane, "-o", str(tmp_path / "page.html")]) == code
    assert code == (1 if fault else 2 if position_hz else 0)
    told = [event for event in events if event["event"] != "no_data"]
    if not fault:
        assert told == []
        assert ": watched by its current" in shown
        return
    assert told[0]["event"] == "alarm"
    assert START_S < told[0]["time_s"] < START_S + (20.0 if hz == 1.0 else 6.0)
    assert {event["id"] for event in told} == {"0/aileron/1"}
    assert {event["kind"] for event in told if event.get("fault")} == {fault}
    assert "aileron: ALARM, command" in shown
    assert f"{'blocked' if fault == 'blocked' else 'without power'}: draws" in shown


@pytest.mark.slow
def test_positions_that_come_again_are_judged_again(
    tmp_path: Path, plane: str, capsys: pytest.CaptureFixture[str]
) -> None:
    flight, log = flown(5, "blocked"), tmp_path / "flight.csv"
    gone = (flight.current_s > 8.0) & (flight.current_s < START_S - 14.0)  # a log may be silent for ten seconds
    log.write_text(
        replace(flight, position_deg=np.where(gone, np.nan, flight.position_deg))
        .csv("aileron", position=True)
        .replace("nan", "")
    )
    code, events = watched(log, plane)
    assert (code, {event["kind"] for event in events if event.get("fault")}) == (1, {"stuck"})
    assert [event["event"] for event in events if event["event"] != "named"] == ["no_data", "alarm"]
    lines = capsys.readouterr().out.splitlines()
    modes = ["A" if " draws " in line else "deg" for line in lines if "aileron: " in line and ", command " in line]
    assert modes[0] == "deg"
    assert modes[-1] == "deg"
    assert "A" in modes


@pytest.mark.slow
def test_a_jam_that_its_current_told_began_then_though_its_position_comes_back_later(
    tmp_path: Path, plane: str
) -> None:
    """The position is away from 10 s before the jam to 25 s after it, and shows it from then on."""
    flight, log = flown(6, "blocked", 130.0), tmp_path / "flight.csv"
    gone = (flight.current_s > START_S - 10.0) & (flight.current_s < START_S + 25.0)
    log.write_text(
        replace(flight, position_deg=np.where(gone, np.nan, flight.position_deg))
        .csv("aileron", position=True)
        .replace("nan", "")
    )
    code, events = watched(log, plane)
    named = [event for event in events if event.get("fault")]
    assert (code, [event["kind"] for event in named], {event["id"] for event in named}) == (
        1,
        ["blocked", "stuck"],
        {"0/aileron/1"},
    )
    assert [event["fault"]["start_s"] for event in named] == pytest.approx([START_S] * 2, abs=1.0)


@pytest.mark.slow
def test_a_current_that_stops_shows_no_numbers_any_more(
    tmp_path: Path, plane: str, capsys: pytest.CaptureFixture[str]
) -> None:
    flight, log = flown(8), tmp_path / "flight.csv"
    ends_a = np.where(flight.current_s > START_S, np.nan, flight.current_a)
    log.write_text(replace(flight, current_a=ends_a).csv("aileron", position=True).replace("nan", ""))
    assert watched(log, plane) == (0, [])
    rows = [line.strip() for line in capsys.readouterr().out.splitlines() if "aileron current: " in line]
    late = [row.partition("aileron current: ")[2] for row in rows if float(row.split()[0]) > START_S + 6.0]
    assert set(late) == {"no data, no current since 50.0 s"}
    assert " draws " in rows[0]


class _Silent:
    """A monitor that nothing tells anything."""

    is_watched, suspended, standing, unjudged, is_heard, is_calm = False, "", "", "no position came", False, True
    faults: tuple[str, ...] = ()
    suspicions: tuple[str, ...] = ()
    stands_in = unseen = ""

    def feed(self, *_: object) -> list[Event]:
        return []


def test_before_a_current_has_changed_nobody_is_watched_by_it() -> None:
    """Before ArduPlane is armed its servos are asked for an end of their travel, and none moves: two were alarms."""
    made = [cast("SurfaceMonitor", _Silent()) for _ in range(2)]
    both = Witnesses(made[0], lambda: made[1])
    none = np.zeros(0), np.zeros(0)
    for second in range(120):
        time_s = second + np.arange(0.0, 1.0, 0.2)
        drawn_a = np.full(time_s.size, 0.14 if second < 60 else 0.3)
        both.feed((time_s, np.full(time_s.size, -40.0)), none, (time_s, drawn_a), None, ())
        assert second > 60 or both.alone is None
    assert both.alone is made[1]
