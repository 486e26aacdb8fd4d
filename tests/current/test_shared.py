"""Currents of circuits and batteries that the aircraft file names, and one current of several servos."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import servofd
from servofd.cli import main
from servofd.simulation.commands import gusty
from tests.current.hub import dataflash_of, telemetry_of
from tests.current.motor import Sensor, fly

START_S, SECONDS = 120.0, 240.0
NAMES = ("aileron_left", "aileron_right", "elevator")
PLANE = "".join(
    f'[surfaces.{name}]\ncommand = {{ channel = "{name}_cmd_deg", unit = "deg" }}\n'
    'current = { channel = "servo_current_a", unit = "A" }\n'
    for name in NAMES
)


def bench(seed: int, fault: str = "", lost: tuple[str, ...] = (), seen: tuple[str, ...] = ()) -> str:
    """A table of three servos, the ailerons of one command, and of the sum of what they draw, at 10 Hz.

    The positions of those that are `seen` stand in it as well.
    """
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, SECONDS, 0.04)
    aileron_deg, elevator_deg = (gusty(time_s, np.random.default_rng([seed, k])) for k in range(2))
    asked = dict(zip(NAMES, (aileron_deg, -aileron_deg, elevator_deg), strict=True))
    at_s = np.arange(0.05, SECONDS - 0.2, 0.1)
    at_s += rng.uniform(-0.005, 0.005, at_s.size)
    drawn_a = 0.01 * rng.standard_normal(at_s.size)
    read = dict(asked)
    for k, name in enumerate(NAMES):
        kind, sensor = fault if name in lost else "", Sensor(125.0, step_a=0.0, noise_a=0.0)
        flown = fly(SECONDS, 10 * seed + k, sensor=sensor, fault=kind, start_s=START_S, command_deg=asked[name])
        drawn_a += flown.current_a[np.clip(np.searchsorted(flown.current_s, at_s) - 1, 0, None)]
        now = np.clip(np.searchsorted(flown.current_s, time_s) - 1, 0, None)
        read[name] = flown.position_deg[now] + rng.normal(0.0, 0.05, time_s.size)
    columns = [*asked.values(), *(read[name] for name in seen)]
    rows = [
        (t, f"{t:.4f},{','.join(f'{each:.3f}' for each in row)},") for t, *row in zip(time_s, *columns, strict=True)
    ]
    rows += [(t, f"{t:.4f},{',' * len(columns)}{a:.2f}") for t, a in zip(at_s, drawn_a, strict=True)]
    names = [*(f"{name}_cmd_deg" for name in NAMES), *(f"{name}_pos_deg" for name in seen)]
    head = ",".join(["time_s", *names, "servo_current_a"])
    return "\n".join([head, *(row for _, row in sorted(rows))]) + "\n"


def written(folder: Path, seed: int, fault: str = "", lost: tuple[str, ...] = ()) -> str:
    path = folder / f"flight{seed}{fault}.csv"
    path.write_text(bench(seed, fault, lost))
    return str(path)


@pytest.fixture(scope="module")
def plane(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("good")
    (folder / "draft.toml").write_text(PLANE)
    goods = [written(folder, 70 + k) for k in range(4)]
    assert main(["calibrate", *goods, "-c", str(folder / "draft.toml"), "-o", str(folder / "plane.toml")]) == 0
    return str(folder / "plane.toml")


@pytest.mark.slow
def test_who_is_asked_for_something_of_its_own_is_named_alone(tmp_path: Path, plane: str) -> None:
    found = servofd.audit(written(tmp_path, 3, "blocked", ("elevator",)), plane)
    assert {s.surface: s.status for s in found.surfaces} == dict(
        zip(NAMES, ("healthy", "healthy", "fault"), strict=True)
    )
    (fault,) = found["elevator"].faults
    assert fault.kind == "blocked"
    assert START_S - 1.0 <= fault.start_s <= fault.alarm_s <= START_S + 10.0
    assert found.common_causes == ()
    for name in NAMES[:2]:  # what a servo draws is no more because another one blocks
        current = next(s.current for s in found.surfaces if s.surface == name)
        assert current is not None
        assert current.ratio_to_good == pytest.approx(1.0, abs=0.4)


@pytest.mark.slow
@pytest.mark.parametrize("lost", [pytest.param(NAMES[0], marks=pytest.mark.nightly), NAMES[1]])
def test_servos_of_one_command_are_named_together(
    tmp_path: Path, plane: str, lost: str, capsys: pytest.CaptureFixture[str]
) -> None:
    log = written(tmp_path, 5, "blocked", (lost,))
    assert main(["audit", log, "-c", plane, "--json", "-"]) == 1
    (found,) = json.loads(capsys.readouterr().out)["logs"]
    (cause,) = found["common_causes"]
    assert (cause["kind"], cause["surfaces"]) == ("unknown", ["aileron_left", "aileron_right"])
    assert abs(cause["since_s"] - START_S) < 5.0
    assert cause["text"].startswith("one of aileron left, aileron right draws 0.")
    assert "A more: blocked" in found["sentence"]
    assert found["surfaces"]["elevator"]["status"] == "healthy"
    for name in NAMES[:2]:
        (fault,) = found["surfaces"][name]["faults"]
        assert fault["probability"] <= 0.5  # one of two


def with_positions(folder: Path, plane: str, names: tuple[str, ...]) -> Path:
    """The aircraft file with the positions of some."""
    text = Path(plane).read_text()
    for name in names:
        measured = f'measured = {{ channel = "{name}_pos_deg", unit = "deg" }}'
        text = text.replace(f"[surfaces.{name}]\n", f"[surfaces.{name}]\n{measured}\n")
    (folder / "seen.toml").write_text(text)
    return folder / "seen.toml"


@pytest.mark.nightly
def test_a_sensor_that_fails_while_positions_follow_is_no_fault_of_a_servo(tmp_path: Path, plane: str) -> None:
    head, *rows = bench(11, seen=NAMES[2:]).splitlines()
    dead = [
        row.rpartition(",")[0] + ",0.00" if float(row.split(",")[0]) > 100.0 and row[-1] != "," else row for row in rows
    ]
    (tmp_path / "log.csv").write_text("\n".join([head, *dead]) + "\n")
    found = servofd.audit(tmp_path / "log.csv", with_positions(tmp_path, plane, NAMES[2:]))
    assert found.common_causes == ()
    assert {s.surface: s.status for s in found.surfaces} == dict(
        zip(NAMES, ("unknown", "unknown", "healthy"), strict=True)
    )
    assert "its sensor reads nothing while servos move" in found["aileron_left"].reason


@pytest.mark.nightly
@pytest.mark.parametrize("lost", NAMES[:2])
def test_a_jam_that_a_position_shows_is_what_a_wire_shows(tmp_path: Path, plane: str, lost: str) -> None:
    """And none of the servo beside it, whose position nobody knows."""
    (tmp_path / "log.csv").write_text(bench(21, "blocked", (lost,), NAMES[:2]))
    found = servofd.audit(tmp_path / "log.csv", with_positions(tmp_path, plane, NAMES[:2]))
    assert {s.surface for s in found.surfaces if s.status == "fault"} == {lost}
    assert {s.surface for s in found.surfaces if s.status == "healthy"} == set(NAMES) - {lost}


@pytest.mark.slow
def test_a_wire_that_carries_nothing_is_a_supply_that_gave_way(tmp_path: Path, plane: str) -> None:
    found = servofd.audit(written(tmp_path, 7, "unpowered", NAMES), plane)
    (cause,) = found.common_causes
    assert (cause.kind, cause.surfaces) == ("supply", NAMES)
    assert {s.status for s in found.surfaces} == {"fault"}


@pytest.mark.slow
def test_good_servos_are_cleared(tmp_path: Path, plane: str) -> None:
    found = servofd.audit(written(tmp_path, 9), plane)
    assert {s.status for s in found.surfaces} == {"healthy"}


def test_who_draws_what_is_not_guessed(tmp_path: Path) -> None:
    (tmp_path / "draft.toml").write_text(PLANE)
    found = servofd.audit(written(tmp_path, 9), tmp_path / "draft.toml")
    assert not any(s.is_judged for s in found.surfaces)
    assert "calibrate all of them" in found["elevator"].reason


@pytest.mark.parametrize("columns", ["servo_current_a", "aileron_left_current_a,elevator_current_a"])
def test_a_sum_that_a_table_tells_of_several_servos_accuses_none(tmp_path: Path, columns: str) -> None:
    """Nor does one whose column stands there twice, by the names of two of them."""
    head, *rows = bench(9, "blocked", ("elevator",)).splitlines()
    twice = [f"{row},{row.rpartition(',')[2]}" for row in rows] if "," in columns else rows
    (tmp_path / "flight.csv").write_text("\n".join([head.replace("servo_current_a", columns), *twice]) + "\n")
    found = servofd.audit(tmp_path / "flight.csv")
    assert not any(s.is_judged for s in found.surfaces)
    assert "current" in found["elevator"].reason
    assert "calibrate" in found["elevator"].reason


@pytest.mark.slow
@pytest.mark.parametrize(
    ("suffix", "channel", "unit"),
    [
        (".bin", "CSCU[1].Curr", "A"),
        (".bin", "BAT[1].Curr", "A"),
        (".tlog", "BATTERY_STATUS[1].current_battery", "cA"),
    ],
)
def test_the_aircraft_file_says_which_circuit_or_battery_feeds_a_servo(
    tmp_path: Path, suffix: str, channel: str, unit: str
) -> None:
    command_deg = gusty(np.arange(0.0, 180.0, 0.04), np.random.default_rng(1005))
    flight = fly(180.0, 5, sensor=Sensor(10.0), fault="blocked", start_s=START_S, command_deg=command_deg)
    log, file = tmp_path / f"flight{suffix}", tmp_path / "plane.toml"
    log.write_bytes(
        telemetry_of(flight, battery=True) if suffix == ".tlog" else dataflash_of(flight, channel.partition("[")[0])
    )
    file.write_text(
        '[surfaces.aileron]\noutput = 1\ncommand = { channel = "RCOU.C1", unit = "us", trim_us = 1500.0, '
        f'slope_deg_per_us = 0.09 }}\ncurrent = {{ channel = "{channel}", unit = "{unit}" }}\n'
    )
    (fault,) = servofd.audit(log, file)["aileron"].faults
    assert fault.kind == "blocked"
    assert 1.0 < fault.parameters["current_a"].value < 4.0
    file.write_text(file.read_text().replace(f'unit = "{unit}" }}\n', 'unit = "mA" }\n'))
    assert f"is in {unit} by its log, and in mA by the aircraft file" in servofd.audit(log, file)["aileron"].reason
