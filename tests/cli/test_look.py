"""``servofd FILE``: whatever it is given, it says in four lines what it comes to, and where the page is."""

from __future__ import annotations

import json
import re
import shutil
import webbrowser
from pathlib import Path

import pytest

from servofd.cli import main
from tests.fleet.conftest import in_line

SAMPLES = Path(__file__).parent.parent.parent / "sample_logs"


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    return Path(shutil.copy(SAMPLES / "faser_stuck_flight.mat", tmp_path / "flight.mat"))


def looked(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, list[str], str]:
    capsys.readouterr()
    code = main([str(word) for word in words])
    captured = capsys.readouterr()
    return code, captured.out.splitlines(), captured.err


@pytest.mark.slow
def test_a_log_becomes_a_sentence_and_a_page_beside_it(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, lines, err = looked(capsys, flight)
    page = flight.with_suffix(".html")
    assert (code, err) == (1, "")
    assert lines[0] == f"ELEVATOR JAMMED at 0:05 (-0.2 deg). Do not fly. → {page}"
    assert lines[1].startswith("Elevator: on the ground, move it")
    assert lines[2] == "Followed their commands: rudder, aileron left, aileron right."
    assert len(lines) == 3
    assert "<h1>ELEVATOR JAMMED at 0:05 (-0.2 deg). Do not fly.</h1>" in page.read_text()


@pytest.mark.slow
def test_it_is_the_audit_with_all_its_options(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["audit", str(flight), "-s", "elevator", "--json", "-"]) == 1
    audited = json.loads(capsys.readouterr().out)
    code, lines, _ = looked(capsys, "-s", "elevator", "--json", "-", flight, "--no-open")
    assert (code, json.loads("\n".join(lines))) == (1, audited)


@pytest.mark.slow
def test_a_page_of_something_else_is_never_written_over(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = flight.with_suffix(".html")
    other.write_text("my notes on this flight")
    for _ in range(2):
        _, lines, _ = looked(capsys, flight, "-s", "rudder")
        assert lines == [f"Rudder followed its command. → {flight}.html"]
    assert other.read_text() == "my notes on this flight"


@pytest.mark.slow
def test_a_page_goes_where_it_is_wanted(flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, lines, _ = looked(capsys, flight, "-s", "rudder", "-o", tmp_path / "out")
    assert (code, lines[0].rpartition(" → ")[2]) == (0, str(tmp_path / "out" / "flight.html"))
    assert (tmp_path / "out" / "audit.json").exists()
    code, lines, _ = looked(capsys, flight, "-s", "rudder", "--html", tmp_path / "mine.html")
    assert lines[0].endswith(f" → {tmp_path / 'mine.html'}")
    assert not flight.with_suffix(".html").exists()


@pytest.mark.slow
def test_a_folder_is_many_flights_with_a_page_each(
    flight: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("servofd.fleets.run.run_local", in_line)
    shutil.copy(SAMPLES / "table_three_faults.csv", flight.parent)
    words = [flight.parent, "--servo", "hs225bb-eq31"]
    code, lines, _ = looked(capsys, *words)
    folder = flight.parent / "servofd"
    assert code == 1
    assert lines[0] == f"2 of 2 judged logs show a fault. → {folder / 'fleet.html'}"
    assert len(lines) == 3
    assert re.match(r"fault +flight\.mat +ELEVATOR JAMMED at", lines[1])
    assert lines[2].endswith(" ELEVATOR JAMMED, IGNORES SMALL COMMANDS; RUDDER OFF")  # no room for their numbers
    assert all(len(line) <= 80 for line in lines[1:])
    page = (folder / "fleet.html").read_text(encoding="utf-8")
    links = re.findall(r'<th scope="row"><a href="([^"]+)">', page)
    assert [link.partition(".")[0] for link in links] == ["flight", "table_three_faults"]
    assert re.findall(r'<a href="(.*?)">', page) == links
    assert all((folder / link).is_file() for link in links)
    assert page.count('<svg class="thumbnail') == 2
    assert '<table class="stack sortable">' in page
    assert looked(capsys, *words)[1] == lines  # the pages are no logs


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["missing.bin"], "missing.bin: no such file"),
        (["audti"], "no such file, and unknown verb 'audti'; did you mean audit?"),
        (["page.html"], "page.html"),
        (["--servo=s9254"], "--servo"),
        ([], "a log or a verb is needed"),
    ],
)
def test_what_is_no_log_is_one_line(
    words: list[str], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "page.html").write_text("<html><p>no log</html>")
    try:
        code = main(words)
    except SystemExit as ended:
        code = int(str(ended.code))
    err = capsys.readouterr().err
    assert code == 2
    assert says in err
    assert err.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["page.html"]


def test_an_endpoint_is_for_the_monitor(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["udpin:127.0.0.1:14555"])
    assert "servofd monitor" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("display", "terminal", "words", "opened"),
    [(":0", True, [], 1), ("", True, [], 0), (":0", False, [], 0), (":0", True, ["--no-open"], 0)],
)
def test_the_page_is_opened_where_somebody_can_see_it(
    display: str,
    terminal: bool,
    words: list[str],
    opened: int,
    flight: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    seen: list[str] = []
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr("sys.stdout.isatty", lambda: terminal)
    monkeypatch.setattr(webbrowser, "open", seen.append)
    main([str(flight), "-s", "rudder", *words])
    capsys.readouterr()
    assert seen == [flight.with_suffix(".html").as_uri()] * opened
