"""Reading recordings back: the same verdicts, other thresholds, incidents, comparisons, fleets, damage."""

from __future__ import annotations

import getpass
import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servofd.cli import main
from servofd.outputs.recording.read import read_recording
from tests.recordings.inside import everything

ROOT = Path(__file__).parent.parent.parent
SAMPLES = ROOT / "sample_logs"
STUCK = SAMPLES / "faser_stuck_flight.mat"


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings of three logs, and what the audits said; only read."""
    folder = tmp_path_factory.mktemp("fleet")
    for name in ("faser_stuck_flight.mat", "table_three_faults.csv", "faser_healthy_flight.mat"):
        stem = folder / Path(name).stem
        main(["audit", str(SAMPLES / name), "--rrd", f"{stem}.rrd", "--json", f"{stem}.json"])
    return folder


@pytest.fixture
def stuck(folder: Path) -> Path:
    return folder / "faser_stuck_flight.rrd"


def reviewed(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, Any, str]:
    capsys.readouterr()
    code = main(["review", *arguments, "--json", "-"])
    shown = capsys.readouterr()
    return code, json.loads(shown.out) if shown.out else None, shown.err


@pytest.mark.slow
@pytest.mark.parametrize("name", ["faser_stuck_flight", "table_three_faults", "faser_healthy_flight"])
def test_review_says_what_the_audit_said(name: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, document, complaints = reviewed([str(folder / f"{name}.rrd")], capsys)
    (audited,) = json.loads((folder / f"{name}.json").read_text())["logs"]
    (log,) = document["logs"]
    assert document["schema"] == "servofd.audit/1"
    assert log["path"] == Path(audited.pop("path")).name
    assert {key: log[key] for key in audited} == audited
    assert code == int("healthy" not in name)
    assert complaints == ""
    alarms = {f["alarm_s"] for s in audited["surfaces"].values() for f in s["faults"]}
    assert alarms == {e["time_s"] for e in log["events"] if e["level"] == "ERROR"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("table_three_faults.csv", ["--threshold", "interval"]),
        ("faser_stuck_flight.mat", ["--threshold-deg", "0.8"]),
        *(
            pytest.param(name, ["--threshold", "interval"], marks=pytest.mark.nightly)
            for name in ("faser_stuck_flight.mat", "ardupilot_volz_stuck.bin", "telemetry_stuck.tlog")
        ),
    ],
)
def test_judging_again_gives_what_an_audit_would(
    name: str, options: list[str], folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = folder / f"{Path(name).stem}.rrd", tmp_path / "second.rrd"
    if not first.exists():
        first = tmp_path / "first.rrd"
        main(["audit", str(SAMPLES / name), "--rrd", str(first)])
    main(["audit", str(SAMPLES / name), *options, "--rrd", str(second), "--json", str(tmp_path / "audit.json")])
    code, document, _ = reviewed([str(first), *options, "-o", str(tmp_path / "again.rrd")], capsys)
    (wanted,) = json.loads((tmp_path / "audit.json").read_text())["logs"]
    assert rounded(document["logs"][0]["surfaces"]) == rounded(wanted["surfaces"])
    assert code == int(any(s["faults"] for s in wanted["surfaces"].values()))
    once, again = read_recording(second), read_recording(tmp_path / "again.rrd")
    for curve in ("simulated_deg", "residual_deg", "threshold_deg"):
        for surface, trace in once.traces.items():
            np.testing.assert_array_equal(getattr(again.traces[surface], curve), getattr(trace, curve))
    assert main(["review", str(second), "--compare", str(tmp_path / "again.rrd")]) == code
    assert "The same verdicts." in capsys.readouterr().out


def rounded(value: Any) -> Any:
    """Numbers with nine digits: sums in another order differ in their last."""
    if isinstance(value, dict):
        return {key: rounded(each) for key, each in value.items()}
    if isinstance(value, list):
        return [rounded(each) for each in value]
    return float(f"{value:.9g}") if isinstance(value, float) else value


@pytest.mark.slow
def test_two_recordings_stand_beside_each_other(
    stuck: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other.rrd"
    assert main(["review", str(stuck), "--threshold-deg", "20", "-o", str(other)]) in (0, 2)
    code, document, _ = reviewed([str(stuck), "--compare", str(other)], capsys)
    assert code == 1
    assert document["schema"] == "servofd.compare/1"
    assert [one["threshold"]["deg"] for one in document["surfaces"]["elevator"]] == [1.5, 20.0]
    assert document["surfaces"]["elevator"][0]["status"] == "fault"


@pytest.mark.slow
@pytest.mark.parametrize(("span", "status", "code"), [(("6", "12"), "fault", 1), (("0", "4"), "healthy", 0)])
def test_an_incident_is_cut_out(
    span: tuple[str, str], status: str, code: int, stuck: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    part = tmp_path / "part.rrd"
    main(["review", str(stuck), "--between", *span, "-o", str(part)])
    capsys.readouterr()
    found, document, complaints = reviewed([str(part)], capsys)
    assert document["logs"][0]["surfaces"]["elevator"]["status"] == status
    assert document["logs"][0]["duration_s"] == pytest.approx(float(span[1]) - float(span[0]), abs=0.011)
    assert document["logs"][0]["notes"][0].startswith(f"cut from {span[0]} to {span[1]} s")
    assert complaints == ""
    whole, cut = read_recording(stuck).traces["elevator"], read_recording(part).traces["elevator"]
    inside = (whole.time_s >= float(span[0])) & (whole.time_s <= float(span[1]))
    assert cut.measured_deg.tobytes() == whole.measured_deg[inside].tobytes()
    # Flaps are expected in no log of this aircraft, so that they do not make the verdict doubtful.
    assert found == code


@pytest.mark.slow
def test_a_folder_is_a_fleet(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert main(["review", str(folder)]) == 1
    table = capsys.readouterr().out
    assert table.startswith("2 of 3 logs show a fault.")
    for name in ("faser_stuck_flight.rrd", "table_three_faults.rrd", "faser_healthy_flight.rrd", "JAMMED at"):
        assert name in table


def test_one_bad_recording_does_not_stop_the_others(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = tmp_path / "bad.rrd"
    bad.write_bytes(b"")
    code, document, complaints = reviewed([str(folder / "faser_stuck_flight.rrd"), str(bad)], capsys)
    assert code == 1
    assert [log["error"] is None for log in document["logs"]] == [True, False]
    assert complaints.count("\n") == 1


def of_another_program(path: Path) -> None:
    import rerun as rr

    with rr.RecordingStream("somebody", send_properties=True) as stream:
        stream.save(str(path))
        stream.set_time("time_boot", duration=1.0)
        stream.log("/x", rr.Scalars(1.0))


def with_properties(path: Path, **properties: Any) -> None:
    import rerun as rr

    with rr.RecordingStream("servofd", send_properties=False) as stream:
        stream.save(str(path))
        stream.send_property("servofd", rr.AnyValues(**properties))


def without_data(path: Path) -> None:
    import rerun as rr

    with rr.RecordingStream("nothing", send_properties=False) as stream:
        stream.save(str(path))


BAD = {
    "another program": (of_another_program, "not a recording of servofd"),
    "an older servofd": (lambda p: with_properties(p, source="a.mat", faults=1), "an older servofd"),
    "a newer servofd": (lambda p: with_properties(p, schema="servofd.recording/9"), "servofd.recording/9"),
    "spoilt verdicts": (lambda p: with_properties(p, schema="servofd.recording/1", verdicts="{"), "cannot be read"),
    "no data": (without_data, "empty recording"),
    "empty": (lambda p: p.write_bytes(b""), "the file is empty"),
    "text": (lambda p: p.write_text("time_s,a\n"), "not a Rerun recording"),
    "only a header": (lambda p: p.write_bytes(b"RRF2"), "cut short or damaged"),
    "missing": (lambda _: None, "No such file"),
    "a folder without any": (lambda p: p.mkdir(), "no recording (.rrd) in this folder"),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_recordings_are_one_line(what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make, words = BAD[what]
    path = tmp_path / "bad.rrd"
    make(path)
    assert main(["review", str(path)]) == 2
    shown = capsys.readouterr()
    assert words in shown.err
    assert shown.err.count("\n") == 1
    assert shown.out == ""


@pytest.mark.slow
def test_a_truncated_recording_is_repaired(stuck: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    half, fixed = tmp_path / "half.rrd", tmp_path / "fixed.rrd"
    content = stuck.read_bytes()
    half.write_bytes(content[: len(content) // 2])
    code, _, complaints = reviewed([str(half)], capsys)
    assert code == 2
    assert "--repair -o" in complaints
    code, document, complaints = reviewed([str(half), "--repair", "-o", str(fixed)], capsys)
    assert code == 1
    assert document["logs"][0]["surfaces"]["elevator"]["status"] == "fault"
    assert "incomplete or altered" in complaints
    subprocess.run([sys.executable, "-m", "rerun", "rrd", "verify", str(fixed)], check=True, capture_output=True)


@pytest.mark.slow
def test_a_recording_of_a_killed_process_is_read_and_repaired(tmp_path: Path) -> None:
    path, fixed = tmp_path / "killed.rrd", tmp_path / "fixed.rrd"
    code = f"""
