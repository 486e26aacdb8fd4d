"""``--html`` and what the audit prints, on every terminal."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

import servofd
from logparsers.records import Text
from servofd.aircraft.schema import plain_aircraft
from servofd.cli import main
from servofd.cli.terminal import check_targets, print_document, print_table
from servofd.detection.audit import audit_log
from servofd.detection.verdict import Fault, LogAudit, SurfaceAudit, meaning, next_step
from servofd.feedback.flown import flown_aircraft, one_log
from servofd.outputs.audit_report import audit_report
from servofd.outputs.page import html_page
from servofd.outputs.sentence import answers, sentence

SAMPLES = Path(__file__).parent.parent.parent / "sample_logs"
STUCK = str(SAMPLES / "faser_stuck_flight.mat")
KINDS = (
    "stuck",
    "bias",
    "hardover",
    "floating",
    "oscillation",
    "deadband",
    "slow",
    "intermittent",
    "loss_of_effectiveness",
    "unknown",
)


@pytest.mark.slow
def test_audit_writes_a_page_and_names_no_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "report.html"
    assert main(["audit", STUCK, "-s", "elevator", "--html", str(page)]) == 1
    capsys.readouterr()
    text = page.read_text()
    assert "ELEVATOR JAMMED at 0:05 (-0.2 deg). Do not fly." in text
    assert str(SAMPLES) not in text
    assert str(tmp_path) not in text


@pytest.mark.slow
def test_a_page_shows_what_the_autopilot_said_but_not_where_it_flew() -> None:
    said = Text(3.0, "Throttle armed"), Text(4.0, "Home -35.36326 149.16523"), Text(5.0, "Pixhawk 0039002A 3334510B")
    log = replace(one_log(SAMPLES / "ardupilot_volz_stuck.bin"), texts=said)
    one = ("elevator",)
    text = html_page(audit_report([audit_log(log, flown_aircraft(log, only=one), surfaces=one)]))
    assert "Throttle armed" in text
    assert "149.16523" not in text
    assert "0039002A" not in text


@pytest.mark.parametrize("verb", [["audit"], ["explain", "-s", "elevator"], ["identify"]])
@pytest.mark.parametrize(
    ("target", "says"),
    [
        ("no/such/folder/a.html", "does not exist"),
        ("folder", "is a folder"),
        ("missing.csv", "is .* already; choose another file"),
    ],
)
def test_an_output_that_cannot_be_written_stops_before_the_work(
    verb: list[str],
    target: str,
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The log does not exist: the complaint is about the output, so nothing was read before."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    assert main([verb[0], "missing.csv", *verb[1:], "--html", target]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert re.fullmatch(f"servofd: {target}: .*{says}.*\n", captured.err)


def test_a_folder_without_permission_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests may run as root, whom no permission stops."""
    monkeypatch.setattr("os.access", lambda *_: False)
    with pytest.raises(servofd.ServofdError, match="permission denied"):
        check_targets([str(tmp_path / "a.html")], {})


@pytest.fixture(scope="module")
def stuck() -> LogAudit:
    result: LogAudit
    (result,) = servofd.audit(STUCK)
    return result


