"""`servofd calibrate` and `servofd audit --sweep`: files written and refused, tables, exit codes."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

import servofd
from servofd.aircraft.schema import load_aircraft, plain_aircraft
from servofd.cli import main
from servofd.core.types import FloatArray
from servofd.servo.faults import Stuck
from servofd.simulation.flight import SimulatedFlight, simulate_flight

AIRCRAFT = """
[surfaces.rudder]
servo = "hs225bb-eq31"
command = { channel = "rudder_cmd_deg", unit = "deg" }
measured = { channel = "rudder_pos_deg", unit = "deg" }
"""


def written(folder: Path, name: str, time_s: FloatArray, command_deg: FloatArray, measured_deg: FloatArray) -> str:
    rows = np.column_stack([time_s, command_deg, measured_deg])
    path = folder / name
    np.savetxt(path, rows, "%.4f", ",", header="time_s,rudder_cmd_deg,rudder_pos_deg", comments="")
    return str(path)


def flown(seed: int = 1, **options: object) -> SimulatedFlight:
    return simulate_flight(plain_aircraft(["rudder"], "hs225bb-eq31"), seed=seed, **({"duration_s": 30.0} | options))  # type: ignore[arg-type]


def logged(folder: Path, name: str, flight: SimulatedFlight) -> str:
    return written(folder, name, flight.time_s, flight.command_deg[:, 0], flight.measured_deg[:, 0])


@pytest.fixture
def config(tmp_path: Path) -> str:
    path = tmp_path / "plane.toml"
    path.write_text(AIRCRAFT)
    return str(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scale", "zero", "said"),
    [(-1.0, 0.0, "moves against its command"), (11.4, 2048.0, "moves by 11")],
    ids=["reversed", "counts"],
)
def test_a_position_in_another_sign_or_unit_is_said_to_be(
    scale: float, zero: float, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flight = flown()
    read = zero + scale * flight.measured_deg[:, 0]
    good = written(tmp_path, "good.csv", flight.time_s, flight.command_deg[:, 0], read)
    assert main(["calibrate", good, "-o", str(tmp_path / "calibrated.toml")]) == 0
    assert f"rudder: note: its position {said}" in capsys.readouterr().out


@pytest.mark.slow
def test_a_good_flight_gives_an_aircraft_file(tmp_path: Path, config: str, capsys: pytest.CaptureFixture[str]) -> None:
    flight = flown()
    good = written(tmp_path, "good.csv", flight.time_s, flight.command_deg[:, 0], 0.9 * flight.measured_deg[:, 0] + 2.0)
    target = tmp_path / "calibrated.toml"
    assert main(["calibrate", good, "-c", config, "-o", str(target)]) == 0
    shown = capsys.readouterr().out
    assert "Smallest faults that flights like these show" in shown
    assert "rudder: note: 3 more flights like this one would show" in shown
    text = target.read_text()
    assert "good.csv" in text
    assert str(tmp_path) not in text
    surface = load_aircraft(target).surfaces["rudder"]
    assert surface.threshold == "interval"
    assert surface.measured is not None
    assert surface.measured.correction[0] == pytest.approx(1.0 / 0.9, rel=0.015)
    assert surface.calibrated is not None
    assert surface.model.origin == "calibrated"
    # The next flight of the same servo is healthy with this file.
    other = flown(2)
    after = written(tmp_path, "after.csv", other.time_s, other.command_deg[:, 0], 0.9 * other.measured_deg[:, 0] + 2.0)
    assert main(["audit", after, "-c", str(target)]) == 0


@pytest.mark.slow
def test_faulty_flights_are_refused_and_their_good_part_is_not(
    tmp_path: Path, config: str, capsys: pytest.CaptureFixture[str]
) -> None:
    jammed = logged(tmp_path, "jammed.csv", flown(faults={"rudder": Stuck(20.0)}))
    target = tmp_path / "calibrated.toml"
    assert main(["calibrate", jammed, "-c", config, "-o", str(target)]) == 2
    error = capsys.readouterr().err
    # Named for certain or not: the jam is among what it may be, and its time is told.
    told = re.search(
        r"rudder: not a good flight: jammed.csv: (.*) since ([0-9.]+) s(.*?);.* leave that part out", error
    )
    assert told is not None
    assert "stuck" in told[0]
    assert 15.0 < float(told[2]) <= 20.5
    assert error.count("\n") == 1
    assert not target.exists()
    assert main(["calibrate", jammed, "-c", config, "-o", str(target), "--between", "0:18"]) == 0


@pytest.mark.slow
def test_bad_input_is_told_in_a_sentence(tmp_path: Path, config: str, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    flight = flown()
    time_s, command_deg, measured_deg = flight.time_s, flight.command_deg[:, 0], flight.measured_deg[:, 0]
    cases = {
        "rest.csv": ((time_s, 0.1 * np.sin(time_s), 0.1 * rng.standard_normal(time_s.size)), "moves by 0.2 deg only"),
        "noise.csv": ((time_s, command_deg, rng.standard_normal(time_s.size)), "does not follow its command"),
        "swapped.csv": ((time_s, measured_deg, command_deg), "before the command"),
        "clipped.csv": ((time_s, command_deg, np.clip(measured_deg, -2.0, 2.0)), "of travel, the position shows"),
        "units.csv": ((time_s, command_deg, 10.0 * measured_deg), "by 10 times its command"),
    }
    for name, (columns, words) in cases.items():
        target = tmp_path / "calibrated.toml"
        assert main(["calibrate", written(tmp_path, name, *columns), "-c", config, "-o", str(target)]) == 2, name
        error = capsys.readouterr().err
        assert words in error, (name, error)
        assert error.count("\n") == 1
        assert not target.exists()


@pytest.mark.slow
@pytest.mark.parametrize("every", [1, 10])
def test_without_a_file_the_aircraft_is_drafted_and_ten_hertz_will_do(tmp_path: Path, every: int) -> None:
    flight = flown(duration_s=60.0)
    rows = slice(None, None, every)
    columns = flight.time_s[rows], flight.command_deg[rows, 0], flight.measured_deg[rows, 0]
    good, target = written(tmp_path, "good.csv", *columns), tmp_path / "plane.toml"
    assert main(["calibrate", good, "-o", str(target)]) == 0
    assert load_aircraft(target).surfaces["rudder"].calibrated is not None


@pytest.mark.slow
def test_a_rate_of_false_alarms_is_told_and_none_is_promised_that_was_not_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good = logged(tmp_path, "good.csv", flown())
    told = servofd.calibrate(good)
    assert f"about {told.false_alarms_per_hour:.2g} false alarms an hour" in told._repr_html_()
    command = ["calibrate", good, "-o", str(tmp_path / "plane.toml")]
    assert main([*command, "--false-alarms-per-hour", "0.001"]) == 0
    line = next(line for line in capsys.readouterr().out.splitlines() if "false alarms to expect:" in line)
    assert f"about {told.false_alarms_per_hour:.2g} an hour of this surface" in line
    assert line.endswith("0.001 cannot be promised")


@pytest.mark.slow
def test_two_aircraft_are_not_one(tmp_path: Path, config: str, capsys: pytest.CaptureFixture[str]) -> None:
    one, other = flown(1), flown(2)
    first = logged(tmp_path, "one.csv", one)
    second = written(tmp_path, "two.csv", other.time_s, other.command_deg[:, 0], 0.6 * other.measured_deg[:, 0])
    target = tmp_path / "calibrated.toml"
    assert main(["calibrate", first, second, "-c", config, "-o", str(target)]) == 2
    assert "not the same aircraft" in capsys.readouterr().err
    assert not target.exists()


@pytest.mark.parametrize("words", [["--between", "9:3"], ["--between", "x:9"], ["--false-alarms-per-hour", "0"]])
def test_wrong_options_are_told(words: list[str], config: str) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["calibrate", "a.csv", "-c", config, "-o", "b.toml", *words])
    assert stop.value.code == 2


@pytest.mark.slow
def test_a_file_that_would_miss_a_lost_third_is_written_by_force_only(
    tmp_path: Path, config: str, capsys: pytest.CaptureFixture[str]
) -> None:
    good = logged(tmp_path, "good.csv", flown(noise_deg=0.9, duration_s=60.0, command="calm", rate_hz=20.0))
    target = tmp_path / "calibrated.toml"
    asked = ["calibrate", good, "-c", config, "-o", str(target)]
    assert main(asked) == 2
    assert not target.exists()
    shown = capsys.readouterr().err
    assert shown.count("\n") == 1
    assert "third of its speed" in shown
    assert "--force" in shown
    assert main([*asked, "--force"]) == 0
    assert target.exists()


def test_a_log_is_not_overwritten(tmp_path: Path, config: str) -> None:
    good = logged(tmp_path, "good.csv", flown())
    assert main(["calibrate", good, "-c", config, "-o", good]) == 2


def swept(faults: dict[str, Stuck] | None = None) -> SimulatedFlight:
    return flown(command="steps", duration_s=15.0, faults=faults)


@pytest.mark.slow
def test_a_sweep_is_a_go_or_a_no_go(tmp_path: Path, config: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["audit", "--sweep", logged(tmp_path, "ground.csv", swept()), "-c", config]) == 0
    assert " go " in capsys.readouterr().out
    assert main(["audit", "--sweep", logged(tmp_path, "jam.csv", swept({"rudder": Stuck(5.0)})), "-c", config]) == 1
    assert "NO-GO" in capsys.readouterr().out


@pytest.mark.slow
def test_a_surface_that_was_not_moved_cannot_be_judged(
    tmp_path: Path, config: str, capsys: pytest.CaptureFixture[str]
) -> None:
    time_s = np.arange(0.0, 10.0, 0.01)
    command_deg = 1.0 * np.sin(time_s)
    measured_deg = plain_aircraft(["rudder"], "hs225bb-eq31").model("rudder").simulate(time_s, command_deg, time_s)
    log = written(tmp_path, "still.csv", time_s, command_deg, measured_deg + 0.02 * np.sin(50.0 * time_s))
    assert main(["audit", "--sweep", log, "-c", config]) == 2
    assert "move it at least ±3 deg" in capsys.readouterr().out


def test_a_sweep_measures_what_is_wrong(tmp_path: Path, config: str, capsys: pytest.CaptureFixture[str]) -> None:
    time_s = np.arange(0.0, 20.0, 0.01)
    command_deg = 15.0 * np.sin(3.0 * time_s) * np.sign(np.sin(0.7 * time_s))
    healthy_deg = plain_aircraft(["rudder"], "hs225bb-eq31").model("rudder").simulate(time_s, command_deg, time_s)
    noise_deg = 0.05 * np.random.default_rng(0).standard_normal(time_s.size)
    log = written(tmp_path, "weak.csv", time_s, command_deg, 0.94 * healthy_deg + noise_deg)
    code = main(["audit", "--sweep", log, "-c", config, "--json", "-"])
    document = json.loads(capsys.readouterr().out)
    rudder = document["surfaces"]["rudder"]
    assert document["schema"] == "servofd.sweep/1"
    assert (code, rudder["status"]) == (1, "no_go")
    assert rudder["numbers"]["gain"]["low"] <= 0.94 <= rudder["numbers"]["gain"]["high"]
    assert rudder["numbers"]["gain"]["value"] == pytest.approx(0.94, abs=0.003)


@pytest.mark.slow
def test_a_flight_outside_the_part_that_is_asked_for_is_left_out(
    tmp_path: Path, config: str, capsys: pytest.CaptureFixture[str]
) -> None:
    good, later = flown(), flown(seed=3)
    words = [
        logged(tmp_path, "good.csv", good),
        written(tmp_path, "later.csv", 100.0 + later.time_s, later.command_deg[:, 0], later.measured_deg[:, 0]),
    ]
    assert main(["calibrate", *words, "-c", config, "--between", "0:59", "-o", str(tmp_path / "new.toml")]) == 0
    assert main(["calibrate", words[1], "-c", config, "--between", "0:59", "-o", str(tmp_path / "no.toml")]) == 2
    assert "nothing was measured in the part that was chosen" in capsys.readouterr().err