import os, signal, servofd
from servofd.outputs.recording.stream import Clock
from servofd.outputs.recording.stream import Recorder
from servofd.outputs.recording.write import fill, recording_of
import rerun as rr
stream = rr.RecordingStream("servofd-killed", send_properties=False)
stream.save({str(path)!r})
fill(Recorder(stream), recording_of(*servofd.audit({str(STUCK)!r})))
stream.flush()
os.kill(os.getpid(), signal.SIGKILL)
"""
    dead = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False, cwd=ROOT)
    assert dead.returncode == -signal.SIGKILL
    assert read_recording(path).audit.has_fault
    assert main(["review", str(path), "--repair", "-o", str(fixed)]) == 1
    assert (
        subprocess.run(
            [sys.executable, "-m", "rerun", "rrd", "verify", str(path)], check=False, capture_output=True
        ).returncode
        != 0
    )
    subprocess.run([sys.executable, "-m", "rerun", "rrd", "verify", str(fixed)], check=True, capture_output=True)
    whole, saved = read_recording(path), read_recording(fixed)
    assert saved.audit.surfaces == whole.audit.surfaces
    assert saved.traces["elevator"].residual_deg.tobytes() == whole.traces["elevator"].residual_deg.tobytes()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["-o", "x.rrd"], "name one of them"),
        (["--repair"], "needs -o"),
        (["--between", "9", "3", "-o", "x.rrd"], "before the second"),
        (["--between", "900", "950", "-o", "x.rrd"], "the recording runs from"),
        (["--threshold", "interval", "--threshold-deg", "1"], "constant threshold"),
        (["--threshold-deg", "1", "-o", "no/such/x.rrd"], "does not exist"),
        (["--compare", "no.rrd"], "No such file"),
    ],
)
def test_what_cannot_be_done_is_one_line(
    options: list[str],
    words: str,
    stuck: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    assert main(["review", str(stuck), *options]) == 2
    shown = capsys.readouterr()
    assert words in shown.err
    assert shown.err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_recording_is_never_overwritten_by_its_own_review(stuck: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = stuck.read_bytes()
    assert main(["review", str(stuck), "--threshold-deg", "1", "-o", str(stuck)]) == 2
    assert "choose another file" in capsys.readouterr().err
    assert stuck.read_bytes() == before


@pytest.mark.slow
def test_positions_stay_at_home(tmp_path: Path) -> None:
    log = SAMPLES / "ardupilot_volz_stuck.bin"
    path = tmp_path / "a.rrd"
    main(["audit", str(log), "--rrd", str(path)])
    said = everything(path)
    for secret in ("-93.07", str(ROOT), str(Path.home()), getpass.getuser() + "@"):  # the first is where it flew
        assert secret not in said
        assert "stuck at" in said  # it does see what is there


def test_view_needs_a_display(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    if not sys.platform.startswith("linux"):
        pytest.skip("elsewhere there always is one")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert main(["review", "--view", str(STUCK)]) == 2
    assert "no display" in capsys.readouterr().err


@pytest.mark.slow
def test_view_opens_recordings_and_logs(
    stuck: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    opened = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr("servofd.cli.view.open_viewer", lambda path: opened.append(read_recording(path)))
    assert main(["review", "--view", str(stuck)]) == 0
    assert main(["review", "--view", str(STUCK)]) == 0
    assert opened[0].audit.surfaces == opened[1].audit.surfaces
    assert "stuck at" in capsys.readouterr().out
    assert main(["review", "--view", "no.bin"]) == 2


@pytest.mark.slow
def test_view_gives_the_viewer_names_that_it_can_draw(
    stuck: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(
        "servofd.cli.view.open_viewer",
        lambda path: opened.append((path.name, read_recording(path).audit.has_fault)),
    )
    for source in (stuck, STUCK):
        odd = tmp_path / f"飛行{source.suffix}"
        odd.write_bytes(source.read_bytes())
        assert main(["review", "--view", str(odd)]) == 0
    assert opened == [("U+98DBU+884C.rrd", True)] * 2


def test_the_viewer_that_fails_is_one_line(
    stuck: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DISPLAY", ":77")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert main(["review", "--view", str(stuck)]) == 2
    shown = capsys.readouterr().err
    assert "could not be opened" in shown
    assert shown.count("\n") == 1