def printed(audit: LogAudit, capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    print_document(audit_report([audit]))
    return capsys.readouterr().out


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    for name in ("NO_COLOR", "COLUMNS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm-256color")
    return monkeypatch


@pytest.mark.slow
@pytest.mark.parametrize("columns", [40, 80, 100, 200])
def test_no_line_is_wider_than_the_terminal_or_a_hundred_columns(
    columns: int, stuck: LogAudit, terminal: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    terminal.setenv("COLUMNS", str(columns))
    lines = [re.sub(r"\x1b\[[0-9;]*m", "", line).rstrip() for line in printed(stuck, capsys).splitlines()]
    assert max(map(len, lines)) <= min(columns, 100)
    words = " ".join(" ".join(lines).split())
    for surface in stuck.surfaces:
        assert surface.surface in words
    assert "do not fly" in words
    assert "ELEVATOR JAMMED at 0:05 (-0.2 deg). Do not fly." in words
    # The sentence is there in full, however it is folded.
    assert "stuckat-0.2degsince4.99s" in words.replace(" ", "")


@pytest.mark.parametrize("columns", [40, 100])
def test_other_tables_are_lists_on_a_narrow_terminal(
    columns: int, terminal: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    terminal.setenv("COLUMNS", str(columns))
    print_table(
        ["surface", "status", "mean", "max [deg]", "why"], [["elevator", "fault", "-0.145", "8.158", "stuck at"]]
    )
    shown = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    if columns == 40:
        assert shown == "elevator: fault\n  mean -0.145, max [deg] 8.158\n  stuck at\n"
    else:
        assert re.search(r"elevator +fault +-0.145 +8.158 +stuck at", shown)


@pytest.mark.slow
def test_colours_only_where_they_are_wanted(
    stuck: LogAudit, terminal: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    colour = re.compile(r"\x1b\[[0-9;]*(?:38;|[39][0-7])")
    assert colour.search(printed(stuck, capsys))
    terminal.setenv("NO_COLOR", "1")
    plain = printed(stuck, capsys)
    assert not colour.search(plain)
    assert "fault" in plain
    terminal.delenv("FORCE_COLOR")
    piped = printed(stuck, capsys)
    assert "\x1b" not in piped
    assert f"  elevator: {next_step(stuck.surfaces[0])}\n" in piped  # in a pipe no line is folded


@pytest.mark.parametrize("kind", KINDS)
def test_every_fault_has_a_meaning_and_a_next_step(kind: str) -> None:
    fault = Fault(kind, 1.0, 2.0, None, {}, 0.9, ())
    surface = SurfaceAudit("elevator", "fault", "", "x", "constant", 1.5, True, faults=(fault,))
    assert meaning(fault).endswith(".")
    assert next_step(surface).startswith("do not fly; on the ground, ")
    assert sentence([surface]).startswith("ELEVATOR ")
    assert sentence([surface]).endswith(". Do not fly.")


def test_the_verdict_never_hides_what_was_not_judged() -> None:
    healthy = SurfaceAudit("rudder", "healthy", "", "x", "constant", 1.5, True)
    unknown = SurfaceAudit("elevator", "unknown", "", "x", "constant", 1.5, True)
    suspect = SurfaceAudit("aileron", "suspect", "", "x", "constant", 1.5, True)
    assert sentence([unknown]).startswith("Could not tell. No verdict on elevator")
    assert sentence([healthy, unknown]).startswith("Rudder followed its command. No verdict on elevator")
    assert sentence([healthy, suspect]) == "AILERON SUSPECT: look at it before the next flight."
    assert next_step(unknown).startswith("no verdict")


@pytest.mark.slow
def test_what_rests_on_a_fitted_zero_says_so(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """The rudder of this log is off from 10 s on; a servo fitted to the log cannot know which part is right."""
    table = pd.read_csv(SAMPLES / "table_three_faults.csv")[["time_s", "rudder_cmd_deg", "rudder_pos_deg"]]
    table.to_csv(log := tmp_path / "rudder.csv", index=False)
    told = "its zero was fitted to this log: it may as well have been off by -2.5 deg until 0:10, and right since"
    main(["audit", str(log), "--html", str(tmp_path / "fitted.html")])
    assert told in capsys.readouterr().out
    assert told in (tmp_path / "fitted.html").read_text()
    main(["audit", str(log), "--servo", "hs225bb-eq31"])
    assert "was fitted" not in capsys.readouterr().out


def test_the_gravest_fault_heads_and_every_other_one_comes_with_what_to_do() -> None:
    """Whatever began first or lasts: a jam that passed is worse than play that stays, and a mere guess comes last."""
    slow = Fault("slow", 3.0, 3.5, None, {}, 0.3, ("bias", "deadband"))
    play = Fault("deadband", 5.0, 6.0, None, {}, 0.99, ())
    jam = Fault("stuck", 20.0, 20.4, 28.0, {}, 0.9, ("bias",))
    rudder = SurfaceAudit("rudder", "fault", "", "s9254", "constant", 1.5, True, faults=(slow, play, jam))
    assert sentence([rudder]) == "RUDDER JAMMED at 0:20. Do not fly."
    log = LogAudit(one_log(STUCK), plain_aircraft(["rudder"], "s9254"), (rudder,))
    (line,) = answers(log)
    assert line.startswith("Rudder: on the ground, move it from stop to stop and feel for binding;")
    first, second = line.partition(" It also ")[2].split("; ")
    assert (
        first == "ignores small commands since 0:05: move it in steps of 0.5 deg and look for steps it does not follow"
    )
    assert second.startswith("was too slow since 0:03: measure the supply")
