"""Names from outside act nowhere: terminal, page, picture, TOML, tables, and file names that are no UTF-8."""

from __future__ import annotations

import os
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from servofd.cli import main
from servofd.cli.terminal import complain, console, say
from servofd.core.toml_text import toml_value
from servofd.outputs.chart import Chart, Curve, Panel
from servofd.outputs.document import Document, Figures
from servofd.outputs.figure import chart_png
from servofd.outputs.page import html_page
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel
from tests.fleet.conftest import in_line

ACTS = [*map(chr, range(8)), "\x1b", "\x7f", "\x80", "\x9b", "\u202e", "\ufeff"]
HOSTILE = "a<script>alert(1)</script>\x9b31m\u202ex\\1\\g<2>$\\frac$'"
KNOWN = ("--servo", "hs225bb-eq31")
NAMES = ["a\x1b[31m\x9b2J", "<script>alert(1)</script>", "x\\1\\g<2>$\\frac$\"']]>"]


def flight(path: Path, surface: str) -> str:
    time_s = np.arange(1500) / 50
    command = 5.0 * np.sin(2.0 * time_s)
    rows = "".join(f"{t:.2f},{c:.4f},{p:.4f}\n" for t, c, p in zip(time_s, command, np.roll(command, 2), strict=True))
    path.write_text(f'time_s,"{surface}_cmd_deg","{surface}_pos_deg"\n{rows}'.replace("\"'", "'"), encoding="utf-8")
    return str(path)


def lively(path: Path, surface: str, seed: int) -> str:
    """Motion of a known servo, from which it can be identified."""
    rng, time_s = np.random.default_rng(seed), np.arange(1250) / 50
    walk = np.cumsum(rng.normal(size=time_s.size))
    command = np.clip(1.5 * (walk - np.convolve(walk, np.full(100, 0.01), "same")), -18.0, 18.0)
    command = np.convolve(command, np.full(5, 0.2), "same")
    moved = ServoModel.of(servo_named("hs225bb-eq31")).simulate(time_s, command, time_s)
    position = moved + 0.02 * rng.normal(size=time_s.size)
    rows = "".join(f"{t:.2f},{c:.3f},{p:.3f}\n" for t, c, p in zip(time_s, command, position, strict=True))
    path.write_text(f'time_s,"{surface}_cmd_deg","{surface}_pos_deg"\n{rows}', encoding="utf-8")
    return str(path)


@pytest.mark.slow
def test_an_audit_of_a_hostile_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("servofd.fleets.run.run_local", in_line)
    surface = HOSTILE
    bad = b"\xff" if sys.platform == "linux" else b""  # elsewhere no file has such a name
    log = flight(tmp_path / os.fsdecode(b"fl" + bad + b"\x1b[2Jight.csv"), surface)
    page, out = tmp_path / "a.html", tmp_path / "out"
    assert main(["audit", log, "--html", str(page), "-o", str(out)]) in (0, 2)
    said = capsys.readouterr()
    for text in (said.out, said.err, page.read_text(encoding="utf-8")):
        assert not [sign for sign in ACTS if sign in text]
    assert "<script>alert" not in page.read_text(encoding="utf-8")
    assert len(list(out.iterdir())) == 3
    assert main(["audit", str(tmp_path), "-o", str(tmp_path / "fleet")]) in (0, 2)


@pytest.mark.slow
def test_every_other_page_of_a_hostile_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for runs in ("servofd.fleets.run", "servofd.wear.trend"):
        monkeypatch.setattr(f"{runs}.run_local", in_line)
    surface, plane = HOSTILE, tmp_path / "plane.toml"
    bad = os.fsdecode(b"\xff\n") if sys.platform == "linux" else ""
    logs = [lively(tmp_path / f"fl{bad}ight{number}.csv", surface, number) for number in range(2)]
    assert main(["config", logs[0]]) == 0
    plane.write_text(capsys.readouterr().out, encoding="utf-8")
    for words in (
        ["trend", *logs, "-c", str(plane), "--html", str(tmp_path / "trend.html")],
        ["explain", logs[0], "-s", surface, *KNOWN, "--html", str(tmp_path / "explain.html")],
        ["identify", logs[0], "--html", str(tmp_path / "identify.html"), "--save", str(tmp_path / "servo.toml")],
        [*logs, *KNOWN, "--no-open", "-o", str(tmp_path / "pages")],
        ["info", logs[0]],
        ["calibrate", *logs, "-o", str(tmp_path / "calibrated.toml")],
        ["explain", *logs, "-c", str(plane), "--save", str(tmp_path / "explained.toml")],
    ):
        assert main(words) in (0, 1, 2), words
    said = capsys.readouterr()
    pages = {page.name: page.read_text(encoding="utf-8") for page in tmp_path.rglob("*.html")}
    assert {"trend.html", "explain.html", "identify.html"} < pages.keys()
    assert len(pages) > 4
    for text in (said.out, said.err, *pages.values()):
        assert not [sign for sign in ACTS if sign in text]
        assert "Traceback" not in text
    assert not [name for name, text in pages.items() if "<script>alert" in text]
    for written in tmp_path.glob("*.toml"):
        assert tomllib.loads(written.read_text(encoding="utf-8"))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_picture_of_a_hostile_name(name: str) -> None:
    curve = Curve(name, "measured", np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    chart = Chart(f"{name} $x$ \udcff", name, 0.0, 1.0, (Panel.around(name, name, [curve]),))
    assert "<script>alert" not in html_page(Document(name, "healthy", name, parts=[Figures(lambda: [chart])]))
    assert chart_png(chart)[:4] == b"\x89PNG"


@pytest.mark.parametrize("name", [*NAMES, "\udcff", "\x7f\u2028", "ok"])
def test_toml_holds_any_name(name: str) -> None:
    text = toml_value({name: name, "list": [name]})
    assert not [sign for sign in ACTS if sign in text]
    whole = name.replace("\udcff", "\ufffd")
    assert tomllib.loads(f"v = {text}")["v"] == {whole: whole, "list": [whole]}


def test_what_is_printed_acts_nowhere(capsys: pytest.CaptureFixture[str]) -> None:
    say("a\x1bb\udcff c\td")
    complain("x\x9by\nz")
    with pytest.raises(SystemExit):
        main(["audit", "--\x1b[2J"])
    console(force_terminal=True, color_system="truecolor").print("[red]x[/] :smile: \x1b]0;y\x9c", style="bold")
    said = capsys.readouterr()
    first, second = said.out.splitlines()
    assert first == "a\\x1bb\\udcff c\td"
    assert "[red]x[/] :smile: \\x1b]0;y\\x9c" in second
    assert "\x1b[1m" in second  # rich's own
    assert said.err.startswith("servofd: x\\x9by z\n")
    assert not [sign for sign in ACTS if sign in said.err]
