"""A current alone tells a blocked servo, one without power and one that binds; and a good one does neither."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import servofd
from servofd.aircraft.schema import plain_aircraft
from servofd.cli import main
from servofd.servo.faults import Stuck
from servofd.simulation.commands import gusty
from servofd.simulation.flight import simulate_flight
from servofd.simulation.surroundings import current_a, stalled_a
from tests.current.hub import dataflash_of, ulog_of
from tests.current.motor import Flown, Sensor, fly

START_S = 100.0


def flown(seed: int, rate_hz: float, fault: str = "", seconds: float = 180.0, averages: bool = False) -> Flown:
    command_deg = gusty(np.arange(0.0, seconds, 0.04), np.random.default_rng(1000 + seed))
    sensor = Sensor(rate_hz, averages=averages)
    return fly(seconds, seed, sensor=sensor, fault=fault, start_s=START_S, command_deg=command_deg)


def written(path: Path, flight: Flown, **kinds: bool) -> str:
    path.write_text(flight.csv("aileron", **kinds))
    return str(path)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> str:
    """An aircraft whose aileron is known by the current of three good flights, at 10 Hz."""
    folder = tmp_path_factory.mktemp("good")
    logs = [written(folder / f"good{k}.csv", flown(500 + k, 10.0, seconds=300.0)) for k in range(3)]
    output = str(folder / "plane.toml")
    assert main(["calibrate", *logs, "-o", output]) == 0
    return output


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["blocked", "unpowered"])
@pytest.mark.parametrize("rate_hz", [5.0, 50.0])
def test_a_current_alone_tells_it_without_any_calibration(
    tmp_path: Path, fault: str, rate_hz: float, capsys: pytest.CaptureFixture[str]
) -> None:
    log = written(tmp_path / "flight.csv", flown(5, rate_hz, fault))
    assert main(["audit", log, "--json", "-"]) == 1
    (found,) = json.loads(capsys.readouterr().out)["logs"]
    aileron = found["surfaces"]["aileron"]
    assert (aileron["status"], aileron["feedback"], aileron["current"]["status"]) == ("fault", "current", "fault")
    (one,) = aileron["faults"]
    assert (one["kind"], one["witness"]) == (fault, "current")
    assert START_S - 1.0 <= one["start_s"] <= one["alarm_s"] <= START_S + 5.0
    assert "by its current" in found["sentence"]


def test_a_hub_that_reports_once_a_second_shows_a_servo_without_power(tmp_path: Path) -> None:
    """Its current at rest was taken for seven times as much, beside a friction that gave current back."""
    command_deg = gusty(np.arange(0.0, 180.0, 0.04), np.random.default_rng([6006, 7]))
    sensor = Sensor(1.0, averages=True)
    flight = fly(180.0, 6006, sensor=sensor, fault="unpowered", start_s=START_S, command_deg=command_deg)
    found = servofd.audit(written(tmp_path / "flight.csv", flight))["aileron"]
    assert [fault.kind for fault in found.faults] == ["unpowered"]
    assert START_S <= found.faults[0].alarm_s <= START_S + 20.0


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", [1.0, 10.0])
def test_a_good_one_is_cleared(tmp_path: Path, rate_hz: float) -> None:
    found = servofd.audit(written(tmp_path / "flight.csv", flown(6, rate_hz)))
    assert (found["aileron"].status, found["aileron"].feedback) == ("healthy", "current")
    assert found.sentence == "Aileron drew the current of a healthy servo."


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["binding", "blocked", "unpowered", ""])
def test_calibrated_on_good_flights(tmp_path: Path, calibrated: str, fault: str) -> None:
    found = servofd.audit(written(tmp_path / "flight.csv", flown(7, 10.0, fault)), calibrated)
    kinds = [one.kind for one in found["aileron"].faults]
    assert kinds == ([fault] if fault else [])
    if fault == "binding":  # friction is three times as large
        assert 1.7 < found["aileron"].faults[0].parameters["times"].value < 3.5


@pytest.mark.slow
def test_the_sensor_is_at_fault_where_the_current_says_that_it_moves(tmp_path: Path) -> None:
    flight = flown(8, 25.0)
    frozen_deg = flight.position_deg.copy()
    frozen_deg[flight.current_s > START_S] = frozen_deg[flight.current_s > START_S][0]
    flight.position_deg[:] = frozen_deg
    found = servofd.audit(written(tmp_path / "flight.csv", flight, position=True))
    assert found["aileron"].status == "fault"
    assert "its sensor is at fault" in found["aileron"].reason


@pytest.mark.slow
def test_two_witnesses_agree(tmp_path: Path) -> None:
    log = written(tmp_path / "flight.csv", flown(9, 25.0, "blocked"), position=True)
    alone = tmp_path / "alone.csv"
    alone.write_text("\n".join(line.rsplit(",", 2)[0] + "," + line.rsplit(",", 1)[1] for line in _lines(log)))
    (by_position,) = servofd.audit(alone)["aileron"].faults
    found = servofd.audit(log)
    assert found["aileron"].feedback == "both"
    (fault,) = found["aileron"].faults  # one event, told by both
    assert (fault.kind, fault.witness) == ("stuck", "position")
    assert fault.confirmed_by is not None
    assert (fault.confirmed_by.kind, fault.confirmed_by.witness) == ("blocked", "current")
    assert fault.probability >= by_position.probability
    assert fault.alarm_s <= by_position.alarm_s
    assert found["aileron"].reason.startswith("servo: stuck at")
    assert "confirmed by its current (blocked" in found.sentence


@pytest.mark.nightly
def test_a_servo_without_power_is_one_fault_of_both_witnesses(tmp_path: Path) -> None:
    flight = flown(9, 25.0, "unpowered")
    held_deg = flight.position_deg
    held_deg[flight.current_s > START_S] = held_deg[flight.current_s > START_S][0]  # a gear that holds by itself
    (fault,) = servofd.audit(written(tmp_path / "flight.csv", flight, position=True))["aileron"].faults
    assert fault.confirmed_by is not None
    assert (fault.kind, fault.confirmed_by.kind) == ("stuck", "unpowered")


@pytest.mark.slow
def test_a_position_that_follows_takes_back_what_an_unknown_current_looks_like(tmp_path: Path) -> None:
    flight = flown(9, 25.0, "blocked")
    flight.position_deg[:] = flown(9, 25.0).position_deg
    found = servofd.audit(written(tmp_path / "flight.csv", flight, position=True))["aileron"]
    assert (found.status, found.faults, found.suspicions) == ("healthy", (), ())
    assert found.current is not None
    assert found.current.status == "unknown"
    assert "its position followed" in found.current.reason


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda text: text.replace("aileron_current_a", "aileron_current"), "has no unit"),
        (lambda text: _current(text, lambda value: 0.0 * value), "never changes"),
        (lambda text: _current(text, lambda value: -value - 0.2), "wired the wrong way round"),
        (lambda text: _current(text, lambda value: -value), "wired the wrong way round"),
        (lambda text: _current(text, lambda value: 1e3 * value), "which no servo draws"),
        (lambda text: _current(text, lambda value: 1e2 * value), "which no servo draws"),
        (lambda text: _current(text, lambda value: 512.0 + round(value / 8e-4)), "counts have to be converted"),
        (lambda text: _current(text, lambda value: round(10.0 * value)), "reads whole amperes alone"),
        (lambda text: _later(text, 1.7e9), "has a clock of its own"),
        (lambda text: _current(text, lambda value: value * float("nan")), "holds no value"),
    ],
)
def test_bad_currents_end_in_one_line(tmp_path: Path, change: object, said: str) -> None:
    assert callable(change)
    path = tmp_path / "flight.csv"
    path.write_text(change(flown(10, 10.0, seconds=40.0).csv("aileron")))
    found = servofd.audit(path)
    assert said in found["aileron"].reason
    assert found["aileron"].status in ("no_data", "unknown")


def test_a_command_that_is_damage_leaves_the_current_of_the_rest(tmp_path: Path) -> None:
    path, rows = tmp_path / "flight.csv", flown(10, 10.0, seconds=40.0).csv("aileron").splitlines()
    k = next(k for k in range(500, len(rows)) if rows[k].split(",")[1])
    time_s, _, drawn_a = rows[k].split(",")
    rows[k] = f"{time_s},1e29,{drawn_a}"
    path.write_text("\n".join(rows) + "\n")
    found = servofd.audit(path)["aileron"]
    assert (found.status, found.feedback) == ("healthy", "current")


def test_a_sensor_of_tenths_of_an_ampere_tells_as_well(tmp_path: Path) -> None:
    """Most of its readings are 0."""
    path, kinds, sensor = tmp_path / "flight.csv", [], Sensor(10.0, step_a=0.1, noise_a=0.02)
    for fault in ("", "blocked"):
        command_deg = gusty(np.arange(0.0, 140.0, 0.04), np.random.default_rng([2, 7]))
        flight = fly(140.0, 2, sensor=sensor, fault=fault, start_s=START_S, command_deg=command_deg)
        path.write_text(flight.csv("aileron"))
        found = servofd.audit(path)["aileron"]
        kinds.append((found.status, *(one.kind for one in found.faults)))
    assert kinds == [("healthy",), ("fault", "blocked")]


def test_the_current_of_another_servo_is_no_witness(tmp_path: Path) -> None:
    path, flight = tmp_path / "flight.csv", flown(5, 10.0, seconds=120.0)
    path.write_text(replace(flight, current_a=flown(9, 10.0, seconds=120.0).current_a).csv("aileron"))
    found = servofd.audit(path)["aileron"]
    assert found.status == "unknown"
    assert "its current goes with only" in found.reason


@pytest.mark.slow
def test_the_end_of_a_range_is_said(tmp_path: Path) -> None:
    path = tmp_path / "flight.csv"
    path.write_text(_current(flown(5, 10.0, "blocked").csv("aileron"), lambda value: min(value, 0.3)))
    assert "the end of its range" in servofd.audit(path)["aileron"].reason


@pytest.mark.slow
def test_a_current_that_dies_while_the_position_follows_is_no_fault_of_the_servo(tmp_path: Path) -> None:
    goods = [tmp_path / f"good{k}.csv" for k in range(3)]
    for k, good in enumerate(goods):
        good.write_text(flown(70 + k, 10.0, seconds=100.0).csv("aileron", position=True))
    plane = servofd.calibrate(goods).save(tmp_path / "plane.toml")
    head, *rows = flown(5, 10.0).csv("aileron", position=True).splitlines()
    read = [row.split(",") for row in rows]
    dead = [[t, asked, "0.0", at] if a and float(t) > START_S else [t, asked, a, at] for t, asked, a, at in read]
    (tmp_path / "flight.csv").write_text("\n".join([head, *map(",".join, dead)]) + "\n")
    found = servofd.audit(tmp_path / "flight.csv", plane)["aileron"]
    assert (found.status, found.faults) == ("healthy", ())
    assert "the sensor of the current is at fault; moves as in its good flights" in found.reason


@pytest.mark.slow
def test_a_current_that_ends_in_the_first_half_of_a_flight_clears_nobody(tmp_path: Path) -> None:
    """The servo blocks after that."""
    log = written(tmp_path / "flight.csv", flown(5, 10.0, "blocked"))
    head, *rows = _lines(log)
    early = [row if float(row.partition(",")[0]) < 40.0 else row.rpartition(",")[0] + "," for row in rows]
    Path(log).write_text("\n".join([head, *early]) + "\n")
    assert main(["audit", log]) == 2
    found = servofd.audit(log)["aileron"]
    assert found.status == "unknown"
    assert found.judged_share < 0.5
    assert found.reason.startswith("judged for too little of the log")


@pytest.mark.slow
def test_a_current_that_begins_in_mid_flight_is_judged_from_there(tmp_path: Path) -> None:
    log = written(tmp_path / "flight.csv", flown(5, 10.0, "blocked"))
    head, *rows = _lines(log)
    late = [row if float(row.partition(",")[0]) > 40.0 else row.rpartition(",")[0] + "," for row in rows]
    Path(log).write_text("\n".join([head, *late]) + "\n")
    (fault,) = servofd.audit(log)["aileron"].faults
    assert fault.kind == "blocked"


def test_a_current_that_stands_still_for_a_part_of_the_log_ends_in_a_verdict(tmp_path: Path) -> None:
    """A part of it that never changes tells nothing of the servo, and the others do."""
    path, kept = tmp_path / "flight.csv", iter(range(10**6))
    path.write_text(_current(flown(10, 10.0, seconds=60.0).csv("aileron"), lambda a: a * (next(kept) > 400)))
    assert servofd.audit(path)["aileron"].status in ("healthy", "suspect", "fault", "unknown")


def _lines(log: str) -> list[str]:
    return Path(log).read_text().splitlines()


def _later(text: str, by_s: float) -> str:
    """The same table with the rows of its last column on another clock."""
    head, *rows = text.splitlines()
    told = [
        f"{float(row.partition(',')[0]) + by_s},{row.partition(',')[2]}" if not row.endswith(",") else row
        for row in rows
    ]
    return "\n".join([head, *told]) + "\n"


def _current(text: str, change: object) -> str:
    """The same table with other values of its last column."""
    assert callable(change)
    head, *rows = text.splitlines()
    parts = [row.rsplit(",", 1) for row in rows]
    told = [f"{first},{change(float(last)) if last else ''}" for first, last in parts]
    return "\n".join([head, *told]) + "\n"


@pytest.mark.parametrize(
    ("column", "said"), [("amps", "and by its current"), ("current", "column current has no unit")]
)
def test_a_table_of_one_servo_names_its_current_in_few_letters(
    tmp_path: Path, column: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bench.csv"
    text = flown(10, 10.0, seconds=40.0).csv("aileron", position=True)
    path.write_text(text.replace("aileron_current_a", column))
    assert main(["info", str(path), "--json"]) == 0
    ((surface,),) = (log["surfaces"] for log in json.loads(capsys.readouterr().out)["logs"])
    assert said in surface["verdict"]
    found = servofd.audit(path)["aileron"]
    assert found.current is not None
    assert (found.current.time_s is None) == (column == "current")


@pytest.mark.slow
def test_milliamperes_are_asked_for_by_name(tmp_path: Path) -> None:
    text = flown(5, 10.0, "blocked").csv("aileron")
    path = tmp_path / "flight.csv"
    path.write_text(_current(text, lambda value: 1e3 * value).replace("current_a", "current_ma"))
    (fault,) = servofd.audit(path)["aileron"].faults
    assert fault.kind == "blocked"
    assert 1.0 < fault.parameters["current_a"].value < 4.0


@pytest.mark.slow
def test_the_page_draws_the_current(tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    main(["audit", written(tmp_path / "flight.csv", flown(5, 10.0, "blocked")), "--html", str(page)])
    text = page.read_text()
    assert "good ones differ by" in text
    assert "Blocked at 1:40, close-up" in text


@pytest.mark.slow
@pytest.mark.parametrize("position", [False, pytest.param(True, marks=pytest.mark.nightly)])
def test_a_recording_says_what_the_audit_said(tmp_path: Path, position: bool) -> None:
    log = written(tmp_path / "flight.csv", flown(9, 25.0, "blocked"), position=position)
    paths = {name: str(tmp_path / name) for name in ("flight.rrd", "audit.json", "review.json")}
    assert main(["audit", log, "--rrd", paths["flight.rrd"], "--json", paths["audit.json"]]) == 1
    assert main(["review", paths["flight.rrd"], "--json", paths["review.json"]]) == 1
    said = [json.loads(Path(paths[name]).read_text())["logs"][0]["surfaces"] for name in ("audit.json", "review.json")]
    assert said[0] == said[1]


@pytest.mark.parametrize("seed", [500, 511])
def test_a_blocked_servo_that_hardly_pushes_is_not_cleared_by_its_own_current(seed: int) -> None:
    """In gusts it is asked to be elsewhere for moments alone, and draws more than in motion in a tenth of its rows."""
    aircraft = plain_aircraft(["elevator", "aileron"], "s9254")
    flight = simulate_flight(
        aircraft, duration_s=120.0, seed=seed, noise_deg=0.05, command="gusty", faults={"elevator": (Stuck(50.0),)}
    )
    log, rng = {"time_s": flight.time_s}, np.random.default_rng(seed)
    for k, name in enumerate(aircraft.surfaces):
        command_deg, position_deg = flight.command_deg[:, k], flight.measured_deg[:, k]
        smooth_deg = np.convolve(np.pad(position_deg, 2, mode="edge"), np.full(5, 0.2), "valid")
        drawn_a = current_a(np.gradient(smooth_deg, flight.time_s), rng)
        log[f"{name}_cmd_deg"] = command_deg
        log[f"{name}_current_a"] = drawn_a + stalled_a(flight.time_s, command_deg, position_deg)
    (audit,) = servofd.audit(log)
    assert audit["elevator"].status in ("fault", "suspect", "unknown")
    assert audit["aileron"].status == "healthy"


@pytest.mark.slow
def test_it_is_drawn_in_a_notebook(tmp_path: Path) -> None:
    found = servofd.audit(written(tmp_path / "flight.csv", flown(5, 10.0, "blocked")))
    assert [axes.get_ylabel() for axes in found.plot().axes] == ["deflection [deg]", "current [A]"]


def together(flights: Mapping[str, Flown], volts_v: Callable[[float], float]) -> str:
    """One table of several surfaces, with their common supply."""
    rows = []
    for k, (name, flight) in enumerate(flights.items()):
        before, after = ",," * k, ",," * (len(flights) - 1 - k)
        for line in flight.csv(name).splitlines()[1:]:
            at_s, rest = line.split(",", 1)
            rows.append((float(at_s), f"{at_s},{before}{rest}{after},{volts_v(float(at_s)):.2f}"))
    head = ["time_s", *(f"{name}_cmd_deg,{name}_current_a" for name in flights), "servo_voltage_v"]
    return "\n".join([",".join(head), *(row for _, row in sorted(rows))]) + "\n"


@pytest.mark.slow
@pytest.mark.parametrize("lost", [("aileron", "elevator", "rudder"), ("elevator", "rudder"), ("elevator",)])
def test_servos_without_power_at_once_are_one_supply_that_gave_way(tmp_path: Path, lost: tuple[str, ...]) -> None:
    flights = {
        name: flown(30 + k, 10.0, "unpowered" if name in lost else "")
        for k, name in enumerate(("aileron", "elevator", "rudder"))
    }
    path = tmp_path / "flight.csv"
    path.write_text(together(flights, lambda at_s: 0.4 if at_s > START_S and len(lost) > 1 else 6.0))
    found = servofd.audit(path)
    assert [s.surface for s in found.surfaces if s.status == "fault"] == list(lost)  # as grave as its parts
    if len(lost) == 1:
        assert found.common_causes == ()
        return
    (cause,) = found.common_causes
    assert (cause.kind, cause.surfaces) == ("supply", lost)
    assert abs(cause.since_s - START_S) < 1.5
    assert "it fell from 6.0 to 0.4 V" in cause.text
    assert found.sentence.startswith("SUPPLY GAVE WAY at 1:")


@pytest.mark.slow
@pytest.mark.parametrize("again_v", [4.5, 6.0])
def test_a_supply_that_sags_is_said_though_servos_follow(tmp_path: Path, again_v: float) -> None:
    """By a quarter for good, or to a half for two seconds in four."""

    def volts_v(at_s: float) -> float:
        return 6.0 if at_s < START_S else again_v if (at_s - START_S) % 4.0 > 2.0 else min(again_v, 4.5)

    flights = {name: flown(30 + k, 10.0) for k, name in enumerate(("aileron", "elevator", "rudder"))}
    path = tmp_path / "flight.csv"
    path.write_text(together(flights, volts_v))
    found = servofd.audit(path)
    (cause,) = found.common_causes
    assert (cause.kind, cause.surfaces) == ("supply", ())
    assert abs(cause.since_s - START_S) < 0.2
    assert "it fell from 6.0 to 4.5 V though no servo failed with it" in found.sentence
    assert {s.status for s in found.surfaces} == {"healthy"}


@pytest.mark.slow
def test_a_battery_that_empties_is_no_supply_that_gives_way(tmp_path: Path) -> None:
    flights = {name: flown(30 + k, 10.0) for k, name in enumerate(("aileron", "elevator"))}
    path = tmp_path / "flight.csv"
    path.write_text(together(flights, lambda at_s: 8.4 - 2.2 * at_s / 180.0))
    found = servofd.audit(path)
    assert {s.status for s in found.surfaces} == {"healthy"}
    assert found.common_causes == ()


def test_info_says_what_a_current_allows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", written(tmp_path / "flight.csv", flown(5, 10.0, seconds=40.0)), "--json"]) == 0
    (surface,) = json.loads(capsys.readouterr().out)["logs"][0]["surfaces"]
    assert (surface["position"], surface["current"]) == ("-", "aileron_current_a")
    assert surface["verdict"] == "yes, by its current"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("message", "rail"), [("CSCU", "CSCU[0].Curr, CSCU[1].Curr are currents"), ("BAT", "BAT[1].Curr is")]
)
def test_currents_of_circuits_are_told_though_no_file_names_them(
    tmp_path: Path, message: str, rail: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "flight.bin"
    path.write_bytes(dataflash_of(flown(5, 10.0, seconds=40.0), message))
    assert main(["info", str(path)]) == 0
    assert f"{rail}" in " ".join(capsys.readouterr().out.split())
    assert main(["audit", str(path)]) == 2
    assert f"{rail}" in capsys.readouterr().err


@pytest.mark.slow
def test_a_topic_of_a_fork_is_a_current_once_the_aircraft_file_names_it(tmp_path: Path) -> None:
    log, plane = tmp_path / "flight.ulg", tmp_path / "plane.toml"
    log.write_bytes(ulog_of(flown(5, 10.0, "blocked", seconds=120.0)))
    plane.write_text(
        '[surfaces.aileron]\ncommand = { channel = "actuator_outputs[0].output[0]", unit = "us", trim_us = 1500.0, '
        'slope_deg_per_us = 0.09 }\ncurrent = { channel = "servo_status[0].servo_current[0]", unit = "A" }\n'
    )
    (fault,) = servofd.audit(log, plane)["aileron"].faults
    assert (fault.kind, fault.witness) == ("blocked", "current")


def test_runs_that_hold_the_same_are_told_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = flown(5, 10.0, seconds=20.0).csv("aileron").splitlines()
    path, commands = tmp_path / "bench.csv", [row for row in rows[1:] if not row.endswith(",")]
    runs = [f"{run},{row}" for run, of in enumerate([rows[1:]] * 3 + [commands]) for row in of]
    path.write_text("\n".join([f"run,{rows[0]}", *runs]) + "\n")
    assert main(["info", str(path)]) == 0
    told = [line for line in capsys.readouterr().out.splitlines() if line.startswith(str(path))]
    assert [line.split(": table")[0] for line in told] == [f"{path} (runs 0 to 2)", f"{path} (run 3)"]


def test_calibrate_says_why_a_current_is_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "good.csv"
    text = flown(5, 10.0, seconds=60.0).csv("aileron", position=True)
    path.write_text(text.replace("aileron_current_a", "aileron_current"))
    main(["calibrate", str(path), "-o", str(tmp_path / "plane.toml"), "--force"])
    told = capsys.readouterr()
    assert "its current is not calibrated: column aileron_current has no unit" in " ".join(told.out.split())
    path.write_text(text.replace("aileron_pos_deg", "other").replace("aileron_current_a", "aileron_current"))
    assert main(["calibrate", str(path), "-o", str(tmp_path / "plane.toml")]) == 2
    assert "column aileron_current has no unit" in capsys.readouterr().err


@pytest.mark.slow
def test_a_column_without_a_unit_takes_nothing_from_the_others(tmp_path: Path) -> None:
    path = tmp_path / "flight.csv"
    flights = {"aileron": flown(5, 10.0), "elevator": flown(9, 10.0, "blocked")}
    path.write_text(together(flights, lambda _: 6.0).replace("aileron_current_a", "aileron_current"))
    found = servofd.audit(path)
    assert [fault.kind for fault in found["elevator"].faults] == ["blocked"]
    assert "column aileron_current has no unit" in found["aileron"].reason


def test_a_current_without_commands_can_be_no_witness(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "flight.csv"
    rows = [row.split(",") for row in flown(5, 10.0, seconds=20.0).csv("aileron").splitlines()]
    path.write_text("\n".join([",".join(rows[0]), *(f"{row[0]},,{row[2]}" for row in rows[1:])]) + "\n")
    assert main(["info", str(path), "--json"]) == 0
    assert '"verdict": "no: ' in capsys.readouterr().out


def test_info_says_once_what_currents_allow(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(Path(__file__).parents[2] / "sample_logs" / "ardupilot_volz_stuck.bin")]) == 0
    assert capsys.readouterr().out.count("blocked") == 1


@pytest.mark.slow
def test_cycles_of_a_bench_end_in_one_table_and_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = []
    asked_deg = np.interp(0.04 * np.arange(325), [0.0, 5.0, 8.0, 13.0], [-20.0, 20.0, 20.0, -20.0])
    for run in range(20):  # the same commands each time
        cycle = fly(13.0, run, sensor=Sensor(25.0), command_deg=asked_deg)
        head, *lines = cycle.csv("ram").splitlines()
        rows += [f"{run},{line}" for line in lines]
    path = tmp_path / "cycles.csv"
    path.write_text("\n".join([f"run,{head}", *rows]) + "\n")
    assert main(["calibrate", str(path), "-o", str(tmp_path / "ram.toml")]) == 0
    assert "known from 20" in capsys.readouterr().out
    assert main(["audit", str(path), "-c", str(tmp_path / "ram.toml")]) != 1
    told = capsys.readouterr()
    assert told.err.count("\n") <= 1
    assert told.out.count("run 7") == 1


@pytest.mark.slow
def test_a_jam_that_draws_more_than_any_motion_is_no_fault_of_the_sensor() -> None:
    (result,) = servofd.audit(
        Path(__file__).parents[2] / "sample_logs" / "ardupilot_volz_stuck.bin", surfaces=("elevator",)
    )
    (elevator,) = result.surfaces
    (fault,) = elevator.faults
    assert fault.kind == "stuck"
    assert fault.confirmed_by is not None
    assert 1.0 < fault.confirmed_by.parameters["current_a"].value < 1.4  # the simulated stall
    assert "sensor" not in elevator.reason


@pytest.mark.slow
def test_limits_of_an_older_file_are_those_of_other_tests_and_hide_nothing(tmp_path: Path, calibrated: str) -> None:
    lines = Path(calibrated).read_text().replace("healthy_current.limits_nats]", "healthy_current.limits]").splitlines()
    assert "[surfaces.aileron.healthy_current.limits]" in lines
    older = [
        f"{line.split()[0]} = 1e6" if line.startswith(("blocked =", "unpowered =", "binding =")) else line
        for line in lines
    ]
    (tmp_path / "older.toml").write_text("\n".join(older))
    (found,) = servofd.audit(written(tmp_path / "flight.csv", flown(5, 10.0, "blocked")), tmp_path / "older.toml")
    assert [fault.kind for fault in found["aileron"].faults] == ["blocked"]


def test_what_to_do_about_a_unit_is_said_once_below_the_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "flight.csv"
    flights = {name: flown(5 + k, 10.0, seconds=20.0) for k, name in enumerate(("aileron", "elevator"))}
    path.write_text(together(flights, lambda _: 6.0).replace("_current_a", "_current"))
    assert main(["audit", str(path)]) == 2
    lines = capsys.readouterr().out.splitlines()
    assert sum("[surfaces.<surface>.current] of the aircraft file" in line for line in lines) == 1
    assert sum("column elevator_current has no unit" in line for line in lines) == 1
