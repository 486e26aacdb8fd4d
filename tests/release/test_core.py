"""The core alone, as ``pip install servofd`` brings it: it judges, and names the part that is missing for the rest."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from servofd.cli import main
from servofd.core.errors import EXTRAS

SAMPLES = Path(__file__).parent.parent.parent / "sample_logs"
CODE = f"""
import importlib.machinery, sys
class Hidden(importlib.machinery.PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.partition(".")[0] in {set(EXTRAS)!r} else super().find_spec(name, path, target)
sys.meta_path = [one for one in sys.meta_path if one is not importlib.machinery.PathFinder] + [Hidden]
from servofd.cli import main
sys.exit(main(sys.argv[1:]))
"""


def core(folder: Path, *words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", CODE, *map(str, words)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.nightly
def test_the_core_judges_a_flight_a_folder_and_a_table(tmp_path: Path) -> None:
    run = core(tmp_path, SAMPLES / "faser_stuck_flight.mat", "-o", "out")
    assert run.returncode == 1
    assert run.stdout.startswith("ELEVATOR JAMMED at 0:05 (-0.2 deg). Do not fly. → out/faser_stuck_flight.html")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"audit.json", "faser_stuck_flight.html"}
    assert run.stderr.startswith("servofd: no figures, no recording: this needs matplotlib, which is not installed")
    assert core(tmp_path, "simulate", "-o", "flights/a.csv", "--duration", "12").returncode == 2  # no such folder
    (tmp_path / "flights").mkdir()
    assert core(tmp_path, "simulate", "-o", "flights/a.csv", "--duration", "12").returncode == 0
    run = core(tmp_path, "flights", "--workers", "1")
    assert "flights/servofd/fleet.html" in run.stdout
    assert "Traceback" not in run.stderr


@pytest.mark.parametrize("verb", ["audit", "info", "config", "explain", "identify", "audit --sweep", "calibrate"])
def test_an_hdf5_log_without_its_package_is_refused_in_one_line(
    verb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)  # as if it were not installed
    log = tmp_path / "flight.mat"
    log.write_bytes(b"\x89HDF\r\n\x1a\n".ljust(600, b"\0"))
    rest = ["-o", str(tmp_path / "plane.toml")] if verb == "calibrate" else []
    assert main([*verb.split(), str(log), *rest]) == 2
    said = f'servofd: {log}: this needs h5py, which is not installed: pip install "servofd[{EXTRAS["h5py"]}]"'
    assert capsys.readouterr().err.splitlines() == [said]


@pytest.mark.parametrize("words", [["audit"], ["trend", "-c", "faser"]])
def test_an_address_without_its_package_is_refused_in_one_line(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "fsspec", None)
    assert main([*words, "s3://club/flights"]) == 2
    hint = f'this needs fsspec, which is not installed: pip install "servofd[{EXTRAS["fsspec"]}]"'
    assert capsys.readouterr().err.splitlines() == [f"servofd: s3://club/flights: {hint}"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "package"),
    [
        (["serve"], "starlette"),
        pytest.param(["audit", "LOG", "--rrd", "a.rrd"], "rerun", marks=pytest.mark.nightly),
        pytest.param(["audit", "FOLDER", "-o", "results", "--workers", "1"], "pyarrow", marks=pytest.mark.nightly),
    ],
)
def test_what_is_missing_is_named_in_one_line(words: list[str], package: str, tmp_path: Path) -> None:
    (tmp_path / "FOLDER").mkdir()
    for place in (tmp_path / "LOG", tmp_path / "FOLDER" / "a.mat"):
        place.write_bytes((SAMPLES / "faser_stuck_flight.mat").read_bytes())
    run = core(tmp_path, *words)
    assert run.returncode == 2
    lines = [line for line in run.stderr.splitlines() if "interrupted" not in line]
    assert lines == [f'servofd: this needs {package}, which is not installed: pip install "servofd[{EXTRAS[package]}]"']
