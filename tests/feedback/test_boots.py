"""Two boots in one file are two flights."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

import servofd
from servofd.cli import main


@pytest.mark.slow
def test_no_fault_spans_a_reboot_and_each_boot_is_judged_on_its_own(tmp_path: Path) -> None:
    parts = []
    for name, fault in (("first", ["--fault", "rudder:stuck@25"]), ("second", [])):
        path = tmp_path / f"{name}.bin"
        assert main(["simulate", "-o", str(path), "--duration", "40", *fault]) == 0
        parts.append(path.read_bytes())
    both = tmp_path / "both.bin"
    both.write_bytes(parts[0] + parts[1])
    first, second = servofd.audit(both, "simulated")
    assert (first.log.run, second.log.run) == ("boot 1", "boot 2")
    for result in (first, second):
        for surface in result.surfaces:
            assert surface.residuals is not None
            assert surface.judged_share > 0.9
            assert surface.residuals.time_s[-1] - surface.residuals.time_s[0] < 41.0
    assert [s.surface for s in first.surfaces if s.status == "fault"] == ["rudder"]
    assert not second.has_fault


def _two_boots(folder: Path, *, first: list[str], second: list[str]) -> Path:
    both = folder / "both.bin"
    parts = []
    for name, options in (("first", first), ("second", second)):
        assert main(["simulate", "-o", str(folder / f"{name}.bin"), *options]) == 0
        parts.append((folder / f"{name}.bin").read_bytes())
    both.write_bytes(b"".join(parts))
    return both


@pytest.mark.slow
def test_an_aircraft_is_drafted_from_the_longest_flight_of_a_log(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    both = _two_boots(tmp_path, first=["--duration", "20", "--seed", "3"], second=["--duration", "30"])
    drafts = []
    for path in (both, tmp_path / "second.bin"):
        capsys.readouterr()
        assert main(["config", str(path)]) == 0
        drafts.append(tomllib.loads(capsys.readouterr().out))
    of_both, of_second = drafts
    for name, surface in of_second["surfaces"].items():
        known = [each["calibrated"] for each in (of_both["surfaces"][name], surface)]
        gain, other = (each["parameters"]["gain"] for each in known)
        spread = np.sqrt(sum(each["between"][0][0] for each in known))
        assert abs(gain - other) < 3.0 * spread


@pytest.mark.slow
def test_each_boot_is_a_sweep_of_its_own_and_one_that_is_no_go_counts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sweep = ["--duration", "20", "--command", "chirp"]
    both = _two_boots(tmp_path, first=[*sweep, "--fault", "rudder:stuck@5"], second=sweep)
    capsys.readouterr()
    assert main(["audit", "--sweep", str(both), "-c", "simulated", "--json", "-"]) == 1
    last = json.loads(capsys.readouterr().out)
    (first,) = last["earlier_boots"]
    assert {name for name, one in first["surfaces"].items() if one["status"] == "no_go"} == {"rudder"}
    assert {one["status"] for one in last["surfaces"].values()} == {"go"}
    assert first["duration_s"] < 21.0
    assert last["duration_s"] < 21.0


@pytest.mark.slow
def test_a_sweep_that_begins_slowly_has_no_servo_of_its_own_there() -> None:
    """An elevator with a little play, which oscillated by the servo of the slow half."""
    (result,) = servofd.audit(Path(__file__).parents[2] / "sample_logs" / "hidden" / "hidden_11.csv")
    assert [surface.status for surface in result.surfaces] == ["healthy"]
