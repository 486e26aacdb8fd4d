"""Each check says `look` where its truth is wrong, and only there."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import logparsers
from logparsers.dataflash.encode import encode
from servofd.axes.motion import Series
from servofd.axes.px4 import Control
from servofd.cli import main
from servofd.flight import checks
from servofd.flight.columns import Flight, flight_of
from servofd.simulation.airframe import airframe_log, fly_airframe
from servofd.simulation.dataflash_writer import pulses, words
from tests.axes.flights import flown
from tests.fleet.conftest import in_line

NAMES = ["surface_check", "saturation", "trim", "travel", "limit_cycle", "asymmetry", "supply", "axis_change"]
TIME_S = np.arange(0.0, 200.0, 0.04)
FLOWN_S = (80.0, 180.0)


def flight_with(share: np.ndarray, *, stick: np.ndarray | None = None, supply: np.ndarray | None = None) -> Flight:
    output = Control(TIME_S, share, "aileron", {"roll": 1.0}, 0.0, 800.0)
    motion = flown(1, duration_s=200.0)
    flies = (motion.time_s >= FLOWN_S[0]) & (motion.time_s <= FLOWN_S[1])
    sticks = {} if stick is None else {"roll": Series(TIME_S, stick)}
    volts = None if supply is None else Series(TIME_S, supply)
    return Flight((output,), motion, "", flies, FLOWN_S, sticks, volts)


def wave(size: float = 0.3) -> np.ndarray:
    return size * np.sin(2.0 * np.pi * 0.3 * TIME_S)


def test_a_command_that_stands_at_its_end_to_the_last_is_said() -> None:
    assert checks.saturation(flight_with(wave())).status == "ok"
    late = checks.saturation(flight_with(np.where(TIME_S > 176.0, 1.0, wave())))
    assert late.status == "look"
    assert late.since_s == pytest.approx(176.0, abs=0.1)
    assert "the aircraft did not roll that way" in late.text


def test_an_aircraft_that_obeys_to_the_last_is_not_said_to_disobey() -> None:
    flight = flight_with(np.where(TIME_S > 176.0, 1.0, wave()))
    assert flight.motion is not None
    late = flight.motion.time_s > 176.0
    flight.motion.commands_us["roll"][late] = 400.0
    flight.motion.rates_deg_s[0][late] = 80.0
    assert "the aircraft did roll that way, by 8" in checks.saturation(flight).text


def test_full_elevator_on_the_ground_between_two_flights_is_no_saturation() -> None:
    flight = flight_with(np.where((TIME_S > 120.0) & (TIME_S < 130.0), 1.0, wave()))
    assert checks.saturation(flight).status == "look"
    assert flight.motion is not None
    flight.motion.airspeed_m_s[(flight.motion.time_s > 118.0) & (flight.motion.time_s < 132.0)] = 3.0
    assert checks.saturation(flight).status == "look"  # of a stall
    stands = (flight.motion.time_s > 112.0) & (flight.motion.time_s < 138.0)
    flight.motion.airspeed_m_s[stands] = 1.0
    flight.motion.roll_deg[stands] = 0.0
    assert [checks.saturation(one).status for one in flight.each()] == ["ok", "ok"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [101, 103, 105])
def test_reversed_and_swapped_surfaces_are_found_from_the_first_turns(tmp_path: Path, seed: int) -> None:
    path = tmp_path / "flight.bin"
    path.write_bytes(airframe_log(fly_airframe(seed, duration_s=60.0)))
    log = logparsers.read(path)
    assert "turned" not in checks.surface_check(flight_of(log)).text
    reversed_ = dict(log.parameters) | {f"SERVO{k}_REVERSED": 1.0 for k in (1, 2)}
    swapped = dict(log.parameters)
    ailerons = [name for name, value in swapped.items() if name.endswith("_FUNCTION") and value == 4.0]
    elevators = [name for name, value in swapped.items() if name.endswith("_FUNCTION") and value == 19.0]
    swapped |= dict.fromkeys(ailerons, 19.0) | dict.fromkeys(elevators, 4.0)
    for parameters, says in ((reversed_, "turned against its command"), (swapped, "turned with the command of")):
        found = checks.surface_check(flight_of(replace(log, parameters=parameters)))
        assert found.status == "look"
        assert says in found.text


def test_trim_and_asymmetry_are_those_of_level_flight() -> None:
    assert checks.trim(flight_with(wave())).status == checks.asymmetry(flight_with(wave())).status == "ok"
    held = flight_with(wave() + 0.5)
    assert checks.trim(held).status == checks.asymmetry(held).status == "look"


@pytest.mark.slow
def test_a_surface_that_moves_against_its_stick_is_named_before_take_off() -> None:
    swept = np.where(TIME_S < 60.0, np.sin(0.5 * TIME_S), wave())
    stick = 400.0 * np.sin(0.5 * TIME_S)
    done = checks.surface_check(flight_with(swept, stick=stick))
    assert done.status == "ok"
    assert done.text.startswith("done: aileron")
    turned = checks.surface_check(flight_with(swept, stick=-stick))
    assert (turned.status, "against the stick" in turned.text) == ("look", True)
    assert checks.surface_check(flight_with(0.0 * swept)).text.startswith("not done")
    assert checks.surface_check(flight_with(0.4 * swept)).text.startswith("partly done")


def test_a_rail_that_sags_is_said() -> None:
    volts = np.full(TIME_S.size, 5.1)
    assert checks.supply(flight_with(wave(), supply=volts)).status == "ok"
    sags = checks.supply(flight_with(wave(), supply=np.where(np.abs(TIME_S - 120.0) < 0.3, 3.9, volts)))
    assert sags.status == "look"
    assert sags.since_s == pytest.approx(120.0, abs=0.5)
    assert checks.supply(flight_with(wave())).status == "unknown"


def test_a_swing_at_one_frequency_is_a_limit_cycle_and_gusts_are_none() -> None:
    calm = flight_with(wave())
    assert checks.limit_cycle(calm).status == "ok"
    assert calm.motion is not None
    swing = np.where(calm.motion.time_s > 120.0, np.sin(2.0 * np.pi * 2.0 * calm.motion.time_s), 0.0)
    calm.motion.rates_deg_s[0] += 120.0 * swing
    calm.motion.commands_us["roll"][:] += 400.0 * swing
    found = checks.limit_cycle(calm)
    assert (found.status, "2.0 Hz" in found.text) == ("look", True)
    assert found.since_s == pytest.approx(120.0, abs=6.0)


@pytest.mark.slow
def test_a_log_without_feedback_or_aircraft_file_ends_in_an_answer(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, out, page = tmp_path / "jam.bin", tmp_path / "jam.json", tmp_path / "jam.html"
    words = ["simulate", "-o", str(log), "--airframe", "plain", "--seed", "9", "--duration", "180"]
    assert main([*words, "--fault", "aileron_left:stuck@100:value=10"]) == 0
    capsys.readouterr()
    assert main(["audit", str(log), "--json", str(out), "--html", str(page)]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "roll" in err
    (found,) = json.loads(out.read_text())["logs"]
    assert [check["name"] for check in found["flight"]["checks"]] == NAMES
    change = found["flight"]["checks"][-1]
    assert change["status"] == "look"
    begin_s = logparsers.read(log)["RCOU.C1"].time_s[0]
    assert change["since_s"] - begin_s == pytest.approx(100.0, abs=3.0)
    assert found["flight"]["axes"]["roll"]["status"] == "look"
    assert found["flight"]["axes"]["roll"]["explained_share"] > 0.0
    assert "distance from its own past" in page.read_text()


@pytest.mark.parametrize("seconds", ["12", "20"])
def test_a_short_log_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str], seconds: str) -> None:
    log = tmp_path / "short.bin"
    assert main(["simulate", "-o", str(log), "--airframe", "plain", "--seed", "3", "--duration", seconds]) == 0
    capsys.readouterr()
    assert main(["audit", str(log), "--json", str(tmp_path / "short.json")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.slow
def test_a_folder_of_crash_logs_has_an_answer_and_a_page_for_each(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("servofd.fleets.run.run_local", in_line)
    for seed in ("3", "9"):
        words = ["simulate", "-o", str(tmp_path / f"flight{seed}.bin"), "--airframe", "plain", "--seed", seed]
        assert main([*words, "--duration", "90"]) == 0
    capsys.readouterr()
    out = tmp_path / "out"
    assert main(["audit", str(tmp_path), "-o", str(out)]) == 2
    said = capsys.readouterr().out
    assert said.count("nothing looks wrong in") == 2
    assert str(tmp_path) not in said.partition("\n")[2]
    pages = [page.read_text() for page in out.glob("*.html") if page.name != "fleet.html"]
    assert len(pages) == 2
    for page in pages:
        assert "What this flight says by itself" in page
        assert "the reference is the flight's own past" in page.replace("&#39;", "'").replace("\n", " ")
        assert "nullspace filter" not in page.partition("What the words mean")[0]


@pytest.mark.parametrize(
    ("banner", "kind"), [("ArduRover V4.5.0 (1a2b3c4d)", "ground rover"), ("ArduSub V4.5.0", "submarine")]
)
def test_what_has_no_surfaces_is_said_to_be_what_it_is_and_gets_no_advice(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], banner: str, kind: str
) -> None:
    path, stamps = tmp_path / "drive.bin", np.arange(1_000_000, 61_000_000, 40_000)
    path.write_bytes(encode([*words(stamps[:1], {"SERVO1_FUNCTION": 26.0}, banner), pulses(stamps, {1: 1500.0})]))
    assert main(["audit", str(path), "--html", str(tmp_path / "drive.html")]) == 2
    said = capsys.readouterr().err
    assert f"No control surfaces: a {kind}." in (tmp_path / "drive.html").read_text()
    assert "calibrate" not in said
    assert said.count("\n") == 1
