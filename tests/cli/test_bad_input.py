"""Whatever a user gets wrong: one clear line on stderr, exit code 2, nothing written half."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from servofd.cli import main

if TYPE_CHECKING:
    from collections.abc import Callable

SAMPLES = Path(__file__).parent.parent.parent / "sample_logs"
PNG = b"\x89PNG\r\n\x1a\n" + bytes(200)


def table(rows: int = 600, **columns: object) -> str:
    """A healthy plain table of one surface, with some columns replaced."""
    time_s = np.arange(rows) * 0.01
    values: dict[str, object] = {"time_s": time_s, "elevator_cmd_deg": 5 * np.sin(time_s)}
    values["elevator_pos_deg"] = 5 * np.sin(time_s - 0.058)
    values |= columns
    lines = [",".join(values)]
    lines += [",".join(str(np.asarray(v)[k]) for v in values.values()) for k in range(rows)]
    return "\n".join(lines) + "\n"


def with_text_in_a_cell() -> str:
    lines = table().splitlines()
    lines[100] = lines[100].rsplit(",", 1)[0] + ",broken"
    return "\n".join(lines) + "\n"


def commands_only(path: Path) -> None:
    """RAPTRS log: HDF5 with commands, and no position."""
    import h5py

    with h5py.File(path, "w") as file:
        file["/Sensors/Fmu/Time_us"] = np.arange(500) * 20_000
        file["/Control/cmdElev_rad"] = 0.1 * np.sin(np.arange(500) / 50.0)


LOGS: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "missing file": ("no_such_file.csv", lambda _path: None, "no such file"),
    "folder": ("folder", lambda path: path.mkdir(), "folder"),
    "empty file": ("empty.csv", lambda path: path.write_bytes(b""), "empty"),
    "picture named .mat": ("picture.mat", lambda path: path.write_bytes(PNG), "PNG"),
    "truncated .mat": (
        "cut.mat",
        lambda path: path.write_bytes((SAMPLES / "faser_stuck_flight.mat").read_bytes()[:100_001]),
        "the file ends inside",
    ),
    "header only": ("header.csv", lambda path: path.write_text(table(0)), "no "),
    "text in a cell": ("text.csv", lambda path: path.write_text(with_text_in_a_cell()), "broken"),
    "time backwards": (
        "back.csv",
        lambda path: path.write_text(table(time_s=np.arange(600)[::-1] * 0.01)),
        "backwards",
    ),
    "clock set back": (
        "reset.csv",
        lambda path: path.write_text(table(time_s=np.arange(600) * 0.01 - 3.0 * (np.arange(600) > 300))),
        "backwards",
    ),
    "position never measured": (
        "nan.csv",
        lambda path: path.write_text(table(elevator_pos_deg=np.full(600, np.nan))),
        "no value",
    ),
    "position never changes": (
        "constant.csv",
        lambda path: path.write_text(table(elevator_pos_deg=np.zeros(600))),
        "never changes",
    ),
    "position is the command": (
        "echo.csv",
        lambda path: path.write_text(table(elevator_pos_deg=5 * np.sin(np.arange(600) * 0.01))),
        "echo",
    ),
    "no surfaces": ("plain.csv", lambda path: path.write_text("time_s,a\n0,1\n1,2\n"), "_cmd_deg"),
    "command never moves": (
        "quiet.csv",
        lambda path: path.write_text(
            table(elevator_cmd_deg=np.zeros(600), elevator_pos_deg=0.1 * np.sin(np.arange(600)))
        ),
        "too little motion",
    ),
    "too slow": (
        "slow.csv",
        lambda path: path.write_text(table(time_s=np.arange(600) * 0.2)),
        "5 Hz",
    ),
    "commands only": ("raptrs.h5", commands_only, "no measured deflection"),
    "one sample": ("one.csv", lambda path: path.write_text(table(1)), "holds a single value: not a measurement"),
}


def one_line(text: str) -> str:
    (line,) = text.strip().splitlines()
    assert "Traceback" not in text
    return line


@pytest.mark.parametrize("name", LOGS)
def test_bad_logs(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file_name, make, expected = LOGS[name]
    path = tmp_path / file_name
    make(path)
    assert main(["audit", str(path)]) == 2
    line = one_line(capsys.readouterr().err)
    assert expected in line
    assert file_name in line


CONFIGS = {
    "not toml": ("surfaces = [", "not valid TOML"),
    "empty": ("", "surfaces: at least one entry is needed"),
    "unknown key": ("[surfaces.elevator]\nservoo='x'\ncommand={channel='de',unit='deg'}", "did you mean servo?"),
    "unknown key of its motion": (
        "[motion]\nrate_hz=25.0\nreference_m_s=20.0\ndays=1\nflights=1\nhours=1.0\n"
        "[motion.regime]\nairspeed_low_m_s=10.0\nairspeed_high_m_s=30.0\nthrottle_low=0.1\nlift_m_s2=20.0\n"
        "lift_high_m_s2=20.0\n[motion.axes.roll]\nform='roll_rate'\ncorner_hz=1.0\ndelay_s=0.1\ngain=1.0\n"
        "offset=0.0\nothers=[0.0,0.0,0.0,0.0]\nnoise_var=1.0\nexplained=0.9\n[[motion.axes.roll.spreads]]\n"
        "window_s=5.0\nloss_var=0.01\ncross_us=0.0\noffset_var_us2=1.0",
        "motion.regime.lift_m_s2: unknown key; did you mean lift_high_m_s2? known: airspeed_low_m_s",
    ),
    "unknown key of a channel": (
        "[surfaces.elevator]\ncommand={channel='de',unit='us',slope_deg_per_us=0.1,trim_deg=1.0}",
        "surfaces.elevator.command.trim_deg: unknown key; did you mean trim_us?",
    ),
    "unknown servo": ("[surfaces.elevator]\nservo='hs999'\ncommand={channel='de',unit='deg'}", "unknown servo 'hs999'"),
    "no unit": ("[surfaces.elevator]\ncommand={channel='de'}", "unit"),
    "bad unit": ("[surfaces.elevator]\ncommand={channel='de',unit='inch'}", "'inch'"),
    "no slope": ("[surfaces.elevator]\ncommand={channel='de',unit='us'}", "slope_deg_per_us"),
    "upside down": (
        "[surfaces.elevator]\ncommand={channel='de',unit='deg'}\ncommand_saturation_deg=[25.0,-25.0]",
        "lower < upper",
    ),
    "text for a number": (
        "[surfaces.elevator]\ncommand={channel='de',unit='deg'}\nthreshold_deg='low'",
        "surfaces.elevator.threshold_deg",
    ),
    "unstable servo": (
        "[servos.mine]\ntitle='x'\nnumerator=[1.0]\ndenominator=[1.0,-1.0]\ndelay_s=0.0\nhold='zoh'\nsource='x'\n"
        "[surfaces.elevator]\nservo='mine'\ncommand={channel='de',unit='deg'}",
        "negative real parts",
    ),
    "misspelt channel": (
        "[surfaces.elevator]\ncommand={channel='elevatr_cmd_deg',unit='deg'}\n"
        "measured={channel='elevator_pos_deg',unit='deg'}",
        "elevator_cmd_deg",
    ),
}


@pytest.mark.parametrize("name", CONFIGS)
def test_bad_aircraft_files(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content, expected = CONFIGS[name]
    log, config = tmp_path / "good.csv", tmp_path / "plane.toml"
    log.write_text(table())
    config.write_text(content)
    assert main(["audit", str(log), "-c", str(config), "-o", str(tmp_path / "out")]) == 2
    assert expected in one_line(capsys.readouterr().err)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["audit", "good.csv", "--servo", "hs999"], "unknown servo 'hs999'"),
        (["audit", "good.csv", "-s", "elevtor"], "did you mean elevator?"),
        (["audit", "good.csv", "-c", "nowhere.toml"], "nowhere.toml"),
        (["audit", "good.csv", "-c", "fasr"], "did you mean faser?"),
        (["audit", "good.csv", "--json", "no/such/folder/a.json"], "does not exist"),
        (["audit", "good.csv", "--rrd", "no/such/folder/a.rrd"], "does not exist"),
        (["audit", "good.csv", "-o", "good.csv"], "is a file; give the name of a folder"),
        (["audit", "good.csv", "good.csv", "--rrd", "a.rrd"], "one log at a time"),
        (["simulate", "-o", "a.xyz"], ".csv"),
        (["simulate", "-o", "no/such/folder/a.csv"], "cannot write here"),
        (["simulate", "-o", "a.csv", "--fault", "elevtor:stuck@1"], "did you mean elevator?"),
        (["simulate", "-o", "a.csv", "--fault", "elevator:stuk@1"], "did you mean stuck?"),
        (["simulate", "-o", "a.csv", "--fault", "elevator"], "SURFACE:KIND@START"),
        (["simulate", "-o", "a.csv", "--fault", "elevator:stuck@soon"], "start_s=soon"),
        (["simulate", "-o", "a.csv", "--fault", "elevator:deadband@1:width=2"], "width_deg"),
        (["simulate", "-o", "a.csv", "--fault", "elevator:deadband@1:width_deg=-2"], "positive"),
        (["simulate", "-o", "a.csv", "--fault", "elevator:slow@1:bandwidth_scale=2"], "at most 1"),
        (["simulate", "-o", "a.csv", "--fault", "elevator:bias@1:end_s=soon"], "end_s=soon"),
        (["simulate", "-o", "a.csv", "--effect", "elevator:delai:delay_s=1"], "did you mean delay?"),
        (["simulate", "-o", "a.csv", "--effect", "elevator:delay"], "delay_s: give it too, a number from"),
        (["simulate", "-o", "a.csv", "--effect", "elevator:delay:delay_s=-1"], "between 0 and 0.5"),
        (["simulate", "-o", "a.csv", "--command", "loop"], "unknown command 'loop'"),
        (["simulate", "-o", "a.csv", "--duration", "-3"], "positive duration"),
        (["simulate", "-o", "a.csv", "--duration", "nan"], "positive duration"),
        (["simulate", "-o", "a.csv", "--seed", "-1"], "zero or more"),
        (["simulate", "-o", "a.csv", "-c", "faser", "--servo", "x"], "unknown servo"),
        (["simulate", "-o", "a.bin", "--generation", "volts"], "did you mean volz?"),
        (["simulate", "-o", "a.tlog", "--generation", "volz"], "belongs to a .bin"),
        (["simulate", "-o", "a.bin", "--fault", "elevtor:stuck@1"], "did you mean elevator?"),
        (["config", "--filter", "hs225"], "unknown servo"),
        (["config", "--filter", "s9254", "--pole", "0"], "pole"),
        (["config", "--filter", "s9254", "--rate-hz", "0"], "rate"),
    ],
)
def test_bad_requests(
    arguments: list[str],
    expected: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "good.csv").write_text(table())
    assert main(arguments) == 2
    assert expected in one_line(capsys.readouterr().err)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["good.csv"]


@pytest.mark.parametrize(
    "arguments",
    [["audit"], ["audit", "a.csv", "--threshold-deg", "-1"], ["nonsense"], [], ["config", "--servos", "--colour"]],
)
def test_wrong_calls(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    assert "--help" in one_line(capsys.readouterr().err)


@pytest.mark.slow
def test_one_bad_log_does_not_stop_the_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = tmp_path / "good.csv"
    good.write_text(table())
    stuck = shutil.copy(SAMPLES / "faser_stuck_flight.mat", tmp_path)
    assert (
        main(["audit", str(good), str(tmp_path / "gone.csv"), str(stuck)]) == 1
    )  # a fault anywhere outranks what could not be told
    captured = capsys.readouterr()
    assert "gone.csv" in one_line(captured.err)
    assert "healthy" in captured.out
    assert "fault" in captured.out
