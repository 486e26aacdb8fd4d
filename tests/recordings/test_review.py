"""Reading recordings back: the same verdicts, comparisons, fleets, damage."""

from __future__ import annotations

import getpass
import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

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
        some = ["-s", "elevator", "-s", "rudder"] if name.endswith(".csv") else []  # whose servos are fitted
        main(["audit", str(SAMPLES / name), *some, "--rrd", f"{stem}.rrd", "--json", f"{stem}.json"])
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
def test_two_recordings_stand_beside_each_other(
    stuck: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other.rrd"
    main(["audit", str(STUCK), "--threshold-deg", "20", "--rrd", str(other)])
    code, document, _ = reviewed([str(stuck), "--compare", str(other)], capsys)
    assert code == 1
    assert document["schema"] == "servofd.compare/1"
    assert [one["threshold"]["deg"] for one in document["surfaces"]["elevator"]] == [1.5, 20.0]
    assert document["surfaces"]["elevator"][0]["status"] == "fault"
    assert main(["review", str(stuck), "--compare", str(stuck)]) == 1
    assert "The same verdicts." in capsys.readouterr().out


@pytest.mark.slow
def test_a_folder_is_a_fleet(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert main(["review", str(folder)]) == 1
    table = capsys.readouterr().out
    assert table.startswith("2 of 3 logs show a fault.")
    for name in ("faser_stuck_flight.rrd", "table_three_faults.rrd", "faser_healthy_flight.rrd", "JAMMED at"):
        assert name in table


@pytest.mark.slow
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
def test_of_a_truncated_recording_what_is_whole_is_read(
    stuck: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    half = tmp_path / "half.rrd"
    content = stuck.read_bytes()
    half.write_bytes(content[: len(content) // 2])
    code, document, complaints = reviewed([str(half)], capsys)
    assert code == 1
    assert document["logs"][0]["surfaces"]["elevator"]["status"] == "fault"
    assert "incomplete or altered" in complaints


@pytest.mark.nightly
def test_a_recording_of_a_killed_process_is_read(tmp_path: Path) -> None:
    path = tmp_path / "killed.rrd"
    code = f"""
import os, signal, servofd
from servofd.outputs.recording.stream import Recorder
from servofd.outputs.recording.content import Recording
from servofd.outputs.recording.write import fill
import rerun as rr
stream = rr.RecordingStream("servofd-killed", send_properties=False)
stream.save({str(path)!r})
fill(Recorder(stream), Recording.of(*servofd.audit({str(STUCK)!r})))
stream.flush()
os.kill(os.getpid(), signal.SIGKILL)
"""
    dead = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False, cwd=ROOT)
    assert dead.returncode == -signal.SIGKILL
    assert read_recording(path).audit.has_fault
    assert main(["review", str(path)]) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "words"),
    [
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


@pytest.mark.slow
def test_positions_stay_at_home(tmp_path: Path) -> None:
    log = SAMPLES / "ardupilot_volz_stuck.bin"
    path = tmp_path / "a.rrd"
    main(["audit", str(log), "-c", "simulated", "--rrd", str(path)])
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
    monkeypatch.setattr("servofd.cli.review.open_viewer", lambda path: opened.append(read_recording(path)))
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
        "servofd.cli.review.open_viewer",
        lambda path: opened.append((path.name, read_recording(path).audit.has_fault)),
    )
    for source in (stuck, STUCK):
        odd = tmp_path / f"飛行{source.suffix}"
        odd.write_bytes(source.read_bytes())
        assert main(["review", "--view", str(odd)]) == 0
    assert opened == [("U+98DBU+884C.rrd", True)] * 2


@pytest.mark.slow
def test_the_viewer_that_fails_is_one_line(
    stuck: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DISPLAY", ":77")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert main(["review", "--view", str(stuck)]) == 2
    shown = capsys.readouterr().err
    assert "could not be opened" in shown
    assert shown.count("\n") == 1
